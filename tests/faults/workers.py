"""Small jobs in processes of their own, to be killed: training, a sweep and a table.

Each goes on from what it finds in its folder, as the commands do, and tells in `progress` how far
it is. They are started by a server that has imported everything: a start is then a fork.
"""

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from palm_jax.train import checkpoint, interrupts, learner, records, sweep, table
from palm_jax.train.config import Config
from palm_jax.train.metrics import MetricsLog

STEPS, EVERY = 100, 3
CONFIG = learner.LearnerConfig(
    width=2, crop=20, embed=4, hidden=(8,), batch_size=4, steps=STEPS, warmup_steps=4, ema=0.9
)
OPTIONS = sweep.SweepConfig(run=Path(), camera="-30:30:6", workspace="4x5", episodes=1)
WORLDS = 2  # a batch: 60 of them
TABLE = table.TableConfig(preset="quick")
PAUSE = 0.02  # seconds after each piece of work


def data() -> learner.Batch:
    rng = np.random.default_rng(0)
    return learner.Batch(
        {"front": rng.integers(0, 256, (30, 24, 24, 3), dtype=np.uint8)},
        rng.normal(size=(30, 3)).astype(np.float32),
        rng.normal(size=(30, 10)).astype(np.float32),
    )


def bank() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (5, 24, 24, 3), dtype=np.uint8)


def _quiet(folder: Path) -> None:
    """Output into a file; and compiled programs are kept, for every process compiles the same."""
    output = os.open(folder / "output", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(output, 1)
    os.dup2(output, 2)
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def train(folder: Path) -> None:
    """A training with real checkpoints; leaves final.npz. Ends with 130 when asked to stop."""
    _quiet(folder)
    model, store, stop = learner.make_learner(CONFIG, 3), folder / "checkpoints", interrupts.Stop()
    with stop.listening():
        state, done = None, 0
        found = checkpoint.latest_valid(store)
        if found:
            done, path = found
            state = checkpoint.load(path, model.abstract_state())
        with MetricsLog(folder / "metrics.jsonl", resume_step=done) as log:

            def on_log(step: int, values: dict[str, float]) -> None:
                log.write(step, values)
                _tell(folder, str(step))

            state = learner.run(
                model,
                data(),
                seed=0,
                state=state,
                bank=bank(),
                log_every=1,
                on_log=on_log,
                checkpoint_every=EVERY,
                on_checkpoint=lambda step, state: _save(store, step, state),
                should_stop=stop,
            )
    if stop():
        sys.exit(130)
    leaves = jax.tree_util.tree_leaves_with_path(state)
    arrays = {jax.tree_util.keystr(name): np.asarray(leaf) for name, leaf in leaves}
    records.save_arrays(folder / "final.npz", arrays)


def _save(store: Path, step: int, state: learner.TrainState) -> None:
    checkpoint.save(store, step, state, keep=1)


def _tell(folder: Path, line: str) -> None:
    with (folder / "progress").open("a") as file:
        file.write(line + "\n")
    time.sleep(PAUSE)


def run_sweep(folder: Path) -> None:
    """A sweep in rooms without physics; leaves sweep.npz."""
    import rooms

    _quiet(folder)
    runner, _ = rooms.evaluator(WORLDS)
    policy: Any = None
    sweep.job(OPTIONS).perform(
        folder / "sweep.npz",
        runner,
        policy,
        header={},
        seed=0,
        aligned=True,
        progress=lambda count: _tell(folder, str(count)),
    )


def run_table(folder: Path) -> None:
    """A table of faked cells; a line of `progress` for each that begins, and that has ended."""
    _quiet(folder)

    def fake(config: Config, log: Path) -> int:
        assert config.out is not None
        name = f"{config.task}/{config.out.name}"
        _tell(folder, f"begin {name}")
        good = np.random.default_rng(list(name.encode())).random(24) < 0.5
        episodes = {
            "success": good,
            "nan": np.zeros(24, bool),
            "object_xy": np.zeros((24, 2)),
            "camera_angle": np.zeros(24),
            "length": np.ones(24),
        }
        records.save_eval(config.out / "eval.npz", {"in_domain": episodes})
        count = {"successes": int(good.sum()), "episodes": 24, "nan": 0}
        (config.out / "eval.json").write_text(json.dumps({"in_domain": count}))
        _tell(folder, f"end {name}")
        return 0

    table._train = fake  # in this process alone
    sys.exit(table.main(["--preset", TABLE.preset, "--out", str(folder)]))
