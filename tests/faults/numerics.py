"""Numbers that are not finite, and worlds that do not fit into memory."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
import play
import rooms
from faults.cases import Outcome, case, refused

from palm_jax.envs.rollout import repeat_params
from palm_jax.train import debug, evaluate, learner, loop, sweep
from palm_jax.train.files import records

POLICY: Any = None
SIDE = 24
CONFIG = play.small(
    learner.LearnerConfig(width=2, crop=20, batch_size=4, steps=100, warmup_steps=4, ema=0.9)
)


@case("numerics", "an episode's physics goes non-finite")
def _nan_episode(folder: Path) -> Outcome:
    runner, _ = rooms.evaluator(8)  # whose physics diverges where y > 0.15 m
    xs, ys = sweep.cells_of("3x7")
    params = sweep.cell_params(runner.runner.env.default_params(), np.zeros(1), xs, ys, 1)
    found = evaluate.record(runner.episodes(POLICY, jax.random.key(0), params, 21))
    counted = records.counts({"workspace": found})["workspace"]
    assert counted["nan"] == found.nan.sum() == 6 and not found.solved[found.nan].any()
    records.save_eval(folder / "eval.npz", {"workspace": found})
    again = records.load_eval(folder / "eval.npz")
    assert records.counts(again)["workspace"] == counted
    return Outcome("a failure, counted in eval.json and eval.npz")


for _name in ("proprio", "actions"):

    @case("numerics", f"{_name} of the data has an infinity", field=_name)
    def _infinite_data(folder: Path, field: str) -> Outcome:
        data = play.samples(SIDE)
        values = np.array(getattr(data, field))
        values[3, 1] = np.inf
        model = learner.make_learner(CONFIG, play.PROPRIO)
        with refused(ValueError, f"{field} has non-finite values"):
            loop.run(model, dataclasses.replace(data, **{field: values}), seed=0)
        return Outcome("refused before anything is compiled")


@case("numerics", "updates keep going non-finite", long=True)
def _bad_updates(folder: Path) -> Outcome:
    data = play.samples(SIDE)
    actions = np.array(data.actions) * np.float32(1e-3)
    actions[5:7, 6] = 3e38, -3e38  # finite, but not their distance
    config = dataclasses.replace(CONFIG, max_skipped_steps=3, ema=0.0)
    model = learner.make_learner(config, play.PROPRIO)
    bad = dataclasses.replace(data, actions=actions)
    with refused(loop.NonFiniteError, "max_skipped_steps = 3", "debug replay"):
        with debug.dumping(folder, model) as on_failure:
            bank = play.backgrounds(SIDE)
            loop.run(model, bad, seed=0, bank=bank, log_every=5, on_failure=on_failure)
    (dump,) = folder.iterdir()
    lines = debug.replay(dump)
    assert "The first that is not finite is input/target" in lines[1], lines
    return Outcome("stops after 4 with a dump; its replay names the input that overflows")


@case("memory", "a batch of worlds does not fit")
def _too_many_worlds(folder: Path) -> Outcome:
    told: list[str] = []
    small, _ = rooms.evaluator(16, fits=5, tell=told.append)
    large, _ = rooms.evaluator(16)
    few, many = (
        runs.domain(POLICY, "workspace", seed=3, count=21, aligned=False) for runs in (small, large)
    )
    np.testing.assert_array_equal(few.success, many.success)
    np.testing.assert_array_equal(few.object_xy, many.object_xy)
    assert [text.partition(";")[0] for text in told] == [
        f"{count} worlds of panda do not fit into memory" for count in (16, 8)
    ]
    assert small.runners.worlds == {"panda": 4}
    return Outcome("halved twice and said; the same episodes")


@case("memory", "a batch of a sweep does not fit")
def _too_many_in_a_sweep(folder: Path) -> Outcome:
    job = sweep.job(sweep.SweepConfig(run=Path(), camera="-10:10:2", workspace="3x4"))
    found = []
    for fits in (16, 3):
        runner, _ = rooms.evaluator(16, fits=fits)
        path = folder / f"{fits}.npz"
        job.perform(path, runner, POLICY, header={}, seed=0, aligned=True)
        found.append(records.load_sweep(path))
    np.testing.assert_array_equal(found[0].success, found[1].success)
    assert [sweep.worlds for sweep in found] == [16, 2]
    return Outcome("halved, and the size is in the file; the same cells")


@case("memory", "not even one world fits")
def _no_world(folder: Path) -> Outcome:
    runner, _ = rooms.evaluator(4, fits=0)
    with refused(MemoryError, "not even one world of panda fits", "RESOURCE_EXHAUSTED"):
        runner.domain(POLICY, "workspace", seed=3, count=5, aligned=False)
    return Outcome("an error that names it")


@case("memory", "another error of XLA comes")
def _another_error(folder: Path) -> Outcome:
    runner, _ = rooms.evaluator(4)

    def broken(*arguments: Any, **options: Any) -> Any:
        raise jax.errors.JaxRuntimeError("INTERNAL: broken")

    runner.runner.run = broken  # type: ignore[method-assign]
    params = repeat_params(runner.runner.env.default_params(), 4)
    with refused(jax.errors.JaxRuntimeError, "INTERNAL"):
        runner.episodes(POLICY, jax.random.key(0), params, 4)
    assert not evaluate.out_of_memory(ValueError("memory"))
    return Outcome("passed on: nothing is halved")
