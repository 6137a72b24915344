"""A small training run in a process of its own: `python training_process.py FOLDER SEED PAUSE`.

It goes on from what it finds in FOLDER, as the training command does, and leaves final.npz.
"""

import os
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from palm_jax.train import checkpoint, learner
from palm_jax.train.metrics import MetricsLog

STEPS, EVERY = 24, 5
CONFIG = learner.LearnerConfig(
    width=2, crop=20, embed=4, hidden=(8,), batch_size=4, steps=STEPS, warmup_steps=4, ema=0.9
)


def data() -> learner.Batch:
    rng = np.random.default_rng(0)
    return learner.Batch(
        {"front": rng.integers(0, 256, (30, 24, 24, 3), dtype=np.uint8)},
        rng.normal(size=(30, 3)).astype(np.float32),
        rng.normal(size=(30, 10)).astype(np.float32),
    )


def bank() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (5, 24, 24, 3), dtype=np.uint8)


def train(folder: Path, seed: int, pause: float) -> None:
    """Trains to the end; `pause` seconds after each step."""
    model = learner.make_learner(CONFIG, 3)
    store = folder / "checkpoints"
    state, done = None, 0
    found = checkpoint.latest_valid(store)
    if found:
        done, path = found
        state = checkpoint.load(path, model.abstract_state())
    with MetricsLog(folder / "metrics.jsonl", resume_step=done) as log:

        def on_log(step: int, values: dict[str, float]) -> None:
            log.write(step, values)
            time.sleep(pause)

        def on_checkpoint(step: int, state: learner.TrainState) -> None:
            checkpoint.save(store, step, state, keep=2)

        state = learner.run(
            model,
            data(),
            seed=seed,
            state=state,
            bank=bank(),
            log_every=1,
            on_log=on_log,
            checkpoint_every=EVERY,
            on_checkpoint=on_checkpoint,
        )
    save(folder / "final.npz", state)


def save(path: Path, state: Any) -> None:
    leaves = jax.tree_util.tree_leaves_with_path(state)
    np.savez(path, **{jax.tree_util.keystr(name): np.asarray(leaf) for name, leaf in leaves})


if __name__ == "__main__":
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    train(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))
