"""`python -m palm_jax debug replay DUMP`: an update that failed, repeated and explained.

A training that has to skip too many updates stops, and leaves all that one of them was computed
from: state, batch, backgrounds, key and configuration. A dump has a checkpoint's layout (hashed, no
pickle) in `RUN/dumps/STEP`.
"""

import argparse
import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.align import Camera
from palm_jax.train import checkpoint
from palm_jax.train.learner import (
    Batch,
    Failure,
    Learner,
    LearnerConfig,
    compiler_options,
    make_learner,
)
from palm_jax.train.loop import NonFiniteError

DUMPS = "dumps"


@contextlib.contextmanager
def dumping(folder: Path, learner: Learner) -> Iterator[Callable[[Failure], None]]:
    """Around `loop.run`: what to give it as `on_failure`; the error then names the dump.

    Args:
      folder: of the dumps.
      learner: whose steps fail.
    """
    written: list[Path] = []
    try:
        yield lambda failure: written.append(save(folder, learner, failure))
    except NonFiniteError as error:
        if not written:
            raise
        raise NonFiniteError(
            f"{error}. To see where it begins: python -m palm_jax debug replay {written[-1]}"
        ) from error


def save(folder: Path, learner: Learner, failure: Failure) -> Path:
    """Writes a dump; returns its folder, FOLDER/STEP."""
    cameras = failure.batch.cameras
    tree = {
        "state": failure.state,
        "batch": {
            "images": failure.batch.images,
            "proprio": failure.batch.proprio,
            "actions": failure.batch.actions,
            "tcp": failure.batch.tcp,
            "K": {view: camera.K for view, camera in cameras.items()},
            "cam_to_world": {view: camera.cam_to_world for view, camera in cameras.items()},
        },
        "bank": failure.bank,
        "key": jax.random.key_data(failure.key),
    }
    meta = {
        "learner": dataclasses.asdict(learner.config),
        "proprio_dim": learner.proprio_dim,
        "views": learner.views,
        "frames": {view: [camera.height, camera.width] for view, camera in cameras.items()},
    }
    return checkpoint.save(folder, int(failure.state.step), tree, meta)


def load(path: Path) -> tuple[Learner, Failure]:
    """Reads a dump.

    Raises:
      CheckpointError: it is damaged, or of another version.
    """
    manifest = checkpoint.verify(path)
    meta = manifest["meta"]
    try:
        values: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in meta["learner"].items()
        }
        learner = make_learner(LearnerConfig(**values), meta["proprio_dim"], meta["views"])
    except (KeyError, TypeError, ValueError) as error:
        raise checkpoint.CheckpointError(
            f"{path}: expected a dump of a failed update by this version, got something else "
            f"({error})"
        ) from error
    # What is no parameter has whatever shapes were written.
    free = {
        name: jax.ShapeDtypeStruct(leaf["shape"], leaf["dtype"])
        for name, leaf in manifest["leaves"].items()
        if not name.startswith("state/")
    }
    tree = checkpoint.load(path, {"state": learner.abstract_state(), **checkpoint.nested(free)})
    stored = tree["batch"]
    cameras = {
        view: Camera(stored["K"][view], stored["cam_to_world"][view], *size)
        for view, size in meta["frames"].items()
    }
    batch = Batch(
        stored["images"], stored["proprio"], stored["actions"], cameras, stored.get("tcp")
    )
    key = jax.random.wrap_key_data(tree["key"])
    return learner, Failure(key, tree["state"], batch, tree.get("bank"))


class Finding(NamedTuple):
    """A quantity of a step with numbers that are not finite."""

    name: str
    bad: int
    size: int
    where: tuple[int, ...]  # index of the first one

    def __str__(self) -> str:
        place = f", first at {list(self.where)}" if self.where else ""
        return f"{self.name}: {self.bad} of {self.size} numbers{place}"


def findings(learner: Learner, failure: Failure) -> list[Finding]:
    """What is not finite, in the order in which a step computes it."""
    names: list[str] = []

    def values(failure: Failure) -> list[jax.Array]:
        everything = learner.examine(failure)
        names[:] = everything
        return list(everything.values())

    # As arrays, which a `Failure` is not to JAX.
    parts = (failure.key, failure.state, failure.batch, failure.bank)
    run = jax.jit(lambda *parts: values(Failure(*parts)), compiler_options=compiler_options())
    found = []
    for value, name in zip(run(*parts), names, strict=True):
        array = np.asarray(value, np.float64)
        bad = ~np.isfinite(array)
        if bad.any():
            where = tuple(int(i) for i in np.argwhere(bad)[0]) if array.ndim else ()
            found.append(Finding(name, int(bad.sum()), array.size, where))
    return found


_CAUSES: Mapping[str, str] = {
    "state/params": "the parameters were so before this update: see the learning rate, and the log",
    "state": "the state was so before this update",
    "batch": "the data are so: the first index is the sample's place in the batch",
    "bank": "a background is so",
    "input": "the data are finite: augmentation or normalisation makes it of them",
    "layer": "what this layer is given is finite: it overflows, or its norm divides by zero",
    "prediction": "the last layer overflows",
    "loss": "predictions are finite, and so far off that their square overflows",
    "gradient": "the loss is finite: this gradient overflows; lower the learning rate",
}


def cause(finding: Finding) -> str:
    """What the first finding means."""
    return next(text for name, text in _CAUSES.items() if finding.name.startswith(name))


def replay(path: Path) -> list[str]:
    """Repeats the update of a dump; the lines to print."""
    learner, failure = load(path)
    step = int(failure.state.step)
    state = jax.tree.map(jnp.copy, failure.state)  # which the step consumes
    _, metrics = learner.jitted_step(failure.key, state, failure.batch, failure.bank)
    loss, norm = float(metrics["loss"]), float(metrics["grad_norm"])
    lines = [f"Update {step + 1} again: loss {loss:.6g}, norm of the gradient {norm:.6g}."]
    if np.isfinite([loss, norm]).all():
        return [*lines, "Not reproduced: with these parameters the update is finite."]
    found = findings(learner, failure)
    if not found:  # the norm alone
        return [*lines, "Every number is finite: the norm of the gradient overflows."]
    lines.append(f"The first that is not finite is {found[0]}.")
    lines.append(f"That is, {cause(found[0])}.")
    return [*lines, "Then:", *(f"  {finding}" for finding in found[1:])]


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns 0 if the failure was reproduced, 1 if not, 2 if the dump is none."""
    parser = argparse.ArgumentParser(prog="python -m palm_jax debug", description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    verb = verbs.add_parser("replay", help="repeat an update that failed, and explain it")
    verb.add_argument("dump", type=Path, help="a folder RUN/dumps/STEP")
    words = parser.parse_args(argv)
    try:
        lines = replay(words.dump)
    except checkpoint.CheckpointError as error:
        print(f"error: {error}")
        return 2
    print("\n".join(lines))
    return 1 if lines[-1].startswith("Not reproduced") else 0
