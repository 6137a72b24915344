"""Numbers of a run on disk: an append-only JSONL log, and JSON files that are whole or absent.

`metrics.jsonl` has one JSON object a line, with the integer `step` first. Each line is flushed as
it is written, so a killed run loses at most the line it was writing; that half line, and every
line beyond the step from which the run goes on, are dropped when the log is opened again, and what
the kill left out is written then. The log of a run that was killed and resumed is therefore that of
one that was not.

JSON has no NaN and no infinity: such numbers are written as null.
"""

import dataclasses
import json
import math
import os
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np


def plain(value: Any) -> Any:
    """`value` in terms of what JSON has: dict, list, str, int, float, bool, None.

    Arrays become nested lists, zero-dimensional ones numbers; dataclasses become dicts; paths
    become strings; non-finite numbers become None.

    Raises:
      TypeError: something else, which is named.
    """
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (set, frozenset)):
        return sorted(plain(item) for item in value)
    if hasattr(value, "__array__"):
        array = np.asarray(value)
        if array.dtype.kind in "biuf" or array.dtype.name == "bfloat16":
            return plain(array.tolist())
    raise TypeError(f"cannot write a {type(value).__name__} as JSON: {value!r}")


def fsync_folder(path: Path) -> None:
    """Make a rename inside the folder durable."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_atomic(path: str | Path, content: bytes) -> Path:
    """Write a file so that a reader, or a crash, sees the old content or the new, never a part."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(
        prefix=f".{path.name}.", suffix=".tmp", dir=path.parent
    )
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())  # mkstemp's files are private
        os.replace(temporary, path)
    except BaseException as error:
        Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(path)  # writing knows a number only
        raise
    fsync_folder(path.parent)
    return path


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def write_json(path: str | Path, value: Any) -> Path:
    """Write `plain(value)` as readable JSON, atomically; parent folders are made."""
    text = json.dumps(plain(value), indent=2, allow_nan=False) + "\n"
    return write_atomic(path, text.encode())


def read_metrics(path: str | Path) -> list[dict[str, Any]]:
    """The records of a log in the order of its lines; null comes back as None.

    An unfinished last line is left out. Lines before it that are not JSON objects with a `step`
    are left out too, with a warning that says how many: they mean that the file was damaged.
    """
    records, damaged = _parse(Path(path).read_bytes())
    if damaged:
        warnings.warn(f"{path}: {damaged} unreadable lines left out", stacklevel=2)
    return records


def _parse(content: bytes) -> tuple[list[dict[str, Any]], int]:
    *lines, tail = content.split(b"\n")
    records, damaged = [], 0
    for line in (*lines, tail):
        try:
            record = json.loads(line)
            if not isinstance(record["step"], int):
                raise TypeError
            json.dumps(record, allow_nan=False)  # 1e999 can be read, but not written again
        except (ValueError, KeyError, TypeError, RecursionError):
            damaged += line is not tail and bool(line.strip())
        else:
            records.append(record)
    return records, damaged


class MetricsLog:
    """Append records to `metrics.jsonl`, one flushed line each.

    Args:
      path: the file; made with its parent folders if absent.
      resume_step: the step of the checkpoint from which the run goes on. Records of later steps
        are dropped (the run will write them again), and so is an unfinished last line. None starts
        an empty log, and refuses to overwrite one with records in it.

    Raises:
      FileExistsError: `resume_step` is None and the log has records.
    """

    def __init__(self, path: str | Path, *, resume_step: int | None = None):
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._kept = self._rewind(resume_step) if self.path.exists() else []
        self._file = self.path.open("a", encoding="utf-8")

    def _rewind(self, resume_step: int | None) -> list[dict[str, Any]]:
        """The records that stay."""
        content = self.path.read_bytes()
        records, damaged = _parse(content)
        if resume_step is None:
            if records or damaged:
                raise FileExistsError(
                    f"{self.path} holds the log of another run; resume that run, "
                    "or choose another folder"
                )
            kept = []
        else:
            kept = [record for record in records if record["step"] <= resume_step]
        if damaged:
            warnings.warn(f"{self.path}: {damaged} unreadable lines dropped", stacklevel=3)
        new = "".join(json.dumps(record, allow_nan=False) + "\n" for record in kept).encode()
        if new != content:
            write_atomic(self.path, new)
        return kept

    def write_once(self, step: int, values: Mapping[str, Any]) -> None:
        """`write`, unless the log had such a record when it was opened."""
        names = {"step", *values}
        if not any(record["step"] == step and record.keys() == names for record in self._kept):
            self.write(step, values)

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        """Append one record: the step, then `values` as `plain` makes them."""
        if "step" in values:
            raise ValueError("'step' is given twice: as an argument and among the values")
        record = {"step": int(step), **plain(values)}
        self._file.write(json.dumps(record, allow_nan=False) + "\n")
        self._file.flush()

    def sync(self) -> None:
        """Make everything written durable."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Make everything written durable, and close the file."""
        if not self._file.closed:
            self.sync()
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
