"""Is a data file whole, and can the whole part of one be saved?"""

from __future__ import annotations

import dataclasses
import io
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from palm_jax.train.data import lerobot_writer, output, robomimic_writer, video
from palm_jax.train.data.calibration import RobotKeys
from palm_jax.train.data.errors import (
    DataError,
    FormatError,
    OutputError,
    TruncatedError,
)
from palm_jax.train.data.lerobot import LeRobotSource
from palm_jax.train.data.recording import robot_columns, robot_keys, trajectory_of
from palm_jax.train.data.robomimic import REPAIR, RobomimicSource
from palm_jax.train.data.source import Source, fingerprint, open_source

Problems = dict[str, list[str]]  # episode, or "" for the file -> what is wrong

_ROWS = 64
_PER_FRAME = ("actions", "states", "rewards", "dones")


def verify(path: Path, *, robot: RobotKeys | None = None) -> Problems:
    """Reads everything and reports what is wrong; empty if the file is sound.

    Lengths, totals, poses that `data align` would take, finite actions, every array and column that
    it can be read, images that they can be decoded (in videos: that they are there), and the
    checksums of what `data align` has written.

    Args:
      path: file or folder.
      robot: keys of the pose and the gripper, where they are not known ones; see `unread`.

    Raises:
      FormatError, TruncatedError: the file cannot even be opened.
    """
    with open_source(path) as source:
        problems: Problems = {}
        keys = _known_keys(source, robot or RobotKeys())
        for name in source.episodes:
            found = _episode(source, name, keys)
            if found:
                problems[name] = found
        whole = _totals(source)
        return ({"": whole} if whole else {}) | problems


def unread(path: Path, *, robot: RobotKeys | None = None) -> str:
    """Why the poses of a file are not looked at, or an empty string.

    Args:
      path, robot: see `verify`.
    """
    with _opened(path) as source:
        try:
            robot_keys(source, robot or RobotKeys())
        except DataError as error:
            return str(error).removeprefix(f"{path}: ")
    return ""


def _known_keys(source: Source, robot: RobotKeys) -> RobotKeys | None:
    """Where the robot's poses are, if that is known."""
    try:
        return robot_keys(source, robot)
    except DataError:
        return None


def _episode(source: Source, name: str, keys: RobotKeys | None) -> list[str]:
    problems: list[str] = []
    try:
        length = source.length(name)
        problems += _robot(source, name, keys, length)
        for key in source.number_keys:
            if key in ("actions", "action"):
                problems += _finite_rows(key, source.columns(name, key), length)
        for key in source.image_keys:
            count = _count(source, name, key)
            if count != length:
                problems.append(f"{key} has {count} images, expected {length}")
        if isinstance(source, RobomimicSource):
            problems += _hdf5_episode(source, name, length)
        if isinstance(source, LeRobotSource):
            _read_columns(source, name)
    except (DataError, OSError, RuntimeError, KeyError, ValueError) as error:
        problems.append(str(error).removeprefix(f"{source.path}: "))
    return problems


def _robot(source: Source, name: str, keys: RobotKeys | None, length: int) -> list[str]:
    """What `Recording.trajectory` would refuse."""
    if keys is None or length < 2:
        return [f"{length} frame{'s' * (length != 1)}"] if length < 2 else []
    try:
        trajectory_of(keys, *robot_columns(source, name, keys), length)
    except DataError as error:
        return [str(error).removeprefix(f"{source.path}: ")]
    return []


def _finite_rows(key: str, values: np.ndarray, length: int) -> list[str]:
    if len(values) != length:
        return [f"{key} has {len(values)} rows, expected {length}"]
    bad = np.flatnonzero(~np.isfinite(values).all(1))
    return [f"{key} has NaN or infinity in {len(bad)} frames from {bad[0]} on"] if len(bad) else []


def _count(source: Source, name: str, key: str) -> int:
    """Images of an episode. All are decoded but those in videos, which are counted."""
    if isinstance(source, LeRobotSource) and source.info["features"][key]["dtype"] == "video":
        file, start = source.video(name, key)
        return video.count(file, start, source.fps, source.length(name))
    return sum(len(block) for block in source.blocks(name, key, _ROWS))


def _hdf5_episode(source: RobomimicSource, name: str, length: int) -> list[str]:
    demo = source.demo(name)
    problems = []
    told = demo.attrs.get("num_samples")
    if told is None or int(told) != length:
        problems.append(f"num_samples is {told}, expected {length}")
    for key, dataset in source.datasets(name, every=True):
        per_frame = key.startswith("obs/") or key in _PER_FRAME
        if per_frame and dataset.dtype.kind in "biuf" and dataset.shape:
            if len(dataset) != length:
                problems.append(f"{key} has {len(dataset)} rows, expected {length}")
                continue
        if key not in source.image_keys:
            source.read_through(dataset)
    return problems + robomimic_writer.sound(demo)


def _read_columns(source: LeRobotSource, name: str) -> None:
    """Raises where a column that holds no images cannot be read."""
    for key, entry in source.info["features"].items():
        if key not in source.image_keys and entry["dtype"] != "video":
            source.column(name, key)


def _totals(source: Source) -> list[str]:
    try:
        frames = sum(source.length(name) for name in source.episodes)
    except DataError:
        return []  # told of the episode
    problems: list[str] = []
    if isinstance(source, RobomimicSource):
        total = source.data.attrs.get("total")
        if total is not None and total != frames:
            problems.append(f"total is {total}, not {frames}")
        try:
            source.read_masks()
        except DataError as error:
            problems.append(str(error).removeprefix(f"{source.path}: "))
    if isinstance(source, LeRobotSource):
        expected = {"total_episodes": len(source.episodes), "total_frames": frames}
        for key, value in expected.items():
            if source.info.get(key) != value:
                problems.append(f"meta/info.json: {key} is {source.info.get(key)}, not {value}")
        ends = 0
        for name in source.episodes:
            begin = source.row(name)["dataset_from_index"]
            if begin != ends:
                problems.append(f"episode {name} begins at {begin}, expected {ends}")
            ends = source.row(name)["dataset_to_index"]
        problems += lerobot_writer.sound(source)
    return problems


# -- repair ----------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Repair:
    """Of `repair`."""

    path: Path
    kept: tuple[str, ...]
    dropped: Mapping[str, str]  # episode -> why
    numbers: Mapping[str, str]  # kept episode -> its name in the new file


def repair(path: Path, out: Path, *, robot: RobotKeys | None = None) -> Repair:
    """Copies the sound episodes of a file into a new one, with totals that are right.

    Works on HDF5 files that end too early: what lies beyond the end is not taken for zeros. Their
    episodes keep their names, which a calibration may know; LeRobot demands numbers without gaps,
    so those of a folder are numbered anew, and meta/palm.json says how.

    Args:
      path: file or folder; never touched.
      out: the new one.
      robot: see `verify`.

    Raises:
      FormatError, TruncatedError: nothing can be read.
      OutputError: no sound episode; `out` exists.
      DiskFullError: no space.
    """
    output.check_free(out, path)
    with robomimic_writer.writing(out), _opened(path) as source:
        problems = {
            name: found
            for name in source.episodes
            if (found := _unsound(source, name, robot or RobotKeys()))
        }
        kept = [name for name in source.episodes if name not in problems]
        if not kept:
            reasons = "; ".join(f"{n}: {r[0]}" for n, r in list(problems.items())[:3])
            raise OutputError(f"{path}: no sound episode to save ({reasons})")
        numbers = _numbers(source, kept)
        with output.begun(out, _note(source, problems, numbers)) as partial:
            if isinstance(source, RobomimicSource):
                content = _copy_hdf5(source, kept, partial)
            else:
                content = _copy_lerobot(source, kept, partial)
            partial.publish(content)
    dropped = {name: reasons[0] for name, reasons in problems.items()}
    return Repair(out, tuple(kept), dropped, numbers)


def _numbers(source: Source, kept: list[str]) -> dict[str, str]:
    """What the kept episodes are called in the new file."""
    if isinstance(source, LeRobotSource):
        return {name: str(index) for index, name in enumerate(kept)}
    return {name: name for name in kept}


def _note(source: Source, problems: Problems, numbers: Mapping[str, str]) -> dict[str, Any]:
    """What the new file says of its making."""
    note = {"repaired": fingerprint(source.path, source.files()), "dropped": problems}
    if isinstance(source, LeRobotSource):
        return note | {"episodes": dict(numbers)}
    # Episodes keep their names, so what an earlier repair left out is still what it was.
    return note | {"dropped": dict.fromkeys(source.left_out, ["left out before"]) | problems}


def _unsound(source: Source, name: str, robot: RobotKeys) -> list[str]:
    if isinstance(source, _CutSource):
        lost = source.lost(name)
        if lost:
            return [f"{lost} lies beyond the end of the file"]
    problems = _episode(source, name, _known_keys(source, robot))
    # What copying puts right is no reason to drop an episode.
    return [text for text in problems if not text.startswith("num_samples")]


def _opened(path: Path) -> Source:
    try:
        return open_source(path)
    except TruncatedError as error:
        if path.is_dir():
            raise
        found = re.search(r"its header says (\d+)", str(error))
        if found is None:
            raise
        return _CutSource(path, int(found.group(1)))


class _Padded(io.RawIOBase):
    """A file that seems to go on with zeros to a given size."""

    def __init__(self, path: Path, size: int):
        self._file = path.open("rb")
        self._size, self._place = size, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._size}[whence]
        self._place = base + offset
        return self._place

    def tell(self) -> int:
        return self._place

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        wanted = max(0, min(len(view), self._size - self._place))
        found = os.pread(self._file.fileno(), wanted, self._place)
        view[: len(found)] = found
        view[len(found) : wanted] = bytes(wanted - len(found))
        self._place += wanted
        return wanted

    def close(self) -> None:
        self._file.close()
        super().close()


class _CutSource(RobomimicSource):
    """A robomimic file that ends too early, for as much as there is of it."""

    def __init__(self, path: Path, size: int):
        self.path, self._pool = path, None
        self._real = path.stat().st_size
        self._padded = _Padded(path, size)
        try:
            self.file = h5py.File(self._padded, "r")
            self._read_header()
        except (OSError, RuntimeError, KeyError, ValueError) as error:
            self._padded.close()
            raise TruncatedError(
                f"{path}: so much is missing ({self._real} of {size} bytes are there) that no "
                "episode can be read; copy the file again"
            ) from error

    def lost(self, name: str) -> str:
        """The first array of an episode that is not all there, or an empty string."""
        try:
            for key, dataset in self.datasets(name, every=True):
                if _end(dataset) > self._real:
                    return key
            dict(self.demo(name).attrs)
        except (DataError, OSError, RuntimeError, KeyError, ValueError):
            return "part of its structure"
        return ""

    def length(self, episode: str) -> int:
        try:
            return super().length(episode)
        except (DataError, OSError, RuntimeError, KeyError, ValueError):
            return 0

    def close(self) -> None:
        super().close()
        self._padded.close()


def _end(dataset: h5py.Dataset) -> int:
    """Where in the file the last byte of an array lies."""
    if dataset.chunks is None:
        begin = dataset.id.get_offset()
        return 0 if begin is None else int(begin) + int(dataset.id.get_storage_size())
    ends = [0]
    for index in range(dataset.id.get_num_chunks()):
        info = dataset.id.get_chunk_info(index)
        ends.append(int(info.byte_offset) + int(info.size))
    return max(ends)


def _copy_hdf5(source: RobomimicSource, kept: list[str], partial: output.Partial) -> Path:
    path = partial.folder / "data.hdf5"
    path.unlink(missing_ok=True)
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        for key, value in source.data.attrs.items():
            data.attrs[key] = value
        data.attrs[REPAIR] = json.dumps(partial.recipe)
        data.attrs["total"] = sum(source.length(name) for name in kept)
        for name in kept:
            source.file.copy(source.data[name], data, name=name)
            data[name].attrs["num_samples"] = source.length(name)
        try:
            robomimic_writer.copy_masks(source.file, file, kept)
        except (OSError, RuntimeError, KeyError):
            pass  # beyond the end: filter keys can be made again
    return path


def _copy_lerobot(source: Source, kept: list[str], partial: output.Partial) -> Path:
    if not isinstance(source, LeRobotSource):
        raise FormatError(f"{source.path}: nothing known to repair")
    with lerobot_writer.LeRobotWriter(
        partial, source, keep="all", encoding="png", prefix="palm", instead=False, episodes=kept
    ) as writer:
        for name in kept[len(writer.done) :]:
            writer.begin(name, source.length(name), {})
            writer.end()
        return writer.complete()
