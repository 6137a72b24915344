"""What a fault case is, and the helpers that all of them use."""

import contextlib
import dataclasses
import json
import os
import re
import resource
import shutil
import struct
import subprocess
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple


class Outcome(NamedTuple):
    """A row of the campaign's table."""

    happened: str
    lost: str = "nothing"


class Skipped(Exception):
    """A case cannot be run here; the message says why."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A fault, and a function that causes it in an empty folder and asserts what is promised."""

    group: str
    name: str
    run: Callable[[Path], Outcome]
    long: bool = False  # in `make faults` only


CASES: list[Case] = []


def case(group: str, name: str, *, long: bool = False, **arguments: Any) -> Callable[..., Any]:
    """Registers a function of a folder (and `arguments`) as a case."""

    def register(function: Callable[..., Outcome]) -> Callable[..., Outcome]:
        CASES.append(Case(group, name, lambda folder: function(folder, **arguments), long))
        return function

    return register


def said(error: BaseException, *words: str) -> str:
    """The message of an error, in which all of `words` must stand."""
    text = " ".join(str(error).split())
    for word in words:
        assert word in text, f"expected {word!r} in: {text}"
    return text


@contextlib.contextmanager
def refused(kind: type[BaseException] | tuple[type[BaseException], ...], *words: str) -> Iterator:
    """Around what must raise `kind`, with all of `words` in its message."""
    try:
        yield
    except kind as error:
        said(error, *words)
    else:
        raise AssertionError(f"expected an error with {words}, but nothing was raised")


def flip(path: Path, position: int | None = None, *, bit: int = 0) -> None:
    """One bit of a file, in its middle by default."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2 if position is None else position % len(content)] ^= 1 << bit
    path.write_bytes(content)


def flip_inside(path: Path) -> None:
    """One bit of the first array of an .npz file: not every byte of a ZIP means something."""
    with zipfile.ZipFile(path) as archive:
        first = archive.infolist()[0]
    name, extra = struct.unpack("<HH", path.read_bytes()[first.header_offset + 26 :][:4])
    flip(path, first.header_offset + 30 + name + extra + first.compress_size // 2)


def cut(path: Path, share: float = 0.5) -> None:
    """The file's end."""
    os.truncate(path, int(path.stat().st_size * share))


def snapshot(folder: Path) -> dict[str, bytes]:
    """All files below a folder but locks, by name."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.endswith(".lock")
    }


@contextlib.contextmanager
def file_limit(size: int) -> Iterator[None]:
    """No file may grow beyond `size` bytes: writing more fails as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextlib.contextmanager
def small_disk(folder: Path, *, size: str = "160k") -> Iterator[Callable[..., None]]:
    """A tmpfs at `folder`; yields a function that mounts it again with other options."""
    folder.mkdir(exist_ok=True)
    mount = shutil.which("mount")

    def attempt(*words: str) -> None:
        if mount is None:
            raise Skipped("no mount command")
        done = subprocess.run([mount, *words], capture_output=True, text=True, close_fds=False)
        if done.returncode:
            raise Skipped(f"a small disk could not be mounted: {done.stderr.strip()}")

    attempt("-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder))
    try:
        yield lambda options: attempt("-o", f"remount,{options}", str(folder))
    finally:
        subprocess.run(["umount", str(folder)], check=True, close_fds=False)


def logged(path: Path) -> list[dict[str, Any]]:
    """The lines of a log."""
    return [json.loads(line) for line in path.read_text().splitlines()]


def identifier(found: Case) -> str:
    """For pytest."""
    return re.sub(r"[^a-z0-9]+", "-", f"{found.group} {found.name}".lower()).strip("-")
