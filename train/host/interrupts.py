"""Ctrl-C and SIGTERM: the first asks for an orderly end, the second ends the process at once.

Python's own handlers run between two of its instructions, and so not while a program is compiled or
runs, nor at a barrier: for minutes, or hours. The system's handler writes a byte for each signal
all the same (`signal.set_wakeup_fd`), and a thread that waits for these bytes tells the first and
ends the process at the second. Every file is written whole or not at all, so nothing has to be
tidied up for that. Only code that holds the interpreter's lock throughout delays it.
"""

import _thread
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_MOMENT = 0.05  # seconds

SAME = 0.2
"""Seconds in which signals are one request: timeout(1) and some wrappers send each of them twice,
to the process and to its group."""


def _nothing() -> None:
    pass


class Stop:
    """Whether somebody has asked for an end; to be looked at between two pieces of work."""

    def __init__(self, promise: str = "Stopping after this step; once more ends at once.") -> None:
        """`promise`: what is printed when the first signal comes."""
        self.asked, self._promise = False, promise

    def __call__(self) -> bool:
        return self.asked

    @contextlib.contextmanager
    def listening(self, *, at_once: Callable[[], None] = _nothing) -> Iterator[None]:
        """While a signal is to be noted only.

        Args:
          at_once: called in another thread before the second signal ends the process.
        """

        def note() -> None:
            self.asked = True

        with _watching(note, self._promise, at_once):
            yield


class Signalled(KeyboardInterrupt):
    """Raised by a signal, wherever Python was."""


@contextlib.contextmanager
def raising() -> Iterator[None]:
    """While SIGTERM is to do what Ctrl-C does: raise `Signalled`, once."""

    def interrupt() -> None:
        raise Signalled

    with _watching(interrupt, "Stopping; once more ends at once.", _nothing) as repeat:
        with _raised_again(repeat):
            yield


@contextlib.contextmanager
def _raised_again(repeat: Callable[[], None]) -> Iterator[None]:
    """While an interrupt that Python has dropped is raised once more, a moment later.

    A handler runs wherever the program is. In a finaliser, or in the callback of a weak reference,
    as h5py and JAX have them by the thousand, what it raises is printed and forgotten.
    """
    before, over = sys.unraisablehook, threading.Event()

    def again() -> None:
        if not over.wait(_MOMENT):
            repeat()

    def hook(dropped: "sys.UnraisableHookArgs") -> None:
        if issubclass(dropped.exc_type, Signalled):
            # Thread.start would wait, and be interrupted itself.
            _thread.start_new_thread(again, ())
        else:
            before(dropped)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        over.set()
        sys.unraisablehook = before


def leave(stop: KeyboardInterrupt) -> int:
    """The exit status of a command that was interrupted, which ends here if a signal did it.

    JAX goes on compiling in another thread, and crashes if the process ends in an orderly way.
    """
    if isinstance(stop, Signalled):
        end(130)
    return 130


def end(status: int) -> NoReturn:
    """Ends the process at once, with what it has said."""
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)


@contextlib.contextmanager
def _watching(
    act: Callable[[], None], promise: str, at_once: Callable[[], None]
) -> Iterator[Callable[[], None]]:
    """In the main thread: `act` runs there, at the first signal, as soon as Python does.

    Yields:
      what makes `act` run there once more, called in any thread.
    """
    acted = False
    repeats: list[int] = []

    def handle(number: int, frame: Any) -> None:
        nonlocal acted
        if not acted:
            acted = True
            act()

    def repeat() -> None:
        nonlocal acted
        acted = False
        repeats.append(signal.SIGINT)  # first: the watcher is told of this one, too
        _thread.interrupt_main()

    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    watcher = threading.Thread(target=_watch, args=(reader, promise, at_once, repeats), daemon=True)
    watcher.start()
    before = {number: signal.signal(number, handle) for number in SIGNALS}
    outer = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    try:
        yield repeat
    finally:
        signal.set_wakeup_fd(outer)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(writer)  # which ends the watcher
        watcher.join()
        os.close(reader)


def _watch(reader: int, promise: str, at_once: Callable[[], None], repeats: list[int]) -> None:
    """`repeats`: signals that are to come and are no requests."""
    first: float | None = None
    while numbers := os.read(reader, 64):
        for number in numbers:
            if number not in SIGNALS:
                continue
            if number in repeats:
                repeats.remove(number)
                continue
            if first is None:
                first = time.monotonic()
                # Not through sys.stderr, whose buffer the interrupted code may be holding.
                with contextlib.suppress(OSError):
                    os.write(2, f"\n{promise}\n".encode())
            elif time.monotonic() > first + SAME:
                try:
                    at_once()
                finally:
                    os._exit(128 + number)
