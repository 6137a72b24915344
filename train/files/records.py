"""What an evaluation or a sweep leaves behind, on disk and in memory.

A run folder holds::

    config.json env.json metrics.jsonl checkpoints/ eval.json eval.npz [sweep.npz] ...

`eval.json` is `{domain: {"successes": int, "episodes": int, "nan": int}}`; `eval.npz` holds the
same episodes one by one as arrays named `domain/field`, the fields of `DomainRecord`; `sweep.npz`
holds the arrays of `Sweep`, `strength-SHIFT.npz` those of `StrengthSweep`, with a header that says
of which policy they are; a sweep with another robot than the trained one has `-ROBOT` at the end of
its name. Readers raise `RecordError`, which
names the file and the problem.
"""

import io
import json
import math
import re
import struct
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palm_jax.train.files.metrics import plain, read_metrics, write_atomic

HEADER = "header"
"""Name of the array with the conditions of a sweep, as JSON."""

TIMES = "times.json"  # seconds, and updates: no result rests on it
HELD_OUT = "held_out.json"
"""Of a run on recordings: figures on the episodes that were held out (`train.held_out`)."""


class RecordError(ValueError):
    """A file of a run folder that cannot be used; the message says which and why."""


@dataclass(frozen=True)
class DomainRecord:
    """The N episodes of one policy in one domain."""

    success: NDArray[np.bool_]  # [N]
    nan: NDArray[np.bool_]  # [N] physics or policy went non-finite: counted, and a failure
    object_xy: NDArray[np.float32]  # [N, 2] metres, world: the target object at the start
    camera_angle: NDArray[np.float32]  # [N] radians about the workspace centre; 0 in training
    length: NDArray[np.int32]  # [N] control steps until success or the end
    draws: NDArray[np.int32]  # [N] start poses drawn, in all stages; 0: not recorded

    @property
    def episodes(self) -> int:
        return len(self.success)

    @property
    def solved(self) -> NDArray[np.bool_]:
        """[N] successes that count: a non-finite episode never does."""
        return self.success & ~self.nan


@dataclass(frozen=True)
class Sweep:
    """S episodes in every cell of a grid of camera angles and object positions."""

    angles: NDArray[np.float64]  # [A] radians
    xs: NDArray[np.float64]  # [X] metres, cell centres
    ys: NDArray[np.float64]  # [Y] metres, cell centres
    success: NDArray[np.bool_]  # [A, X, Y, S]
    nan: NDArray[np.bool_]  # [A, X, Y, S]
    worlds: int = 0  # in a batch at the end; 0: not recorded

    @property
    def solved(self) -> NDArray[np.bool_]:
        """[A, X, Y, S] successes that count: a non-finite episode never does."""
        return self.success & ~self.nan


@dataclass(frozen=True)
class StrengthSweep:
    """S episodes at every strength of one shift; scene s is the same at all of them."""

    shift: str
    strengths: NDArray[np.float64]  # [K]
    success: NDArray[np.bool_]  # [K, S]
    nan: NDArray[np.bool_]  # [K, S]
    worlds: int = 0  # in a batch at the end; 0: not recorded

    @property
    def solved(self) -> NDArray[np.bool_]:
        """[K, S] successes that count: a non-finite episode never does."""
        return self.success & ~self.nan


_ZIP_END = struct.Struct("<4s4H2LH")
"""The end of a ZIP file: signature, disks, entries (twice), the directory's size and start."""

_DTYPES: dict[str, Any] = {
    "success": np.bool_,
    "nan": np.bool_,
    "object_xy": np.float32,
    "camera_angle": np.float32,
    "length": np.int32,
    "draws": np.int32,
}


def domain_record(values: Mapping[str, ArrayLike], *, where: str = "record") -> DomainRecord:
    """Check and convert the arrays of one domain; `where` names them in errors.

    `draws` may be missing: it was not always recorded.
    """
    values = {"draws": np.zeros(np.shape(values.get("success", ())), np.int32), **values}
    _refuse_unknown(where, values, _DTYPES)
    missing = sorted(set(_DTYPES) - set(values))
    if missing:
        raise RecordError(f"{where}: missing {', '.join(missing)}; expected {', '.join(_DTYPES)}")
    arrays = {
        name: _numbers(f"{where}/{name}", values[name], kind) for name, kind in _DTYPES.items()
    }
    count = arrays["success"].shape[0] if arrays["success"].ndim else 0
    for name, array in arrays.items():
        expected = (count, 2) if name == "object_xy" else (count,)
        if array.shape != expected:
            raise RecordError(
                f"{where}/{name}: expected shape {expected} (as many episodes as success has), "
                f"got {array.shape}"
            )
    return DomainRecord(**arrays)


def _numbers(where: str, value: ArrayLike, kind: Any) -> NDArray[Any]:
    """An array of this kind; one of other numbers may come, if it says the same."""
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise RecordError(f"{where}: expected numbers, got {array.dtype}")
    with np.errstate(invalid="ignore", over="ignore"):
        found = array.astype(kind)
        whole = found.dtype.kind == "f" or np.array_equal(found, array)
    if not whole or not np.isfinite(found).all():
        raise RecordError(f"{where}: expected finite {found.dtype} numbers, got others")
    return found


def _refuse_unknown(where: object, found: Iterable[str], known: Iterable[str]) -> None:
    """A name that is not ours may be one of ours, damaged, and its array be taken for absent."""
    unknown = sorted(set(found) - set(known))
    if unknown:
        raise RecordError(f"{where}: unknown {', '.join(unknown)}; expected {', '.join(known)}")


def joined(parts: Sequence[DomainRecord]) -> DomainRecord:
    """The episodes of several records (at least one), one after the other."""
    return DomainRecord(
        *(
            np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(DomainRecord)
        )
    )


def counts(records: Mapping[str, DomainRecord]) -> dict[str, dict[str, int]]:
    """The content of eval.json: successes, episodes and non-finite episodes per domain."""
    return {
        name: {
            "successes": int(record.solved.sum()),
            "episodes": record.episodes,
            "nan": int(record.nan.sum()),
        }
        for name, record in records.items()
    }


def save_arrays(path: Path, arrays: Mapping[str, ArrayLike]) -> Path:
    """Write an .npz file, whole or not at all."""
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **arrays)
    return write_atomic(path, content.getvalue())


def save_eval(path: Path, records: Mapping[str, Mapping[str, ArrayLike] | DomainRecord]) -> Path:
    """Write eval.npz, whole or not at all.

    Args:
      path: the file, by custom RUN/eval.npz.
      records: per domain either a `DomainRecord` or a mapping with its fields.
    """
    arrays = {}
    for domain, values in records.items():
        if isinstance(values, DomainRecord):
            record = values
        else:
            record = domain_record(values, where=domain)
        for field in fields(record):
            arrays[f"{domain}/{field.name}"] = getattr(record, field.name)
    return save_arrays(path, arrays)


def save_sweep(
    path: Path, sweep: Sweep | StrengthSweep, header: Mapping[str, Any] | None = None
) -> Path:
    """Write a sweep of either kind, whole or not at all.

    Args:
      header: of which policy and under which conditions, as JSON can hold it.
    """
    arrays = {field.name: getattr(sweep, field.name) for field in fields(sweep)}
    return save_arrays(path, arrays if header is None else with_header(arrays, header))


def with_header(arrays: Mapping[str, ArrayLike], header: Mapping[str, Any]) -> dict[str, ArrayLike]:
    """Arrays for an .npz file, with a header as one of them."""
    return {**arrays, HEADER: np.asarray(json.dumps(plain(header), sort_keys=True))}


def header_of(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """The header among arrays; empty if there is none."""
    try:
        header = json.loads(str(arrays[HEADER]))
    except (KeyError, ValueError, RecursionError):
        return {}
    return header if isinstance(header, dict) else {}


def sweep_path(folder: Path, robot: str = "", *, shift: str = "") -> Path:
    """Where a run's sweep is: over the grid, or over the strength of a shift.

    Args:
      folder: the run's.
      robot: "" for the one that the policy was trained on.
      shift: "" for the grid of positions and camera angles.
    """
    stem = f"strength-{shift}" if shift else "sweep"
    return folder / f"{stem}{f'-{robot}' if robot else ''}.npz"


def file_word(name: str) -> str:
    """A name that comes from a file, as part of a file's name: it leads into no other folder."""
    return re.sub(r"[^\w+-]+", "-", name)[:80]


def swept_robot(path: Path) -> str:
    """The robot in a sweep's file name, "" for the trained one: the reverse of `sweep_path`."""
    words = path.stem.split("-")
    return "-".join(words[2 if words[0] == "strength" else 1 :])


def load_strengths(path: Path) -> StrengthSweep:
    """Read a `StrengthSweep`."""
    arrays = load_arrays(path)
    arrays.pop(HEADER, None)
    _refuse_unknown(path, arrays, [field.name for field in fields(StrengthSweep)])
    missing = {field.name for field in fields(StrengthSweep)} - {"worlds", *arrays}
    if missing:
        raise RecordError(f"{path}: missing {', '.join(sorted(missing))}")
    strengths = np.atleast_1d(_numbers(f"{path}: strengths", arrays["strengths"], float))
    success, nan = (_numbers(f"{path}: {name}", arrays[name], bool) for name in ("success", "nan"))
    axes = (strengths.ndim, success.ndim) == (1, 2)
    if not axes or len(success) != len(strengths) or nan.shape != success.shape:
        raise RecordError(
            f"{path}: expected success and nan of shape [{len(strengths)}, S], "
            f"got {success.shape} and {nan.shape}"
        )
    return StrengthSweep(str(arrays["shift"]), strengths, success, nan, worlds_of(arrays))


def worlds_of(arrays: Mapping[str, NDArray[Any]]) -> int:
    """Worlds in a batch at the end of a sweep, 0 if they were not recorded."""
    found = arrays.get("worlds", np.zeros((), int))
    return int(found) if found.shape == () and found.dtype.kind in "iu" else 0


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Read an .npz file without pickles."""
    try:
        content = path.read_bytes()
        # From memory: NumPy leaves a file that it cannot read open.
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            _check_directory(content, len(archive.files))
            return {name: archive[name] for name in archive.files}
    except Exception as error:  # damaged bytes make zipfile and NumPy raise whatever comes to mind
        raise RecordError(f"{path}: not a readable .npz file ({error})") from error


def load_views(path: Path) -> dict[str, NDArray[np.uint8]]:
    """Read views.npz: images [H, W, 3] by name."""
    views = load_arrays(path)
    for name, view in views.items():
        if view.dtype != np.uint8 or view.shape[2:] != (3,) or not view.size:
            raise RecordError(f"{path}: {name}: expected an image, got {view.dtype} {view.shape}")
    return views


def _check_directory(content: bytes, count: int) -> None:
    """Raises ValueError for an archive whose directory hides some of its arrays.

    Every array has a checksum, but the directory has none: a byte of it can make an entry swallow
    the next ones, and zipfile does not compare what it found with the number at the end.
    """
    end = content[-_ZIP_END.size :]
    if len(end) < _ZIP_END.size:
        raise ValueError("it ends early")
    signature, _, _, _, entries, size, start, _ = _ZIP_END.unpack(end)
    large = entries == 0xFFFF  # then the number is elsewhere
    if signature != b"PK\x05\x06" or not (
        large or (entries == count and start + size + _ZIP_END.size == len(content))
    ):
        raise ValueError("its directory is damaged")


def load_eval(path: Path) -> dict[str, DomainRecord]:
    """Read eval.npz; the domains come in the order in which they were written."""
    grouped: dict[str, dict[str, NDArray[Any]]] = {}
    for name, array in load_arrays(path).items():
        domain, _, field = name.rpartition("/")
        if not domain:
            raise RecordError(f"{path}: array {name!r} is not named domain/field")
        grouped.setdefault(domain, {})[field] = array
    return {
        name: domain_record(values, where=f"{path}: {name}") for name, values in grouped.items()
    }


def load_sweep(path: Path) -> Sweep:
    """Read sweep.npz."""
    arrays = load_arrays(path)
    arrays.pop(HEADER, None)
    _refuse_unknown(path, arrays, [field.name for field in fields(Sweep)])
    missing = {"angles", "xs", "ys", "success"} - set(arrays)
    if missing:
        raise RecordError(f"{path}: missing {', '.join(sorted(missing))}")
    success = _numbers(f"{path}: success", arrays["success"], bool)
    nan = _numbers(f"{path}: nan", arrays.get("nan", np.zeros_like(success)), bool)
    angles, xs, ys = (
        np.atleast_1d(_numbers(f"{path}: {name}", arrays[name], float))
        for name in ("angles", "xs", "ys")
    )
    if not angles.ndim == xs.ndim == ys.ndim == 1:
        raise RecordError(f"{path}: expected angles, xs and ys with one axis each")
    grid = (len(angles), len(xs), len(ys))
    for name, array in (("success", success), ("nan", nan)):
        if array.ndim != 4 or array.shape[:3] != grid or array.shape != success.shape:
            raise RecordError(
                f"{path}: {name}: expected shape [angles, xs, ys, episodes] = {grid} + (S,), "
                f"got {array.shape}"
            )
    return Sweep(angles, xs, ys, success, nan, worlds_of(arrays))


def load_json(path: Path) -> dict[str, Any]:
    """Read a JSON object."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise RecordError(f"{path}: not readable as JSON ({error})") from error
    if not isinstance(content, dict):
        raise RecordError(f"{path}: expected a JSON object, got {type(content).__name__}")
    return content


def load_sessions(path: Path) -> list[dict[str, Any]]:
    """Read env.json: an entry for every time that a run was worked on, the first one first. Files
    of before there were several hold the last one alone."""
    content = load_json(path)
    sessions = content.get("sessions", [content])
    if not isinstance(sessions, list) or not all(isinstance(entry, dict) for entry in sessions):
        raise RecordError(
            f"{path}: sessions: expected a list of JSON objects, got {sessions!r:.80}"
        )
    return sessions


def load_notes(path: Path) -> dict[str, Any]:
    """A JSON object on which no result rests: empty if it is absent or damaged."""
    try:
        return load_json(path)
    except RecordError:
        return {}


def seconds(notes: Mapping[str, Any], name: str) -> float | None:
    """A time that was noted; None if it was not, or is none."""
    value = notes.get(name)
    if isinstance(value, (int, float)) and 0 <= value < math.inf:
        return float(value)
    return None


def load_counts(path: Path) -> dict[str, dict[str, int]]:
    """Read eval.json and check that every domain holds sane counts."""
    result = {}
    for domain, entry in load_json(path).items():
        try:
            good, total = int(entry["successes"]), int(entry["episodes"])
            nan = int(entry.get("nan", 0))
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
            raise RecordError(
                f"{path}: {domain}: expected successes, episodes and nan, got {entry!r}"
            ) from error
        if not 0 <= good <= total or not 0 <= nan <= total:
            raise RecordError(f"{path}: {domain}: impossible counts {entry!r}")
        result[domain] = {"successes": good, "episodes": total, "nan": nan}
    return result


def check_counts(path: Path, episodes: Mapping[str, DomainRecord]) -> None:
    """Check that the counts of an eval.json are those of the episodes beside it.

    JSON has no checksum: a digit that was changed is found in this way.

    Raises:
      RecordError: they differ; the domain is named.
    """
    compare_counts(path, load_counts(path), episodes)


def compare_counts(
    where: object, stored: Mapping[str, Mapping[str, int]], episodes: Mapping[str, DomainRecord]
) -> None:
    """`check_counts` of counts that were read; `where` names them."""
    counted = counts(episodes)
    for domain in {**stored, **counted}:
        if stored.get(domain) != counted.get(domain):
            raise RecordError(
                f"{where}: {domain}: {stored.get(domain)}, but the episodes in the .npz file "
                f"beside it count {counted.get(domain)}"
            )


def load_metrics(path: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """Read metrics.jsonl; unreadable lines are not fatal.

    Returns:
      the records, and a sentence for each thing that was wrong with the file.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            records = read_metrics(path)
        except OSError as error:
            raise RecordError(f"{path}: not readable ({error})") from error
    return records, [str(warning.message) for warning in caught]
