"""The training command without a simulator, in a process of its own, to be killed or joined:

    python training_process.py FOLDER DEVICES PAUSE WORDS...

DEVICES are virtual ones of this process, which must choose them at the start; it sleeps for PAUSE
seconds after every line of the log. WORDS are those of `python -m palm_jax.train`.
"""

import functools
import os
import sys
from pathlib import Path

import jax

HEARTBEAT = 10  # seconds without which a process of several counts as dead; JAX's own are 100


def main(folder: Path, devices: int, pause: float, words: list[str]) -> int:
    """The command's exit status."""
    jax.config.update("jax_num_cpu_devices", devices)
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    jax.distributed.initialize = functools.partial(
        jax.distributed.initialize, heartbeat_timeout_seconds=HEARTBEAT
    )
    import play

    from palm_jax.train import __main__ as command

    play.set_up(folder, pause=pause)
    return command.main(words)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]), sys.argv[4:]))
