"""Success of a policy in every domain: all scenes of a domain in one vmapped rollout."""

import dataclasses
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import jax
import numpy as np

from palm_jax.envs import registry, shifts
from palm_jax.envs.base import EnvParams, State
from palm_jax.envs.rollout import Act, Episodes, Runner, take_params
from palm_jax.envs.tasks import Task
from palm_jax.train.files.records import DomainRecord
from palm_jax.train.host import devices
from palm_jax.train.learner import NOISE_ROWS, Learner, PolicyState
from palm_jax.train.methods import Method

Watch = Callable[[State], None]
Result = TypeVar("Result")

VIEW = "front"
"""Name of the one camera view that policies see so far."""


class Runners:
    """One task on two robots: the one of the demonstrations, and that of `embodiment` domains.

    A robot's `Runner` is made when it is first asked for, which takes most of a minute to compile,
    and kept: methods share it. One whose worlds do not fit into memory is replaced by one of half
    as many.
    """

    def __init__(
        self,
        make: Callable[[str], Runner],
        robot: str,
        other: str,
        *,
        tell: Callable[[str], None] | None = None,
    ) -> None:
        """`make` gives a robot's runner; all have the same task and number of worlds. `tell` is
        called with a sentence when that number had to be lowered."""
        self.robot, self.other = robot, other
        self._make, self._tell = make, tell
        self._made: dict[str, Runner] = {}

    @classmethod
    def of(
        cls,
        task: str,
        robot: str,
        other: str,
        worlds: int,
        *,
        tell: Callable[[str], None] | None = None,
    ) -> "Runners":
        """The runners of a task and two robots by name, `worlds` worlds a batch, which this
        process's devices share."""
        found = devices.local_for(worlds)

        def make(name: str) -> Runner:
            return Runner(registry.make(task, name), worlds, devices=found)

        return cls(make, robot, other, tell=tell)

    def of_robot(self, robot: str) -> Runner:
        """The one of a robot."""
        if robot not in self._made:
            self._made[robot] = self._make(robot)
        return self._made[robot]

    @property
    def first(self) -> Runner:
        """That of the robot that the demonstrations are of."""
        return self.of_robot(self.robot)

    def plays(self, domain: str) -> str:
        """The robot of a domain."""
        return self.other if shifts.other_robot(domain) else self.robot

    def domain(self, domain: str) -> Runner:
        """The one that plays a domain."""
        return self.of_robot(self.plays(domain))

    @property
    def worlds(self) -> dict[str, int]:
        """Worlds in a batch, of every robot that has a runner."""
        return {robot: runner.worlds for robot, runner in self._made.items()}

    def fitting(self, robot: str, use: Callable[[Runner], Result]) -> Result:
        """`use` of a robot's runner; again, from its beginning, with half as many worlds while they
        do not fit into memory.

        Raises:
          MemoryError: not even one world fits.
        """
        while True:
            try:
                return use(self.of_robot(robot))
            except jax.errors.JaxRuntimeError as error:
                if not out_of_memory(error):
                    raise
                self.halve(robot, str(error).partition("\n")[0])

    def halve(self, robot: str, why: str) -> None:
        """Go on with half as many worlds.

        Raises:
          MemoryError: there is but one.
        """
        runner = self._made[robot]
        if runner.worlds == 1:
            raise MemoryError(f"not even one world of {robot} fits into memory: {why}")
        self._made[robot] = runner.halved()
        if self._tell:
            self._tell(
                f"{runner.worlds} worlds of {robot} do not fit into memory; going on with "
                f"{self._made[robot].worlds} at a time ({why})"
            )


def out_of_memory(error: BaseException) -> bool:
    """Whether XLA failed to allocate."""
    return "RESOURCE_EXHAUSTED" in str(error)


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

    def act(self, policy: PolicyState, rows: np.ndarray | None = None) -> Act:
        """The policy as a function of a batch of observations; `rows`: see `Learner.act`."""
        act = self.learner.jitted_act
        return lambda key, image, proprio: act(key, policy, {VIEW: image}, proprio, rows)

    def batches(
        self,
        policy: PolicyState,
        scenes: jax.Array,
        params: EnvParams,
        count: int,
        *,
        robot: str | None = None,
        first: int = 0,
        watch: Watch | None = None,
    ) -> Iterator[tuple[np.ndarray, Episodes]]:
        """The episodes `first` to `count`, batch by batch in order, each with its rows.

        Scene i depends on (`scenes`, i) and its params alone: another size of the batches changes
        rounding, and nothing else. A batch that does not fit into memory is tried again with half
        as many worlds.

        Args:
          policy: from `Learner.policy_state`.
          scenes: key of the scenes.
          params: leading axis [count].
          count: any number; batches of the runner's size, the last one filled up and cut.
          robot: who acts; by default the one of the demonstrations.
          first: where to begin.
          watch: shown every state of the first batch.

        Raises:
          MemoryError: not even one world fits.
        """
        robot = robot or self.runners.robot
        while first < count:
            # The policy's noise comes in tables of so many rows, and a batch reads one of them.
            end = min(count, first - first % NOISE_ROWS + NOISE_ROWS)

            def batch(
                runner: Runner, first: int = first, end: int = end, watch: Watch | None = watch
            ) -> tuple[np.ndarray, Episodes]:
                rows = np.arange(first, min(first + runner.worlds, end))
                return rows, self._batch(policy, scenes, params, rows, runner, watch)

            rows, found = self.runners.fitting(robot, batch)
            yield rows, found
            first, watch = first + len(rows), None

    def _batch(
        self,
        policy: PolicyState,
        scenes: jax.Array,
        params: EnvParams,
        rows: np.ndarray,
        runner: Runner,
        watch: Watch | None,
    ) -> Episodes:
        """The episodes of consecutive rows, at most as many as the runner has worlds."""
        table = int(rows[0]) - int(rows[0]) % NOISE_ROWS
        every = np.arange(rows[0], rows[0] + runner.worlds)
        found = runner.run(
            jax.random.fold_in(scenes, 2**31 + table),
            jax.vmap(lambda i: jax.random.fold_in(scenes, i))(every),
            take_params(params, np.minimum(every, rows[-1])),
            self.act(policy, np.minimum(every - table, NOISE_ROWS - 1)),
            self.method.spec(self.task, self.image_size),
            frame=self.method.frame,
            watch=watch,
        )
        return jax.tree.map(lambda field: np.asarray(field)[: len(rows)], found)

    def episodes(
        self,
        policy: PolicyState,
        scenes: jax.Array,
        params: EnvParams,
        count: int,
        *,
        robot: str | None = None,
        watch: Watch | None = None,
    ) -> Episodes:
        """`count` episodes at once; see `batches`."""
        parts = [
            found
            for _, found in self.batches(policy, scenes, params, count, robot=robot, watch=watch)
        ]
        return jax.tree.map(lambda *fields: np.concatenate(fields), *parts)

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
        scenes, robot = scene_key(seed, domain), self.runners.plays(domain)
        return record(self.episodes(policy, scenes, params, count, robot=robot, watch=watch))

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
