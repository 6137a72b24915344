"""Every reader, given files with random damage: what it refuses it names, and it never guesses."""

import functools
import json
import random
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import jax
import numpy as np
from faults import damaged_files
from faults.cases import Outcome, case, snapshot

from palm_jax.train import checkpoint, debug, demos, table, workspace
from palm_jax.train.config import ConfigError
from palm_jax.train.files import locks, records

SECONDS = 20.0  # of each reader, in the long campaign
SHORT = 0.4


def mutate(content: bytes, rng: random.Random) -> bytes:
    """Some bits flipped, a part cut out, doubled, or replaced by noise, or the end cut off."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        if not data:
            break
        at, length = rng.randrange(len(data)), rng.choice((1, 2, 8, 64))
        kind = rng.randrange(5)
        if kind == 0:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del data[at : at + length]
        elif kind == 2:
            data[at:at] = data[at : at + length]
        elif kind == 3:
            data[at : at + length] = rng.randbytes(length)
        else:
            del data[at:]
    return bytes(data)


def _fuzz(
    folder: Path,
    make: Callable[[Path], Path],
    read: Callable[[Path], Any],
    errors: tuple[type[Exception], ...],
    seconds: float,
    exact: bool,
) -> Outcome:
    """Reads mutations for so long; with `exact`, what is accepted must be what was written."""
    path = make(folder)
    good, rng = path.read_bytes(), random.Random(1)
    expected = _plain(read(path))
    end, tried, accepted = time.monotonic() + seconds, 0, 0
    while time.monotonic() < end or tried < 20:
        bad = mutate(good, rng)
        path.write_bytes(bad)
        tried += 1
        try:
            found = read(path)
        except errors as error:
            named = path.name in str(error) or path.parent.name in str(error)
            assert named, f"the message does not name the file: {error}"
        else:
            accepted += 1
            assert not exact or bad == good or _plain(found) == expected, "wrong data were accepted"
        assert path.read_bytes() == bad, "a reader changed the file"
    return Outcome("refused by name, or read as written" if exact else "refused by name, or read")


def _plain(value: Any) -> Any:
    leaves = jax.tree_util.tree_leaves_with_path(
        value if isinstance(value, (dict, list)) else vars(value)
    )
    return [(str(path), np.asarray(leaf).tobytes()) for path, leaf in leaves]


def _eval_npz(folder: Path) -> Path:
    damaged_files._results(folder)
    return folder / "eval.npz"


def _read_eval(path: Path) -> Any:
    return {name: vars(record) for name, record in records.load_eval(path).items()}


def _eval_json(folder: Path) -> Path:
    damaged_files._results(folder)
    return folder / "eval.json"


def _read_counts(path: Path) -> Any:
    """As a run reads them: against the episodes."""
    records.check_counts(path, records.load_eval(path.with_suffix(".npz")))
    return records.load_counts(path)


def _sweep_npz(folder: Path) -> Path:
    cells = np.random.default_rng(0).random((2, 3, 4, 5)) < 0.5
    axes = (np.arange(float(n)) for n in cells.shape[:3])
    return records.save_sweep(folder / "sweep.npz", records.Sweep(*axes, cells, ~cells))


def _strength_npz(folder: Path) -> Path:
    cells = np.random.default_rng(0).random((4, 5)) < 0.5
    curve = records.StrengthSweep("lighting", np.arange(4.0), cells, ~cells)
    return records.save_sweep(folder / "strength-lighting.npz", curve)


def _metrics(folder: Path) -> Path:
    path = folder / "metrics.jsonl"
    path.write_text("".join(json.dumps({"step": i, "loss": i / 7}) + "\n" for i in range(20)))
    return path


def _read_metrics(path: Path) -> Any:
    return {"rows": [str(row) for row in records.load_metrics(path)[0]]}


def _manifest(folder: Path) -> Path:
    return shutil.copytree(damaged_files._saved(), folder / "checkpoints") / "200/manifest.json"


def _arrays(folder: Path) -> Path:
    return damaged_files._largest(_manifest(folder).parent)


def _read_checkpoint(path: Path) -> Any:
    while path.name != "200":
        path = path.parent
    return checkpoint.load(path, damaged_files.TREE)


def _table_json(folder: Path) -> Path:
    return damaged_files._a_table(folder)[0].file


@functools.cache
def _fresh() -> dict[str, Any]:
    return table.header(table.TableConfig(preset="quick"))


def _read_table(path: Path) -> Any:
    return table.read(path, _fresh())["results"]


def _config_json(folder: Path) -> Path:
    workspace.begin(damaged_files._config(folder), folder, "palm")
    return folder / "config.json"


def _read_config(path: Path) -> Any:
    """As `sweep` and the policies read it."""
    return vars(workspace.stored_config(path.parent))


def _claim(folder: Path) -> Path:
    with locks.claim(folder):
        content = (folder / locks.CLAIM).read_text()
    path = folder / "claim"
    path.write_text(content)
    return path


def _read_claim(path: Path) -> Any:
    """None is a claim of nobody; whatever else must be one."""
    found = locks._Owner.read(path)
    return {"owner": "" if found is None else found.store()}


def _demos(folder: Path) -> Path:
    return damaged_files.demonstrations(folder / "demos.hdf5")


_RECORD = (records.RecordError,)
_CHECKPOINT = (checkpoint.CheckpointError,)
_READERS: tuple[tuple[str, Any, Any, tuple[type[Exception], ...], bool], ...] = (
    ("eval.npz", _eval_npz, _read_eval, _RECORD, True),
    ("eval.json beside its episodes", _eval_json, _read_counts, _RECORD, True),
    ("sweep.npz", _sweep_npz, records.load_sweep, _RECORD, True),
    ("strength.npz", _strength_npz, records.load_strengths, _RECORD, True),
    ("metrics.jsonl", _metrics, _read_metrics, _RECORD, False),
    ("a checkpoint's manifest", _manifest, _read_checkpoint, _CHECKPOINT, True),
    ("a checkpoint's arrays", _arrays, _read_checkpoint, _CHECKPOINT, True),
    ("table.json", _table_json, _read_table, (*_RECORD, ConfigError), True),
    ("config.json", _config_json, _read_config, (*_RECORD, ConfigError), False),
    ("a claim", _claim, _read_claim, (), False),
)

for _name, _make, _read, _errors, _exact in _READERS:
    for _long in (False, True):
        case(
            "fuzzing",
            f"{_name}, for {SECONDS if _long else SHORT:g} s",
            long=_long,
            make=_make,
            read=_read,
            errors=_errors,
            seconds=SECONDS if _long else SHORT,
            exact=_exact,
        )(_fuzz)


@case("fuzzing", "a bit in each of 30 arrays of the demonstrations")
def _bits_of_demonstrations(folder: Path) -> Outcome:
    """HDF5's own structures are left alone: its library may not return from broken ones."""
    path = _demos(folder)
    good = path.read_bytes()
    with h5py.File(path, "r") as file:
        places: list[int] = []
        file["data"].visititems(
            lambda _, item: (
                places.append(item.id.get_offset() + item.nbytes // 2)
                if isinstance(item, h5py.Dataset) and item.nbytes
                else None
            )
        )
    for place in random.Random(1).sample(places, 30):
        bad = bytearray(good)
        bad[place] ^= 4
        path.write_bytes(bytes(bad))
        try:
            damaged_files.read_demonstrations(path)
        except demos.DemoFileError as error:
            assert path.name in str(error)
        else:
            raise AssertionError(f"byte {place} is another one, and was not noticed")
    path.write_bytes(good)
    assert damaged_files.read_demonstrations(path).episodes == 2
    return Outcome("every one is noticed, and the file named", "the collection, said")


@case("fuzzing", "what is no dump is given to `debug replay`")
def _no_dump(folder: Path) -> Outcome:
    store = shutil.copytree(damaged_files._saved(), folder / "checkpoints")
    before = snapshot(store)
    for path in (folder, store, store / "200", folder / "absent"):
        assert debug.main(["replay", str(path)]) == 2
    assert snapshot(store) == before
    return Outcome("refused by name")
