"""Parts of a sweep, made by several machines and joined into one file.

The episodes of a sweep draw nothing from each other. Shard i of n runs the i-th part of them, whole
batches of the grid or whole strengths of a shift, and leaves RUN/shards/NAME-i-of-n.npz: the arrays
of the whole sweep, of which its own part counts, and a header with the conditions. `merge` joins
the shards of one command, after a look at their headers, into the file of the undivided sweep.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palm_jax.train.files import records

FOLDER = "shards"


class ShardError(ValueError):
    """Shards that cannot be made or joined; the message says which and why."""


def parse(text: str) -> tuple[int, int]:
    """(i, n) of "i/n".

    Raises:
      ShardError: anything else, or i not from 1 to n.
    """
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    if match and 1 <= int(match[1]) <= int(match[2]):
        return int(match[1]), int(match[2])
    raise ShardError(f"shard: expected i/n with i from 1 to n, got {text!r}")


def path_of(whole: Path, index: int, count: int) -> Path:
    """Where shard `index` of `count` of the sweep `whole` lies."""
    return whole.parent / FOLDER / f"{whole.stem}-{index}-of-{count}.npz"


def load(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """A shard's arrays, and its header.

    Raises:
      RecordError: not a readable .npz file.
      ShardError: it has no header.
    """
    arrays = records.load_arrays(path)
    header = records.header_of(arrays)
    if not header:
        raise ShardError(f"{path}: not a shard of a sweep (no readable header)")
    return arrays, header


def check(path: Path, found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Raises ShardError for the first field in which two headers differ."""
    for name in sorted({*found, *expected}):
        if found.get(name) != expected.get(name):
            raise ShardError(
                f"{path} was made with {name} = {found.get(name)!r}, here it is "
                f"{expected.get(name)!r}: shards of two kinds are not joined. Give all of them the "
                "same command, run and versions, or sweep this one again (--redo)"
            )


def merge(
    whole: Path,
    shape: tuple[int, ...],
    part: Callable[[tuple[int, int]], range],
    grid: Mapping[str, Any],
    header: Mapping[str, Any],
) -> dict[str, Any]:
    """The outcomes (`success`, `nan`) and the smallest `worlds` of a whole sweep, from its shards.

    Args:
      whole: the file of the undivided sweep; it names the shards.
      shape: of the outcomes.
      part: shard (i, n) -> its rows, in the flattened outcomes.
      grid: arrays of the record that every shard has to have just so.
      header: the conditions of the command that joins.

    Raises:
      ShardError: a shard is missing, or was made under other conditions; the message names it.
      RecordError: a file that cannot be read.
    """
    count = _count(whole)
    joined = {name: np.zeros(int(np.prod(shape)), bool) for name in ("success", "nan")}
    worlds = []
    for index in range(1, count + 1):
        path = path_of(whole, index, count)
        arrays, found = load(path)
        check(path, found, header)
        _check_arrays(path, arrays, shape, grid)
        rows = slice(part((index, count)).start, part((index, count)).stop)
        for name, into in joined.items():
            into[rows] = arrays[name].astype(bool).ravel()[rows]
        worlds.append(records.worlds_of(arrays))
    outcomes = {name: values.reshape(shape) for name, values in joined.items()}
    return {**outcomes, "worlds": min(worlds)}


def _count(whole: Path) -> int:
    """How many shards there are; all must be there."""
    pattern = re.compile(re.escape(whole.stem) + r"-(\d{1,6})-of-(\d{1,6})\.npz")
    folder = whole.parent / FOLDER
    names = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    found: dict[int, set[int]] = {}
    for match in filter(None, map(pattern.fullmatch, names)):
        found.setdefault(int(match[2]), set()).add(int(match[1]))
    if len(found) != 1:
        kinds = " and ".join(f"{n} parts" for n in sorted(found)) or "none"
        raise ShardError(f"{folder}: expected the shards of one sweep {whole.stem}, found {kinds}")
    count, indices = found.popitem()
    missing: Sequence[int] = sorted(set(range(1, count + 1)) - indices)
    if missing:
        words = ", ".join(f"{index}/{count}" for index in missing[:9])
        raise ShardError(
            f"{folder}: of {whole.stem} the shards {words} are missing ({len(missing)} of {count})"
            f": run the same command with --shard {missing[0]}/{count}"
        )
    return count


def _check_arrays(
    path: Path,
    arrays: Mapping[str, NDArray[Any]],
    shape: tuple[int, ...],
    grid: Mapping[str, Any],
) -> None:
    for name in ("success", "nan"):
        if name not in arrays or arrays[name].shape != shape:
            got = arrays[name].shape if name in arrays else "nothing"
            raise ShardError(f"{path}: {name}: expected shape {shape}, got {got}")
    for name, value in grid.items():
        if name not in arrays or not np.array_equal(arrays[name], np.asarray(value)):
            raise ShardError(f"{path}: its {name} are not those of this command")
