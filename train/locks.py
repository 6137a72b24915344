"""Who works where: claims on folders, and a lock around files that several processes write.

A claim is a file `FOLDER/.claim`, made with O_EXCL, which says who works in the folder: the host,
the processes by number and start, and since when. Two processes with the same folder therefore
never run the same cell, nor train into the same run. A process that is started by the holder shares
its claim. The claim of a host's own dead processes is taken over; whether those of another
machine are alive cannot be seen from here, so they have to be given up by a person.

`locked` is an advisory lock (flock) beside a file, for reading, changing and writing it. The kernel
frees it with the process that held it. Claims are made and taken over under such a lock, too.

`alone` is the same in folders of the user's, where nothing may be left: it does not wait, and its
file is gone afterwards.
"""

import contextlib
import dataclasses
import datetime
import errno
import fcntl
import json
import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

CLAIM = ".claim"


class Busy(RuntimeError):
    """Another process holds the claim; the message names it and says what to do.

    `elsewhere`: whether it is on another machine.
    """

    def __init__(self, message: str, *, elsewhere: bool = False) -> None:
        super().__init__(message)
        self.elsewhere = elsewhere


@dataclasses.dataclass(frozen=True)
class Process:
    """A process such that no later one is taken for it.

    Attributes:
      pid: its number, which the system uses again.
      started: when it was started, by a clock that nobody sets; "" where the system does not tell.
    """

    pid: int
    started: str

    @classmethod
    def own(cls) -> "Process":
        """The calling process."""
        return cls(os.getpid(), _started(os.getpid()))

    @property
    def alive(self) -> bool:
        """Whether it still runs, asked on its own host."""
        try:
            os.kill(self.pid, 0)
        except (ProcessLookupError, OverflowError):
            return False
        except PermissionError:
            pass
        return _started(self.pid) == self.started


def _started(pid: int) -> str:
    """Boot and clock ticks since then at which a process began; "" for none, and for zombies."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""
    return "" if fields[0] in "ZX" else f"{boot}/{fields[19]}"


def host() -> str:
    """This machine, as far as process numbers mean the same."""
    try:
        space = os.readlink("/proc/self/ns/pid")
    except OSError:
        space = ""
    return f"{socket.gethostname()} {space}".strip()


@dataclasses.dataclass(frozen=True)
class _Owner:
    host: str
    processes: tuple[Process, ...]
    since: str  # for people: nothing is decided by the time of day

    def store(self) -> str:
        return json.dumps(dataclasses.asdict(self)) + "\n"

    @classmethod
    def read(cls, path: Path) -> "_Owner | None":
        """None if there is no claim, or none that was written to its end."""
        try:
            found: dict[str, Any] = json.loads(path.read_text())
            processes = tuple(Process(int(p["pid"]), str(p["started"])) for p in found["processes"])
            return cls(str(found["host"]), processes, str(found["since"]))
        except (OSError, ValueError, KeyError, TypeError):
            return None


@contextlib.contextmanager
def claim(folder: str | Path, *, name: str = CLAIM, take_over: bool = False) -> Iterator[None]:
    """Holds the claim on a folder (made if absent).

    Args:
      folder: of a run or a cell.
      name: of the file; another one claims less than the whole folder.
      take_over: also from another machine, whose processes cannot be seen from here.

    Raises:
      Busy: a process that is alive, or may be, works there.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path, own = folder / name, Process.own()
    with locked(path):
        found = _Owner.read(path)
        shared = found is not None and _is_parent(found)
        if found is not None and not shared:
            _refuse_if_alive(path, found, take_over=take_over)
        processes = (*found.processes, own) if found is not None and shared else (own,)
        since = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
        _write(path, _Owner(host(), processes, since))
    try:
        yield
    finally:
        with locked(path):
            now = _Owner.read(path)
            if now is not None and own in now.processes and now.host == host():
                left = tuple(p for p in now.processes if p != own and p.alive)
                if left:
                    _write(path, dataclasses.replace(now, processes=left))
                else:
                    path.unlink()


def _is_parent(owner: _Owner) -> bool:
    parent = os.getppid()
    return owner.host == host() and Process(parent, _started(parent)) in owner.processes


def _refuse_if_alive(path: Path, owner: _Owner, *, take_over: bool) -> None:
    pids = ", ".join(str(process.pid) for process in owner.processes)
    name = owner.host.partition(" ")[0]
    if owner.host != host():
        if take_over:
            return
        raise Busy(
            f"{path.parent} has been in use since {owner.since} by process {pids} on {name}, "
            f"which cannot be seen from here: if it is gone, delete {path}",
            elsewhere=True,
        )
    if any(process.alive for process in owner.processes):
        raise Busy(
            f"{path.parent} has been in use since {owner.since} by process {pids} on this machine: "
            "wait for it, stop it, or choose another folder"
        )


def _write(path: Path, owner: _Owner) -> None:
    """Under the lock. A dead process's claim goes first, so that every claim is a new file."""
    path.unlink(missing_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    with os.fdopen(descriptor, "w") as file:
        file.write(owner.store())


@contextlib.contextmanager
def locked(path: str | Path, *, waiting: Callable[[], None] | None = None) -> Iterator[None]:
    """Alone with a file among all processes that ask the same way.

    Args:
      path: the file; the lock is `.NAME.lock` beside it, and stays there empty.
      waiting: called before waiting for another process.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_name(f".{path.name.lstrip('.')}.lock").open("a") as file:
        if waiting is None:
            fcntl.flock(file, fcntl.LOCK_EX)
        elif not _free(file):
            waiting()
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _free(file: IO[Any]) -> bool:
    """Takes the lock on a file if no other has it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.EAGAIN, errno.EACCES):
            raise
        return False
    return True


@contextlib.contextmanager
def alone(path: str | Path) -> Iterator[None]:
    """Holds a lock among all processes that ask the same way, without waiting for it.

    Args:
      path: of the lock, an empty file. One that a killed process has left holds nobody up.

    Raises:
      Busy: another process has it.
    """
    path = Path(path)
    while True:
        with path.open("a") as file:
            if not _free(file):
                raise Busy(f"another process holds {path}")
            if not _is(path, file):
                continue  # the one who held it has just deleted it
            try:
                yield
            finally:
                path.unlink(missing_ok=True)  # first: whoever has it open sees that it is gone
            return


def _is(path: Path, file: IO[Any]) -> bool:
    """Whether an open file still is the one of that name."""
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False
