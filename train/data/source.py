"""A data file of any known format, read episode by episode.

`open_source` tells the format; a `Source` gives numbers whole and images in blocks, so that memory
does not grow with the file.
"""

from __future__ import annotations

import abc
import dataclasses
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from palm_jax.train.data.errors import FormatError, KeyMissingError

WHOLE_HASH_BYTES = 2**28
"""Larger sources are identified by their sizes and both ends of every file: hashing them whole
would take as long as aligning them."""

_END_BYTES = 2**20


@dataclasses.dataclass(frozen=True)
class Feature:
    """What one key holds in every frame."""

    shape: tuple[int, ...]  # of one frame; images: (height, width, 3)
    dtype: str
    images: bool = False


class Source(abc.ABC):
    """One data set. A context manager; nothing of it is ever written to.

    Attributes:
      path: file or folder.
      format: "robomimic" or "lerobot".
      fps: frames a second.
      episodes: names, in order.
    """

    path: Path
    format: str
    fps: float
    episodes: tuple[str, ...]

    @abc.abstractmethod
    def length(self, episode: str) -> int:
        """Frames of an episode."""

    @abc.abstractmethod
    def features(self) -> dict[str, Feature]:
        """What each key holds, as in the first episode."""

    @abc.abstractmethod
    def numbers(self, episode: str, key: str) -> np.ndarray:
        """[T, ...] of a key that holds no images.

        Raises:
          KeyMissingError: not in this episode.
        """

    @abc.abstractmethod
    def blocks(self, episode: str, key: str, size: int) -> Iterator[np.ndarray]:
        """The images of an episode in order, about `size` at a time: uint8 [n, H, W, 3].

        Raises:
          TruncatedError: fewer images than frames.
        """

    @abc.abstractmethod
    def image(self, episode: str, key: str, index: int) -> np.ndarray:
        """One image, uint8 [H, W, 3]."""

    @abc.abstractmethod
    def in_all(self, episodes: Sequence[str]) -> tuple[list[str], dict[str, str]]:
        """Keys of numbers that each of some episodes has in every frame, all of one kind; and why
        others, images apart, are not among them."""

    def camera_info(self, episode: str) -> dict[str, dict[str, Any]]:
        """Camera name -> {"intrinsics", "extrinsics"} that the file itself has; empty if none."""
        return {}

    def model_file(self, episode: str) -> str | None:
        """The MJCF that the file itself has, or None."""
        return None

    def task(self, episode: str) -> str:
        """What is done in the episode, in words."""
        return "unknown"

    @property
    def left_out(self) -> frozenset[str]:
        """Names of episodes that `data repair` did not take over into this file."""
        return frozenset()

    @property
    def numbered_anew(self) -> Mapping[str, str]:
        """Episode before a `data repair` -> its name now, where that is another one."""
        return {}

    def split(self) -> tuple[list[str], list[str]] | None:
        """Episodes for training and for validation, where the file itself says so."""
        return None

    @abc.abstractmethod
    def close(self) -> None:
        """Let go of the file."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def image_keys(self) -> list[str]:
        """Keys that hold images."""
        return [key for key, feature in self.features().items() if feature.images]

    @property
    def number_keys(self) -> list[str]:
        """Keys that do not."""
        return [key for key, feature in self.features().items() if not feature.images]

    def resolve(self, name: str) -> str:
        """The key that is meant by a name: itself, or the only one that ends with it.

        Raises:
          KeyMissingError: none, or several.
        """
        keys = list(self.features())
        if name in keys:
            return name
        near = [key for key in keys if re.search(rf"[/.]{re.escape(name)}$", key)]
        if len(near) == 1:
            return near[0]
        problem = f"{', '.join(near)} all end so" if near else f"it has {', '.join(keys)}"
        raise KeyMissingError(f"{self.path} has no key {name!r}: {problem}")

    def columns(self, episode: str, expression: str) -> np.ndarray:
        """[T, n] of `key`, `key[a:b]`, `key[i]`, or several of them joined with "+".

        Raises:
          KeyMissingError: a key that is not there.
          FormatError: not an expression of that form, or columns that do not exist.
        """
        parts = [self._columns(episode, part.strip()) for part in expression.split("+")]
        lengths = {len(part) for part in parts}
        if len(lengths) > 1:
            raise FormatError(f"{expression}: arrays of different lengths {sorted(lengths)}")
        return np.concatenate(parts, 1)

    def _columns(self, episode: str, part: str) -> np.ndarray:
        match = re.fullmatch(r"(.+?)(?:\[(\d+)(?::(\d+))?\])?", part)
        if match is None:
            raise FormatError(f"{part!r}: expected KEY, KEY[i] or KEY[first:end]")
        name, first, end = match.groups()
        values = self.numbers(episode, self.resolve(name))
        values = np.asarray(values, np.float64)
        values = values.reshape(len(values), int(np.prod(values.shape[1:])))
        if first is None:
            return values
        start, stop = int(first), int(end) if end else int(first) + 1
        if not start < stop <= values.shape[1]:
            raise FormatError(f"{part}: {name} has {values.shape[1]} columns")
        return values[:, start:stop]

    def files(self) -> list[Path]:
        """The files that make up the source."""
        if self.path.is_dir():
            return sorted(path for path in self.path.rglob("*") if path.is_file())
        return [self.path]

    def fingerprint(self) -> dict[str, Any]:
        """Identifies the content: name, bytes, and a hash whose name says of what."""
        return fingerprint(self.path, self.files())


def fingerprint(path: Path, files: list[Path]) -> dict[str, Any]:
    """See `Source.fingerprint`."""
    size = sum(file.stat().st_size for file in files)
    whole = size <= WHOLE_HASH_BYTES
    digest = hashlib.sha256()
    for file in files:
        if path.is_dir():
            digest.update(f"{file.relative_to(path)}:{file.stat().st_size}\n".encode())
        with file.open("rb") as content:
            if whole:
                while part := content.read(2**20):
                    digest.update(part)
            else:
                digest.update(content.read(_END_BYTES))
                content.seek(max(0, file.stat().st_size - _END_BYTES))
                digest.update(content.read(_END_BYTES))
    name = "sha256" if whole else "sha256_of_ends"
    return {"name": path.name, "bytes": size, name: digest.hexdigest()}


def open_source(path: Path) -> Source:
    """Opens a robomimic file or a LeRobot folder.

    Raises:
      FormatError: neither, or one that lacks what its format demands.
      TruncatedError: an HDF5 file that ends too early.
      ExtraMissingError: LeRobot without pyarrow and av.
    """
    from palm_jax.train.data import lerobot, robomimic

    if not path.exists():
        raise FormatError(f"{path}: no such file or folder")
    if path.is_dir():
        if (path / "meta" / "info.json").is_file():
            return lerobot.LeRobotSource(path)
        raise FormatError(
            f"{path}: a folder without meta/info.json; expected a LeRobot data set (its root) or a "
            "robomimic HDF5 file"
        )
    with path.open("rb") as file:
        if file.read(8) == b"\x89HDF\r\n\x1a\n":
            return robomimic.RobomimicSource(path)
    raise FormatError(
        f"{path}: neither HDF5 nor a folder; expected a robomimic HDF5 file or the root folder of "
        "a LeRobot v3 data set"
    )
