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
import play

from palm_jax.train import __main__ as command
from palm_jax.train import sweep, table
from palm_jax.train.config import Config
from palm_jax.train.files import records

STEPS, EVERY = 100, 3
OPTIONS = sweep.SweepConfig(run=Path(), camera="-30:30:6", workspace="4x5", episodes=1)
WORLDS = 2  # a batch: 60 of them
TABLE = table.TableConfig(preset="quick")
PAUSE = 0.02  # seconds after each piece of work


def _quiet(folder: Path) -> None:
    """Output into a file; and compiled programs are kept, for every process compiles the same."""
    output = os.open(folder / "output", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(output, 1)
    os.dup2(output, 2)
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def train(folder: Path, *, hesitation: float = 0.0) -> None:
    """The training command in a run folder, without a simulator. Asked to stop, its last checkpoint
    takes `hesitation` seconds more."""
    _quiet(folder)
    play.set_up(folder, tell=lambda line: _tell(folder, line), hesitation=hesitation)
    sys.exit(command.main(play.words(folder, steps=STEPS, checkpoint_every=EVERY)))


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
        (config.out / "env.json").write_text("{}")
        _tell(folder, f"end {name}")
        return 0

    table._train = fake  # in this process alone
    sys.exit(table.main(["--preset", TABLE.preset, "--out", str(folder)]))
