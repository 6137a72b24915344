"""Checkpoints that are whole, or known not to be.

Layout of a folder of checkpoints::

    checkpoints/
      400/              one checkpoint: the folder's name is the step
        manifest.json   written last: size and SHA-256 of every other file, and what is in them
        arrays/         the leaves, written by Orbax
      600/
      damaged/          what was set aside, each named STEP-REASON

Orbax stores the arrays, but neither notices a flipped byte in a chunk nor refuses an empty folder
that is named like a step; it casts dtypes silently, too. So everything here goes by the manifest:
`save` writes into a hidden folder, hashes, syncs and renames; `latest_valid` returns the newest
checkpoint whose every byte is as it was written, and moves what is not to `damaged/`; `load`
compares names, shapes and dtypes of all leaves before reading.

No pickle is written or read. A tree is stored as its leaves by name ("params/head/output/bias"), so
that a checkpoint depends on no class of Flax or Optax; the target of `load` gives the structure.
"""

import contextlib
import errno
import hashlib
import json
import logging
import math
import os
import shutil
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as orbax
from orbax.checkpoint import v1 as ocp

from palm_jax.train.files import versions
from palm_jax.train.files.metrics import fsync_folder, plain, write_atomic

FORMAT = "palm_jax.checkpoint"
VERSION = 1
_LOOKS = 5  # so often in a row what a failed save has left must be gone...
_CLEARING_S = 5.0  # ...within this time
MANIFEST = "manifest.json"
ARRAYS = "arrays"
DAMAGED = "damaged"
SAVING = ".saving-"  # .saving-STEP-PID: being written, or left by a process that was killed
REMOVING = ".removing-"  # being deleted: nothing in there is wanted
SCORE = "score"
"""The entry of a checkpoint's meta data by which `prune` and `best` choose; larger is better."""
FINGERPRINT = "config"
"""The entry that says to which run's configuration a checkpoint belongs."""
GONE = "gone"
"""The reason of a checkpoint that was removed while it was read: nothing is damaged."""
NEWEST = 2
"""How many of the newest `prune` spares: should the last be damaged, little is lost."""

_OUR_OWN = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)
"""Errors that are this process's or machine's, and say nothing of what was to be read."""

_log = logging.getLogger(__name__)


class CheckpointError(ValueError):
    """A checkpoint cannot be used."""


class DamagedCheckpoint(CheckpointError):
    """A checkpoint's files are not what was written; `reason` is a short name for how."""

    def __init__(self, path: Path, reason: str, detail: str):
        super().__init__(f"{path}: {detail} ({reason})")
        self.reason = reason


class CheckpointMismatch(CheckpointError):
    """A whole checkpoint holds other leaves than the target; the message names one."""


# ---------------------------------------------------------------------------------------- leaves


def _named_leaves(tree: Any) -> dict[str, Any]:
    """ "a/b/0" -> leaf, in tree order."""
    named: dict[str, Any] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        if name in named or not all(name.split("/")):
            raise ValueError(f"cannot store a leaf under the name {name!r}: empty or not unique")
        if jnp.issubdtype(getattr(leaf, "dtype", np.float32), jax.dtypes.prng_key):
            raise ValueError(f"leaf {name!r} is a typed key: store its jax.random.key_data")
        named[name] = leaf
    if not named:
        raise ValueError("nothing to save or to load: the tree has no leaves")
    return named


def _describe(leaf: Any) -> dict[str, Any]:
    """Shape and dtype as the manifest has them."""
    if not hasattr(leaf, "dtype"):
        leaf = np.asarray(leaf)
    return {"dtype": str(leaf.dtype), "shape": [int(n) for n in leaf.shape]}


def nested(named: Mapping[str, Any]) -> dict[str, Any]:
    """The tree of dictionaries in which leaves have these names."""
    tree: dict[str, Any] = {}
    for name, leaf in named.items():
        *folders, last = name.split("/")
        inner = tree
        for folder in folders:
            inner = inner.setdefault(folder, {})
        inner[last] = leaf
    return tree


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True, allow_nan=False).encode()).hexdigest()


# ------------------------------------------------------------------------------------------ save


def save(
    directory: str | Path,
    step: int,
    tree: Any,
    meta: Mapping[str, Any] | None = None,
    *,
    keep: int | None = None,
) -> Path:
    """Write one checkpoint; when this returns, it is on disk and whole.

    Args:
      directory: the folder of checkpoints; made if absent. A checkpoint of the same step in it is
        replaced.
      step: 0 or more.
      tree: any pytree of arrays and numbers; they are gathered to the host.
      meta: whatever JSON can hold, returned by `read_meta`; `score` decides what is kept.
      keep: if given, `prune(directory, keep=keep)` afterwards.

    Returns:
      the checkpoint's folder, directory/STEP.
    """
    directory = Path(directory).absolute()  # Orbax refuses relative paths
    if step < 0:
        raise ValueError(f"step is {step}; expected 0 or more")
    named = _named_leaves(tree)
    directory.mkdir(parents=True, exist_ok=True)
    temporary = directory / f"{SAVING}{step}-{os.getpid()}"
    _remove(temporary)
    try:
        temporary.mkdir()
        _write_arrays(temporary / ARRAYS, named)
        manifest = {
            "format": FORMAT,
            "version": VERSION,
            "step": int(step),
            "files": _hash_files(temporary),
            "leaves": {name: _describe(leaf) for name, leaf in named.items()},
            "versions": versions.current(),
            "meta": plain(meta or {}),
        }
        _write_manifest(temporary, manifest)
        final = directory / str(step)
        _put_in_place(temporary, final)
    except BaseException:
        _clear(temporary)
        raise
    if keep is not None:
        prune(directory, keep=keep)
    return final


def _clear(temporary: Path) -> None:
    """Delete what a failed save has written. Orbax raises with its first write that fails, while
    threads of it finish theirs and make the folder anew: gone is what stays away for a while."""
    looks, end = 0, time.monotonic() + _CLEARING_S
    while looks < _LOOKS and time.monotonic() < end:
        shutil.rmtree(temporary, ignore_errors=True)
        time.sleep(0.05)
        looks = 0 if temporary.exists() else looks + 1


def _write_arrays(path: Path, named: Mapping[str, Any]) -> None:
    host = {name: np.asarray(leaf) for name, leaf in named.items()}
    # Orbax refuses arrays without elements; the manifest's shape and dtype say all about them.
    tree = nested({name: array for name, array in host.items() if array.size})
    try:
        _orbax_save(path, tree)
    except OSError:
        raise
    except Exception as error:  # a full disk is a ValueError to Orbax, with a page of context
        cause = str(error).rpartition(": ")[2]
        raise OSError(f"{path.parent.parent}: the checkpoint cannot be written: {cause}") from error


def _orbax_save(path: Path, tree: Mapping[str, Any]) -> None:
    if jax.process_count() == 1:
        ocp.save(path, tree)
        return
    # Parameters are the same in every process, and one of them writes; but ocp.save (0.12.8) would
    # wait for the others all the same. The older interface does what its options say.
    options = orbax.options.MultiprocessingOptions(**_alone())
    handler = orbax.PyTreeCheckpointHandler(multiprocessing_options=options)
    with orbax.Checkpointer(handler, multiprocessing_options=options) as checkpointer:
        checkpointer.save(path, tree)


def _alone() -> dict[str, Any]:
    """Orbax's words for: this process, without the others."""
    return {"primary_host": jax.process_index(), "active_processes": {jax.process_index()}}


def _reading() -> contextlib.AbstractContextManager[Any]:
    """Lets Orbax read in this process without the others."""
    if jax.process_count() == 1:
        return contextlib.nullcontext()
    context = ocp.Context()
    for name, value in _alone().items():
        setattr(context.multiprocessing, name, value)
    return context


def _hash_files(folder: Path) -> dict[str, dict[str, Any]]:
    """Sizes and hashes of all files below; syncs each, and each folder, on the way."""
    files = {}
    for path in sorted(folder.rglob("*")):
        if path.is_dir():
            fsync_folder(path)
            continue
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            os.fsync(file.fileno())
        files[path.relative_to(folder).as_posix()] = {
            "size": path.stat().st_size,
            "sha256": digest,
        }
    return files


def _write_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    content = {name: value for name, value in manifest.items() if name != "checksum"}
    content["checksum"] = _digest(content)
    write_atomic(folder / MANIFEST, (json.dumps(content, indent=1) + "\n").encode())


def _put_in_place(new: Path, final: Path) -> None:
    """Give a whole checkpoint its name. What had the name goes last: a crash on the way leaves one
    of the two whole, under the name or under one that `_sweep_leftovers` knows."""
    old = _hide(final) if final.exists() else None
    try:
        os.rename(new, final)
    except BaseException:
        if old is not None:
            os.rename(old, final)
        raise
    fsync_folder(final.parent)
    if old is not None:
        shutil.rmtree(old, ignore_errors=True)


def _hide(path: Path) -> Path:
    """Take the name from what is to be deleted; where it is then."""
    hidden = path.with_name(f"{REMOVING}{path.name.lstrip('.')}-{os.getpid()}")
    shutil.rmtree(hidden, ignore_errors=True)
    os.rename(path, hidden)
    return hidden


def _remove(path: Path) -> None:
    """Delete a checkpoint such that a crash on the way never leaves a part under its name."""
    if path.exists():
        shutil.rmtree(_hide(path), ignore_errors=True)


# ---------------------------------------------------------------------------------------- verify


def verify(path: str | Path) -> dict[str, Any]:
    """Compare every byte of a checkpoint with its manifest, and return the manifest.

    Raises:
      DamagedCheckpoint: something is missing or differs, or this is not a checkpoint at all.
    """
    path = Path(path)
    manifest = _read_manifest(path)
    with _explained(path):
        _refuse_ways_out(path, manifest["files"])
        for name, expected in manifest["files"].items():
            _verify_file(path, name, expected)
    return manifest


def _verify_file(path: Path, name: str, expected: Mapping[str, Any]) -> None:
    file = path / name
    if not file.is_file():
        raise DamagedCheckpoint(path, "missing-file", f"{name} is missing")
    size = file.stat().st_size
    if size != expected["size"]:
        raise DamagedCheckpoint(
            path, "wrong-size", f"{name} has {size} bytes, expected {expected['size']}"
        )
    with file.open("rb") as stream:
        if hashlib.file_digest(stream, "sha256").hexdigest() != expected["sha256"]:
            raise DamagedCheckpoint(path, "wrong-hash", f"{name} differs from what was written")


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    """While files of a checkpoint are read: it may be removed meanwhile, and the disk may fail."""
    try:
        yield
    except (DamagedCheckpoint, OSError) as error:
        if not os.path.lexists(path):
            raise DamagedCheckpoint(path, GONE, "there is none, or it has been removed") from error
        if isinstance(error, DamagedCheckpoint) or error.errno in _OUR_OWN:
            raise
        raise DamagedCheckpoint(path, "unreadable", str(error)) from error


def _refuse_ways_out(path: Path, names: Iterable[str]) -> None:
    """Whoever made the files, reading a checkpoint reads its own folder and nothing else."""
    for name in names:
        parts = PurePosixPath(name).parts
        if not parts or name.startswith("/") or ".." in parts:
            raise DamagedCheckpoint(path, "way-out", f"{MANIFEST} names {name!r}, a file elsewhere")
    for folder, folders, files in os.walk(path):
        for link in (Path(folder, name) for name in folders + files):
            if link.is_symlink():
                raise DamagedCheckpoint(path, "link", f"{link.relative_to(path)} is a link")


def _read_manifest(path: Path) -> dict[str, Any]:
    with _explained(path):
        return _manifest_of(path)


def _manifest_of(path: Path) -> dict[str, Any]:
    if path.is_symlink() or (path / MANIFEST).is_symlink():
        raise DamagedCheckpoint(path, "link", "expected a folder and files, not links")
    if not path.is_dir():
        raise DamagedCheckpoint(path, "not-a-folder", "expected a folder")
    if not any(path.iterdir()):
        raise DamagedCheckpoint(path, "empty", "the folder is empty")
    file = path / MANIFEST
    if not file.is_file():
        raise DamagedCheckpoint(path, "no-manifest", f"{MANIFEST} is missing")
    try:
        manifest = json.loads(file.read_bytes())
        if manifest["format"] != FORMAT or manifest["version"] != VERSION:
            raise DamagedCheckpoint(
                path,
                "unknown-format",
                f"{MANIFEST} says {manifest['format']!r} version {manifest['version']!r}, "
                f"this program reads {FORMAT!r} version {VERSION}",
            )
        content = {name: value for name, value in manifest.items() if name != "checksum"}
        intact = _digest(content) == manifest["checksum"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        if isinstance(error, DamagedCheckpoint):
            raise
        raise DamagedCheckpoint(path, "bad-manifest", f"{MANIFEST} is unreadable") from error
    if not intact:
        raise DamagedCheckpoint(path, "bad-manifest", f"{MANIFEST} differs from its own checksum")
    if wrong := _wrong_entry(manifest):
        raise DamagedCheckpoint(
            path, "bad-manifest", f"{MANIFEST}: {wrong} is not what it has to be, or is missing"
        )
    if path.name.isdigit() and manifest["step"] != int(path.name):
        raise DamagedCheckpoint(path, "wrong-step", f"holds step {manifest['step']}")
    return manifest


def _wrong_entry(manifest: Mapping[str, Any]) -> str | None:
    """The first entry of a manifest that is of another kind than `save` writes: a checksum tells
    damage, not who wrote it."""
    kinds = {"step": int, "files": dict, "leaves": dict, "meta": dict}
    for name, kind in kinds.items():
        if type(manifest.get(name)) is not kind:
            return name
    for name, field, kind in (
        ("files", "size", int), ("files", "sha256", str), ("leaves", "dtype", str),
        ("leaves", "shape", list),
    ):  # fmt: skip
        for key, entry in manifest[name].items():
            if not isinstance(entry, dict) or type(entry.get(field)) is not kind:
                return f"{name}: {key}"
    return None


def steps(directory: str | Path) -> list[tuple[int, Path]]:
    """(step, folder) of everything named like a checkpoint, by ascending step; not verified."""
    directory = Path(directory)
    if not directory.is_dir():
        return []
    found = [(int(path.name), path) for path in directory.iterdir() if path.name.isdecimal()]
    return sorted(found)


def latest_valid(
    directory: str | Path, *, repair: bool = True, fingerprints: Collection[str] = ()
) -> tuple[int, Path] | None:
    """The newest checkpoint that is whole, as (step, folder), or None if there is none.

    Args:
      directory: the folder of checkpoints; it need not exist.
      repair: move damaged checkpoints, and those that a killed process left half-written, to
        `directory/damaged/STEP-REASON`, and log a warning for each. False only looks: for readers
        of a folder into which another process may be writing.
      fingerprints: if given, a checkpoint whose meta data have a `FINGERPRINT` that is none of them
        is another run's, and treated like a damaged one.
    """
    directory = Path(directory)
    if repair and directory.is_dir():
        _sweep_leftovers(directory)
    for step, path in reversed(steps(directory)):
        try:
            _refuse_foreign(path, verify(path), fingerprints)
        except DamagedCheckpoint as damage:
            if repair and damage.reason != GONE:
                _set_aside(path, f"{step}-{damage.reason}", str(damage))
            continue
        return step, path
    return None


def _refuse_foreign(path: Path, manifest: Mapping[str, Any], fingerprints: Collection[str]) -> None:
    found = manifest["meta"].get(FINGERPRINT)
    if fingerprints and found is not None and found not in fingerprints:
        raise DamagedCheckpoint(path, "foreign", "belongs to a run with other options")


def _sweep_leftovers(directory: Path) -> None:
    for path in sorted(directory.glob(f"{SAVING}*")):
        step, _, pid = path.name.removeprefix(SAVING).partition("-")
        if _is_other_process(pid):
            continue
        final = directory / step
        if not final.exists() and _is_whole(path, step):
            _put_in_place(path, final)  # nothing but its name was missing
        else:
            _set_aside(path, f"{step}-unfinished", f"{path}: never completed (unfinished)")
    for path in directory.glob(f"{REMOVING}*"):
        if not _is_other_process(path.name.rpartition("-")[2]):
            shutil.rmtree(path, ignore_errors=True)


def _is_whole(path: Path, step: str) -> bool:
    try:
        return str(verify(path)["step"]) == step
    except DamagedCheckpoint:
        return False


def _is_other_process(pid: str) -> bool:
    """Whether a process of this number, not ours, is alive: it may still be writing."""
    if not pid.isdecimal() or int(pid) == os.getpid():
        return False
    try:
        os.kill(int(pid), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _set_aside(path: Path, name: str, why: str) -> Path:
    folder = path.parent / DAMAGED
    folder.mkdir(exist_ok=True)
    target = next(target for target in _candidates(folder / name) if not target.exists())
    os.rename(path, target)
    _log.warning("checkpoint set aside: %s; moved to %s", why, target)
    return target


def _candidates(path: Path) -> Iterator[Path]:
    yield path
    number = 2
    while True:
        yield path.with_name(f"{path.name}-{number}")
        number += 1


# ------------------------------------------------------------------------------------------ load


def load(path: str | Path, target: Any) -> Any:
    """Read a checkpoint into the structure of `target`.

    Args:
      path: a checkpoint's folder. It is verified first.
      target: a pytree of arrays or `jax.ShapeDtypeStruct`s (as from `jax.eval_shape`), with exactly
        the leaves that were saved.

    Returns:
      the tree; leaves are NumPy arrays where the target's are, else JAX arrays with the sharding
      of the target's leaf if that has one.

    Raises:
      DamagedCheckpoint: the files are not what was written.
      CheckpointMismatch: a leaf's name, shape or dtype differs; nothing is ever cast.
    """
    path = Path(path)
    manifest = verify(path)
    named = _named_leaves(target)
    _compare(path, manifest["leaves"], {name: _describe(leaf) for name, leaf in named.items()})
    arrays = _read_arrays(path / ARRAYS)
    for name, leaf in named.items():
        if 0 in np.shape(leaf):
            arrays[name] = np.empty(leaf.shape, leaf.dtype)
    leaves = [_restore(arrays[name], leaf) for name, leaf in named.items()]
    return jax.tree.unflatten(jax.tree.structure(target), leaves)


def _compare(path: Path, saved: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    def fail(problem: str) -> None:
        raise CheckpointMismatch(
            f"{path}: {problem}. It was written with another configuration (network, views, "
            "optimiser or task): use the run's own, or start a new run"
        )

    for name in wanted:
        if name not in saved:
            fail(f"leaf {name!r} is expected, but not in the checkpoint")
        if saved[name] != wanted[name]:
            was, want = saved[name], wanted[name]
            fail(
                f"leaf {name!r}: expected {want['dtype']}{want['shape']}, "
                f"the checkpoint has {was['dtype']}{was['shape']}"
            )
    extra = [name for name in saved if name not in wanted]
    if extra:
        fail(f"leaf {extra[0]!r} is in the checkpoint, but not expected ({len(extra)} such)")


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All leaves as host arrays, whatever devices they were saved from."""
    path = path.absolute()
    with _reading():
        metadata = ocp.metadata(path).metadata
        like = jax.tree.map(lambda leaf: np.empty(leaf.shape, leaf.dtype), metadata)
        found = ocp.load(path, like)
    return {name: np.asarray(leaf) for name, leaf in _named_leaves(found).items()}


def _restore(value: np.ndarray, like: Any) -> Any:
    if not isinstance(like, (jax.Array, jax.ShapeDtypeStruct)):
        return value
    array = jnp.array(value)  # a copy: a JAX array that shares NumPy's memory cannot be donated
    sharding = getattr(like, "sharding", None)
    return array if sharding is None else jax.device_put(array, sharding)


# ------------------------------------------------------------------------------- meta, retention


def read_meta(path: str | Path) -> dict[str, Any]:
    """The meta data of a checkpoint; reads the manifest only.

    Raises:
      DamagedCheckpoint: the manifest is missing or damaged.
    """
    return _read_manifest(Path(path))["meta"]


def versions_of(path: str | Path) -> Any:
    """What a checkpoint says of the versions that wrote it."""
    return _read_manifest(Path(path)).get("versions")


def content_hash(path: str | Path) -> str:
    """SHA-256 of what a checkpoint holds: equal for copies, whatever their meta data say."""
    manifest = _read_manifest(Path(path))
    return _digest({name: manifest[name] for name in ("step", "files", "leaves")})


def update_meta(path: str | Path, **values: Any) -> None:
    """Add or replace entries of a checkpoint's meta data, atomically (e.g. a `score`)."""
    path = Path(path)
    manifest = _read_manifest(path)
    _write_manifest(path, {**manifest, "meta": {**manifest["meta"], **plain(values)}})


def best(
    directory: str | Path, *, count: int = 1, score: str = SCORE, fingerprints: Collection[str] = ()
) -> list[tuple[int, Path]]:
    """Up to `count` whole checkpoints by falling score, the newer first among equals.

    Those without a finite score, and another run's (see `latest_valid`), are never among them.
    """
    ranked: list[tuple[int, Path]] = []
    for step, path in _ranked(Path(directory), score):
        if len(ranked) == count:
            break
        try:
            _refuse_foreign(path, verify(path), fingerprints)
        except DamagedCheckpoint as damage:
            _log.warning("checkpoint passed over: %s", damage)
        else:
            ranked.append((step, path))
    return ranked


def _ranked(directory: Path, score: str) -> list[tuple[int, Path]]:
    scored = []
    for step, path in steps(directory):
        try:
            value = read_meta(path).get(score)
        except DamagedCheckpoint:
            continue
        if isinstance(value, (int, float)) and math.isfinite(value):
            scored.append((float(value), step, path))
    scored.sort(key=lambda entry: entry[:2], reverse=True)
    return [(step, path) for _, step, path in scored]


def prune(directory: str | Path, *, keep: int, score: str = SCORE) -> list[int]:
    """Delete all but the `keep` best by score and the two newest; returns the deleted steps.

    Without scores only the newest stay. Damaged checkpoints are not touched.
    """
    directory = Path(directory)
    if keep < 0:
        raise ValueError(f"keep is {keep}; expected 0 or more")
    readable = []
    for step, path in steps(directory):
        try:
            _read_manifest(path)
        except DamagedCheckpoint:
            continue
        readable.append((step, path))
    spared = {step for step, _ in _ranked(directory, score)[:keep]}
    spared |= {step for step, _ in readable[-NEWEST:]}
    deleted = []
    for step, path in readable:
        if step not in spared:
            _remove(path)
            deleted.append(step)
    return deleted
