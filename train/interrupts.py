"""Ctrl-C and SIGTERM: the first asks for an orderly end, the second ends the process at once.

At once means by the system's own action, also while a program is being compiled and no Python runs:
every file is written whole or not at all, so nothing has to be tidied up for that.
"""

import _thread
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_MOMENT = 0.05  # seconds


class Stop:
    """Whether somebody has asked for an end; to be looked at between two pieces of work."""

    def __init__(self, promise: str = "Stopping after this step; once more ends at once.") -> None:
        """`promise`: what is printed when the first signal comes."""
        self.asked, self._promise = False, promise

    def __call__(self) -> bool:
        return self.asked

    @contextmanager
    def listening(self) -> Iterator[None]:
        """While a signal is to be noted only."""

        def note() -> None:
            self.asked = True
            # Not through sys.stderr, whose buffer the interrupted code may be holding.
            os.write(2, f"\n{self._promise}\n".encode())

        with _on_first_signal(note):
            yield


@contextmanager
def raising() -> Iterator[None]:
    """While SIGTERM is to do what Ctrl-C does: raise KeyboardInterrupt, once."""

    def interrupt() -> None:
        raise KeyboardInterrupt

    with _on_first_signal(interrupt), _raised_again():
        yield


@contextmanager
def _raised_again() -> Iterator[None]:
    """While an interrupt that Python has dropped is raised once more, a moment later.

    A handler runs wherever the program is. In a finaliser, or in the callback of a weak reference,
    as h5py and JAX have them by the thousand, what it raises is printed and forgotten.
    """
    before, handler = sys.unraisablehook, signal.getsignal(signal.SIGINT)
    over = threading.Event()

    def again() -> None:
        if not over.wait(_MOMENT):
            _thread.interrupt_main()

    def hook(dropped: "sys.UnraisableHookArgs") -> None:
        if not issubclass(dropped.exc_type, KeyboardInterrupt):
            before(dropped)
            return
        signal.signal(signal.SIGINT, handler)
        _thread.start_new_thread(again, ())  # Thread.start would wait, and be interrupted itself

    sys.unraisablehook = hook
    try:
        yield
    finally:
        over.set()
        sys.unraisablehook = before


@contextmanager
def _on_first_signal(act: Callable[[], None]) -> Iterator[None]:
    def handle(number: int, frame: Any) -> None:
        for each in SIGNALS:
            signal.signal(each, signal.SIG_DFL)
        act()

    before = {number: signal.signal(number, handle) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
