"""Ctrl-C and SIGTERM: the first asks for an orderly end, the second ends the process at once.

At once means by the system's own action, also while a program is being compiled and no Python runs:
every file is written whole or not at all, so nothing has to be tidied up for that.
"""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


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

    with _on_first_signal(interrupt):
        yield


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
