"""Versions that were noted, beside those of now."""

import importlib.metadata
import platform
from typing import Any

import pytest

from palm_jax.train.files import versions

NOW = {"jax": "0.10.2", "mujoco-mjx": "3.17.0", "palm_jax": "0.1.0"}


def test_what_is_installed_is_named() -> None:
    found = versions.current()
    assert found["python"] == platform.python_version()
    for name in ("jax", "numpy", "mujoco"):
        assert found[name] == importlib.metadata.version(name)


@pytest.mark.parametrize(
    ("old", "found"),
    [
        (NOW, None),
        ({"jax": "0.9.1"}, ("jax", "0.9.1", "0.10.2")),
        ({"mujoco_mjx": "3.16"}, ("mujoco-mjx", "3.16", "3.17.0")),
        ({"palm-jax": "unknown", "jax": "0.10.2", "flax": "1"}, None),
        ({"palm-jax": "0.0.9"}, ("palm_jax", "0.0.9", "0.1.0")),
        ({}, None),
        (None, None),
        (["jax"], None),
    ],
)
def test_the_first_that_differs(old: Any, found: tuple[str, str, str] | None) -> None:
    assert versions.difference(old, NOW) == found
