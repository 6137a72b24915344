"""Where a policy fails to pick an object up, and whether something stood in the camera's way.

    python examples/failures.py RUN
    python examples/failures.py RUN --domains in_domain workspace viewpoint --scenes 50

The scenes are those of the training command's own evaluation, replayed by the robot of the
demonstrations. Of each it is noted where the first object and its place lie, how high the hand was
when it closed for the first time and the object came, and whether the task was solved. For tasks
with a place to put things (`insert_peg`, `rearrange_veggies`).

It is also an example of how to look into episodes: `Evaluator.domain` shows every state of a batch
of worlds to a function of yours.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

LIFTED_M = 0.03  # above where it began
CLOSED = 0.8  # of the opening at the start: the fingers are on their way
HIDDEN_DEG = 45.0  # the place stands in the way within this angle of the line to the camera


class Outcomes(NamedTuple):
    """Episodes, leading axis [N]."""

    solved: np.ndarray  # bool
    lifted: np.ndarray  # bool: the first object was picked up at some time
    hidden: np.ndarray  # bool: its place stood between it and the camera at the start
    closed_mm: np.ndarray  # the TCP above its middle when the hand closed, NaN if it never did


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
    """Keeps of every state of a batch what `outcomes` needs.

    Another number of worlds begins anew: the batch did not fit into memory.
    """

    def __init__(
        self, body: int, goal: int, hand: Callable[[Any], tuple[np.ndarray, np.ndarray]]
    ) -> None:
        """Ids of the object's body and of its place's; `hand` gives of a state the heights of the
        TCP [N], metres, and the openings [N]."""
        self._body, self._goal, self._hand = body, goal, hand
        self._states: list[tuple[np.ndarray, ...]] = []  # object's height, TCP's, opening
        self._start = self._place = self._camera = np.zeros((0, 3))

    def __call__(self, state: Any) -> None:
        """Of type `envs.base.State`, leading axis [N]."""
        places = np.asarray(state.data.xpos)
        if len(places) != len(self._start):
            self._states = []
            self._start, self._place = places[:, self._body], places[:, self._goal]
            self._camera = np.asarray(state.camera_to_world)[:, :3, 3]
        self._states.append((places[:, self._body, 2], *map(np.asarray, self._hand(state))))

    def outcomes(self, solved: np.ndarray) -> Outcomes:
        """What was seen of the first worlds, those that `solved` tells of."""
        count = min(len(solved), len(self._start))
        height, tcp, opening = (
            np.stack(each)[:, :count] for each in zip(*self._states, strict=True)
        )
        lifted = (height - height[0]).max(axis=0) > LIFTED_M
        closed = opening < CLOSED * opening[0]
        above = np.take_along_axis(tcp - height, closed.argmax(axis=0)[None], axis=0)[0]
        return Outcomes(
            solved[:count],
            lifted,
            hidden(self._start, self._place, self._camera)[:count],
            np.where(closed.any(axis=0), 1e3 * above, np.nan),
        )


def lines(domain: str, found: Outcomes) -> list[str]:
    """What came of a domain, for people."""
    failed, words = ~found.solved, []
    for name, where in (("behind its place", found.hidden), ("elsewhere", ~found.hidden)):
        words.append(f"object {name}: {found.solved[where].sum()} of {where.sum()} solved")
    missed, dropped = failed & ~found.lifted, failed & found.lifted
    words.append(f"failures: {missed.sum()} never lifted it, {dropped.sum()} did")
    for name, where in (("solved", found.solved), ("never lifted", missed)):
        closed = np.sort(found.closed_mm[where & np.isfinite(found.closed_mm)])
        heights = " ".join(f"{height:.0f}" for height in closed)
        words.append(f"mm above it when the hand closed, {name}: {heights or '-'}")
    return [f"{domain}: {found.solved.sum()} of {len(found.solved)} solved", *words]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path, help="folder of a training run (one method)")
    parser.add_argument("--domains", nargs="+", default=["in_domain"])
    parser.add_argument("--scenes", type=int, default=50, help="in each domain, one batch")
    options = parser.parse_args()

    import jax

    from palm_jax.train import workspace
    from palm_jax.train.evaluate import Runners

    config = workspace.stored_config(options.run)
    runners = Runners.of(config.task, config.robot, config.second_robot, options.scenes)
    for domain in options.domains:
        if runners.plays(domain) != config.robot:
            parser.error(f"{domain}: expected domains of the demonstrations' robot")
    evaluator, policy = workspace.load_policy(options.run, runners)
    items = getattr(evaluator.task, "items", None)
    if not items:
        parser.error(f"{options.run}: {config.task} has no place to put an object")
    env = evaluator.runner.env
    hand = jax.jit(jax.vmap(lambda state: (env.tcp(state)[2, 3], env.opening(state))))
    object_id, place_id = (env.mj_model.body(name).id for name in (items[0].body, items[0].goal))
    for domain in options.domains:
        watcher = Watcher(object_id, place_id, hand)
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
