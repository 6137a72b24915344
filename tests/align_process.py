"""`python -m palm_jax data align` in a process of its own, to be stopped and killed.

It is started by a server that has imported everything: a start is then a fork.
"""

import os
import sys
from pathlib import Path

import jax

import palm_jax.train.data.commands as commands


def align(words: list[str], output: Path, cache: str | None) -> None:
    """Runs the command, with its output in a file; ends with its exit code.

    Args:
      words: after `data`.
      output: to which is added.
      cache: folder of compiled programs.
    """
    file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(file, 1)
    os.dup2(file, 2)
    if cache:
        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    sys.exit(commands.main(words))
