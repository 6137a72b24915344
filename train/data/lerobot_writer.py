"""Aligned episodes into a LeRobot v3 folder, beside what the source had.

Each episode is first written as a table of its own; when all are there they are joined into files
of about 100 MB, as LeRobot does. Aligned images are PNG in the tables (exact) or one mp4 an
episode.
"""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from palm_jax.train.data import output, video
from palm_jax.train.data.errors import OutputError
from palm_jax.train.data.lerobot import CODEBASE, LeRobotSource
from palm_jax.train.data.source import Source
from palm_jax.train.files.metrics import write_json

ENCODINGS = ("png", *video.VideoWriter.ENCODERS)
FILES_A_CHUNK = 1000
DATA_MB, VIDEO_MB = 100, 200

_INDEX = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_NAME = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_PNG_LEVEL = 1

NOTE, CHECKSUMS = "meta/palm.json", "sha256"
"""How the set was made; in it {file: sha256} of all other files."""

Tasks = tuple[list[str], list[str]]
"""Of an episode, in words: all of them, and that of each frame."""

ROBOMIMIC_NAMES = {"actions": "action", "rewards": "next.reward", "dones": "next.done"}


def lerobot_name(key: str) -> str:
    """What a key of a robomimic file is called in a LeRobot table."""
    name = ROBOMIMIC_NAMES.get(key, key.replace("obs/", "observation.", 1))
    return name.replace("/", ".")


class LeRobotWriter(output.Writer):
    """See `output.Writer`.

    Args:
      partial: where it is written; its recipe becomes meta/palm.json.
      source: what is kept comes from here.
      keep: "numbers" (all but images), "all" or "none" of the source's columns.
      encoding: of the aligned images, one of `ENCODINGS`.
      prefix: of the new keys.
      episodes: of the source, those that will be written; they are numbered anew.
      instead: the proprioception as `observation.state`, the labels as `action`; what the source
        has under these names as `source_state` and `source_action`.

    Raises:
      ExtraMissingError: without pyarrow.
      OutputError: "all" of a source in another format; a new key that is kept of the source, too.
    """

    def __init__(
        self,
        partial: output.Partial,
        source: Source,
        *,
        keep: str,
        encoding: str,
        prefix: str,
        instead: bool,
        episodes: Sequence[str] | None = None,
    ):
        self.episodes = tuple(source.episodes if episodes is None else episodes)
        self._pa, self._pq = video.extra("pyarrow"), video.extra("pyarrow.parquet")
        if keep == "all" and not isinstance(source, LeRobotSource):
            raise OutputError("--keep all copies images as they are stored: within one format only")
        self.partial, self.source, self.encoding = partial, source, encoding
        self.names = _names(prefix, instead)
        self._kept = self._columns_kept(keep)
        output.check_names(self._kept.values(), self.names.values())
        self._video: video.VideoWriter | None = None
        # Episodes as they are finished; the data set that is made of them; the same when it is
        # complete.
        self._parts, self._set, self._whole = (
            partial.folder / name for name in ("parts", "set", "whole")
        )
        self.done = self._finished()

    def _columns_kept(self, keep: str) -> dict[str, str]:
        """Keys of the source -> what they are called beside the new ones."""
        if keep == "none":
            return {}
        if isinstance(self.source, LeRobotSource):
            features = self.source.info["features"]
            names = {
                key: key
                for key, entry in features.items()
                if keep == "all" or entry["dtype"] not in ("image", "video")
            }
        else:
            keys, self.skipped = self.source.in_all(self.episodes)
            names = {key: lerobot_name(key) for key in keys}
            self.skipped |= {k: "LeRobot has its own" for k, n in names.items() if n in _INDEX}
        old = {"observation.state": "source_state", "action": "source_action"}
        new = set(self.names.values())
        return {
            key: old.get(name, name) if name in new else name
            for key, name in names.items()
            if name not in _INDEX
        }

    def _finished(self) -> tuple[str, ...]:
        if self._whole.exists():
            return self.episodes
        done: list[str] = []
        for name in self.episodes:
            note = self._note(len(done))
            if note is None or note["name"] != name:
                break
            done.append(name)
        return tuple(done)

    def _note(self, number: int) -> dict[str, Any] | None:
        """What is known of a finished episode, if its files are what was written."""
        try:
            note: dict[str, Any] = json.loads(self._part(number).with_suffix(".json").read_text())
            same = note["sha256"] == self._hashes(number)
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return note if same else None

    def _hashes(self, number: int) -> list[str]:
        files = [self._part(number)] + [self._mp4(number)] * (self.encoding != "png")
        return [output.file_sha256(file) for file in files if file.exists()]

    def _part(self, number: int) -> Path:
        return self._parts / f"{number:06d}.parquet"

    # -- one episode -------------------------------------------------------------------------------

    def begin(self, name: str, length: int, numbers: Mapping[str, np.ndarray]) -> None:
        self._name, self._length = name, length
        self._number = self.episodes.index(name)
        self._columns: dict[str, Any] = {}
        self._features: dict[str, Any] = {}
        self._stats: dict[str, dict[str, Any]] = {}
        self._tasks = self._keep(name)
        self._blocks: dict[str, list[np.ndarray]] = {}
        self._pictures: list[dict[str, Any]] = []
        self._sums = np.zeros((2, 3))
        self._shape: tuple[int, ...] = ()
        for key, values in numbers.items():
            self._blocks[key] = [values]

    def _mp4(self, number: int) -> Path:
        place = _NAME.format(**_place(number))
        return self._set / "videos" / self.names["image"] / f"{place}.mp4"

    def add(self, images: np.ndarray, numbers: Mapping[str, np.ndarray]) -> None:
        for key, values in numbers.items():
            self._blocks.setdefault(key, []).append(values)
        unit = images.reshape(-1, 3) / 255.0
        self._sums += [unit.sum(0), (unit**2).sum(0)]
        self._shape = images.shape[1:]
        if self.encoding != "png":
            if self._video is None:
                self._video = video.VideoWriter(
                    self._mp4(self._number), self.source.fps, self.encoding
                )
            self._video.write(images)
            return
        for image in images:
            content = io.BytesIO()
            Image.fromarray(image).save(content, "PNG", compress_level=_PNG_LEVEL)
            name = f"frame-{len(self._pictures):06d}.png"
            self._pictures.append({"bytes": content.getvalue(), "path": name})

    def end(self) -> None:
        pa = self._pa
        for key, parts in self._blocks.items():
            self._put(self.names[key], np.concatenate(parts))
        if self._shape:
            self._put_images()
        frames = np.arange(self._length)
        if "timestamp" not in self._columns:  # the source's own
            self._put("timestamp", (frames / self.source.fps).astype(np.float32))
        self._put("frame_index", frames)
        self._put("episode_index", np.full(self._length, self._number))
        part = self._part(self._number)
        part.parent.mkdir(exist_ok=True)
        self._pq.write_table(pa.table(self._columns), part, compression="snappy")
        for file in (part, self._mp4(self._number)):
            if file.exists():
                output.sync(file)
        words, each = self._tasks
        note = {
            "name": self._name,
            "length": self._length,
            "tasks": words,
            "task_of_frame": each,
            "features": self._features,
            "stats": self._stats,
            "sha256": self._hashes(self._number),
        }
        write_json(part.with_suffix(".json"), note)  # last: it says that the part is whole

    def _put(self, key: str, values: np.ndarray) -> None:
        flat = values.reshape(len(values), -1)
        kind = self._pa.from_numpy_dtype(values.dtype)
        size = flat.shape[1]
        column = self._pa.array(flat.ravel(), kind)
        if size != 1:
            column = self._pa.FixedSizeListArray.from_arrays(column, size)
        self._columns[key] = column
        self._features[key] = {"dtype": str(values.dtype), "shape": [size], "names": None}
        self._stats[key] = _stats(flat.astype(np.float64))

    def _put_images(self) -> None:
        key, (height, width) = self.names["image"], self._shape[:2]
        feature: dict[str, Any] = {
            "dtype": "image" if self._video is None else "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
        }
        if self._video is None:
            fields = [("bytes", self._pa.binary()), ("path", self._pa.string())]
            self._columns[key] = self._pa.array(self._pictures, self._pa.struct(fields))
        else:
            self._video.close()
            self._video = None
            feature["info"] = {
                "video.height": height,
                "video.width": width,
                "video.channels": 3,
                "video.codec": self.encoding,
                "video.pix_fmt": "yuv420p",
                "video.fps": self.source.fps,
                "is_depth_map": False,
                "has_audio": False,
            }
        self._features[key] = feature
        count = self._length * height * width
        mean = self._sums[0] / count
        std = np.sqrt(np.maximum(self._sums[1] / count - mean**2, 0.0))
        self._stats[key] = {
            "min": [[[0.0]]] * 3,
            "max": [[[1.0]]] * 3,
            "mean": mean.reshape(3, 1, 1).tolist(),
            "std": std.reshape(3, 1, 1).tolist(),
            "count": [self._length],
        }

    def _keep(self, name: str) -> Tasks:
        """Puts the columns that come from the source; returns what is done in the episode."""
        source = self.source
        if not isinstance(source, LeRobotSource):
            for key, target in self._kept.items():
                self._put(target, source.numbers(name, key))
            return [source.task(name)], [source.task(name)] * source.length(name)
        for key, target in self._kept.items():
            entry = source.info["features"][key]
            self._features[target] = entry
            if entry["dtype"] == "video":
                continue
            column = self._columns[target] = source.column(name, key)
            if key in source.numeric:
                values = source.as_numbers(name, key, column).astype(np.float64)
                self._stats[target] = _stats(values.reshape(len(values), -1))
        if "timestamp" in source.numeric:
            self._put("timestamp", source.numbers(name, "timestamp").astype(np.float32))
        return source.tasks(name)

    # -- the whole ---------------------------------------------------------------------------------

    def close(self) -> None:
        if self._video is not None:
            self._video.close()
            self._video = None

    def complete(self) -> Path:
        if not self._whole.exists():
            self._make_set()
            output.sync(self._set)
            self._set.rename(self._whole)
        output.remove(self._parts)
        return self._whole

    def _make_set(self) -> None:
        for name in ("data", "meta"):  # of an earlier call that came as far as this
            output.remove(self._set / name)
        notes = [
            json.loads(self._part(number).with_suffix(".json").read_text())
            for number in range(len(self.episodes))
        ]
        tasks = list(dict.fromkeys(word for note in notes for word in note["tasks"]))
        if isinstance(self.source, LeRobotSource):
            tasks = self.source.in_order(tasks)
        rows = self._join(notes, tasks)
        for key, entry in notes[0]["features"].items():
            if entry["dtype"] == "video":
                self._place_videos(key, rows, notes)
        features = notes[0]["features"] | {
            key: {"dtype": "int64", "shape": [1], "names": None} for key in ("index", "task_index")
        }
        self._write_meta(rows, notes, tasks, features)
        files = sorted(file for file in self._set.rglob("*") if file.is_file())
        hashes = {str(file.relative_to(self._set)): output.file_sha256(file) for file in files}
        write_json(self._set / NOTE, self.partial.recipe | {CHECKSUMS: hashes})

    def _join(self, notes: Sequence[dict[str, Any]], tasks: list[str]) -> list[dict[str, Any]]:
        """The parts into data files; returns the rows of meta/episodes."""
        pa, rows, begin = self._pa, [], 0
        file, writer = -1, None
        target = self._set
        for number, note in enumerate(notes):
            part = self._part(number)
            table = self._pq.read_table(part)
            length = note["length"]
            table = table.append_column("index", pa.array(np.arange(begin, begin + length)))
            task = np.array([tasks.index(word) for word in note["task_of_frame"]])
            table = table.append_column("task_index", pa.array(task))
            if writer is None or target.stat().st_size >= DATA_MB * 2**20:
                if writer is not None:
                    writer.close()
                file += 1
                target = self._set / "data" / f"{_NAME.format(**_place(file))}.parquet"
                target.parent.mkdir(parents=True, exist_ok=True)
                writer = self._pq.ParquetWriter(target, table.schema, compression="snappy")
            writer.write_table(table)  # a row group for each episode
            place = _place(file)
            rows.append(
                {
                    "episode_index": number,
                    "tasks": note["tasks"],
                    "length": length,
                    "data/chunk_index": place["chunk_index"],
                    "data/file_index": place["file_index"],
                    "dataset_from_index": begin,
                    "dataset_to_index": begin + length,
                    "meta/episodes/chunk_index": 0,
                    "meta/episodes/file_index": 0,
                }
            )
            begin += length
        if writer is not None:
            writer.close()
        return rows

    def _place_videos(
        self, key: str, rows: list[dict[str, Any]], notes: Sequence[dict[str, Any]]
    ) -> None:
        """Where each episode is in the videos of a key; those of the source are copied."""
        columns = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
        if key == self.names["image"]:
            for number, (row, note) in enumerate(zip(rows, notes, strict=True)):
                values = (*_place(number).values(), 0.0, note["length"] / self.source.fps)
                row |= {f"videos/{key}/{c}": v for c, v in zip(columns, values, strict=True)}
            return
        assert isinstance(self.source, LeRobotSource)
        for row, note in zip(rows, notes, strict=True):
            old = self.source.row(note["name"])
            row |= {f"videos/{key}/{c}": old[f"videos/{key}/{c}"] for c in columns}
            file, _ = self.source.video(note["name"], key)
            place = {c: int(row[f"videos/{key}/{c}"]) for c in columns[:2]}
            target = self._set / "videos" / key / f"{_NAME.format(**place)}.mp4"
            if not target.exists():
                self._copy(file, target)

    def _copy(self, file: Path, target: Path) -> None:
        """Whole or not at all."""
        target.parent.mkdir(parents=True, exist_ok=True)
        new = self.partial.folder / "copy.mp4"
        shutil.copyfile(file, new)
        output.sync(new)
        new.rename(target)

    def _write_meta(
        self,
        rows: list[dict[str, Any]],
        notes: Sequence[dict[str, Any]],
        tasks: list[str],
        features: dict[str, Any],
    ) -> None:
        meta = self._set / "meta"
        episodes = meta / "episodes" / "chunk-000" / "file-000.parquet"
        episodes.parent.mkdir(parents=True, exist_ok=True)
        self._pq.write_table(self._pa.Table.from_pylist(rows), episodes, compression="snappy")
        self._write_tasks(meta / "tasks.parquet", tasks)
        stats = {key: _pooled([n["stats"][key] for n in notes]) for key in notes[0]["stats"]}
        if isinstance(self.source, LeRobotSource) and self.episodes == self.source.episodes:
            # Of images, which nobody has looked at here: right for all episodes only.
            stats = {k: v for k, v in self.source.stats.items() if k in self._kept} | stats
        write_json(meta / "stats.json", stats)
        fps = self.source.fps
        videos = any(entry["dtype"] == "video" for entry in features.values())
        robot = (
            self.source.info.get("robot_type") if isinstance(self.source, LeRobotSource) else None
        )
        write_json(
            meta / "info.json",
            {
                "codebase_version": CODEBASE,
                "robot_type": robot,
                "total_episodes": len(rows),
                "total_frames": rows[-1]["dataset_to_index"],
                "total_tasks": len(tasks),
                "chunks_size": FILES_A_CHUNK,
                "data_files_size_in_mb": DATA_MB,
                "video_files_size_in_mb": VIDEO_MB,
                "fps": int(fps) if fps == int(fps) else fps,
                "splits": {"train": f"0:{len(rows)}"},
                "data_path": f"data/{_NAME}.parquet",
                "video_path": f"videos/{{video_key}}/{_NAME}.mp4" if videos else None,
                "features": features,
            },
        )

    def _write_tasks(self, path: Path, tasks: list[str]) -> None:
        """The table that pandas reads as a frame indexed by the task's name."""
        table = self._pa.table({"task_index": list(range(len(tasks))), "task": tasks})
        column = {"metadata": None, "pandas_type": "unicode", "numpy_type": "object"}
        number = {"metadata": None, "pandas_type": "int64", "numpy_type": "int64"}
        note = {
            "index_columns": ["task"],
            "column_indexes": [],
            "columns": [
                {"name": "task_index", "field_name": "task_index", **number},
                {"name": "task", "field_name": "task", **column},
            ],
            "pandas_version": "2.0.0",
        }
        schema = table.schema.with_metadata({b"pandas": json.dumps(note).encode()})
        self._pq.write_table(table.cast(schema), path)


def sound(source: LeRobotSource) -> list[str]:
    """Problems of a data set against the checksums of its files; empty if it has none of either."""
    try:
        expected = dict(json.loads(source.inside(NOTE).read_text()).get(CHECKSUMS, {}))
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
        return [f"{NOTE} cannot be read ({error})"]
    problems = []
    for name, value in expected.items():
        try:
            if output.file_sha256(source.inside(name)) != value:
                problems.append(f"{name} is not what was written (sha256)")
        except (OSError, ValueError) as error:
            problems.append(f"{name} cannot be read ({error})")
    return problems


def _names(prefix: str, instead: bool) -> dict[str, str]:
    names = {key: f"observation.{prefix}_{key}" for key in ("proprio", "valid", "tcp", "opening")}
    names |= {"image": f"observation.images.{prefix}", "actions": f"action.{prefix}"}
    return names | ({"proprio": "observation.state", "actions": "action"} if instead else {})


def _place(number: int) -> dict[str, int]:
    return {"chunk_index": number // FILES_A_CHUNK, "file_index": number % FILES_A_CHUNK}


def _stats(values: np.ndarray) -> dict[str, Any]:
    """Of [T, n], as lists of n numbers."""
    numbers = {
        "min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0),
    }  # fmt: skip
    return {key: value.tolist() for key, value in numbers.items()} | {"count": [len(values)]}


def _pooled(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The same of all episodes together."""
    counts = np.array([part["count"][0] for part in parts], float)
    shape = np.shape(parts[0]["mean"])
    weights = (counts / counts.sum()).reshape(-1, *[1] * len(shape))
    means = np.array([part["mean"] for part in parts], float)
    squares = np.array([part["std"] for part in parts], float) ** 2 + means**2
    mean = (weights * means).sum(0)
    return {
        "min": np.min(np.array([part["min"] for part in parts], float), 0).tolist(),
        "max": np.max(np.array([part["max"] for part in parts], float), 0).tolist(),
        "mean": mean.tolist(),
        "std": np.sqrt(np.maximum((weights * squares).sum(0) - mean**2, 0.0)).tolist(),
        "count": [int(counts.sum())],
    }
