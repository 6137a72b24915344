"""The same work by other packages, on the same inputs: what a benchmark compares itself with.

Each module has `peers(...)`, a table by name; what is not installed is left out, and said.
"""

import importlib
import sys
from types import ModuleType


def imported(peer: str, *names: str) -> list[ModuleType] | None:
    """The modules that `peer` needs; None, and a line on stderr, if one cannot be imported."""
    try:
        return [importlib.import_module(name) for name in names]
    except ImportError as error:
        print(f"  without {peer}: {error}", file=sys.stderr)
        return None
