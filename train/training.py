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
from palm_jax.train import checkpoint, debug, learner, loop, workspace
from palm_jax.train.config import Learning
from palm_jax.train.files import pictures, records
from palm_jax.train.files.metrics import MetricsLog, write_json
from palm_jax.train.host import devices, interrupts
from palm_jax.train.reporting import console as terminal

PROMISE = "Stopping after this update, which saves; once more ends at once."
LOG_EVERY = 25  # updates
_BANK = 128  # background textures for Random Overlay


class Interrupted(KeyboardInterrupt):
    """Stopped on request, with everything saved."""


class Score(NamedTuple):
    """How good a checkpoint is."""

    rank: float  # the larger, the better
    logged: dict[str, float]  # what the log of the training says of it


class _Begun(NamedTuple):
    """A checkpoint to go on from."""

    step: int
    path: Path
    state: learner.TrainState


@dataclasses.dataclass(frozen=True)
class Training:
    """One policy's training.

    Attributes:
      config: steps, seed, checkpoints.
      name: of the method.
      model: what is trained.
      folder: of the run; its config.json tells its checkpoints from others'.
      score: of a checkpoint (step, state); None where it is not to be scored.
      augment: whether images are augmented, which takes backgrounds.
    """

    config: Learning
    name: str
    model: learner.Learner
    folder: Path
    score: Callable[[int, learner.TrainState], Score | None]
    augment: bool

    def train(self, data: learner.Batch, console: Console) -> None:
        """Trains from the newest valid checkpoint, or from the start, to the last step.

        Raises:
          ConfigError: begun under other versions.
          Interrupted: stopped on request.
          NonFiniteError: see `loop.run`; the message names a dump.
        """
        config, store = self.config, self.folder / "checkpoints"
        fingerprint = workspace.fingerprints(self.folder)[0]
        begun = self._begun(console)
        done = begun.step if begun else 0
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
                    checkpoint.FINGERPRINT: fingerprint,
                }
                with timed(self.folder, "checkpoints_s"):
                    log.sync()  # a checkpoint on the disk has its log there
                    path = checkpoint.save(store, step, state, meta, keep=config.keep)
                if not together.agreed:
                    self._score_if_missing(path, step, state, log)
                devices.wait()

            def on_failure(failure: learner.Failure) -> None:
                dump(failure)
                devices.wait()

            with timed(self.folder, "training_and_selection_s"), dumped as dump:
                if begun:
                    self._score_if_missing(begun.path, done, begun.state, log)
                loop.run(
                    self.model,
                    data,
                    seed=config.seed,
                    state=begun.state if begun else None,
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
        note(self.folder, updates=config.steps)

    def _begun(self, console: Console) -> "_Begun | None":
        """Where the training goes on: the newest valid checkpoint, if there is one.

        Raises:
          ConfigError: it was written under other versions.
        """
        found = checkpoint.latest_valid(
            self.folder / "checkpoints", fingerprints=workspace.fingerprints(self.folder)
        )
        if not found:
            return None
        step, path = found
        workspace.check_versions(
            path,
            checkpoint.versions_of(path),
            allowed=self.config.other_versions,
            instead="choose another --out",
        )
        state = checkpoint.load(path, self.model.abstract_state())
        if step < self.config.steps:
            terminal.resumed(console, f"{self.name}, step {step} of {self.config.steps}")
        return _Begun(step, path, state)

    def _score_if_missing(
        self, path: Path, step: int, state: learner.TrainState, log: MetricsLog
    ) -> None:
        """Writes the score of a checkpoint into the log and then into its meta data.

        One that a stop has left between two others is never scored: a training that was interrupted
        chooses among the checkpoints of one that was not.
        """
        if step % self.config.checkpoint_every and step != self.config.steps:
            return
        if checkpoint.SCORE in checkpoint.read_meta(path):
            return
        with timed(self.folder, "selection_s"):
            found = self.score(step, state)
        if found is not None:
            # Killed in between, the checkpoint is scored again, to the same row.
            log.write_once(step, found.logged)
            log.sync()
            checkpoint.update_meta(path, **{checkpoint.SCORE: found.rank})


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
        earlier = records.seconds(records.load_notes(folder / records.TIMES), what) or 0.0
        note(folder, **{what: round(earlier + time.monotonic() - start, 2)})


def note(folder: Path, **values: float) -> None:
    """Adds values to times.json, on which no result rests."""
    path = folder / records.TIMES
    write_json(path, {**records.load_notes(path), **values})
