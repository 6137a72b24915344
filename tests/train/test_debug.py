"""A training that goes non-finite stops with a dump, which says where it began."""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from palm_jax import align
from palm_jax.train import debug, learner, loop

CONFIG = learner.LearnerConfig(
    width=2, crop=20, embed=4, hidden=(8,), batch_size=4, steps=24, max_skipped_steps=2
)
RNG = np.random.default_rng(0)
DATA = learner.Batch(
    {"front": RNG.integers(0, 256, (30, 24, 24, 3), dtype=np.uint8)},
    RNG.normal(size=(30, 3)).astype(np.float32),
    RNG.normal(size=(30, 10)).astype(np.float32),
)
BANK = RNG.integers(0, 256, (5, 24, 24, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def model() -> learner.Learner:
    return learner.make_learner(CONFIG, 3)


def run(model: learner.Learner, data: learner.Batch, folder: Path, **options: Any) -> Path:
    """Trains until it stops; the dump that the error names."""
    options = {"log_every": 4, **options}
    with pytest.raises(loop.NonFiniteError, match="max_skipped_steps = 2") as caught:
        with debug.dumping(folder, model) as on_failure:
            loop.run(model, data, seed=0, bank=BANK, on_failure=on_failure, **options)
    path = Path(str(caught.value).rpartition(" ")[2])
    assert "python -m palm_jax debug replay" in str(caught.value) and path.is_dir()
    return path


@pytest.mark.parametrize("stopped", [False, True])
def test_a_bad_sample_is_found_in_its_dump(
    stopped: bool, model: learner.Learner, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its numbers are finite, as `run` asks of its data, but not their squares. Somebody who stops
    the training before the next line of its log is told as well."""
    actions = DATA.actions.copy()
    actions[:, 6] *= 1e-30
    actions[5, 6] = 3e38
    actions[6, 6] = -3e38  # the range's width overflows
    asked = itertools.count()
    options: dict[str, Any] = {"log_every": 100, "should_stop": lambda: next(asked) == 23}
    bad = dataclasses.replace(DATA, actions=actions)
    path = run(model, bad, tmp_path, **(options if stopped else {}))
    again, failure = debug.load(path)
    assert again.config == model.config and failure.batch.proprio.shape == (4, 3)
    assert debug.main(["replay", str(path)]) == 0
    out = capsys.readouterr().out
    assert "loss nan" in out and "The first that is not finite is input/target" in out
    assert "augmentation or normalisation makes it" in out


def test_parameters_that_overflow_are_traced_to_their_layer(
    model: learner.Learner, tmp_path: Path
) -> None:
    start = model.jitted_init(jax.random.key(0), learner.fit_normalizer(DATA.proprio, DATA.actions))
    heads = {**start.params["head"]}
    heads["layer0"] = jax.tree.map(lambda x: np.full_like(x, 3e38), heads["layer0"])
    state = dataclasses.replace(start, params={**start.params, "head": heads})
    state = jax.tree.map(jax.numpy.array, state)
    batch = loop.take(DATA, np.arange(4))
    path = debug.save(tmp_path, model, learner.Failure(jax.random.key(1), state, batch, None))
    lines = debug.replay(path)
    assert "The first that is not finite is layer hidden0" in lines[1]
    assert "overflow" in lines[2] and any("gradient/head/output" in line for line in lines)


def test_a_dump_keeps_cameras_and_says_when_all_is_well(
    model: learner.Learner, tmp_path: Path
) -> None:
    pose = np.tile(np.diag([1.0, -1, -1, 1]).astype(np.float32), (4, 1, 1))
    camera = jax.vmap(lambda pose: align.Camera.from_fovy(40.0, 24, 24, pose))(pose)
    batch = dataclasses.replace(
        loop.take(DATA, np.arange(4)),
        cameras={"front": camera},
        tcp=np.zeros((4, 3), np.float32),
    )
    state = model.jitted_init(
        jax.random.key(0), learner.fit_normalizer(batch.proprio, batch.actions)
    )
    path = debug.save(tmp_path, model, learner.Failure(jax.random.key(1), state, batch, BANK))
    _, failure = debug.load(path)
    assert jax.tree.structure(failure.batch) == jax.tree.structure(batch)
    jax.tree.map(np.testing.assert_array_equal, failure.batch, batch)
    assert debug.main(["replay", str(path)]) == 1


def test_what_is_no_dump_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert debug.main(["replay", str(tmp_path)]) == 2
    assert "the folder is empty" in capsys.readouterr().out
    debug.checkpoint.save(tmp_path, 3, {"x": np.ones(1)})
    assert debug.main(["replay", str(tmp_path / "3")]) == 2
    assert "expected a dump of a failed update" in capsys.readouterr().out
