"""Where a policy fails to pick an object up, and whether something stood in the camera's way.

    python examples/failures.py RUN
    python examples/failures.py RUN --domains in_domain workspace viewpoint --scenes 50

The scenes are those of the training command's own evaluation, replayed by the robot of the
demonstrations. Of each it is noted where the first object and its place lie, how high the object
came, and whether the task was solved. For tasks with a place to put things (`insert_peg`,
`rearrange_veggies`).

It is also an example of how to look into episodes: `Evaluator.domain` shows every state of a batch
of worlds to a function of yours.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np

LIFTED_M = 0.03  # above where it began
HIDDEN_DEG = 45.0  # the place stands in the way within this angle of the line to the camera


class Outcomes(NamedTuple):
    """Episodes, leading axis [N]."""

    solved: np.ndarray  # bool
    lifted: np.ndarray  # bool: the first object was picked up at some time
    hidden: np.ndarray  # bool: its place stood between it and the camera at the start


def hidden(
    objects: np.ndarray, places: np.ndarray, cameras: np.ndarray, within_deg: float = HIDDEN_DEG
) -> np.ndarray:
    """[N] whether a place lies, seen from an object, in the direction of the camera.

    Args:
      objects, places, cameras: positions [N, 3], metres in the world; heights do not count.
      within_deg: largest angle between the two directions.
    """
    to_place, to_camera = (places - objects)[:, :2], (cameras - objects)[:, :2]
    lengths = np.linalg.norm(to_place, axis=1) * np.linalg.norm(to_camera, axis=1)
    cosine = np.sum(to_place * to_camera, axis=1) / lengths
    return np.asarray(cosine > np.cos(np.radians(within_deg)))


class Watcher:
    """Keeps of every state of a batch what `outcomes` needs."""

    def __init__(self, body: int, goal: int) -> None:
        """Ids of the object's body and of its place's."""
        self._body, self._goal = body, goal
        self.positions: list[np.ndarray] = []  # of the object, [N, 3] each
        self.place = self.camera = np.zeros((0, 3))  # at the start

    def __call__(self, state) -> None:  # type: ignore[no-untyped-def]  # envs.base.State
        places = np.asarray(state.data.xpos)
        if not self.positions:
            self.place = places[:, self._goal]
            self.camera = np.asarray(state.camera_to_world)[:, :3, 3]
        self.positions.append(places[:, self._body])

    def outcomes(self, solved: np.ndarray) -> Outcomes:
        """What was seen of the first `len(solved)` worlds."""
        count, start = len(solved), self.positions[0]
        height = np.stack(self.positions)[:, :, 2].max(axis=0) - start[:, 2]
        behind = hidden(start, self.place, self.camera)
        return Outcomes(solved, height[:count] > LIFTED_M, behind[:count])


def lines(domain: str, found: Outcomes) -> list[str]:
    """What came of a domain, for people."""
    failed, words = ~found.solved, []
    for name, where in (("behind its place", found.hidden), ("elsewhere", ~found.hidden)):
        words.append(f"object {name}: {found.solved[where].sum()} of {where.sum()} solved")
    missed, dropped = (failed & ~found.lifted).sum(), (failed & found.lifted).sum()
    words.append(f"failures: {missed} never lifted it, {dropped} did")
    return [f"{domain}: {found.solved.sum()} of {len(found.solved)} solved", *words]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path, help="folder of a training run (one method)")
    parser.add_argument("--domains", nargs="+", default=["in_domain"])
    parser.add_argument("--scenes", type=int, default=50, help="in each domain, one batch")
    options = parser.parse_args()

    from palm_jax.train import workspace
    from palm_jax.train.evaluate import Runners

    config = workspace.stored_config(options.run)
    runners = Runners.of(config.task, config.robot, config.second_robot, options.scenes)
    evaluator, policy = workspace.load_policy(options.run, runners)
    items = getattr(evaluator.task, "items", None)
    if not items:
        parser.error(f"{options.run}: {config.task} has no place to put an object")
    model = evaluator.runner.env.mj_model
    for domain in options.domains:
        if runners.plays(domain) != config.robot:
            parser.error(f"{domain}: expected domains of the demonstrations' robot")
        watcher = Watcher(model.body(items[0].body).id, model.body(items[0].goal).id)
        record = evaluator.domain(
            policy,
            domain,
            seed=config.eval_seed,
            count=options.scenes,
            aligned=workspace.quoted_variant(options.run) == "aligned",
            watch=watcher,
        )
        print("\n  ".join(lines(domain, watcher.outcomes(record.success))), flush=True)


if __name__ == "__main__":
    main()
