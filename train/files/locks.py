"""Who works where: claims on folders, and a lock around files that several processes write.

A claim is a file `FOLDER/.claim`, which says who works in the folder: the host, the processes by
number and start, since when, and for which job of a scheduler. Two processes with the same folder
therefore never run the same cell, nor train into the same run. A process that is started by the
holder shares its claim. The claim of a host's own dead processes is taken over. Whether those of
another machine are alive cannot be seen from here: a job that Slurm has begun anew takes over what
it held before, for Slurm ended that; anything else has to be given up by a person.

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
from typing import IO, Any, NamedTuple

from palm_jax.train.files.metrics import write_atomic

CLAIM = ".claim"

LEFT = 3
"""Exit code of a command that left work to another process, which has not done it yet."""


class Busy(RuntimeError):
    """Another process holds the claim; the message names it and says what to do."""


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
    def numbered(cls, pid: int) -> "Process":
        """The one that has this number now."""
        return cls(pid, _started(pid) or "")

    @classmethod
    def own(cls) -> "Process":
        """The calling process."""
        return cls.numbered(os.getpid())

    @property
    def alive(self) -> bool:
        """Whether it still runs, asked on its own host. In doubt it does."""
        try:
            os.kill(self.pid, 0)
        except (ProcessLookupError, OverflowError):
            return False
        except PermissionError:
            pass  # another user's, whom /proc may hide
        started = _started(self.pid)
        return started is None or started == self.started


def _started(pid: int) -> str | None:
    """Boot and clock ticks since then at which a process began; "" for one that has ended and is
    still listed, None if the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return None
    return "" if fields[0] in "ZX" else f"{boot}/{fields[19]}"


def host() -> str:
    """This machine, as far as process numbers mean the same."""
    try:
        space = os.readlink("/proc/self/ns/pid")
    except OSError:
        space = ""
    return f"{socket.gethostname()} {space}".strip()


class Job(NamedTuple):
    """What a scheduler calls the work that this process is part of.

    Attributes:
      name: "" without a scheduler.
      attempt: how often the scheduler has begun it anew. It ends one before it begins the next, but
        several processes of one attempt may live on several machines.
    """

    name: str = ""
    attempt: int = 0

    @classmethod
    def own(cls) -> "Job":
        """That of the calling process: Slurm's, whose number stays when a job is queued again."""
        number, again = (os.environ.get(f"SLURM_{x}", "") for x in ("JOB_ID", "RESTART_COUNT"))
        if not number:
            return cls()
        cluster = os.environ.get("SLURM_CLUSTER_NAME", "")
        return cls(f"slurm {cluster} {number}", int(again) if again.isdecimal() else 0)

    def follows(self, other: "Job") -> bool:
        """Whether it is a later attempt at the same work."""
        return bool(self.name) and self.name == other.name and self.attempt > other.attempt


@dataclasses.dataclass(frozen=True)
class _Owner:
    host: str
    processes: tuple[Process, ...]
    since: str  # for people: nothing is decided by the time of day
    job: Job = Job()

    def store(self) -> str:
        fields = {**dataclasses.asdict(self), "job": self.job.name, "attempt": self.job.attempt}
        return json.dumps(fields) + "\n"

    @classmethod
    def read(cls, path: Path) -> "_Owner | None":
        """None if there is no claim, or none that can be read."""
        try:
            found: dict[str, Any] = json.loads(path.read_text())
            processes = tuple(Process(int(p["pid"]), str(p["started"])) for p in found["processes"])
            job = Job(str(found.get("job", "")), int(found.get("attempt", 0)))
            return cls(str(found["host"]), processes, str(found["since"]), job)
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
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
        _write(path, _Owner(host(), processes, since, Job.own()))
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
    return owner.host == host() and Process.numbered(parent) in owner.processes


def _refuse_if_alive(path: Path, owner: _Owner, *, take_over: bool) -> None:
    pids = ", ".join(str(process.pid) for process in owner.processes)
    name = owner.host.partition(" ")[0]
    if owner.host != host():
        if take_over or Job.own().follows(owner.job):
            return
        raise Busy(
            f"{path.parent} has been in use since {owner.since} by process {pids} on {name}, which "
            f"cannot be seen from here: if it is gone, call with --take-over, or delete {path}"
        )
    if any(process.alive for process in owner.processes):
        raise Busy(
            f"{path.parent} has been in use since {owner.since} by process {pids} on this machine: "
            "wait for it, stop it, or choose another folder"
        )


def _write(path: Path, owner: _Owner) -> None:
    """Under the lock. Whole or not at all: others may live by the claim that it replaces."""
    write_atomic(path, owner.store().encode())


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
