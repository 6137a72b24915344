"""A training in a run folder: resumed where it stopped, logged, checkpointed, scored, timed.

What is trained on, and what makes one checkpoint better than another, is the caller's.
"""

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import jax
from rich.console import Console

from palm_jax.align import procedural_bank
from palm_jax.train import checkpoint, debug, devices, interrupts, learner, pictures, records
from palm_jax.train import console as terminal
from palm_jax.train.config import Learning
from palm_jax.train.metrics import MetricsLog, write_json

PROMISE = "Stopping after this update, which saves; once more ends at once."
LOG_EVERY = 25  # updates
_BANK = 128  # background textures for Random Overlay


class Interrupted(KeyboardInterrupt):
    """Stopped on request, with everything saved."""


class Score(NamedTuple):
    """How good a checkpoint is."""

    rank: float  # the larger, the better
    logged: dict[str, float]  # what the log of the training says of it


@dataclasses.dataclass(frozen=True)
class Training:
    """One policy's training.

    Attributes:
      config: steps, seed, checkpoints.
      name: of the method.
      model: what is trained.
      folder: of the run.
      belongs: fingerprint of the run; checkpoints of others are not used.
      score: of a checkpoint (step, state); None where it is not to be scored.
      augment: whether images are augmented, which takes backgrounds.
    """

    config: Learning
    name: str
    model: learner.Learner
    folder: Path
    belongs: str
    score: Callable[[int, learner.TrainState], Score | None]
    augment: bool

    def train(self, data: learner.Batch, console: Console) -> None:
        """Trains from the newest valid checkpoint, or from the start, to the last step.

        Raises:
          Interrupted: stopped on request.
          NonFiniteError: see `learner.run`; the message names a dump.
        """
        config, store = self.config, self.folder / "checkpoints"
        state, done = self._resumed(console)
        dumped = debug.dumping(self.folder / debug.DUMPS, self.model)
        stop = interrupts.Stop(PROMISE)
        together = devices.Together(stop)
        with (
            MetricsLog(self.folder / "metrics.jsonl", resume_step=done) as log,
            terminal.ProgressBar(console, config.steps, f"train {self.name}", done=done) as bar,
            stop.listening(),
        ):
            shown = done

            def on_log(step: int, values: dict[str, float]) -> None:
                nonlocal shown
                log.write(step, values)
                bar.advance(step - shown, loss=f"{values['loss']:.4f}")
                shown = step

            def on_checkpoint(step: int, state: learner.TrainState) -> None:
                meta = {
                    "method": self.name,
                    "task": config.task,
                    checkpoint.FINGERPRINT: self.belongs,
                }
                path = checkpoint.save(store, step, state, meta, keep=config.keep)
                if not stop():
                    found = self._score_if_missing(path, step, state)
                    if found is not None:
                        log.write(step, found.logged)
                devices.wait()

            def on_failure(failure: learner.Failure) -> None:
                dump(failure)
                devices.wait()

            with timed(self.folder, "training_and_selection_s"), dumped as dump:
                learner.run(
                    self.model,
                    data,
                    seed=config.seed,
                    state=state,
                    bank=backgrounds(config) if self.augment else None,
                    log_every=LOG_EVERY,
                    on_log=on_log,
                    checkpoint_every=config.checkpoint_every,
                    on_checkpoint=on_checkpoint,
                    should_stop=together,
                    on_failure=on_failure,
                    devices=jax.devices(),
                )
        if together.agreed:
            raise Interrupted

    def _resumed(self, console: Console) -> tuple[learner.TrainState | None, int]:
        """The newest valid checkpoint, scored, and its step; None and 0 if there is none."""
        found = checkpoint.latest_valid(self.folder / "checkpoints", fingerprint=self.belongs)
        if not found:
            return None, 0
        done, path = found
        state = checkpoint.load(path, self.model.abstract_state())
        if done < self.config.steps:
            terminal.resumed(console, f"{self.name}, step {done} of {self.config.steps}")
        self._score_if_missing(path, done, state)
        return state, done

    def _score_if_missing(self, path: Path, step: int, state: learner.TrainState) -> Score | None:
        """The score of a checkpoint, written into its meta data; None if it is not scored now."""
        if checkpoint.SCORE in checkpoint.read_meta(path):
            return None
        with timed(self.folder, "selection_s"):
            found = self.score(step, state)
        if found is not None:
            checkpoint.update_meta(path, **{checkpoint.SCORE: found.rank})
        return found


def backgrounds(config: Learning) -> jax.Array:
    """Pictures [K, H, W, 3] for Random Overlay: the user's own, or textures made in jit."""
    if config.backgrounds is not None:
        return jax.numpy.asarray(pictures.read_folder(config.backgrounds, config.image_size))
    return procedural_bank(jax.random.key(config.seed), _BANK, config.image_size)


@contextmanager
def timed(folder: Path, what: str) -> Iterator[None]:
    """Adds the seconds spent inside to times.json, which also counts over interruptions."""
    start = time.monotonic()
    try:
        yield
    finally:
        path = folder / "times.json"
        times = dict(records.load_notes(path))
        earlier = records.seconds(times, what) or 0.0
        write_json(path, {**times, what: round(earlier + time.monotonic() - start, 2)})
