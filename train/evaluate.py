"""Success of a policy in every domain: all scenes of a domain in one vmapped rollout."""

import dataclasses
import zlib
from collections.abc import Callable, Sequence

import jax
import numpy as np

from palm_jax.envs import shifts
from palm_jax.envs.base import EnvParams, State
from palm_jax.envs.rollout import Act, Episodes, Runner, repeat_params, take_params
from palm_jax.envs.tasks import Task
from palm_jax.train.learner import Learner, PolicyState
from palm_jax.train.methods import Method
from palm_jax.train.records import DomainRecord

Watch = Callable[[State], None]

VIEW = "front"
"""Name of the one camera view that policies see so far."""


@dataclasses.dataclass(frozen=True)
class Evaluator:
    """What stays the same over the evaluations of one method: world, input, learner."""

    runner: Runner
    method: Method
    learner: Learner
    image_size: int

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
        watch: Watch | None = None,
    ) -> Episodes:
        """`count` episodes; scene i depends on (`scenes`, i) and its params alone.

        Args:
          policy: from `Learner.policy_state`.
          scenes: key of the scenes.
          params: leading axis [count].
          count: any number; batches of the runner's size, the last one filled up and cut.
          watch: shown every state of the first batch.
        """
        spec, worlds = self.method.spec(self.task, self.image_size), self.runner.worlds
        parts = []
        for first in range(0, count, worlds):
            rows = np.arange(first, first + worlds)
            keys = jax.vmap(lambda i: jax.random.fold_in(scenes, i))(rows)
            batch = take_params(params, np.minimum(rows, count - 1))
            noise = jax.random.fold_in(scenes, 2**31 + first)
            parts.append(
                self.runner.run(
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
        params = shifts.shifted(self.runner.env.default_params(), domain)
        if aligned:
            params = shifts.aligned_hand(params)
        episodes = self.episodes(
            policy, scene_key(seed, domain), repeat_params(params, count), count, watch=watch
        )
        return record(episodes)


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
      domains: names, see `shifts.shifted`.
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
        turned = "viewpoint" in domain
        for variant in variants if turned else variants[:1]:
            results[variant][domain] = evaluator.domain(
                policy,
                domain,
                seed=seed,
                count=scenes,
                aligned=variant == "aligned",
                watch=watch(variant, domain) if watch else None,
            )
        if not turned:
            for variant in variants[1:]:
                results[variant][domain] = results[variants[0]][domain]
        if progress:
            progress()
    return results


def quoted(results: dict[str, dict[str, DomainRecord]]) -> str:
    """The variant with the most successes over all domains: the one that is quoted."""

    def successes(variant: str) -> int:
        return sum(int(domain.solved.sum()) for domain in results[variant].values())

    return max(results, key=successes)
