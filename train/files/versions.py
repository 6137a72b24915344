"""The versions that decide what comes out of a run, and whether they are still the same."""

import platform
from collections.abc import Mapping
from importlib import metadata
from typing import Any

_PACKAGES = (
    "palm_jax",
    "jax",
    "jaxlib",
    "flax",
    "optax",
    "orbax-checkpoint",
    "mujoco",
    "mujoco-mjx",
    "numpy",
)


def current() -> dict[str, str]:
    """Those of Python and of the packages that are installed."""
    found = {name: version for name in _PACKAGES if (version := _installed(name))}
    return found | {"python": platform.python_version()}


def _installed(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:  # a checkout that was not installed
        return None


def difference(old: Any, new: Mapping[str, str]) -> tuple[str, str, str] | None:
    """The first package of which two notes tell different versions, with both of them.

    Args:
      old: what a file holds; None and whatever is no note tell nothing.
      new: from `current`.
    """
    noted = {_plain(name): str(version) for name, version in old.items()} if _is_note(old) else {}
    for name, version in new.items():
        before = noted.get(_plain(name), "unknown")
        if before not in ("unknown", version):
            return name, before, version
    return None


def _is_note(value: Any) -> bool:
    return isinstance(value, Mapping) and all(isinstance(name, str) for name in value)


def _plain(name: str) -> str:
    """A package's name is the same with a hyphen and an underscore."""
    return name.replace("_", "-")
