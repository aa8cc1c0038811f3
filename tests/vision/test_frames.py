"""Folders of images, videos and GIFs in and out."""

import struct
from fractions import Fraction

import numpy as np
import pytest
from PIL import Image

from mpfjax.vision.files.frames import frame_rate, num_images, read_frames, write_video


def shades(num, height=32, width=48):
    """Frames of one shade each, which any lossy codec keeps."""
    frames = np.zeros((num, height, width, 3), np.uint8)
    frames[:] = np.linspace(20, 220, num).astype(np.uint8)[:, None, None, None]
    return frames


def test_images_come_in_natural_order_without_hidden_companions(tmp_path):
    names = ["1.png", "02.png", "2.png", "10.png", "11.png", "a1.png", "a1b9.png", "a1b10.png"]
    (tmp_path / "img").mkdir()
    for name, still in zip(names, shades(len(names)), strict=True):
        Image.fromarray(still).save(tmp_path / "img" / name)
    (tmp_path / "img" / "._1.png").write_bytes(b"what another system says of 1.png")
    assert num_images(tmp_path) == len(names)
    np.testing.assert_array_equal(np.stack(list(read_frames(tmp_path / "img"))), shades(len(names)))
    np.testing.assert_array_equal(np.stack(list(read_frames(tmp_path, 2, 4))), shades(8)[1:4])


@pytest.mark.parametrize("ending", ["jpg", "png", "tif", "tiff", "webp"])
def test_an_image_is_turned_as_its_file_says(tmp_path, ending):
    """As OpenCV does, on which detectors run."""
    still = np.zeros((32, 48, 3), np.uint8)
    still[:16, :24] = 200
    image, exif = Image.fromarray(still), Image.Exif()
    exif[0x0112] = 6  # a camera held upright: to be turned by a quarter
    image.save(tmp_path / f"1.{ending}", exif=exif)
    (frame,) = read_frames(tmp_path)
    assert frame.shape == (48, 32, 3)
    assert np.abs(frame - np.rot90(still, -1).astype(float)).mean() < 5


def at_times(path, times, stills, codec="libx264", options=None):
    """A video whose frames are at these multiples of 1/600 s."""
    av = pytest.importorskip("av", reason="the extra 'video' is missing")
    with av.open(str(path), "w") as video:
        stream = video.add_stream(codec, rate=30, options=options)
        stream.height, stream.width, stream.pix_fmt = *stills.shape[1:3], "yuv420p"
        stream.codec_context.time_base = Fraction(1, 600)
        for time, still in zip(times, stills, strict=True):
            frame = av.VideoFrame.from_ndarray(still, format="rgb24")
            frame.pts, frame.time_base = int(time), Fraction(1, 600)
            video.mux(stream.encode(frame))
        video.mux(stream.encode())


def test_a_video_of_variable_frame_rate_has_the_frames_that_it_holds(tmp_path):
    """30 and 10 a second by turns: resampled to the higher rate they would be twice as many."""
    path, stills = tmp_path / "varies.mp4", shades(12)
    at_times(path, np.cumsum([0] + [60, 20] * 5 + [60]).tolist(), stills)
    back = np.stack(list(read_frames(path))).astype(int)
    assert back.shape == stills.shape
    assert np.abs(back - stills).max() <= 8
    np.testing.assert_array_equal(back[4:7], np.stack(list(read_frames(path, 5, 7))))
    assert frame_rate(path) == pytest.approx(15, rel=0.1)
    times: list[float] = []
    assert [times[-1] for _ in read_frames(path, 2, 4, times=times)] == times
    np.testing.assert_allclose(times, [0.1, 0.1 + 1 / 30, 0.2 + 1 / 30], atol=1e-3)


# a, b, c, d of a file that moves (x, y) to (a x + c y, b x + d y), and what becomes of a frame.
TURNS = {
    (0, 1, -1, 0): lambda still: np.rot90(still, -1),
    (-1, 0, 0, -1): lambda still: np.rot90(still, 2),
    (0, -1, 1, 0): np.rot90,
    (-1, 0, 0, 1): lambda still: still[:, ::-1],
    (0, 1, 1, 0): lambda still: still.transpose(1, 0, 2),
}


@pytest.mark.parametrize(("turn", "turned"), TURNS.items(), ids=[str(turn) for turn in TURNS])
def test_a_video_is_turned_and_mirrored_as_its_file_says(tmp_path, turn, turned):
    still = shades(1)[0].copy()
    still[:8, :24] = (220, 30, 30)
    path = tmp_path / "turned.mp4"
    at_times(path, [0, 20], np.stack([still, still]))
    (upright, _) = read_frames(path)
    content = path.read_bytes()
    place = content.index(b"tkhd") + 44
    a, b, c, d = (65536 * number for number in turn)
    matrix = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(content[:place] + matrix + content[place + len(matrix) :])
    np.testing.assert_array_equal(next(read_frames(path)), turned(upright))


@pytest.mark.parametrize("ending", ["mp4", "gif"])
def test_a_video_comes_back(tmp_path, ending):
    path = tmp_path / f"video.{ending}"
    write_video(path, iter(shades(6)))
    back = np.stack(list(read_frames(path, 2, 5))).astype(int)
    assert back.shape == (4, 32, 48, 3)
    assert np.abs(back - shades(6)[1:5]).max() <= 8


@pytest.mark.parametrize("name", ["cam:1.mp4", "2026-11-27T06:47:01.mp4", "06:47/a b%20c.mp4"])
def test_a_path_with_a_colon_is_a_path(tmp_path, monkeypatch, name):
    """To FFmpeg the words before it are else a protocol."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    write_video(name, iter(shades(3)))
    assert len(list(read_frames(name))) == 3
    assert frame_rate(name) == 10.0


@pytest.mark.parametrize("name", ["broken.mp4", "broken.gif", "img/000001.png"])
def test_an_unreadable_file_is_named(tmp_path, name):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"not a picture")
    with pytest.raises(ValueError, match=rf"{path.name}: cannot be read") as raised:
        list(read_frames(tmp_path if name.startswith("img") else path))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
def test_frames_after_a_damaged_one_keep_their_numbers(tmp_path, codec):
    """With frames that are decoded in another order than they are shown in."""
    path = tmp_path / "damaged.mp4"
    noise = np.random.default_rng(0).integers(0, 256, (40, 64, 96, 3), dtype=np.uint8)
    at_times(path, 24 * np.arange(40), noise, codec, {"bf": "2"})
    whole, content = np.stack(list(read_frames(path))).astype(int), bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 3000] = bytes(3000)
    path.write_bytes(content)
    with pytest.warns(RuntimeWarning, match=r"damaged\.mp4: \d+ frames are too dam") as warned:
        frames = list(read_frames(path))
    damaged = [number for number, frame in enumerate(frames, 1) if frame is None]
    numbers = ", ".join(map(str, damaged))
    assert str(warned[0].message).endswith(
        f" {len(damaged)} frames are too damaged to be decoded: {numbers}"
    )
    assert len(frames) == len(whole) == 40
    assert 0 < len(damaged) < 10
    for number in range(max(damaged), 40):
        assert np.abs(whole - frames[number]).mean(axis=(1, 2, 3)).argmin() == number
    assert next(read_frames(path, damaged[0], damaged[0])) is None


def test_a_video_shows_the_frame_before_one_that_is_not_there(tmp_path):
    first, second = shades(2)
    write_video(tmp_path / "gaps.mp4", [None, first, None, None, second])
    values = [int(frame.mean()) for frame in read_frames(tmp_path / "gaps.mp4")]
    assert np.abs(np.array(values) - [20, 20, 20, 20, 220]).max() <= 8


@pytest.mark.parametrize("mode", ["L", "LA", "1", "I;16", "P", "RGBA"])
def test_whatever_an_image_holds_it_becomes_three_channels_of_eight_bits(tmp_path, mode):
    """Grey, grey with transparency, black and white, 16 bits, a palette, colours likewise."""
    grey = np.tile(np.linspace(0, 255, 48).astype(np.uint8), (32, 1))
    if mode == "1":
        grey = np.where(grey > 127, 255, 0).astype(np.uint8)
    image = Image.fromarray(grey)
    if mode == "I;16":
        image = Image.fromarray(grey.astype(np.uint16) * 257)
    elif mode == "RGBA":
        image = image.convert("RGB").convert(mode)
    else:
        image = image.convert(mode)
    image.save(tmp_path / "1.png")
    (frame,) = read_frames(tmp_path)
    assert frame.dtype == np.uint8
    assert frame.shape == (32, 48, 3)
    np.testing.assert_array_equal(frame, np.repeat(grey[:, :, None], 3, axis=2))
