"""The same work by other packages, on the same inputs: what a benchmark compares itself with.

Each module has `peers() -> dict[str, ...]`; a package that is not installed is left out, by name.
"""

import importlib
from types import ModuleType


def imported(*names: str) -> list[ModuleType] | None:
    """The modules, or None if one of them cannot be imported here."""
    try:
        return [importlib.import_module(name) for name in names]
    except ImportError:
        return None
