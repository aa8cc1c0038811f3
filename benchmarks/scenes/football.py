"""A rendered football scene with true boxes, for tracking without a video."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key, UInt8

from mpfjax.checks import Count, CountOrZero, checked

_PITCH_DEPTH = (22.0, 52.0)
_PLAYER_HEIGHT = 1.85
_CAMERA_HEIGHT = 11.0
_SEGMENT = 36
_KITS = (  # shirt, shorts, socks
    ((196, 30, 42), (240, 238, 232), (196, 30, 42)),
    ((236, 238, 240), (28, 38, 92), (236, 238, 240)),
)
_BOARDS = np.array(((24, 58, 120), (214, 176, 40), (232, 232, 230), (30, 96, 88)), np.float32)
_SKIN = ((224, 182, 150), (141, 94, 64), (196, 146, 110), (96, 64, 44))
_HAIR = ((52, 36, 24), (20, 16, 14), (122, 88, 46), (24, 20, 18))


class Scene(NamedTuple):
    """A rendered video and its ground truth.

    - `frames`: RGB, shape (t, h, w, 3).
    - `tracks`: rows (frame, id, x, y, w, h) of every player's true box, in MOTChallenge form:
      frames count from 1, and (x, y) is the top-left corner in pixels. A player who is hidden by
      another has a box too.
    - `kits`: the kit of each player by id, 0 for the players to track and 1 for the others.
    """

    frames: UInt8[np.ndarray, "t h w 3"]
    tracks: Float[np.ndarray, "rows 6"]
    kits: dict[int, int]


class _Camera(NamedTuple):
    """A camera on the stand that turns from side to side."""

    yaw: float
    tilt: float
    focal: float
    height: int
    width: int

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(u, v) in pixels of points (x, y, z) in metres, and their scale in pixels a metre."""
        right, forward, up = self._axes()
        offsets = points - np.array([0.0, 0.0, _CAMERA_HEIGHT])
        scale = self.focal / (offsets @ forward)
        u = self.width / 2 + scale * (offsets @ right)
        v = self.height / 2 - scale * (offsets @ up)
        return np.stack([u, v], axis=-1), scale

    def ground(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The point (x, y) in metres where each pixel meets the ground, and metres per pixel."""
        right, forward, up = (axis.astype(np.float32) for axis in self._axes())
        u = np.arange(self.width, dtype=np.float32)[None, :, None] + 0.5 - self.width / 2
        v = self.height / 2 - np.arange(self.height, dtype=np.float32)[:, None, None] - 0.5
        rays = self.focal * forward + u * right + v * up
        # Rays at or above the horizon meet no ground; other things are drawn there.
        reach = _CAMERA_HEIGHT / np.maximum(-rays[:, :, 2], np.float32(1e-3))
        return reach * rays[:, :, 0], reach * rays[:, :, 1], reach

    def _axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        sin, cos = np.sin(self.yaw), np.cos(self.yaw)
        right = np.array([cos, -sin, 0.0])
        level = np.array([sin, cos, 0.0])
        forward = level * np.cos(self.tilt) - np.array([0, 0, np.sin(self.tilt)])
        up = level * np.sin(self.tilt) + np.array([0, 0, np.cos(self.tilt)])
        return right, forward, up


@checked
def football_scene(
    key: Key[Array, ""],
    num_frames: Count = 120,
    *,
    num_players: Count = 4,
    num_opponents: CountOrZero = 4,
    height: Count = 288,
    width: Count = 512,
    still_camera: bool = False,
) -> Scene:
    """Render players of two teams on a pitch, seen by a camera that pans with the play.

    Players of a team differ only in skin and hair. About every two seconds, at 12 frames a second,
    two players of a team change places and cross on the way. The players to track, of kit 0, have
    the ids from 1 on; the ids of their opponents follow. The same key gives the same scene. With
    `still_camera` the camera does not move, as background subtraction requires.

    Raises `ValueError` for no frames, no pixels, fewer than one player or a negative number of
    opponents.
    """
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel().tolist())
    kits = [0] * num_players + [1] * num_opponents
    paths = np.concatenate(
        [_team_paths(rng, num_frames, kits.count(kit), kit) for kit in sorted(set(kits))], axis=1
    )
    turf, crowd = (rng.random(size, dtype=np.float32) for size in ((256, 256), (64, 256)))
    strides = rng.random(len(kits))
    frames, rows = [], []
    cameras = _cameras(paths[:, :num_players], height, width)
    if still_camera:
        cameras = cameras[:1] * num_frames
    for t, camera in enumerate(cameras):
        frame = _background(camera, turf, crowd)
        rows += _draw_players(frame, camera, paths[: t + 1], kits, strides)
        noise = 2.5 * rng.standard_normal((height, width, 1), dtype=np.float32)
        frames.append(np.clip(frame + noise, 0, 255).astype(np.uint8))
    return Scene(np.stack(frames), np.array(rows), dict(enumerate(kits, 1)))


def _team_paths(rng: np.random.Generator, num_frames: int, size: int, kit: int) -> np.ndarray:
    """(t, players, 2) in metres: stations across the pitch, at which pairs change places."""
    across = (np.arange(size) - (size - 1) / 2) * 4.6 + 2.0 * kit
    depth = 33.0 + 4.5 * (np.arange(size) % 2) + 2.5 * kit
    stations = np.stack([across, depth], axis=1) + rng.normal(0, 0.8, (size, 2))
    order, corners = np.arange(size), [stations]
    for _ in range(num_frames // _SEGMENT + 2):
        first = rng.integers(max(size - 1, 1))
        swap = order.copy()
        swap[[first, min(first + 1, size - 1)]] = order[[min(first + 1, size - 1), first]]
        order = swap
        corners.append(stations[order] + rng.normal(0, 1.0, (size, 2)))
    t = np.arange(num_frames) / _SEGMENT + 0.35 * kit
    whole, part = t.astype(int), t % 1.0
    ease = (part - np.sin(2 * np.pi * part) / (2 * np.pi))[:, None, None]
    corners = np.array(corners)
    sway = 0.35 * np.sin(0.21 * np.arange(num_frames)[:, None] + rng.random(size) * 6.3)
    paths = (1 - ease) * corners[whole] + ease * corners[whole + 1]
    return paths + np.stack([sway, 0.5 * sway], axis=-1)


def _cameras(paths: np.ndarray, height: int, width: int) -> list[_Camera]:
    """A camera for each frame that follows the players, and swings a little past them."""
    swing = 0.09 * np.sin(2 * np.pi * np.arange(len(paths)) / 90)
    yaw = np.arctan2(paths[:, :, 0].mean(1), paths[:, :, 1].mean(1)) + swing
    return [_Camera(float(angle), 0.285, 2.6 * height, height, width) for angle in yaw]


def _background(camera: _Camera, turf: np.ndarray, crowd: np.ndarray) -> np.ndarray:
    x, y, span = camera.ground()
    mown = 0.5 + 0.5 * np.tanh(6 * np.sin(2 * np.pi * x / 9.0))
    grass = _rgb(52, 122, 48) + mown[:, :, None] * _rgb(14, 20, 10)
    grain = _texture(turf, 4 * x, 4 * y) + _texture(turf, 0.7 * x, 0.7 * y) - 1
    frame = grass * (1 + 0.16 * grain[:, :, None])
    for distance in _line_distances(x, y):
        strength = np.clip(0.5 + (0.07 - distance) / span, 0, 1) * np.clip(0.14 / span, 0, 1)
        frame += 0.85 * strength[:, :, None] * (_rgb(238, 240, 234) - frame)
    return _stand(frame, camera, x, y, crowd)


def _line_distances(x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    """How far each point of the ground is from each line on the pitch, in metres."""
    near, far = _PITCH_DEPTH
    outside = np.maximum(np.maximum(near - y, y - far), 0)
    circle = np.abs(np.hypot(x, y - (near + far) / 2) - 7.0)
    box = np.maximum(np.abs(x + 24) - 6, np.abs(y - (near + far) / 2) - 9)
    return [np.abs(y - far), np.abs(y - near), np.hypot(x, outside), circle, np.abs(box)]


def _stand(
    frame: np.ndarray, camera: _Camera, x: np.ndarray, y: np.ndarray, crowd: np.ndarray
) -> np.ndarray:
    """Boards along the far side, and the crowd behind them."""
    far = _PITCH_DEPTH[1] + 3.0
    foot, scale = camera.project(np.array([[0.0, far, 0.0]]))
    rows = np.arange(camera.height, dtype=np.float32)[:, None] + 0.5
    above = np.float32(1 / scale[0]) * (np.float32(foot[0, 1]) - rows) + 0 * x
    stand = (y > far) | (y < 0) | (above > 0)
    last = int(np.flatnonzero(stand.any(axis=1)).max(initial=-1)) + 1
    x, y, above, stand = x[:last], y[:last], above[:last], stand[:last, :, None]
    across = far * x / np.maximum(np.abs(y), 1.0)
    panel = np.floor(across / 8.0).astype(int) % 4
    people = _texture(crowd, 2.4 * across, 2.6 * above)
    hue = _texture(crowd, 2.4 * across + 91, 2.6 * above + 17)
    tint = np.stack([hue, 0.75 + 0 * hue, 1 - hue], axis=-1)
    seats = 36 + 110 * people[:, :, None] ** 2 * tint
    covered = np.where((above < 1.1)[:, :, None], _BOARDS[panel], seats)
    frame[:last] = np.where(stand, covered, frame[:last])
    return frame


def _rgb(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def _texture(tile: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A tile of random values repeated over the plane and smoothed between its points."""
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = x - x0, y - y0
    height, width = tile.shape
    left, right, top, bottom = x0 % width, (x0 + 1) % width, y0 % height, (y0 + 1) % height
    upper = tile[top, left] * (1 - fx) + tile[top, right] * fx
    return upper * (1 - fy) + (tile[bottom, left] * (1 - fx) + tile[bottom, right] * fx) * fy


def _draw_players(
    frame: np.ndarray, camera: _Camera, paths: np.ndarray, kits: list[int], strides: np.ndarray
) -> list[list[float]]:
    """Draw all players, the farthest first, and return their rows of the truth."""
    t, rows = len(paths), {}
    walked = np.linalg.norm(np.diff(paths, axis=0), axis=-1).sum(axis=0)
    for i in np.argsort(-paths[-1, :, 1]):
        foot = np.array([*paths[-1, i], 0.0])
        (where,), (scale,) = camera.project(foot[None])
        speed = 0.0 if t == 1 else float(np.linalg.norm(paths[-1, i] - paths[-2, i]))
        heading = 1.0 if t == 1 or paths[-1, i, 0] >= paths[-2, i, 0] else -1.0
        phase = 2 * np.pi * float(walked[i] / 1.7 + strides[i])
        gait = min(speed / 0.22, 1.0)
        _draw_player(frame, where, scale, kits[i], int(i), phase, gait, heading)
        tall, wide = _PLAYER_HEIGHT * scale, 0.82 * scale
        corner = np.array([where[0] - wide / 2, where[1] - 0.98 * tall])
        rows[i] = [float(t), float(i + 1), *corner.tolist(), float(wide), float(tall)]
    return [rows[i] for i in sorted(rows)]


def _draw_player(
    frame: np.ndarray, foot: np.ndarray, scale: float, kit: int, who: int, phase: float,
    gait: float, heading: float,
) -> None:  # fmt: skip
    shirt, shorts, socks = (np.array(colour, float) for colour in _KITS[kit])
    skin, hair = np.array(_SKIN[who % 4], float), np.array(_HAIR[who % 4], float)

    def at(across: float, up: float) -> tuple[float, float]:
        return float(foot[0] + across * scale), float(foot[1] - up * scale)

    def limb(start: tuple, end: tuple, width: float, colour: np.ndarray) -> None:
        _draw_stroke(frame, at(*start), at(*end), width * scale, colour)

    _draw_ellipse(frame, at(0.25, 0.0), (0.55 * scale, 0.13 * scale), np.zeros(3), opacity=0.4)
    for side, shade in ((-1.0, 0.82), (1.0, 1.0)):
        swing = side * gait * np.sin(phase)
        lift = 0.16 * gait * max(0.0, side * np.cos(phase))
        knee = (0.07 * side + 0.22 * swing + 0.05 * heading * gait, 0.48 + 0.3 * lift)
        ankle = (0.07 * side + 0.34 * swing - 0.5 * heading * lift, 0.07 + lift)
        limb((0.07 * side, 0.88), knee, 0.085, shade * skin)
        limb(knee, ankle, 0.07, shade * socks)
        limb(ankle, (ankle[0] + 0.1 * heading, ankle[1] - 0.02), 0.055, np.array([25.0, 25, 28]))
        limb((0.08 * side, 0.95), (0.07 * side + 0.12 * swing, 0.68), 0.115, shade * shorts)
    for side, shade in ((-1.0, 0.85), (1.0, 1.0)):
        swing = -side * gait * np.sin(phase)
        elbow = (0.24 * side + 0.12 * swing, 1.16)
        hand = (0.25 * side + 0.28 * swing + 0.06 * heading * gait, 0.94 + 0.1 * gait)
        limb((0.19 * side, 1.42), elbow, 0.075, shade * shirt)
        limb(elbow, hand, 0.05, shade * skin)
    lean = 0.05 * heading * gait
    limb((lean - 0.08, 1.38), (-0.06, 1.02), 0.14, 0.92 * shirt)
    limb((lean + 0.08, 1.38), (0.06, 1.02), 0.14, shirt)
    limb((lean, 1.5), (lean, 1.56), 0.06, skin)
    _draw_ellipse(frame, at(1.2 * lean, 1.68), (0.115 * scale, 0.14 * scale), skin)
    _draw_ellipse(frame, at(1.2 * lean - 0.02 * heading, 1.76), (0.12 * scale, 0.08 * scale), hair)


def _draw_ellipse(
    frame: np.ndarray, centre: tuple[float, float], radii: tuple[float, float], colour: np.ndarray,
    opacity: float = 1.0,
) -> None:  # fmt: skip
    """Draw a filled ellipse along the axes."""
    (cx, cy), (rx, ry) = centre, radii
    window = _window(frame, np.subtract(centre, radii), np.add(centre, radii), 1)
    if window is None:
        return
    part, x, y = window
    inside = (1 - np.hypot((x - cx) / rx, (y - cy) / ry)) * min(rx, ry)
    _blend(part, np.clip(inside + 0.5, 0, 1) * opacity, colour)


# Smooth strokes on a float frame, with values in [0, 255].


def _draw_stroke(
    frame: Float[np.ndarray, "h w 3"],
    start: tuple[float, float],
    end: tuple[float, float],
    radius: float,
    colour: Float[np.ndarray, "3"],
) -> None:
    """Draw a line of half-width `radius` with round ends; a dot where the ends coincide."""
    (x0, y0), (x1, y1) = start, end
    window = _window(frame, np.minimum(start, end), np.maximum(start, end), radius + 1)
    if window is None:
        return
    part, x, y = window
    dx, dy = x1 - x0, y1 - y0
    along = ((x - x0) * dx + (y - y0) * dy) / max(dx * dx + dy * dy, 1e-9)
    along = np.clip(along, 0, 1)
    distance = np.hypot(x - x0 - along * dx, y - y0 - along * dy)
    _blend(part, np.clip(radius + 0.5 - distance, 0, 1), colour)


def _window(
    frame: np.ndarray, low: np.ndarray, high: np.ndarray, more: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """The part of the frame between two corners and so many pixels more, and its pixels."""
    x0, y0 = np.maximum(np.floor(low - more), 0).astype(int)
    x1, y1 = np.minimum(np.ceil(high + more), frame.shape[1::-1]).astype(int)
    if x0 >= x1 or y0 >= y1:
        return None
    return frame[y0:y1, x0:x1], np.arange(x0, x1)[None] + 0.5, np.arange(y0, y1)[:, None] + 0.5


def _blend(part: np.ndarray, opacity: np.ndarray, colour: np.ndarray) -> None:
    """Colour pixels, each by its opacity."""
    part += opacity[:, :, None] * (colour - part)
