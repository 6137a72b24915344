"""Run folders of tiny untrained policies, as the training command leaves them."""

import dataclasses
import functools
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.envs.registry import TASKS
from palm_jax.train import checkpoint, methods, workspace
from palm_jax.train.config import Config
from palm_jax.train.evaluate import VIEW
from palm_jax.train.learner import Learner, TrainState, fit_normalizer, make_learner

CONFIG = Config(task="lift_lid", width=2, image_size=32, random_crop=28)

HEIGHTS = (0.8, 1.0)
"""Range of the TCP's height in what passes for training data, metres."""


def config(method: str) -> Config:
    return dataclasses.replace(CONFIG, method=(method,))


def learner(method: str) -> Learner:
    """That of a method."""
    spec = methods.find(method).spec(TASKS[CONFIG.task], CONFIG.image_size)
    return make_learner(config(method).learner(methods.find(method)), spec.proprio_size, (VIEW,))


def state(method: str, seed: int) -> TrainState:
    """Random parameters, and others as their average; ranges of plausible data."""
    model, rng = learner(method), np.random.default_rng(seed)
    proprio = rng.uniform(-1, 1, (50, model.proprio_dim))
    proprio[:2, -2] = HEIGHTS
    proprio[2:, -2] = 0.9
    actions = np.tile([1.0, 0, 0, 0, 1, 0, 0, 0, 0, 0], (50, 1))
    actions[:, :9] += rng.uniform(-0.02, 0.02, (50, 9))
    actions[:, 9] = rng.integers(0, 2, 50)
    first = model.jitted_init(jax.random.key(seed), fit_normalizer(proprio, actions))
    return dataclasses.replace(
        first,
        step=jnp.asarray(seed, jnp.int32),
        ema_params=jax.tree.map(lambda leaf: 0.9 * leaf, first.params),
    )


def write(folder: Path, method: str = "palm") -> Path:
    """A run with three checkpoints: steps 10 (best), 20 (worse) and 30 (not scored)."""
    workspace.begin(dataclasses.replace(config(method), out=folder), folder, method)
    for step, meta in ((10, {"score": 0.8}), (20, {"score": 0.3}), (30, {})):
        checkpoint.save(folder / "checkpoints", step, state(method, step), meta)
    return folder


@functools.cache
def run(method: str = "palm") -> Path:
    """One such run of a method for all tests of a process: not to be written to."""
    place = tempfile.mkdtemp(prefix="palm_jax-tiny-")
    return write(Path(place) / method, method)
