"""Settings for the whole suite.

Compiled programs are kept between runs in .pytest_cache/xla; set PALM_JAX_TEST_CACHE to another
folder, or to an empty string to compile everything anew.
"""

import os
from pathlib import Path
from typing import Any

# Before anything imports matplotlib: figures are drawn to files.
os.environ.setdefault("MPLBACKEND", "Agg")

import hypothesis
import jax
import pytest
from xdist.scheduler import LoadScopeScheduling

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


_TOGETHER = {
    "envs": (
        "test_demos.py",
        "test_policy_frames.py",
    ),  # besides all of tests/envs that is not named here
    "stages": ("test_stages.py", "test_docs.py"),
    "gym": ("test_gym.py",),  # late, when its worlds have been compiled by the others
}
"""Files that share worlds, by a name for their process."""


class Processes(LoadScopeScheduling):
    """Which tests share a process: those of a file; and those of files that share worlds, which
    take longer to compile than all else and would be compiled in both processes."""

    def _split_scope(self, nodeid: str) -> str:
        file = Path(nodeid.split("::")[0])
        for name, files in _TOGETHER.items():
            if file.name in files:
                return name
        return "envs" if file.parent.name == "envs" else str(file)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> LoadScopeScheduling:
    """For `--dist loadscope` and the like."""
    return Processes(config, log)
