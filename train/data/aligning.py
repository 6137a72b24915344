"""Frames of a data file to a policy's inputs and labels, in a stream.

The alignment is `palm_jax.align.align`, as in training and on the robot. A thread reads ahead while
frames are aligned eight at a time: on a CPU what is in between then stays in the caches.
"""

from __future__ import annotations

import dataclasses
import itertools
import queue
import threading
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import numpy as np

from palm_jax.align import (
    Aligned,
    AlignSpec,
    Camera,
    achieved_deltas,
    align,
    gripper_labels,
    overwrite_transitions,
    undistort,
)
from palm_jax.train.data.errors import EpisodeLengthError
from palm_jax.train.data.recording import Recording, Trajectory

T = TypeVar("T")

BATCH = 8
BLOCK = 32
"""Frames read at a time: enough for the disk, little for memory (25 MB of 512 pixels)."""

_AHEAD = 2
_PADDED_TO = 64
"""Episodes are padded to a multiple of this many frames: labels then compile for few lengths."""

PAPER_STEP, PAPER_RATE = 0.02, 20.0
"""Change of the opening from frame to frame that the paper takes for a command, and at how many
frames a second."""

PAPER_ROWS = 512
"""Rows of the frames that the paper's pixel sizes refer to."""


@dataclasses.dataclass(frozen=True)
class AlignedEpisode:
    """One episode as a policy sees it."""

    name: str
    images: np.ndarray  # [T, size, size, 3] uint8
    proprio: np.ndarray  # [T, P] float32
    actions: np.ndarray  # [T, 10] float32: body-frame delta (6D, xyz), gripper 1 open, 0 close
    valid: np.ndarray  # [T] bool: the TCP is in front of the camera, inside the image
    tcp: np.ndarray  # [T, 4, 4] float32, base
    opening: np.ndarray  # [T] float32
    camera: Camera  # of the upright, undistorted frames that the images were cut from


class Block(NamedTuple):
    """Consecutive frames of an episode."""

    episode: str
    images: np.ndarray  # uint8 [n, H, W, 3], as stored


class Stream(NamedTuple):
    """An episode that is being aligned; take the blocks before the next episode."""

    name: str
    trajectory: Trajectory
    actions: np.ndarray  # [T, 10] float32
    blocks: Iterator[Aligned]  # NumPy leaves [n, ...], in order; T frames in all


def paper_spec(height: int, **changes: object) -> AlignSpec:
    """The paper's alignment for frames of `height` rows: its pixel sizes, scaled from 512 rows.

    Args:
      height: rows of the camera's image.
      changes: fields of `AlignSpec` that are given, not scaled.
    """
    scale = height / PAPER_ROWS
    scaled: dict[str, object] = {
        "crop": max(16, round(200 * scale)),
        "offset": (0, round(40 * scale)),
        "thickness": max(1.0, round(2 * scale)),
        "arrow_length": max(3.0, round(10 * scale)),
        "arrow_width": max(3.0, round(10 * scale)),
        "dot_radius": max(1.0, round(5 * scale)),
        "frame": height,
    }
    return AlignSpec(**(scaled | changes))  # type: ignore[arg-type]


def labels(trajectory: Trajectory, *, transitions: int = 0, rate: float = PAPER_RATE) -> np.ndarray:
    """[T, 10] float32: the delta to the next recorded pose in the TCP's frame, and the gripper.

    Args:
      trajectory: T frames, two at least.
      rate: frames a second: from one frame to the next a gripper moves the less, the more there
        are, and the paper's threshold with it.
      transitions: the frames with so many largest translations become the identity
        (`palm_jax.align.overwrite_transitions`).

    Raises:
      EpisodeLengthError: more transitions than frames.
    """
    length = len(trajectory.tcp)
    if not 0 <= transitions <= length:
        raise EpisodeLengthError(f"expected at most {length} transitions, got {transitions}")
    # The last pose and opening repeated: no motion, and the label before stays.
    more = -length % _PADDED_TO
    tcp = np.concatenate([trajectory.tcp, np.repeat(trajectory.tcp[-1:], more, 0)])
    opening = np.concatenate([trajectory.opening, np.repeat(trajectory.opening[-1:], more)])
    deltas = overwrite_transitions(achieved_deltas(tcp), transitions)
    commands = gripper_labels(opening, threshold=PAPER_STEP * PAPER_RATE / rate)
    return np.concatenate([deltas, commands[:, None]], 1)[:length]


@partial(jax.jit, static_argnames="spec")
def _aligned(
    images: jax.Array,
    camera: Camera,
    dist: jax.Array | None,
    tcp: jax.Array,
    opening: jax.Array,
    spec: AlignSpec,
) -> Aligned:
    def one(image: jax.Array, pose: jax.Array, gripper: jax.Array) -> Aligned:
        if dist is not None:
            image = undistort(image, camera.K, dist)
        return align(image, camera, pose, gripper, spec)

    return jax.vmap(one)(images, tcp, opening)


def align_frames(
    images: np.ndarray,
    camera: Camera,
    tcp: np.ndarray,
    opening: np.ndarray,
    spec: AlignSpec,
    *,
    dist: Sequence[float] | None = None,
) -> Aligned:
    """`palm_jax.align.align` of n frames, `BATCH` at a time.

    Args:
      images: uint8 [n, H, W, 3], upright.
      camera: that took them.
      tcp, opening: [n, 4, 4] and [n].
      spec: what to do.
      dist: lens coefficients; the images are undistorted first.

    Returns:
      Aligned with NumPy leaves [n, ...].
    """
    count = len(images)
    coefficients = None if dist is None else np.asarray(dist, np.float32)
    poses, openings = np.asarray(tcp, np.float32), np.asarray(opening, np.float32)
    parts = []
    for first in range(0, count, BATCH):
        rows = np.minimum(np.arange(first, first + BATCH), count - 1)
        block = images[first : first + BATCH] if first + BATCH <= count else images[rows]
        parts.append(_aligned(block, camera, coefficients, poses[rows], openings[rows], spec))
    return jax.tree.map(
        lambda *leaves: np.concatenate([np.asarray(leaf) for leaf in leaves])[:count], *parts
    )


def ahead(items: Iterable[T], *, depth: int = _AHEAD) -> Iterator[T]:
    """The same items, made by a thread that is up to `depth` of them ahead."""
    made: queue.Queue[tuple[bool, object]] = queue.Queue(depth)
    stopped = threading.Event()

    def put(entry: tuple[bool, object]) -> bool:
        while not stopped.is_set():
            try:
                made.put(entry, timeout=0.1)
                return True
            except queue.Full:
                continue
        return False

    def work() -> None:
        try:
            for item in items:
                if not put((True, item)):
                    return
            put((False, None))
        except BaseException as error:  # raised again where the items are used
            put((False, error))

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        while True:
            more, item = made.get()
            if not more:
                if isinstance(item, BaseException):
                    raise item
                return
            yield item  # type: ignore[misc]
    finally:
        stopped.set()
        thread.join()


def unequal(recording: Recording, episode: str, images: int | str) -> EpisodeLengthError:
    """What to raise for an episode with another number of images than poses."""
    poses = len(recording.trajectory(episode).tcp)
    return EpisodeLengthError(
        f"{recording.source.path}: {episode} has {poses} poses and {images} images; leave it out "
        "with `data repair`"
    )


def _blocks(recording: Recording, episodes: Sequence[str]) -> Iterator[Block]:
    for name in episodes:
        seen = 0
        for images in recording.source.blocks(name, recording.image_key, BLOCK):
            yield Block(name, images)
            seen += len(images)
        if not seen:  # it would not be missed
            raise unequal(recording, name, 0)


def stream(
    recording: Recording,
    spec: AlignSpec,
    *,
    episodes: Sequence[str] | None = None,
    transitions: int = 0,
) -> Iterator[Stream]:
    """Episodes in order, their frames aligned as they are read. Memory does not grow with them.

    Args:
      recording: what to read.
      spec: what to do.
      episodes: names; None: all.
      transitions: see `labels`.

    Raises:
      EpisodeLengthError: an episode with another number of images than poses; see `trajectory`.
      DataError: see `Source.blocks`.
    """
    names = recording.source.episodes if episodes is None else episodes
    blocks = ahead(_blocks(recording, names))
    for name, group in itertools.groupby(blocks, key=lambda block: block.episode):
        trajectory = recording.trajectory(name)
        actions = labels(trajectory, transitions=transitions, rate=recording.source.fps)
        yield Stream(name, trajectory, actions, _aligned_blocks(recording, trajectory, group, spec))


def _aligned_blocks(
    recording: Recording, trajectory: Trajectory, blocks: Iterator[Block], spec: AlignSpec
) -> Iterator[Aligned]:
    first, length = 0, len(trajectory.tcp)
    for block in blocks:
        last = first + len(block.images)
        if last > length:
            raise unequal(recording, block.episode, "more")
        yield align_frames(
            recording.camera.upright(block.images),
            recording.camera.camera(block.episode),
            trajectory.tcp[first:last],
            trajectory.opening[first:last],
            spec,
            dist=recording.camera.dist,
        )
        first = last
    if first < length:
        raise unequal(recording, block.episode, first)


def aligned_episodes(
    recording: Recording,
    spec: AlignSpec,
    *,
    episodes: Sequence[str] | None = None,
    transitions: int = 0,
) -> Iterator[AlignedEpisode]:
    """Whole episodes as a policy sees them, one after the other.

    Args, Raises: see `stream`.
    """
    for name, trajectory, actions, blocks in stream(
        recording, spec, episodes=episodes, transitions=transitions
    ):
        parts = list(blocks)
        yield AlignedEpisode(
            name,
            np.concatenate([np.asarray(part.image) for part in parts]),
            np.concatenate([np.asarray(part.proprio) for part in parts]),
            actions,
            np.concatenate([np.asarray(part.valid) for part in parts]),
            trajectory.tcp.astype(np.float32),
            trajectory.opening.astype(np.float32),
            recording.camera.camera(name),
        )


__all__ = [
    "AlignedEpisode",
    "Block",
    "Stream",
    "align_frames",
    "aligned_episodes",
    "labels",
    "paper_spec",
    "stream",
]
