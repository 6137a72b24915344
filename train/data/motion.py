"""Whether the images move where the calibration says that the hand is.

From one frame to another the hand moves, and so do the pixels that show it. For every pair of
frames there is a map of how much each part of the image changed, and a prediction: bright at the
two places where the TCP should be. Over all pairs, what the map of a part of the image has more
than that part's usual is correlated with what the prediction has more than usual. The right
calibration gives 0.25 to 0.35 on robosuite's recordings; a mirrored one 0 to 0.15, because the arm,
the table and the shadows are always where they are, and are subtracted.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from palm_jax.align import Camera, distort_points
from palm_jax.train.data.aligning import BLOCK, unequal
from palm_jax.train.data.calibration import AXES, FLIPS, CameraCalibration, as_opencv, turned
from palm_jax.train.data.recording import Recording, inside, projected
from palm_jax.train.data.rotations import about

_THUMBNAIL, _GRID = 96, 48  # pixels a side; the second divides the first
_WIDTH = 4.0  # of the prediction's spots, cells of the grid
_STEP = 0.03  # metres that the TCP moves between the two frames of a pair
_FRAMES = 400  # of how many frames to look
_PAIRS = 96
LEAST_PAIRS = 8

SURE = 3.0
"""Standard errors by which another reading must be better."""

CLEARLY = 1.3
"""Factor by which its correlation must be larger."""

ALIKE = 0.9
"""Correlations from this share of the best on are taken for as good."""


@dataclasses.dataclass(frozen=True)
class Reading:
    """One way to read the calibration and the images."""

    flip: str  # of the stored images, a key of `FLIPS`
    axes: str = "opencv"  # what the stored pose's axes are taken for
    inverse: bool = False  # the stored pose maps the base into the camera
    euler: str | None = None  # the three angles of the pose read in the other order

    @property
    def guessed(self) -> tuple[bool, int]:
        """How much is taken to be wrong, apart from the flip; angles weigh most."""
        return self.euler is not None, (self.axes != "opencv") + self.inverse


@dataclasses.dataclass(frozen=True)
class Finding:
    """How well a reading fits the images."""

    reading: Reading
    score: float  # correlation
    in_view: float  # share of the frames looked at with the TCP in the image
    better: float  # standard errors by which it is better than the calibration as it is
    same: tuple[Reading, ...] = ()  # other readings with the same pixels


@dataclasses.dataclass(frozen=True)
class Motion:
    """The evidence."""

    pairs: int  # of frames; fewer than `LEAST_PAIRS` tell nothing
    as_is: Finding
    others: tuple[Finding, ...]  # the best first

    @property
    def best(self) -> Finding:
        """The best reading, the given one included."""
        first = self.others[:1]
        return max((self.as_is, *first), key=lambda finding: finding.score)

    @property
    def wrong(self) -> bool:
        """Another reading fits clearly better."""
        best = self.best
        return (
            self.pairs >= LEAST_PAIRS
            and best is not self.as_is
            and best.better > SURE
            and best.score > CLEARLY * max(self.as_is.score, 0.02)
        )

    @property
    def tells(self) -> bool:
        """The images move enough to say anything."""
        return self.pairs >= LEAST_PAIRS and (self.wrong or self.as_is.score > 0.1)


def pose_as(pose: np.ndarray, reading: Reading) -> np.ndarray:
    """A camera's pose [4, 4] read in another way."""
    if reading.euler is not None:
        pose = pose.copy()
        pose[:3, :3] = _reread(pose[:3, :3], reading.euler)
    return as_opencv(pose, reading.axes, reading.inverse)


def camera_as(camera: CameraCalibration, episode: str, reading: Reading) -> Camera:
    """The pinhole camera of an episode, its pose read in another way."""
    plain = camera.camera(episode)
    pose = pose_as(np.asarray(plain.cam_to_world, np.float64), reading)
    return dataclasses.replace(plain, cam_to_world=pose.astype(np.float32))


def _reread(rotation: np.ndarray, order: str) -> np.ndarray:
    """The rotation that the same three angles mean in the order "xyz" (fixed) or "XYZ" (own)."""
    if order == "XYZ":  # they were read about fixed axes: R = Rz Ry Rx
        b = np.arcsin(np.clip(-rotation[2, 0], -1, 1))
        a, c = (
            np.arctan2(rotation[2, 1], rotation[2, 2]),
            np.arctan2(rotation[1, 0], rotation[0, 0]),
        )
        return about(0, a) @ about(1, b) @ about(2, c)
    # They were read about the body's own axes: R = Rx Ry Rz.
    b = np.arcsin(np.clip(rotation[0, 2], -1, 1))
    a, c = np.arctan2(-rotation[1, 2], rotation[2, 2]), np.arctan2(-rotation[0, 1], rotation[0, 0])
    return about(2, c) @ about(1, b) @ about(0, a)


def stored_uv(flip: str, uv: np.ndarray, width: int, height: int) -> np.ndarray:
    """Where points uv [..., 2] of an upright width x height image are in the image as stored."""
    u, v = uv[..., 0], uv[..., 1]
    places = {
        "none": (u, v),
        "ud": (u, height - v),
        "lr": (width - u, v),
        "180": (width - u, height - v),
        "cw": (v, width - u),
        "ccw": (height - v, u),
    }
    return np.stack(places[flip], -1)


def seen_uv(camera: CameraCalibration, uv: np.ndarray, flip: str) -> np.ndarray:
    """Where points are in the images as stored, lens and all.

    Args:
      camera: that took them.
      uv: [..., 2] pixels at which a pinhole camera would show them, upright.
      flip: what turns the stored images upright.

    Returns:
      [..., 2]; NaN for points that the lens puts nowhere near the image.
    """
    if camera.dist is not None:
        size = np.array([camera.width, camera.height])
        with np.errstate(invalid="ignore"):
            # Further out the lens model may fold back into the image.
            near = (np.abs(uv - size / 2) < size).all(-1, keepdims=True)
        seen = distort_points(np.where(near, uv, np.nan), camera.K, camera.dist)
        uv = np.asarray(seen, np.float64)
    return stored_uv(flip, uv, camera.width, camera.height)


def readings(camera: CameraCalibration) -> list[Reading]:
    """Every usual mistake, and each flip that fits the shape of the stored images."""
    size = turned(camera.flip, camera.width, camera.height)
    flips = [flip for flip in FLIPS if turned(flip, camera.width, camera.height) == size]
    poses = [(axes, inverse, None) for inverse in (False, True) for axes in AXES]
    angles = [("opencv", inverse, order) for inverse in (False, True) for order in ("xyz", "XYZ")]
    return [Reading(flip, *pose) for flip, pose in itertools.product(flips, [*poses, *angles])]


@dataclasses.dataclass(frozen=True)
class _Pairs:
    episodes: list[str]  # [P]
    points: np.ndarray  # [P, 2, 3] the TCP in the two frames
    maps: np.ndarray  # [P, G * G] what changed, less its usual


def examine(recording: Recording) -> Motion:
    """Looks at up to a few hundred frames; see the top of the module."""
    pairs = _pairs(recording)
    now = Reading(recording.camera.flip)
    if len(pairs.episodes) < 2:
        nothing = Finding(now, 0.0, 0.0, 0.0)
        return Motion(len(pairs.episodes), nothing, ())
    parts, seen = _contributions(recording.camera, pairs, now)
    as_is = Finding(now, float(parts.mean()), seen, 0.0)
    found: list[Finding] = []
    for reading in readings(recording.camera):
        if reading == now:
            continue
        other, visible = _contributions(recording.camera, pairs, reading)
        gain = other - parts
        error = gain.std() / np.sqrt(len(gain))
        better = float(gain.mean() / error) if error > 1e-9 else 0.0
        found.append(Finding(reading, float(other.mean()), visible, better))
    return Motion(len(parts), as_is, _grouped(found))


def _grouped(found: Sequence[Finding]) -> tuple[Finding, ...]:
    """Best first; readings that give the same pixels together, the simplest in front.

    Angles read in another order are a guess: where the pose need not have been made of angles at
    all, a reading without them that fits about as well goes first.
    """
    order = sorted(found, key=lambda f: (-round(f.score, 6), f.reading.guessed))
    groups = []
    for _, members in itertools.groupby(order, key=lambda f: round(f.score, 6)):
        first, *rest = members
        groups.append(dataclasses.replace(first, same=tuple(f.reading for f in rest)))
    alike = ALIKE * groups[0].score if groups else 0.0
    groups.sort(key=lambda f: (f.score < alike, f.score >= alike and f.reading.euler is not None))
    return tuple(groups)


def _contributions(
    camera: CameraCalibration, pairs: _Pairs, reading: Reading
) -> tuple[np.ndarray, float]:
    """[P] whose mean is the correlation, and the share of points in the image."""
    width, height = turned(reading.flip, camera.width, camera.height)
    uv = np.empty((len(pairs.episodes), 2, 2))
    visible = 0
    cameras = {episode: camera_as(camera, episode, reading) for episode in set(pairs.episodes)}
    for index, (episode, points) in enumerate(zip(pairs.episodes, pairs.points, strict=True)):
        uv[index], _ = projected(cameras[episode], points)
        visible += int(inside(cameras[episode], uv[index]).sum())
    cells = seen_uv(camera, uv, reading.flip) * [_GRID / width, _GRID / height]
    grid = np.arange(_GRID) + 0.5
    # A spot is the product of a row and a column; one that is not seen is nothing.
    spots = np.exp(-((grid - cells[..., None]) ** 2) / (2 * _WIDTH**2))
    spots = np.nan_to_num(spots)
    predicted = np.einsum("pky,pkx->pyx", spots[:, :, 1], spots[:, :, 0])
    predicted = predicted.reshape(len(predicted), -1)
    predicted = predicted - predicted.mean(0)
    norm = np.sqrt((pairs.maps**2).sum() * (predicted**2).sum())
    products = (pairs.maps * predicted).sum(1) * len(predicted)
    return products / max(norm, 1e-12), visible / cells[..., 0].size


def _pairs(recording: Recording) -> _Pairs:
    episodes: list[str] = []
    points, maps = [], []
    for name, thumbnails, tcp in _thumbnails(recording):
        for first, second in _steps(tcp):
            change = _pooled(np.abs(thumbnails[second] - thumbnails[first]), _GRID)
            episodes.append(name)
            points.append(tcp[[first, second]])
            # The root: strong edges must not outweigh all else.
            maps.append(np.sqrt(change).ravel())
    if not maps:
        return _Pairs([], np.empty((0, 2, 3)), np.empty((0, _GRID * _GRID)))
    keep = np.unique(np.linspace(0, len(maps) - 1, min(_PAIRS, len(maps))).astype(int))
    stack = np.stack([maps[i] for i in keep])
    stack = stack / np.maximum(stack.sum(1, keepdims=True), 1e-9)
    kept = [episodes[i] for i in keep]
    return _Pairs(kept, np.stack([points[i] for i in keep]), stack - stack.mean(0))


def _steps(tcp: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of frames between which the TCP [T, 3] has moved by `_STEP`."""
    pairs = []
    for first in range(len(tcp) - 1):
        far = np.flatnonzero(np.linalg.norm(tcp[first + 1 :] - tcp[first], axis=1) > _STEP)
        if len(far):
            pairs.append((first, first + 1 + int(far[0])))
    return pairs


def _thumbnails(recording: Recording) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Grey pictures [T, 96, 96] as stored, and TCP positions, of episodes all over the file."""
    source = recording.source
    longest = max(1, max(source.length(name) for name in source.episodes))
    count = int(np.clip(_FRAMES // longest, 1, len(source.episodes)))
    # Short episodes: as many as make up the frames; long ones: their beginnings.
    chosen = np.unique(np.linspace(0, len(source.episodes) - 1, count).astype(int))
    result = []
    for index in chosen:
        name = source.episodes[index]
        tcp = recording.trajectory(name).tcp[:, :3, 3]
        pictures: list[np.ndarray] = []
        for block in source.blocks(name, recording.image_key, BLOCK):
            pictures += [_thumbnail(image) for image in block]
            if len(pictures) >= _FRAMES // count:
                break
        if not pictures:
            raise unequal(recording, name, 0)
        rows = min(len(pictures), len(tcp))
        result.append((name, np.stack(pictures[:rows]), tcp[:rows]))
    return result


def _thumbnail(image: np.ndarray) -> np.ndarray:
    """Grey [96, 96] of an image [H, W, 3]; of a large one, only some pixels count."""
    step = max(1, min(image.shape[:2]) // (2 * _THUMBNAIL))
    return _pooled(image[::step, ::step].mean(-1), _THUMBNAIL)


def _pooled(picture: np.ndarray, side: int) -> np.ndarray:
    """[H, W] -> [side, side] means of areas; small pictures are repeated."""
    edges = [np.arange(side) * size // side for size in picture.shape]
    if min(picture.shape) < side:
        return picture[np.ix_(*edges)]
    sums = np.add.reduceat(np.add.reduceat(picture, edges[0], 0), edges[1], 1)
    sizes = [np.diff([*edge, size]) for edge, size in zip(edges, picture.shape, strict=True)]
    return np.asarray(sums / np.outer(*sizes))
