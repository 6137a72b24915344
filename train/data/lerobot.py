"""LeRobot v3 data sets: numbers in parquet files, images in mp4 files or in the tables themselves.

Read through pyarrow and PyAV alone (extra `lerobot`); the package `lerobot` is not needed.
"""

from __future__ import annotations

import io
import itertools
import json
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palm_jax.train.data import headers, video
from palm_jax.train.data.errors import FormatError, KeyMissingError, TruncatedError
from palm_jax.train.data.source import Feature, Source
from palm_jax.train.files import pictures

CODEBASE = "v3.0"

_PICTURES, _BUFFER = 8, 2**20
"""Pictures of a table, and bytes of it, that are read at a time."""


class LeRobotSource(Source):
    """A LeRobot v3 folder. See `Source`; episodes are named "0", "1", ... as they are numbered.

    Raises:
      FormatError: another version, a table or field that is missing, or a name that leads out of
        the folder (names of videos and pictures: where they are used).
      ExtraMissingError: without pyarrow.
    """

    format = "lerobot"

    def __init__(self, path: Path):
        self.path = path
        self._root = path.resolve()
        self._pq = video.extra("pyarrow.parquet")
        self.info = self._json("meta/info.json")
        version = str(self.info.get("codebase_version"))
        if version != CODEBASE:
            raise FormatError(
                f"{path}: expected a LeRobot data set of version {CODEBASE}, got {version}; "
                "convert it with lerobot's own converter"
            )
        headers.lerobot_info(self.info, str(path / "meta" / "info.json"))
        self.fps = float(self.info["fps"])
        for key in self.info["features"]:
            _check_name(path, key)
        self._features = {key: _feature(key, entry) for key, entry in self.info["features"].items()}
        self._rows = self._episode_rows()
        self.episodes = tuple(self._rows)
        self.numeric = {
            key for key, f in self._features.items() if not f.images and _is_numeric(f.dtype)
        }
        self._tasks = self._task_names()

    def inside(self, name: str | Path) -> Path:
        """A file of the data set, by the name that the data set itself gives it.

        Raises:
          FormatError: it lies elsewhere.
        """
        path = self.path / name
        try:
            inside = path.resolve().is_relative_to(self._root)
        except (OSError, RuntimeError, ValueError):  # links in a circle, names that are none
            inside = False
        if not inside:
            raise FormatError(
                f"{path} leads out of the data set; expected files that lie in {self.path}: if you "
                "trust it, copy what it refers to into it (`cp -rL` for links)"
            )
        return path

    def _named(self, field: str, **places: Any) -> Path:
        """The file that a pattern of meta/info.json names."""
        whole = {k: v if k == "video_key" else int(v) for k, v in places.items()}
        return self.inside(self.info[field].format(**whole))

    def files(self) -> list[Path]:
        return [self.inside(path.relative_to(self.path)) for path in super().files()]

    def _json(self, name: str) -> dict[str, Any]:
        try:
            content = json.loads(self.inside(name).read_text())
        except (OSError, ValueError, RecursionError) as error:
            raise FormatError(f"{self.path / name}: not readable ({error})") from error
        return headers.an_object(content, str(self.path / name))

    def _table(self, path: Path, columns: list[str] | None = None, **options: Any) -> Any:
        return self._whole(path, self._pq.read_table, columns=columns, **options)

    def _names(self, path: Path) -> list[str]:
        return list(self._whole(path, self._pq.read_schema).names)

    def _whole(self, path: Path, read: Callable[..., Any], **options: Any) -> Any:
        try:
            return read(path, **options)
        except (OSError, ValueError, RuntimeError) as error:
            raise self._broken(path, error) from error

    def _broken(self, path: Path, error: Exception) -> TruncatedError:
        return TruncatedError(
            f"{path}: not a whole parquet file ({error}): an interrupted copy, or a recording "
            "that was not finalised; copy it again, or save the whole episodes with `data repair`"
        )

    def _episode_rows(self) -> dict[str, dict[str, Any]]:
        files = sorted((self.path / "meta" / "episodes").glob("*/*.parquet"))
        if not files:
            raise FormatError(f"{self.path}: no table in meta/episodes")
        rows = []
        for file in files:
            file = self.inside(file.relative_to(self.path))
            wanted = [name for name in self._names(file) if not name.startswith("stats/")]
            rows += self._table(file, wanted).to_pylist()
        videos = [key for key in self._features if self._is_video(key)]
        headers.lerobot_rows(rows, videos, str(self.path / "meta" / "episodes"))
        rows.sort(key=lambda row: row["episode_index"])
        return {str(row["episode_index"]): row for row in rows}

    def _task_names(self) -> dict[int, str]:
        file = self.inside("meta/tasks.parquet")
        if not file.is_file():
            return {}
        table = self._table(file).to_pydict()
        names = table.get("task") or table.get("__index_level_0__") or []
        return dict(zip(table.get("task_index", []), map(str, names), strict=False))

    @property
    def stats(self) -> dict[str, Any]:
        """meta/stats.json, or nothing."""
        file = self.inside("meta/stats.json")
        return self._json("meta/stats.json") if file.is_file() else {}

    def row(self, episode: str) -> dict[str, Any]:
        """The episode's row of meta/episodes."""
        return self._rows[episode]

    def length(self, episode: str) -> int:
        return int(self._rows[episode]["length"])

    def features(self) -> dict[str, Feature]:
        return self._features

    def _data_file(self, episode: str) -> Path:
        row = self._rows[episode]
        return self._named(
            "data_path", chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
        )

    def in_all(self, episodes: Sequence[str]) -> tuple[list[str], dict[str, str]]:
        why = {
            key: f"{self._features[key].dtype}, not numbers"
            for key in self.number_keys
            if key not in self.numeric
        }
        return [key for key in self.number_keys if key not in why], why

    def _file_with(self, episode: str, key: str) -> Path:
        file = self._data_file(episode)
        if key not in self._names(file):
            raise KeyMissingError(f"{file} has no column {key!r}")
        return file

    def column(self, episode: str, key: str) -> Any:
        """A column of the episode's table, as pyarrow has it."""
        file = self._file_with(episode, key)
        table = self._table(file, [key], filters=[("episode_index", "=", int(episode))])
        self._check_rows(file, episode, len(table))
        return table.column(key)

    def _check_rows(self, file: Path, episode: str, count: int) -> None:
        if count != self.length(episode):
            raise TruncatedError(
                f"{file}: episode {episode} has {count} rows, meta/episodes says "
                f"{self.length(episode)}; copy the data set again, or leave the episode out with "
                "`data repair`"
            )

    def numbers(self, episode: str, key: str) -> np.ndarray:
        return self.as_numbers(episode, key, self.column(episode, key))

    def as_numbers(self, episode: str, key: str, column: Any) -> np.ndarray:
        """[T, ...] of a column of the episode.

        Raises:
          KeyMissingError: it holds none.
          FormatError: they are of another shape than meta/info.json says.
        """
        shape = self._features[key].shape
        try:
            values = np.asarray(column.to_pylist())
            if values.dtype.kind in "biuf":
                return values.reshape(len(values), *shape)
        except ValueError as error:
            raise FormatError(
                f"{self.path}: {key}: expected {' x '.join(map(str, shape)) or 1} numbers a frame, "
                f"as meta/info.json says, got others in episode {episode} ({error})"
            ) from error
        raise KeyMissingError(f"{self.path}: {key!r} holds no numbers")

    def blocks(self, episode: str, key: str, size: int) -> Iterator[np.ndarray]:
        if self._is_video(key):
            file, start = self.video(episode, key)
            yield from video.read(file, start, self.fps, self.length(episode), size)
            return
        pictures = self._pictures(episode, key)
        while block := [self._decoded(item) for item in itertools.islice(pictures, size)]:
            yield np.stack(block)

    def _is_video(self, key: str) -> bool:
        return bool(self.info["features"][key]["dtype"] == "video")

    def _pictures(self, episode: str, key: str) -> Iterator[dict[str, Any]]:
        """The items of a column of pictures, a few at a time in memory."""
        path, found = self._file_with(episode, key), 0
        try:
            with self._pq.ParquetFile(path, buffer_size=_BUFFER) as file:
                for batch in file.iter_batches(
                    _PICTURES, _row_groups(file, int(episode)), [key, "episode_index"]
                ):
                    mine = batch.column("episode_index").to_numpy() == int(episode)
                    for row in np.flatnonzero(mine):
                        found += 1
                        yield batch.column(key)[int(row)].as_py()
        except (OSError, ValueError, RuntimeError) as error:
            raise self._broken(path, error) from error
        self._check_rows(path, episode, found)

    def video(self, episode: str, key: str) -> tuple[Path, float]:
        """The video file of an episode, and where in it the episode begins (seconds)."""
        row = self._rows[episode]
        file = self._named(
            "video_path",
            video_key=key,
            chunk_index=row[f"videos/{key}/chunk_index"],
            file_index=row[f"videos/{key}/file_index"],
        )
        if not file.is_file():
            raise TruncatedError(f"{file}: missing; copy the data set again")
        return file, float(row[f"videos/{key}/from_timestamp"])

    def _decoded(self, item: dict[str, Any]) -> np.ndarray:
        content = item.get("bytes")
        source: Any = io.BytesIO(content) if content else self.inside(str(item.get("path")))
        try:
            return pictures.rgb(source)
        except ValueError as error:
            raise TruncatedError(f"{self.path}: an image that cannot be read ({error})") from error

    def image(self, episode: str, key: str, index: int) -> np.ndarray:
        if self._is_video(key):
            file, start = self.video(episode, key)
            (block,) = video.read(file, start + index / self.fps, self.fps, 1, 1)
            return np.asarray(block[0])
        (item,) = itertools.islice(self._pictures(episode, key), index, index + 1)
        return self._decoded(item)

    def task(self, episode: str) -> str:
        names = self._rows[episode].get("tasks") or list(self._tasks.values())
        return str(names[0]) if names else "unknown"

    def _repaired(self, entry: str) -> dict[str, Any]:
        """What `data repair` has noted; empty in other sets."""
        try:
            return dict(self._json("meta/palm.json")[entry])
        except (FormatError, ValueError, TypeError, LookupError):
            return {}

    @property
    def left_out(self) -> frozenset[str]:
        return frozenset(self._repaired("dropped"))

    @property
    def numbered_anew(self) -> dict[str, str]:
        numbers = self._repaired("episodes")
        return {old: str(new) for old, new in numbers.items() if old != new}

    def tasks(self, episode: str) -> tuple[list[str], list[str]]:
        """What is done in the episode, in words: all of it, and in each frame."""
        words = [str(name) for name in self._rows[episode].get("tasks") or [self.task(episode)]]
        if "task_index" not in self._names(self._data_file(episode)):
            return words, [words[0]] * self.length(episode)
        indices = self.column(episode, "task_index").to_pylist()
        frames = [self._tasks.get(index, words[0]) for index in indices]
        return list(dict.fromkeys([*words, *frames])), frames

    def in_order(self, tasks: Sequence[str]) -> list[str]:
        """Tasks as meta/tasks numbers them, those that it lacks behind."""
        places = {name: place for place, name in enumerate(self._tasks.values())}
        return sorted(tasks, key=lambda task: places.get(task, len(places)))

    def close(self) -> None:
        pass


def _row_groups(file: Any, episode: int) -> list[int]:
    """Parts of a table that may hold rows of an episode."""
    groups = []
    for number in range(file.num_row_groups):
        group = file.metadata.row_group(number)
        columns = (group.column(index) for index in range(group.num_columns))
        known = next((c.statistics for c in columns if c.path_in_schema == "episode_index"), None)
        if known is None or not known.has_min_max or known.min <= episode <= known.max:
            groups.append(number)
    return groups


def _is_numeric(dtype: str) -> bool:
    known = np.sctypeDict.get(dtype)  # not np.dtype(), which reads a language of its own
    return known is not None and np.dtype(known).kind in "biuf"


def _check_name(path: Path, key: str) -> None:
    """Names become parts of paths: those of the data set, and those of what is written from it."""
    if re.fullmatch(r"[^/\\\x00-\x1f]+", key) is None or not key.strip("."):
        raise FormatError(
            f"{path / 'meta/info.json'}: feature {key!r}: expected a name without / and \\, and "
            "not of dots alone"
        )


def _feature(key: str, entry: dict[str, Any]) -> Feature:
    shape = tuple(int(size) for size in entry["shape"])
    dtype = str(entry["dtype"])
    info = entry.get("info") or {}
    depth = info.get("is_depth_map") or info.get("video.is_depth_map")
    if dtype not in ("video", "image") or depth or len(shape) != 3:
        return Feature(() if shape == (1,) else shape, dtype)
    names = entry.get("names") or []
    first = str(names[0]) if isinstance(names, list) and names else ""
    if first.startswith("channel") or (not first and shape[0] == 3):
        shape = (*shape[1:], shape[0])
    return Feature(shape, "uint8", images=shape[-1] == 3)
