"""LeRobot v3 data sets: numbers in parquet files, images in mp4 files or in the tables themselves.

Read through pyarrow and PyAV alone (extra `lerobot`); the package `lerobot` is not needed.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from palm_jax.train import pictures
from palm_jax.train.data import headers, video
from palm_jax.train.data.errors import FormatError, KeyMissingError, TruncatedError
from palm_jax.train.data.source import Feature, Source

CODEBASE = "v3.0"


class LeRobotSource(Source):
    """A LeRobot v3 folder. See `Source`; episodes are named "0", "1", ... as they are numbered.

    Raises:
      FormatError: another version, or a table or field that is missing.
      ExtraMissingError: without pyarrow.
    """

    format = "lerobot"

    def __init__(self, path: Path):
        self.path = path
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
        self._rows = self._episode_rows()
        self.episodes = tuple(self._rows)
        self._features = {key: _feature(key, entry) for key, entry in self.info["features"].items()}
        self._tasks = self._task_names()

    def _json(self, name: str) -> dict[str, Any]:
        try:
            content = json.loads((self.path / name).read_text())
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
            raise TruncatedError(
                f"{path}: not a whole parquet file ({error}): an interrupted copy, or a recording "
                "that was not finalised; copy it again, or save the whole episodes with `data "
                "repair`"
            ) from error

    def _episode_rows(self) -> dict[str, dict[str, Any]]:
        files = sorted((self.path / "meta" / "episodes").glob("*/*.parquet"))
        if not files:
            raise FormatError(f"{self.path}: no table in meta/episodes")
        rows = []
        for file in files:
            wanted = [name for name in self._names(file) if not name.startswith("stats/")]
            rows += self._table(file, wanted).to_pylist()
        features = self.info["features"].items()
        videos = [key for key, entry in features if entry["dtype"] == "video"]
        headers.lerobot_rows(rows, videos, str(self.path / "meta" / "episodes"))
        rows.sort(key=lambda row: row["episode_index"])
        return {str(row["episode_index"]): row for row in rows}

    def _task_names(self) -> dict[int, str]:
        file = self.path / "meta" / "tasks.parquet"
        if not file.is_file():
            return {}
        table = self._table(file).to_pydict()
        names = table.get("task") or table.get("__index_level_0__") or []
        return dict(zip(table.get("task_index", []), map(str, names), strict=False))

    @property
    def stats(self) -> dict[str, Any]:
        """meta/stats.json, or nothing."""
        file = self.path / "meta" / "stats.json"
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
        name = self.info["data_path"].format(
            chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
        )
        return self.path / name

    def column(self, episode: str, key: str) -> Any:
        """A column of the episode's table, as pyarrow has it."""
        file = self._data_file(episode)
        if key not in self._names(file):
            raise KeyMissingError(f"{file} has no column {key!r}")
        table = self._table(file, [key], filters=[("episode_index", "=", int(episode))])
        if len(table) != self.length(episode):
            raise TruncatedError(
                f"{file}: episode {episode} has {len(table)} rows, meta/episodes says "
                f"{self.length(episode)}; copy the data set again, or leave the episode out with "
                "`data repair`"
            )
        return table.column(key)

    def numbers(self, episode: str, key: str) -> np.ndarray:
        column = self.column(episode, key)
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
        count = self.length(episode)
        if self.info["features"][key]["dtype"] == "video":
            file, start = self.video(episode, key)
            yield from video.read(file, start, self.fps, count, size)
            return
        for first in range(0, count, size):
            yield np.stack(
                [
                    self._decoded(item.as_py())
                    for item in self.column(episode, key).slice(first, size)
                ]
            )

    def video(self, episode: str, key: str) -> tuple[Path, float]:
        """The video file of an episode, and where in it the episode begins (seconds)."""
        row = self._rows[episode]
        name = self.info["video_path"].format(
            video_key=key,
            chunk_index=row[f"videos/{key}/chunk_index"],
            file_index=row[f"videos/{key}/file_index"],
        )
        file = self.path / name
        if not file.is_file():
            raise TruncatedError(f"{file}: missing; copy the data set again")
        return file, float(row[f"videos/{key}/from_timestamp"])

    def _decoded(self, item: dict[str, Any]) -> np.ndarray:
        content = item.get("bytes")
        source: Any = io.BytesIO(content) if content else self.path / str(item.get("path"))
        try:
            return pictures.rgb(source)
        except ValueError as error:
            raise TruncatedError(f"{self.path}: an image that cannot be read ({error})") from error

    def image(self, episode: str, key: str, index: int) -> np.ndarray:
        if self.info["features"][key]["dtype"] == "video":
            file, start = self.video(episode, key)
            (block,) = video.read(file, start + index / self.fps, self.fps, 1, 1)
            return np.asarray(block[0])
        return self._decoded(self.column(episode, key)[index].as_py())

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

    def close(self) -> None:
        pass


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
