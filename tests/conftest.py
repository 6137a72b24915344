"""Settings for the whole suite.

Compiled programs are kept between runs in .pytest_cache/xla; set PALM_JAX_TEST_CACHE to another
folder, or to an empty string to compile everything anew.
"""

import os
from pathlib import Path

# Before anything imports matplotlib: figures are drawn to files.
os.environ.setdefault("MPLBACKEND", "Agg")

import hypothesis
import jax
import pytest

# Seconds of compilation above which a program is worth a file.
WORTH_CACHING = 0.3

hypothesis.settings.register_profile(
    "palm_jax",
    max_examples=25,
    # The first example compiles; the seed is fixed so that a failure is the same for everyone.
    deadline=None,
    derandomize=True,
    database=None,
)
hypothesis.settings.load_profile("palm_jax")


def pytest_configure(config: pytest.Config) -> None:
    """Let a key that is used twice raise, and keep compiled programs."""
    jax.config.update("jax_debug_key_reuse", True)
    folder = os.environ.get("PALM_JAX_TEST_CACHE", str(config.rootpath / ".pytest_cache" / "xla"))
    if folder:
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", WORTH_CACHING)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Which tests share a process (`--dist loadgroup`): those of a file; and those that share
    worlds, which take longer to compile than all else and would be compiled in both processes."""
    for item in items:
        item.add_marker(pytest.mark.xdist_group(_process(item.path)))


def _process(file: Path) -> str:
    if file.name in ("test_stages.py", "test_docs.py"):
        return "stages"
    return "envs" if file.parent.name == "envs" else str(file)
