"""Outputs that are whole or absent, and that a second call of the same command goes on with.

Everything is written into a folder `.NAME.partial` beside the output, by one process at a time.
What is in it is described by its recipe (source, calibration, options, versions): only the same
command goes on with it, and none other deletes it. The output is made there and gets its name when
it is complete.
"""

from __future__ import annotations

import abc
import contextlib
import hashlib
import json
import os
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from palm_jax.train.data.errors import DiskFullError, OutputError
from palm_jax.train.files import locks
from palm_jax.train.files.metrics import fsync_folder, plain, write_json

RECIPE = "recipe.json"

NEW = ("image", "proprio", "valid", "tcp", "opening", "actions")
"""What is made of an episode."""


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


def partial_path(path: Path) -> Path:
    """The folder in which an output is written until it is complete."""
    return path.parent / f".{path.name}.partial"


def remove(path: Path) -> None:
    """Deletes a file or a folder, if there is one."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Makes a file, or all files in a folder, durable."""
    for file in [*path.rglob("*"), path]:
        fsync_folder(file)


class Partial:
    """The folder in which one output is written; see `begun`.

    Attributes:
      path: of the output.
      folder: for whatever is written until then.
      recipe: how the output is made, in terms of JSON.
    """

    def __init__(self, path: Path, recipe: Mapping[str, Any]):
        self.path, self.folder = path, partial_path(path)
        self.recipe: dict[str, Any] = json.loads(json.dumps(plain(recipe)))
        self.whole = False

    def begin(self) -> None:
        """Makes the folder, or goes on with what the same command has left there."""
        if self.folder.is_dir() and os.listdir(self.folder) == [RECIPE]:
            remove(self.folder)  # nothing has been made yet, or all of it has got its name
        if os.path.lexists(self.folder):
            self._check_recipe()
            return
        # Under another name until its recipe is there, without which it would be nobody's.
        new = self.folder.with_name(f"{self.folder.name}.new")
        remove(new)
        try:
            write_json(new / RECIPE, self.recipe)
            os.rename(new, self.folder)
        except BaseException:
            remove(new)
            raise

    def _check_recipe(self) -> None:
        advice = "delete it, or choose another --out"
        try:
            found = json.loads((self.folder / RECIPE).read_text())
        except (OSError, ValueError):
            found = None
        if not isinstance(found, dict):
            raise OutputError(f"{self.folder} is none of ours, and in the way; {advice}")
        if set(found) != set(self.recipe):
            raise OutputError(f"{self.folder} was begun by another command; {advice}")
        for key, wanted in self.recipe.items():
            if found[key] != wanted:
                raise OutputError(
                    f"{self.folder} was begun with {key} = {str(found[key])[:200]}, now it is "
                    f"{str(wanted)[:200]}; {advice}"
                )

    def publish(self, content: Path) -> None:
        """Gives the complete output its name, durably.

        Args:
          content: a file or folder in `folder`.

        Raises:
          OutputError: there is something of that name by now.
        """
        sync(content)
        self.whole = True
        if os.path.lexists(self.path):
            raise OutputError(
                f"{self.path} has appeared in the meantime and is not overwritten: move it, then "
                "the same command gives what is complete its name"
            )
        os.rename(content, self.path)
        fsync_folder(self.path.resolve().parent)
        remove(self.folder)


@contextlib.contextmanager
def begun(path: Path, recipe: Mapping[str, Any]) -> Iterator[Partial]:
    """The folder in which an output is written, while nobody else writes there.

    After Ctrl-C it stays for the same command to go on with, after an error nothing is left.

    Args:
      path: of the output.
      recipe: what two calls must have in common to go on with each other.

    Raises:
      OutputError: another process is writing it; something in the way that another command has
        left, or that is none of ours.
    """
    partial = Partial(path, recipe)
    path.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(locks.alone(partial.folder.with_name(f"{partial.folder.name}.lock")))
        except locks.Busy as error:
            raise OutputError(
                f"another process is writing {path}: wait for it, stop it, or choose another --out"
            ) from error
        partial.begin()
        try:
            yield partial
        except KeyboardInterrupt:
            raise
        except BaseException:
            if not partial.whole:
                remove(partial.folder)
            raise


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
        if block.dtype.hasobject:  # texts, arrays of several lengths
            for item in block.ravel().tolist():
                content = item.tobytes() if isinstance(item, np.ndarray) else repr(item).encode()
                self._hash.update(len(content).to_bytes(8, "big") + content)
        else:
            self._hash.update(np.ascontiguousarray(block).data)

    def hex(self) -> str:
        """The hash of what has been added."""
        return self._hash.hexdigest()


def file_sha256(path: Path) -> str:
    """Of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_names(kept: Iterable[str], new: Iterable[str]) -> None:
    """Raises where two arrays of an output would have one name, or one would lie in the other.

    Args:
      kept: names of what comes from the source.
      new: names of what is made.

    Raises:
      OutputError: with the names.
    """
    counts = Counter([*kept, *new])
    twice = []
    for name, count in counts.items():
        parts = name.split("/")
        above = {"/".join(parts[:end]) for end in range(1, len(parts))}
        if count > 1 or above & set(counts):
            twice.append(name)
    if twice:
        raise OutputError(
            f"{', '.join(twice)} would be in the output twice, once as it is in the source; choose "
            "another --prefix, leave out --instead, or use --keep none"
        )


class Writer(abc.ABC):
    """Takes episodes one after the other. A context manager.

    Attributes:
      done: names of the episodes that an earlier call has left complete.
      skipped: keys of the source that the format cannot hold -> why.
    """

    done: tuple[str, ...] = ()
    skipped: Mapping[str, str] = {}

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
    def complete(self) -> Path:
        """Everything is written: returns what is to be published."""

    @abc.abstractmethod
    def close(self) -> None:
        """Lets go of all files. What is finished is left for another call to go on with."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: object, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except (OSError, RuntimeError, KeyError, ValueError):
            if kind is None or issubclass(kind, KeyboardInterrupt):
                raise
            # A full disk, say: what cannot be flushed is thrown away, and the error is told.
