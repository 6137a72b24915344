"""Settings for the whole suite.

Compiled programs are kept between runs in .pytest_cache/xla; set PALM_JAX_TEST_CACHE to another
folder, or to an empty string to compile everything anew.
"""

import os

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
