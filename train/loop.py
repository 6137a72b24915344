"""The loop around a learner's compiled step: which samples a step gets, and when it ends.

Files, clocks and printing stay with the caller, who hands in callbacks. The order of the samples is
a function of (key, step) alone (`batch_indices`), as is all that a step draws: a run that was
interrupted and resumed from a checkpoint is bit for bit the run that was not.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from palm_jax.train import model
from palm_jax.train.host.devices import Split
from palm_jax.train.learner import (
    Batch,
    Failure,
    Learner,
    LearnerConfig,
    TrainState,
    check_batch,
    check_cameras,
    fit_normalizer,
)


class NonFiniteError(FloatingPointError):
    """More steps had a non-finite loss or gradient than the configuration lets pass."""


def batch_indices(key: jax.Array, step: int, count: int, batch_size: int) -> np.ndarray:
    """Indices of the samples of one step, [batch_size] int64.

    The steps read, one after the other, an endless row of permutations of range(count), the i-th of
    which is a function of (key, i): every sample comes once an epoch, none is dropped, and a step's
    batch may span two epochs.
    """
    if count < 1:
        raise ValueError("no samples to draw from")
    position = np.arange(batch_size, dtype=np.int64) + np.int64(step) * batch_size
    epochs = position // count
    return np.concatenate(
        [
            _permutation(_key_bytes(key), int(epoch), count)[position[epochs == epoch] % count]
            for epoch in range(int(epochs[0]), int(epochs[-1]) + 1)
        ]
    )


def _key_bytes(key: jax.Array) -> bytes:
    return np.asarray(jax.random.key_data(key)).tobytes()


@functools.lru_cache(maxsize=4)
def _permutation(key: bytes, epoch: int, count: int) -> np.ndarray:
    typed = jax.random.wrap_key_data(jnp.asarray(np.frombuffer(key, np.uint32)))
    draws = np.asarray(jax.random.bits(jax.random.fold_in(typed, epoch), (count,)))
    order = np.argsort(draws, kind="stable")
    order.setflags(write=False)
    return order


def take(data: Batch, indices: np.ndarray) -> Batch:
    """The samples at `indices` of a data set in host memory."""
    return jax.tree.map(lambda x: x[indices], data)


@dataclasses.dataclass(frozen=True)
class RunKeys:
    """The independent keys of a run, all from its seed."""

    init: jax.Array
    step: jax.Array
    order: jax.Array

    @staticmethod
    def from_seed(seed: int) -> "RunKeys":
        """Keys for parameters, steps and the order of the samples."""
        return RunKeys(*jax.random.split(jax.random.key(seed), 3))


def run(
    learner: Learner,
    data: Batch,
    *,
    seed: int,
    state: TrainState | None = None,
    bank: ArrayLike | None = None,
    steps: int | None = None,
    trunk: model.PretrainedTrunk | None = None,
    log_every: int = 50,
    on_log: Callable[[int, dict[str, float]], None] | None = None,
    checkpoint_every: int = 0,
    on_checkpoint: Callable[[int, TrainState], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    devices: Sequence[jax.Device] | None = None,
    on_failure: Callable[[Failure], None] | None = None,
) -> TrainState:
    """Train up to `steps`, and return the state.

    Args:
      learner: from `make_learner`.
      data: the data set, arrays in host memory with one leading axis.
      seed: of everything random. A resumed run must have the seed of the run it resumes.
      state: to go on from (it is consumed), or None to start.
      bank: backgrounds [K, H, W, 3] for the random overlay; required if the configuration has one.
      steps: where to stop, counted from the start of the run; the configuration's by default.
      trunk: imported weights for a new run.
      log_every: `on_log(step, metrics)` after every so many steps, and after the last. The metrics
        are those of that one step, so that they do not depend on where a run was interrupted.
      checkpoint_every: `on_checkpoint(step, state)` after every so many steps (0 for never), and
        after the last one unless it was just called. The state must not be kept: it is consumed
        by the next step.
      should_stop: asked before every step; True ends the run as if `steps` were reached here.
      devices: those that share every batch, the default device alone by default. With those of
        several processes each of them makes this call, with the same arguments; `state` and
        `bank` count on the first only. States that are handed out are on one device.
      on_failure: given a step to look at, before `NonFiniteError` is raised.

    Raises:
      DeviceError: the devices do not divide the batch.
      NonFiniteError: more than `config.max_skipped_steps` updates had to be skipped.
      ValueError: the data do not fit the learner.
    """
    config = learner.config
    split = Split(None) if devices is None else Split.over(devices)
    split.check(config.batch_size)
    count = _check_data(learner, data, bank)
    keys = RunKeys.from_seed(seed)
    if state is None:
        normalizer = fit_normalizer(data.proprio, data.actions)
        state = learner.jitted_init(keys.init, normalizer, trunk=trunk)
    backgrounds = None if bank is None or config.overlay_fraction == 0 else jnp.asarray(bank)
    last = config.steps if steps is None else steps
    key, state, backgrounds = split.everywhere((keys.step, state, backgrounds))
    step = learner.step_over(split)
    done = saved = int(state.step)

    def look(state: TrainState) -> None:
        if on_failure and int(state.skipped) > config.max_skipped_steps:
            alone, bank = split.on_one(state), split.on_one(backgrounds)
            on_failure(_find_failure(learner, keys, alone, data, bank, log_every))
        check_skipped(int(state.skipped), int(state.step), config)

    while done < last and not (should_stop and should_stop()):
        batch = split.rows(data, batch_indices(keys.order, done, count, config.batch_size))
        state, metrics = step(key, state, batch, backgrounds)
        done += 1
        if done % log_every == 0 or done == last:
            numbers = {name: float(value) for name, value in metrics.items()}
            if on_log:
                on_log(done, numbers)
            look(state)
        if on_checkpoint and checkpoint_every and done % checkpoint_every == 0:
            on_checkpoint(done, split.on_one(state))
            saved = done
    look(state)  # a stop may have come between two lines of the log
    state = split.on_one(state)
    if on_checkpoint and checkpoint_every and saved != done:
        on_checkpoint(done, state)
    return state


def _check_data(learner: Learner, data: Batch, bank: ArrayLike | None) -> int:
    """Raises ValueError for data that a run cannot use; returns the number of samples."""
    config = learner.config
    count = check_batch(data, learner.proprio_dim, learner.views, config.crop)
    for name in ("proprio", "actions"):
        if not np.isfinite(getattr(data, name)).all():
            raise ValueError(f"{name} has non-finite values; filter the data first")
    if config.overlay_fraction > 0 and bank is None:
        raise ValueError(
            "the configuration has a random overlay, but no bank of backgrounds was given; "
            "pass one, e.g. align.procedural_bank(...), or set overlay_fraction=0"
        )
    if config.turns:
        check_cameras(data, learner.views)
    return count


def _find_failure(
    learner: Learner,
    keys: RunKeys,
    state: TrainState,
    data: Batch,
    bank: jax.Array | None,
    back: int,
) -> Failure:
    """The last of the `back` steps before this state that fails with it.

    A skipped step leaves the parameters as they are, so that the last step, if it was one, is
    repeated exactly. An earlier one is tried with the parameters of today: bad data stay bad. If
    none fails, the last step is given.
    """
    done, count = int(state.step), len(data.proprio)
    found: Failure | None = None
    for step in range(done - 1, max(done - 1 - back, -1), -1):
        batch = take(data, batch_indices(keys.order, step, count, learner.config.batch_size))
        before = dataclasses.replace(state, step=jnp.int32(step))
        tried = Failure(keys.step, before, batch, bank)
        # A copy, which the step consumes.
        _, metrics = learner.jitted_step(keys.step, jax.tree.map(jnp.copy, before), batch, bank)
        if not np.isfinite([float(metrics["loss"]), float(metrics["grad_norm"])]).all():
            return tried
        found = found or tried
    assert found is not None
    return found


def check_skipped(skipped: int, step: int, config: LearnerConfig) -> None:
    """Raise `NonFiniteError` if more updates were skipped than the configuration lets pass."""
    if skipped > config.max_skipped_steps:
        raise NonFiniteError(
            f"{skipped} of {step} updates had a non-finite loss or gradient, more than "
            f"max_skipped_steps = {config.max_skipped_steps}. The parameters are those before "
            "these updates; lower learning_rate or grad_clip, or look for bad samples"
        )
