"""What saving costs, as a share of the training that it interrupts:

    python -m benchmarks.bench_checkpoint --preset quick --samples-per-second 770

A checkpoint of the preset's network is saved as a training saves it (arrays, hashes, syncs, rename,
retention). How fast the training is by itself `python -m palm_jax bench train` says, and the header
of a table.
"""

import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from palm_jax.envs.registry import TASKS
from palm_jax.train import checkpoint, config, methods
from palm_jax.train.evaluate import VIEW
from palm_jax.train.learner import make_learner


def run(*, preset: str = "quick", samples_per_second: float, repeats: int = 7) -> dict[str, Any]:
    """Seconds of a save, and its share of an interval between two checkpoints.

    Args:
      preset: whose network, batch and interval.
      samples_per_second: of its training, without saving.
      repeats: saves; the median counts.
    """
    chosen, method = config.PRESETS[preset](), methods.find("palm")
    size = method.spec(TASKS[chosen.task], chosen.image_size).proprio_size
    abstract = make_learner(chosen.learner(method), size, (VIEW,)).abstract_state()
    rng = np.random.default_rng(0)
    state = jax.tree.map(lambda x: np.asarray(rng.normal(size=x.shape), x.dtype), abstract)
    wall, busy = [], []
    with tempfile.TemporaryDirectory() as folder:
        for step in range(repeats):
            begin, begun = time.perf_counter(), time.process_time()
            saved = checkpoint.save(folder, step, state, {"preset": preset}, keep=chosen.keep)
            wall.append(time.perf_counter() - begin)
            busy.append(time.process_time() - begun)
        bytes_ = sum(path.stat().st_size for path in Path(saved).rglob("*") if path.is_file())
    interval = chosen.checkpoint_every * chosen.batch_size / samples_per_second
    seconds, cpu = statistics.median(wall), statistics.median(busy)
    return {
        "preset": preset,
        "megabytes": bytes_ / 1e6,
        "save_seconds": seconds,
        "save_cpu_seconds": cpu,
        "interval_seconds": interval,
        "share": seconds / (interval + seconds),
        "worst_share": max(wall) / (interval + max(wall)),
    }


if __name__ == "__main__":
    print(json.dumps(tyro.cli(run), indent=2))
