"""Success of a policy in every domain: all scenes of a domain in one vmapped rollout."""

import dataclasses
import functools
import zlib
from collections.abc import Callable, Sequence

import jax
import numpy as np

from palm_jax.envs import registry, shifts
from palm_jax.envs.base import EnvParams, State
from palm_jax.envs.rollout import Act, Episodes, Runner, take_params
from palm_jax.envs.tasks import Task
from palm_jax.train import devices
from palm_jax.train.learner import Learner, PolicyState
from palm_jax.train.methods import Method
from palm_jax.train.records import DomainRecord

Watch = Callable[[State], None]

VIEW = "front"
"""Name of the one camera view that policies see so far."""


class Runners:
    """One task on two robots: the one of the demonstrations, and that of `embodiment` domains.

    A robot's `Runner` is made when it is first asked for, which takes most of a minute to compile,
    and kept: methods share it.
    """

    def __init__(self, make: Callable[[str], Runner], robot: str, other: str) -> None:
        """`make` gives a robot's runner; all have the same task and number of worlds."""
        self.robot, self.other = robot, other
        self._make = functools.cache(make)

    @classmethod
    def of(cls, task: str, robot: str, other: str, worlds: int) -> "Runners":
        """The runners of a task and two robots by name, `worlds` worlds a batch, which this
        process's devices share."""
        found = devices.local_for(worlds)
        return cls(
            lambda name: Runner(registry.make(task, name), worlds, devices=found), robot, other
        )

    @property
    def first(self) -> Runner:
        """That of the robot that the demonstrations are of."""
        return self._make(self.robot)

    def domain(self, domain: str) -> Runner:
        """The one that plays a domain."""
        return self._make(self.other if shifts.other_robot(domain) else self.robot)


@dataclasses.dataclass(frozen=True)
class Evaluator:
    """What stays the same over the evaluations of one method: worlds, input, learner."""

    runners: Runners
    method: Method
    learner: Learner
    image_size: int

    @property
    def runner(self) -> Runner:
        """The world of the robot that the demonstrations are of."""
        return self.runners.first

    @property
    def task(self) -> Task:
        return self.runner.env.task

    def act(self, policy: PolicyState) -> Act:
        """The policy as a function of a batch of observations."""
        act = self.learner.jitted_act
        return lambda key, image, proprio: act(key, policy, {VIEW: image}, proprio)

    def episodes(
        self,
        policy: PolicyState,
        scenes: jax.Array,
        params: EnvParams,
        count: int,
        *,
        runner: Runner | None = None,
        watch: Watch | None = None,
    ) -> Episodes:
        """`count` episodes; scene i depends on (`scenes`, i) and its params alone.

        Args:
          policy: from `Learner.policy_state`.
          scenes: key of the scenes.
          params: leading axis [count].
          count: any number; batches of the runner's size, the last one filled up and cut.
          runner: the world; by default `self.runner`.
          watch: shown every state of the first batch.
        """
        runner = runner or self.runner
        spec, worlds = self.method.spec(self.task, self.image_size), runner.worlds
        parts = []
        for first in range(0, count, worlds):
            rows = np.arange(first, first + worlds)
            keys = jax.vmap(lambda i: jax.random.fold_in(scenes, i))(rows)
            batch = take_params(params, np.minimum(rows, count - 1))
            noise = jax.random.fold_in(scenes, 2**31 + first)
            parts.append(
                runner.run(
                    noise,
                    keys,
                    batch,
                    self.act(policy),
                    spec,
                    frame=self.method.frame,
                    watch=watch if first == 0 else None,
                )
            )
        return jax.tree.map(lambda *fields: np.concatenate(fields)[:count], *parts)

    def domain(
        self,
        policy: PolicyState,
        domain: str,
        *,
        seed: int,
        count: int,
        aligned: bool,
        watch: Watch | None = None,
    ) -> DomainRecord:
        """`count` scenes of a domain; the same scenes for every method and policy."""
        params = self.scenes(domain, seed=seed, count=count, aligned=aligned)
        scenes, runner = scene_key(seed, domain), self.runners.domain(domain)
        return record(self.episodes(policy, scenes, params, count, runner=runner, watch=watch))

    def scenes(self, domain: str, *, seed: int, count: int, aligned: bool) -> EnvParams:
        """Params of a domain's scenes, leading axis [count]; with the robot that plays it.

        `aligned`: whether the hand's initial yaw turns with the camera.
        """
        # Apart from the keys of the scenes and of the policy in `episodes`.
        key = jax.random.fold_in(scene_key(seed, domain), 2**32 - 1)
        params = self.runners.domain(domain).env.default_params()
        params = shifts.scenes(key, params, domain, count)
        return shifts.aligned_hand(params) if aligned else params


def scene_key(seed: int, domain: str) -> jax.Array:
    """Key of a domain's scenes: a function of the seed and the domain's name."""
    return jax.random.fold_in(jax.random.key(seed), zlib.crc32(domain.encode()))


def record(episodes: Episodes) -> DomainRecord:
    """What is stored of a domain's episodes."""
    return DomainRecord(
        success=np.asarray(episodes.success),
        nan=np.asarray(episodes.nan),
        object_xy=np.asarray(episodes.object_xy),
        camera_angle=np.asarray(episodes.camera_angle),
        length=np.asarray(episodes.length),
        draws=np.asarray(episodes.draws),
    )


def evaluate(
    evaluator: Evaluator,
    policy: PolicyState,
    domains: Sequence[str],
    *,
    seed: int,
    scenes: int,
    progress: Callable[[], None] | None = None,
    watch: Callable[[str, str], Watch | None] | None = None,
) -> dict[str, dict[str, DomainRecord]]:
    """All domains, in each variant of the hand's initial yaw that the method is reported with.

    Args:
      evaluator: see there.
      policy: from `Learner.policy_state`.
      domains: names, see `shifts.parts`.
      seed, scenes: of the scenes in each domain.
      progress: called after each domain.
      watch: (variant, domain) -> what is to be shown the states of its first batch, if anything.

    Returns:
      variant ("aligned", "unaligned") -> domain -> episodes. Domains without a turned camera are
      the same in both and are run once.
    """
    variants = ("aligned",) if evaluator.method.hand == "aligned" else ("unaligned", "aligned")
    results: dict[str, dict[str, DomainRecord]] = {variant: {} for variant in variants}
    for domain in domains:
        for variant in variants if turned(domain) else variants[:1]:
            results[variant][domain] = evaluator.domain(
                policy,
                domain,
                seed=seed,
                count=scenes,
                aligned=variant == "aligned",
                watch=watch(variant, domain) if watch else None,
            )
        if not turned(domain):
            for variant in variants[1:]:
                results[variant][domain] = results[variants[0]][domain]
        if progress:
            progress()
    return results


def turned(domain: str) -> bool:
    """Whether the camera turns in a domain: there the hand's initial yaw may turn with it."""
    return any(name.startswith("viewpoint") for name in shifts.parts(domain))


def quoted(results: dict[str, dict[str, DomainRecord]]) -> str:
    """The variant with the most successes over all domains: the one that is quoted."""

    def successes(variant: str) -> int:
        return sum(int(domain.solved.sum()) for domain in results[variant].values())

    return max(results, key=successes)
