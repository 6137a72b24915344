"""Robomimic's HDF5 files: `data/demo_i/{actions, states, obs/*}`, images uint8 [T, H, W, 3].

Reading is bound by decompression where images are compressed: their chunks are then decompressed in
threads, which h5py by itself does not do, and by `isal`, where that is installed, in half the time.
"""

from __future__ import annotations

import importlib
import itertools
import json
import os
import re
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from palm_jax.train.data import headers
from palm_jax.train.data.errors import FormatError, KeyMissingError, TruncatedError
from palm_jax.train.data.source import Feature, Source
from palm_jax.train.files import hdf5 as hdf5_files

CACHE_BYTES = 64 * 2**20
"""For chunks that are not read past HDF5, and larger than a block or pieces of frames."""

DEFAULT_FPS = 20.0
_ROWS = 64

REPAIR = "palm_repair"
"""Attribute of `data` in a file that `data repair` has written: what it left out, as JSON."""


def _inflater() -> Any:
    """`zlib`, or its faster twin."""
    try:
        return importlib.import_module("isal.isal_zlib")
    except ImportError:
        return zlib


_INFLATER = _inflater()


def by_number(name: str) -> tuple[int, str]:
    """Sorts demo_10 after demo_9."""
    digits = re.findall(r"\d+", name)
    return (int(digits[-1]) if digits else -1, name)


def open_hdf5(path: Path) -> h5py.File:
    """The file, open for reading.

    Raises:
      TruncatedError: it ends before its header says.
      FormatError: not readable as HDF5 for another reason.
    """
    try:
        return h5py.File(path, "r", rdcc_nbytes=CACHE_BYTES)
    except OSError as error:
        if "truncated" in str(error):
            raise TruncatedError(
                f"{path}: the file ends too early ({path.stat().st_size} bytes; {_stored(error)}): "
                "an interrupted copy or recording; copy it again, or save the whole episodes: "
                f"`python -m palm_jax data repair {path} --out NEW`"
            ) from error
        raise FormatError(f"{path}: not a readable HDF5 file ({error})") from error


def _stored(error: OSError) -> str:
    found = re.search(r"stored_eof = (\d+)", str(error))
    return f"its header says {found.group(1)}" if found else "its header says more"


def is_image(dataset: h5py.Dataset) -> bool:
    """Whether a data set of an episode holds colour images."""
    shape: tuple[int, ...] = dataset.shape or ()
    dtype = dataset.dtype
    return bool(len(shape) == 4 and shape[-1] == 3 and dtype == np.uint8 and min(shape[1:3]) > 4)


def refuse(path: Path, wrong: str | None) -> None:
    """Raises what `hdf5_files` has found.

    Raises:
      FormatError: with what to do.
    """
    if wrong:
        raise FormatError(
            f"{path}: {wrong}; a file may have been merged of others in this way: write one that "
            "holds all itself, with h5py's Group.copy(..., expand_soft=True, expand_external=True)"
        )


class RobomimicSource(Source):
    """A robomimic file. See `Source`. Nothing is read from other files that this one refers to.

    Raises:
      TruncatedError, FormatError: see `open_hdf5`; no `data` group, or no episode in it; an episode
        that lies in another file (where it is used).
    """

    format = "robomimic"

    def __init__(self, path: Path):
        self.path = path
        self.file = open_hdf5(path)
        self._pool: ThreadPoolExecutor | None = None
        try:
            self._read_header()
        except BaseException:
            self.file.close()
            raise

    def _read_header(self) -> None:
        for name in ("data", "mask"):
            refuse(self.path, hdf5_files.link(self.file, name))
        data = self.file.get("data")
        if not isinstance(data, h5py.Group):
            raise FormatError(
                f"{self.path}: no group 'data': not a robomimic file (found "
                f"{', '.join(self.file) or 'nothing'})"
            )
        self.data = data
        self._looked_at: set[str] = set()
        self._look_at_masks()
        names = [name for name in data if self._is_episode(name)]
        if not names:
            raise FormatError(f"{self.path}: no episode in 'data'")
        self.episodes = tuple(sorted(names, key=by_number))
        self.env_args = headers.parsed(data.attrs.get("env_args", "{}"), f"{self.path}: env_args")
        self.fps = self._rate()
        self._features = {key: _feature(dataset) for key, dataset in self.datasets(names[0])}

    def _rate(self) -> float:
        where = f"{self.path}: env_args: env_kwargs"
        told = headers.an_object(self.env_args.get("env_kwargs") or {}, where).get("control_freq")
        if told is not None:
            return headers.rate(told, f"{where}: control_freq")
        return headers.rate(self.data.attrs.get("fps", DEFAULT_FPS), f"{self.path}: fps")

    def _look_at_masks(self) -> None:
        try:
            if isinstance(masks := self.file.get("mask"), h5py.Group):
                refuse(self.path, hdf5_files.way_out(masks))
        except (OSError, RuntimeError, KeyError):
            pass  # damaged: an error where they are used

    def _is_episode(self, name: str) -> bool:
        try:
            if hdf5_files.link(self.data, name):
                return True
            return isinstance(self.data[name], h5py.Group)
        except (OSError, RuntimeError, KeyError):
            return True  # one that cannot be read is an error where it is used

    def demo(self, episode: str) -> h5py.Group:
        """The group of an episode.

        Raises:
          TruncatedError: it cannot be read.
          FormatError: it leads to another file.
        """
        try:
            if episode not in self._looked_at:
                refuse(self.path, hdf5_files.link(self.data, episode))
                refuse(self.path, hdf5_files.way_out(self.data[episode]))
                self._looked_at.add(episode)
            return self.data[episode]
        except (OSError, RuntimeError, KeyError) as error:
            raise TruncatedError(
                f"{self.path}: {episode} cannot be read ({error}); save the whole episodes: "
                f"`python -m palm_jax data repair {self.path} --out NEW`"
            ) from error

    def datasets(self, episode: str, *, every: bool = False) -> list[tuple[str, h5py.Dataset]]:
        """Arrays of an episode that have a row for each frame; with `every`, all there are."""
        found: list[tuple[str, h5py.Dataset]] = []

        def note(name: str, item: Any) -> None:
            if not isinstance(item, h5py.Dataset):
                return
            numeric = item.dtype.kind in "biuf" and item.shape
            if every or (numeric and not name.startswith("next_obs/")):
                found.append((name, item))

        self.demo(episode).visititems(note)
        return found

    def _dataset(self, episode: str, key: str) -> h5py.Dataset:
        try:
            dataset = self.demo(episode)[key]
        except KeyError:
            raise KeyMissingError(
                f"{self.path}: {episode} has no {key!r}, which the first episode has; leave the "
                "episode out with `data repair`"
            ) from None
        if not isinstance(dataset, h5py.Dataset) or not dataset.shape:
            raise FormatError(
                f"{self.path}: {episode}: {key}: expected an array with a row for each frame, got "
                f"{'a group' if isinstance(dataset, h5py.Group) else 'a single value'}; leave the "
                "episode out with `data repair`"
            )
        return dataset

    def length(self, episode: str) -> int:
        demo = self.demo(episode)
        if "actions" in demo:
            return len(self._dataset(episode, "actions"))
        if "num_samples" in demo.attrs:
            where = f"{self.path}: {episode}: num_samples"
            return headers.count(demo.attrs["num_samples"], where)
        return max((len(dataset) for _, dataset in self.datasets(episode)), default=0)

    def features(self) -> dict[str, Feature]:
        return self._features

    def in_all(self, episodes: Sequence[str]) -> tuple[list[str], dict[str, str]]:
        found: dict[str, list[Any]] = {}
        for name in episodes:
            length = self.length(name)
            for key, dataset in self.datasets(name, every=True):
                if key.startswith("next_obs/") or is_image(dataset):
                    continue
                fits = dataset.dtype.kind in "biuf" and (dataset.shape or ())[:1] == (length,)
                kind = (dataset.shape[1:], dataset.dtype) if fits else None
                found.setdefault(key, []).append(kind)
        why = {}
        for key, kinds in found.items():
            if None in kinds:
                why[key] = "no numbers with a row for each frame"
            elif len(kinds) < len(episodes) or len(set(kinds)) > 1:
                why[key] = "not the same in all episodes"
        return [key for key in found if key not in why], why

    def numbers(self, episode: str, key: str) -> np.ndarray:
        values: np.ndarray = self._read(self._dataset(episode, key), slice(None))
        return values

    def _read(self, dataset: h5py.Dataset, rows: Any) -> np.ndarray:
        try:
            values: np.ndarray = dataset[rows]
        except (OSError, RuntimeError) as error:
            raise TruncatedError(
                f"{self.path}: {dataset.name} cannot be read ({error}); save the whole episodes: "
                f"`python -m palm_jax data repair {self.path} --out NEW`"
            ) from error
        return values

    def read_through(self, dataset: h5py.Dataset) -> None:
        """Reads an array in blocks.

        Raises:
          TruncatedError: it cannot be read.
        """
        if not dataset.shape:
            self._read(dataset, ())
            return
        for first in range(0, len(dataset), _ROWS):
            self._read(dataset, slice(first, first + _ROWS))

    def read_masks(self) -> None:
        """Reads the filter keys.

        Raises:
          TruncatedError: one cannot be read.
        """
        for item in (self.file.get("mask") or {}).values():
            self.read_through(item)

    def blocks(self, episode: str, key: str, size: int) -> Iterator[np.ndarray]:
        dataset = self._dataset(episode, key)
        per_chunk = dataset.chunks[0] if dataset.chunks else 1
        # Whole chunks, so that none is decompressed twice.
        size = max(1, size // per_chunk) * per_chunk
        read = self._read
        if _is_gzip(dataset):
            read = self._gzipped
        elif self._plain(dataset):
            read = self._copied
        for first in range(0, len(dataset), size):
            yield read(dataset, slice(first, min(first + size, len(dataset))))

    def _plain(self, dataset: h5py.Dataset) -> bool:
        """Bytes one after the other in this very file."""
        return bool(
            dataset.chunks is None
            and dataset.dtype == np.uint8
            and dataset.id.get_offset() is not None
            and self.file.userblock_size == 0
            and self.file.driver == "sec2"
        )

    def _copied(self, dataset: h5py.Dataset, rows: slice) -> np.ndarray:
        """Rows, read past HDF5, which lets no other thread run while it copies."""
        block = np.empty((rows.stop - rows.start, *dataset.shape[1:]), np.uint8)
        begin = dataset.id.get_offset() + rows.start * int(np.prod(dataset.shape[1:]))
        with self.path.open("rb", buffering=0) as file:
            file.seek(begin)
            done = 0
            view = memoryview(block).cast("B")  # type: ignore[arg-type]
            while done < len(view):
                count = file.readinto(view[done:])
                if not count:
                    return self._read(dataset, rows)  # beyond the end: the error with advice
                done += count
        return block

    def _gzipped(self, dataset: h5py.Dataset, rows: slice) -> np.ndarray:
        """Rows, decompressed in threads (zlib lets the others run, HDF5 does not)."""
        self._pool = self._pool or ThreadPoolExecutor(min(4, os.cpu_count() or 1))
        shape, chunk = dataset.shape, dataset.chunks
        block = np.empty((rows.stop - rows.start, *shape[1:]), np.uint8)

        def decompress(place: tuple[int, ...], packed: bytes) -> None:
            part = np.frombuffer(_INFLATER.decompress(packed), np.uint8).reshape(chunk)
            ends = (rows.stop, *shape[1:])  # a chunk at an edge is whole, and goes beyond it
            sizes = [min(c, end - at) for c, end, at in zip(chunk, ends, place, strict=True)]
            begins = (place[0] - rows.start, *place[1:])
            target = tuple(slice(at, at + n) for at, n in zip(begins, sizes, strict=True))
            block[target] = part[tuple(map(slice, sizes))]

        steps = [range(0, size, step) for size, step in zip(shape[1:], chunk[1:], strict=True)]
        jobs = []
        for place in itertools.product(range(rows.start, rows.stop, chunk[0]), *steps):
            try:
                mask, packed = dataset.id.read_direct_chunk(place)
            except (OSError, RuntimeError):
                return self._read(dataset, rows)  # never written: zeros, or the error with advice
            if mask:  # this chunk was stored without the filter
                return self._read(dataset, rows)
            jobs.append(self._pool.submit(decompress, place, packed))
        try:
            for job in jobs:
                job.result()
        except (_INFLATER.error, ValueError):
            return self._read(dataset, rows)  # raises, with advice
        return block

    def image(self, episode: str, key: str, index: int) -> np.ndarray:
        return self._read(self._dataset(episode, key), index)

    def camera_info(self, episode: str) -> dict[str, dict[str, Any]]:
        text = self.demo(episode).attrs.get("camera_info")
        return headers.camera_info(text, f"{self.path}: {episode}: camera_info") if text else {}

    def model_file(self, episode: str) -> str | None:
        text = self.demo(episode).attrs.get("model_file")
        return str(text) if text else None

    def task(self, episode: str) -> str:
        return str(self.env_args.get("env_name", "unknown"))

    def split(self) -> tuple[list[str], list[str]] | None:
        """Robomimic's filter keys train and valid, as far as they name episodes that are there.

        Raises:
          FormatError: an episode in both.
        """
        mask = self.file.get("mask")
        if not isinstance(mask, h5py.Group) or not {"train", "valid"} <= set(mask):
            return None
        named = [{str(name, "utf-8") for name in mask[key][()]} for key in ("train", "valid")]
        both = sorted(named[0] & named[1], key=by_number)
        if both:
            raise FormatError(
                f"{self.path}: the filter keys train and valid both name {both[0]}; expected "
                "different episodes: mend them, or pass --validation SHARE"
            )
        train, valid = ([name for name in self.episodes if name in names] for names in named)
        return (train, valid) if train and valid else None

    @property
    def left_out(self) -> frozenset[str]:
        try:
            return frozenset(json.loads(self.data.attrs.get(REPAIR, "{}"))["dropped"])
        except (ValueError, TypeError, LookupError, RecursionError):
            return frozenset()

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
        self.file.close()


def _feature(dataset: h5py.Dataset) -> Feature:
    return Feature(tuple(dataset.shape[1:]), str(dataset.dtype), is_image(dataset))


def _is_gzip(dataset: h5py.Dataset) -> bool:
    """Chunks compressed by gzip and nothing else. (Shuffling single bytes does nothing, but may be
    there.)"""
    return bool(
        dataset.compression == "gzip"
        and not dataset.fletcher32
        and dataset.scaleoffset is None
        and dataset.dtype == np.uint8
    )
