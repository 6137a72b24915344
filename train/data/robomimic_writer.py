"""Aligned episodes into robomimic's HDF5 layout, beside what the source had."""

from __future__ import annotations

import contextlib
import json
import os
import zlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from palm_jax.train.data import output
from palm_jax.train.data.errors import disk_full, is_disk_full
from palm_jax.train.data.robomimic import RobomimicSource, by_number, is_image
from palm_jax.train.data.source import Source

COMPRESSIONS: dict[str, dict[str, Any]] = {
    "gzip": {"compression": "gzip", "compression_opts": 1},
    "lzf": {"compression": "lzf"},
    "none": {},
}
CHECKSUMS = "palm_sha256"
"""Attribute of an episode: {key: sha256} as JSON."""

RECIPE = "palm"
"""Attribute of `data`: how the file was made, as JSON."""

_DONE = "palm_complete"
_HASHED_ROWS = 64


def checksum(dataset: h5py.Dataset) -> str:
    """sha256 of an array, read in blocks."""
    digest = output.Digest()
    if not dataset.shape:  # a single value
        digest.add(np.asarray(dataset[()])[None])
        return digest.hex()
    for first in range(0, len(dataset), _HASHED_ROWS):
        digest.add(dataset[first : first + _HASHED_ROWS])
    return digest.hex()


def sound(demo: h5py.Group) -> list[str]:
    """Problems of an episode against its checksums; empty if it has none of either."""
    try:
        expected = json.loads(demo.attrs.get(CHECKSUMS, "{}")).items()
    except (ValueError, TypeError, AttributeError, RecursionError):
        return [f"the attribute {CHECKSUMS} cannot be read"]
    problems = []
    for key, value in expected:
        if not isinstance(demo.get(key), h5py.Dataset):
            problems.append(f"{key} is missing")
            continue
        try:
            if checksum(demo[key]) != value:
                problems.append(f"{key} is not what was written (sha256)")
        except (OSError, RuntimeError) as error:
            problems.append(f"{key} cannot be read ({error})")
    return problems


class RobomimicWriter(output.Writer):
    """See `output.Writer`.

    Args:
      partial: where it is written; its recipe is written into the file.
      source: what is kept comes from here.
      keep: "numbers" (all but images), "all" or "none" of the source's arrays.
      compression: of the aligned images, a key of `COMPRESSIONS`.
      prefix: of the new keys.
      instead: write the labels as `actions`, and the source's as `source_actions`.

    Raises:
      OutputError: a new key that is kept of the source, too.
    """

    def __init__(
        self,
        partial: output.Partial,
        source: Source,
        *,
        keep: str,
        compression: str,
        prefix: str,
        instead: bool,
    ):
        self.partial = partial
        self.source, self.keep, self.prefix = source, keep, prefix
        self.compression, self.options = compression, COMPRESSIONS[compression]
        self.actions = "actions" if instead else f"{prefix}_actions"
        self._check_names()
        self._demo: h5py.Group | None = None
        self._pool = ThreadPoolExecutor(min(4, os.cpu_count() or 1))
        self._path, left = partial.folder / "data.hdf5", partial.folder / "left.hdf5"
        if self._path.exists() and not left.exists():
            os.replace(self._path, left)
        self._path.unlink(missing_ok=True)
        self.file = h5py.File(self._path, "w")
        try:
            self._write_header()
            self._take_over(left)
        except BaseException:
            with contextlib.suppress(OSError, RuntimeError):  # a full disk
                self.close()
            raise

    def _check_names(self) -> None:
        new = [f"obs/{self.prefix}_{key}" for key in output.NEW if key != "actions"]
        if self.keep == "none":
            return
        if not isinstance(self.source, RobomimicSource):
            keys, self.skipped = self.source.in_all(self.source.episodes)
            self._kept = {key: _robomimic_name(key) for key in keys}
            output.check_names(map(self._old_name, self._kept.values()), [self.actions, *new])
            return
        for name in self.source.episodes:
            kept = [
                self._old_name(key)
                for key, dataset in self.source.datasets(name, every=True)
                if self.keep == "all" or not is_image(dataset)
            ]
            output.check_names(kept, [self.actions, *new])

    def _old_name(self, key: str) -> str:
        """What an array of the source is called beside the new ones."""
        return "source_actions" if key == self.actions == "actions" else key

    def _write_header(self) -> None:
        data = self.file.create_group("data")
        if isinstance(self.source, RobomimicSource):
            for name, value in self.source.data.attrs.items():
                data.attrs[name] = value
        else:
            args = {"env_name": self.source.task(self.source.episodes[0]), "env_kwargs": {}}
            args["env_kwargs"] = {"control_freq": self.source.fps}
            data.attrs["env_args"] = json.dumps(args)
        data.attrs[RECIPE] = json.dumps(self.partial.recipe)
        # Room for it now: an attribute that is added last would lie at the end of the file, and
        # with the end of a cut copy the list of episodes would be lost.
        data.attrs["total"] = 0
        self.file.flush()

    def _take_over(self, left: Path) -> None:
        """The sound episodes of a file that an earlier call has left. It is only read: where that
        call was killed, what HDF5 would write next could lie over what is there."""
        if not left.exists():
            return
        data, done = self.file["data"], {}
        try:
            with h5py.File(left, "r") as old:
                for name in sorted(old["data"], key=by_number):
                    demo = old["data"][name]
                    if demo.attrs.get(_DONE) and not sound(demo):
                        old.copy(demo, data, name=name)
                        done[name] = str(demo.attrs[_DONE])
        except (OSError, RuntimeError, KeyError, ValueError) as error:
            if is_disk_full(error):
                raise
            # Killed while it was written: the episodes up to here.
        for name in set(data) - set(done):
            del data[name]
        self.file.flush()
        self.done = tuple(done.values())
        left.unlink()

    def begin(self, name: str, length: int, numbers: Mapping[str, np.ndarray]) -> None:
        own = name if isinstance(self.source, RobomimicSource) else f"demo_{name}"
        self._demo = demo = self.file["data"].create_group(own)
        self._name, self._length, self._filled = name, length, 0
        self._digests: dict[str, output.Digest] = {}
        self._sums: dict[str, str] = {}
        self._keep(demo, name)
        for key, values in numbers.items():
            target = self.actions if key == "actions" else f"obs/{self.prefix}_{key}"
            demo[target] = values
            self._digest(target, values)
        demo.attrs["num_samples"] = length

    def _digest(self, target: str, values: np.ndarray) -> None:
        self._digests.setdefault(target, output.Digest()).add(values)

    def _keep(self, demo: h5py.Group, name: str) -> None:
        if isinstance(self.source, RobomimicSource):
            old = self.source.demo(name)
            for key, value in old.attrs.items():
                if not key.startswith("palm_"):
                    demo.attrs[key] = value
            if self.keep != "none":
                _copy(old, demo, images=self.keep == "all")
                if self.actions in demo:  # by --instead
                    demo.move(self.actions, self._old_name(self.actions))
                self._hash_kept(self.source, demo, name)
        elif self.keep != "none":
            for key, target in self._kept.items():
                values = self.source.numbers(name, key)
                demo[self._old_name(target)] = values
                self._digest(self._old_name(target), values)

    def _hash_kept(self, source: RobomimicSource, demo: h5py.Group, name: str) -> None:
        for key, dataset in source.datasets(name, every=True):
            target = self._old_name(key)
            if target not in demo:
                continue
            if is_image(dataset):
                for block in source.blocks(name, key, _HASHED_ROWS):
                    self._digest(target, block)
            else:
                self._sums[target] = checksum(dataset)

    def add(self, images: np.ndarray, numbers: Mapping[str, np.ndarray]) -> None:
        demo = self._demo
        assert demo is not None
        rows = slice(self._filled, self._filled + len(images))
        for key, values in (("image", images), *numbers.items()):
            target = f"obs/{self.prefix}_{key}"
            if target not in demo:
                shape = (self._length, *values.shape[1:])
                options = self.options if key == "image" else {}
                chunks = (1, *values.shape[1:]) if options else None
                demo.create_dataset(target, shape, values.dtype, chunks=chunks, **options)
            if key == "image" and self.compression == "gzip":
                self._write_gzip(demo[target], rows, values)
            else:
                demo[target][rows] = values
            self._digest(target, values)
        self._filled = rows.stop

    def _write_gzip(self, dataset: h5py.Dataset, rows: slice, images: np.ndarray) -> None:
        """A chunk for each image, compressed in threads: HDF5's filter would let no other run."""
        level = self.options["compression_opts"]
        packed = self._pool.map(lambda image: zlib.compress(image.tobytes(), level), images)
        for row, content in zip(range(rows.start, rows.stop), packed, strict=True):
            dataset.id.write_direct_chunk((row, 0, 0, 0), content)

    def end(self) -> None:
        demo = self._demo
        assert demo is not None and self._filled == self._length
        hashes = self._sums | {key: digest.hex() for key, digest in self._digests.items()}
        demo.attrs[CHECKSUMS] = json.dumps(hashes)
        demo.attrs[_DONE] = self._name
        self.file.flush()
        self._demo = None

    def complete(self) -> Path:
        data = self.file["data"]
        data.attrs["total"] = sum(int(demo.attrs["num_samples"]) for demo in data.values())
        if isinstance(self.source, RobomimicSource):
            copy_masks(self.source.file, self.file, list(data))
        self.close()
        return self._path

    def close(self) -> None:
        self._pool.shutdown()
        if self.file:  # not closed yet
            if self._demo is not None:
                del self.file[self._demo.name]
            self.file.close()


def _robomimic_name(key: str) -> str:
    """What a column of a LeRobot table is called in a robomimic file."""
    return "actions" if key == "action" else f"obs/{key.removeprefix('observation.')}"


def _copy(old: h5py.Group, new: h5py.Group, *, images: bool) -> None:
    """Everything of an episode, as it is stored; images only if asked for."""
    for key, item in old.items():
        if isinstance(item, h5py.Group):
            _copy(item, new.require_group(key), images=images)
        elif images or not is_image(item):
            old.copy(item, new, name=key)


def copy_masks(old: h5py.File, new: h5py.File, episodes: Sequence[str]) -> None:
    """Robomimic's filter keys, as far as they name episodes that are there."""
    if "mask" in new:  # an earlier call came as far as this
        del new["mask"]
    for key, item in (old.get("mask") or {}).items():
        names = [name for name in item[()] if name.decode() in episodes]
        new[f"mask/{key}"] = np.array(names, dtype=item.dtype)


def writing(path: Path) -> Any:
    """Turns a full disk into an error that says what is left: nothing."""
    return disk_full(path, "nothing half-written is left; make room, or choose another --out")
