"""Folders of images, videos and GIFs in and out."""

import signal
import sys

import numpy as np
import pytest
from PIL import Image as pillow

from mpfjax.vision.frames import num_images, read_frames, write_image, write_video


def shades(num, height=32, width=48):
    """Frames of one shade each, which any lossy codec keeps."""
    frames = np.zeros((num, height, width, 3), np.uint8)
    frames[:] = np.linspace(20, 220, num).astype(np.uint8)[:, None, None, None]
    return frames


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "img").mkdir()
    for i, frame in enumerate(shades(5), 1):
        write_image(tmp_path / "img" / f"{i:06d}.png", frame)
    return tmp_path


def test_a_folder_is_read_in_order_and_both_ends_are_in(folder):
    np.testing.assert_array_equal(np.stack(list(read_frames(folder, 2, 4))), shades(5)[1:4])
    np.testing.assert_array_equal(np.stack(list(read_frames(folder / "img"))), shades(5))
    assert num_images(folder) == 5


@pytest.mark.parametrize("ending", ["mp4", "gif"])
@pytest.mark.filterwarnings("ignore:os.fork")
def test_a_video_comes_back(tmp_path, ending):
    path = tmp_path / f"video.{ending}"
    write_video(path, iter(shades(6)))
    back = np.stack(list(read_frames(path, 2, 5))).astype(int)
    assert back.shape == (4, 32, 48, 3)
    assert np.abs(back - shades(6)[1:5]).max() <= 8


@pytest.mark.filterwarnings("ignore:os.fork")
def test_an_odd_size_is_padded_for_an_mp4(tmp_path):
    write_video(tmp_path / "odd.mp4", shades(3, 31, 47))
    assert next(read_frames(tmp_path / "odd.mp4")).shape == (32, 48, 3)


def test_a_missing_path_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone\.mp4"):
        next(read_frames(tmp_path / "gone.mp4"))


@pytest.mark.filterwarnings("ignore:os.fork")
@pytest.mark.parametrize("name", ["broken.mp4", "broken.gif", "img/000001.png"])
def test_an_unreadable_file_is_named(tmp_path, name):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"not a picture")
    with pytest.raises(ValueError, match=rf"{path.name}: cannot be read"):
        list(read_frames(tmp_path if name.startswith("img") else path))


def test_a_range_past_the_end_and_an_empty_one_are_named(folder):
    with pytest.raises(ValueError, match="holds 5 images, frame 6"):
        next(read_frames(folder, 6))
    with pytest.raises(ValueError, match="first, last: 4, 2"):
        next(read_frames(folder, 4, 2))


def test_frames_of_different_sizes_are_named(folder):
    write_image(folder / "img" / "000006.png", shades(1, 10, 10)[0])
    with pytest.raises(ValueError, match="different sizes"):
        list(read_frames(folder))


@pytest.mark.parametrize("mode", ["L", "LA", "1", "I;16", "P", "RGBA"])
def test_whatever_an_image_holds_it_becomes_three_channels_of_eight_bits(tmp_path, mode):
    """Grey, grey with transparency, black and white, 16 bits, a palette, colours likewise."""
    grey = np.tile(np.linspace(0, 255, 48).astype(np.uint8), (32, 1))
    if mode == "1":
        grey = np.where(grey > 127, 255, 0).astype(np.uint8)
    image = pillow.fromarray(grey)
    if mode == "I;16":
        image = pillow.fromarray(grey.astype(np.uint16) * 257)
    elif mode == "RGBA":
        image = image.convert("RGB").convert(mode)
    else:
        image = image.convert(mode)
    image.save(tmp_path / "1.png")
    (frame,) = read_frames(tmp_path)
    assert frame.dtype == np.uint8
    assert frame.shape == (32, 48, 3)
    np.testing.assert_array_equal(frame, np.repeat(grey[:, :, None], 3, axis=2))


@pytest.mark.filterwarnings("ignore:os.fork")
def test_a_video_of_a_single_grey_frame_comes_back(tmp_path):
    for ending in ("mp4", "gif"):
        path = tmp_path / f"single.{ending}"
        write_video(path, shades(2)[1:])
        (frame,) = read_frames(path)
        assert frame.shape == (32, 48, 3)
        assert np.abs(frame.astype(int) - 220).max() <= 8


def test_another_ending_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"path: .*video\.avi"):
        write_video(tmp_path / "video.avi", shades(2))


def test_a_missing_imageio_says_how_to_install_it(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio.v3", None)
    with pytest.raises(ImportError, match=r'pip install "mpfjax\[video\]"'):
        next(read_frames(folder))


def test_an_interrupt_while_a_frame_is_written_leaves_a_whole_video(tmp_path, monkeypatch):
    from imageio.plugins.ffmpeg import FfmpegFormat

    append_data = FfmpegFormat.Writer._append_data
    written = []

    def interrupted(writer, *rest):
        written.append(1)
        if len(written) == 3:
            signal.raise_signal(signal.SIGINT)
        append_data(writer, *rest)

    monkeypatch.setattr(FfmpegFormat.Writer, "_append_data", interrupted)
    stills = [np.full((32, 32, 3), 10 * i, np.uint8) for i in range(5)]
    # A process that a shell started in the background ignores Ctrl-C, and so would this test.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            write_video(tmp_path / "video.mp4", stills)
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(list(read_frames(tmp_path / "video.mp4"))) == 3
