"""The training command without a simulator, in a process of its own, to be killed or joined:

    python training_process.py FOLDER OPTIONS WORDS...

OPTIONS are a JSON object: "devices" are virtual ones of this process, which must choose them at the
start; the others are those of `play.scenery`. WORDS are those of `python -m palm_jax.train`.
"""

import functools
import json
import os
import sys
from pathlib import Path
from typing import Any

import jax

HEARTBEAT = 10  # seconds without which a process of several counts as dead; JAX's own are 100


def main(folder: Path, words: list[str], *, devices: int = 1, **options: Any) -> int:
    """The command's exit status."""
    jax.config.update("jax_num_cpu_devices", devices)
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    jax.distributed.initialize = functools.partial(
        jax.distributed.initialize, heartbeat_timeout_seconds=HEARTBEAT
    )
    import play

    from palm_jax.train import __main__ as command

    play.set_up(folder, **options)
    return command.main(words)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[3:], **json.loads(sys.argv[2])))
