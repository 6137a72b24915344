"""Outputs that are whole or absent, and that a second call of the same command goes on with.

Everything is written into `.NAME.partial` beside the output, which is renamed when it is complete.
What the partial holds is described by a recipe (source, calibration, options, versions): only the
same command goes on with it.
"""

from __future__ import annotations

import abc
import hashlib
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from palm_jax.train.data.errors import DiskFullError, OutputError
from palm_jax.train.metrics import fsync_folder


def partial_path(path: Path) -> Path:
    """Where an output is written until it is complete."""
    return path.parent / f".{path.name}.partial"


def check_free(path: Path, source: Path) -> None:
    """Raises where an output would replace something.

    Raises:
      OutputError: it exists, or is the source, or lies in it.
    """
    if path.exists():
        raise OutputError(f"{path} exists and is not overwritten: move it, or choose another --out")
    check_outside(path, source)


def check_outside(path: Path, source: Path) -> None:
    """Raises where an output would lie in the source's folder.

    Raises:
      OutputError.
    """
    if source.resolve() in path.resolve().parents:
        raise OutputError(f"{path} lies inside the source {source}, which is never touched")


def check_space(path: Path, expected: int) -> None:
    """Raises where an output of `expected` bytes cannot fit.

    Raises:
      DiskFullError: less than half of it is free (compression may save the other half).
    """
    folder = path.resolve().parent
    while not folder.exists():
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    if free < expected / 2:
        raise DiskFullError(
            f"{path}: about {expected / 1e9:.3g} GB are to be written, {free / 1e9:.3g} GB are "
            f"free in {folder}; make room or choose another --out; nothing has been written"
        )


def remove(path: Path) -> None:
    """Deletes a partial output, file or folder."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def publish(partial: Path, path: Path) -> None:
    """Gives a complete output its name, durably."""
    files = (
        [file for file in partial.rglob("*") if file.is_file()] if partial.is_dir() else [partial]
    )
    for file in files:
        descriptor = os.open(file, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    os.replace(partial, path)
    fsync_folder(path.resolve().parent)


class Digest:
    """sha256 of one array that comes in blocks along its first axis, whatever their sizes."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._begun = False

    def add(self, block: np.ndarray) -> None:
        """Append a block."""
        if not self._begun:
            self._hash.update(f"{block.dtype.str}{block.shape[1:]}".encode())
            self._begun = True
        self._hash.update(np.ascontiguousarray(block).data)

    def hex(self) -> str:
        """The hash of what has been added."""
        return self._hash.hexdigest()


class Writer(abc.ABC):
    """Takes episodes one after the other.

    Attributes:
      done: names of the episodes that an earlier call has left complete.
      resumed: whether an earlier call left anything.
    """

    done: tuple[str, ...] = ()

    @property
    def resumed(self) -> bool:
        return bool(self.done)

    @abc.abstractmethod
    def begin(self, name: str, length: int, numbers: Mapping[str, np.ndarray]) -> None:
        """Starts an episode of `length` frames with the arrays that are known whole."""

    @abc.abstractmethod
    def add(self, images: np.ndarray, numbers: Mapping[str, np.ndarray]) -> None:
        """Appends frames: aligned images uint8 [n, S, S, 3] and numbers [n, ...]."""

    @abc.abstractmethod
    def end(self) -> None:
        """Finishes the episode; from here on it is safe."""

    @abc.abstractmethod
    def stop(self) -> None:
        """Leaves what is finished for another call to go on with."""

    @abc.abstractmethod
    def discard(self) -> None:
        """Leaves nothing."""

    @abc.abstractmethod
    def complete(self) -> None:
        """Everything is written: give it its name."""


def same_recipe(found: Any, wanted: Mapping[str, Any], partial: Path) -> None:
    """Raises where a partial output was begun by another command.

    Raises:
      OutputError: with the first entry that differs.
    """
    if not isinstance(found, dict):
        raise OutputError(f"{partial} is not ours; delete it, or choose another --out")
    for key in wanted:
        if key != "created" and found.get(key) != wanted[key]:
            raise OutputError(
                f"{partial} was begun with {key} = {str(found.get(key))[:200]}, now it is "
                f"{str(wanted[key])[:200]}; delete it, or choose another --out"
            )
