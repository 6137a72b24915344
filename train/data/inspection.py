"""What is in a data file: episodes, keys, images, ranges, and what would be in the way."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from palm_jax.train.data.calibration import RobotKeys
from palm_jax.train.data.errors import DataError
from palm_jax.train.data.recording import openness, range_problem, robot_keys
from palm_jax.train.data.source import Source


@dataclasses.dataclass(frozen=True)
class Overview:
    """Of one source."""

    path: Path
    format: str
    fps: float
    episodes: int
    frames: int
    lengths: tuple[int, int]  # shortest, longest
    images: dict[str, tuple[int, int]]  # key -> (width, height)
    numbers: dict[
        str, dict[str, Any]
    ]  # key -> {"shape", "dtype", "min", "max"} of the first episode
    cameras: tuple[str, ...]  # whose calibration the file itself has
    robot: RobotKeys | None  # keys that are understood without being told
    notes: tuple[str, ...]  # what would be in the way


def inspect(source: Source) -> Overview:
    """Reads lengths and the numbers of the first episode, no images."""
    lengths = [source.length(name) for name in source.episodes]
    first = source.episodes[0]
    features = source.features()
    numbers = {key: _numbers(source, first, key) for key in source.number_keys}
    notes = [
        f"{name} has {length} frame{'s' * (length != 1)}: too short to learn from; `data repair` "
        "leaves it out"
        for name, length in zip(source.episodes, lengths, strict=True)
        if length < 2
    ]
    notes += [f"{key} has NaN or infinity" for key, entry in numbers.items() if entry["bad"]]
    if not source.image_keys:
        notes.append("no images: nothing to align")
    robot = None
    try:
        robot = robot_keys(source, RobotKeys())
        notes += _gripper_notes(source, first, robot)
    except DataError as error:
        notes.append(str(error).removeprefix(f"{source.path}: "))
    return Overview(
        path=source.path,
        format=source.format,
        fps=source.fps,
        episodes=len(lengths),
        frames=sum(lengths),
        lengths=(min(lengths), max(lengths)),
        images={k: (features[k].shape[1], features[k].shape[0]) for k in source.image_keys},
        numbers=numbers,
        cameras=_calibrated(source, first),
        robot=robot,
        notes=tuple(notes),
    )


def _gripper_notes(source: Source, episode: str, robot: RobotKeys) -> list[str]:
    """Whether the range that a known key stands for is that of this gripper."""
    assert robot.opening
    opening = openness(robot, source.columns(episode, robot.opening))
    opening = opening[np.isfinite(opening)]
    if not opening.size:
        return []
    problem = range_problem(robot, (float(opening.min()), float(opening.max())))
    return [f"{problem}; write the range into the calibration: --closed, --open"] * bool(problem)


def _calibrated(source: Source, episode: str) -> tuple[str, ...]:
    names = list(source.camera_info(episode))
    if source.model_file(episode) and not names:
        names = ["(model_file)"]
    names += [key for key in source.number_keys if "extrinsic" in key]
    return tuple(names)


def _numbers(source: Source, episode: str, key: str) -> dict[str, Any]:
    feature = source.features()[key]
    entry: dict[str, Any] = {"shape": feature.shape, "dtype": feature.dtype, "bad": False}
    try:
        values = np.asarray(source.numbers(episode, key), float)
    except (DataError, ValueError, TypeError):
        return entry
    finite = values[np.isfinite(values)]
    entry["bad"] = finite.size < values.size
    if finite.size:
        entry |= {"min": float(finite.min()), "max": float(finite.max())}
    return entry
