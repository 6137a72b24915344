"""Hide known, harmless lines that third-party modules print while they are imported."""

import contextlib
import io
import sys
from collections.abc import Iterator

# `from mujoco import mjx` prints these when the optional warp back end is not installed.
MJX_IMPORT_LINES = ("Failed to import warp", "Failed to import mujoco_warp")


@contextlib.contextmanager
def without_lines(*prefixes: str) -> Iterator[None]:
    """Collect standard output inside the block, then print all but the lines with these prefixes.

    Meant for imports: output appears only when the block ends (also when it ends with an error).

    Args:
      *prefixes: beginnings of the lines to drop; none given means `MJX_IMPORT_LINES`.
    """
    dropped = prefixes or MJX_IMPORT_LINES
    caught = io.StringIO()
    try:
        with contextlib.redirect_stdout(caught):
            yield
    finally:
        for line in caught.getvalue().splitlines(keepends=True):
            if not line.startswith(dropped):
                sys.stdout.write(line)
