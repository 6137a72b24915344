"""Gymnasium: many worlds as one `VectorEnv`, or one world as an `Env`.

Importing this module registers `palm_jax/TASK-v0` for every task, so both of these work::

    envs = make_vec("lift_lid", num_envs=16)
    envs = gymnasium.make_vec("palm_jax/lift_lid-v0", num_envs=16)

Observations are dicts: `image` uint8 [size, size, 3] and `proprio` float32 [P], what a policy of
this package sees. Actions are those of `palm_jax.envs.base.Env`. The reward is 1 on the step that
solves the task and 0 on every other. An episode terminates when the task is solved or physics has
diverged (`info["nan"]`), and is truncated at the horizon.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.align import AlignSpec
from palm_jax.envs import registry, shifts
from palm_jax.envs.adapters.domains import check_domain, scene
from palm_jax.envs.base import CONTROL_RATE, WIDE_FRAME, Env, State
from palm_jax.envs.params import EnvParams, check_params, repeat_params
from palm_jax.envs.rollout import Runner

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.utils import seeding
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError(
        "palm_jax.envs.adapters.gym_env needs Gymnasium: pip install 'palm-jax[gym]'"
    ) from error

MAX_MOVE = 0.05
"""Bound of the action space on a translation, metres a control step and axis: 1 m/s, five times
what the scripted experts ask for. `Env.step` itself slows what is beyond the joints' limits."""

RENDER_SIZE = 256
"""Side in pixels of the frames that `render` returns."""

_ROTATION = 1.001  # entries of a rotation, with room for float32

Observation = dict[str, np.ndarray]
Seeds = int | Sequence[int | None] | None


class _Worlds:
    """Episodes in W worlds, each started when its caller says so: what both classes share.

    Every world has a random generator of its own that draws one seed an episode. What a world
    shows therefore depends on its seed and on how often it was reset, not on its neighbours.

    Attributes:
      params: leading [W], of the worlds' present episodes.
      state: leading [W]; None before the first episode.
    """

    def __init__(
        self,
        runner: Runner,
        params: EnvParams | None,
        domain: str,
        spec: AlignSpec,
        frame: int,
        horizon: int | None,
    ) -> None:
        self.runner, self.spec, self.frame = runner, spec, frame
        self.horizon = runner.env.task.horizon if horizon is None else horizon
        if self.horizon < 1:
            raise ValueError(f"horizon: expected at least one control step, got {self.horizon}")
        self.count = runner.worlds
        self.generators = [seeding.np_random()[0] for _ in range(self.count)]
        self.steps = np.zeros(self.count, int)
        self.state: State | None = None
        check_domain(domain)
        params = runner.env.default_params() if params is None else params
        self._default = self._source = self._per_world(params), domain
        self.params = self._source[0]
        # A reset of the batch costs the same for one world as for all, so it makes a start for
        # every world, to be used when that world's turn comes.
        self._starts: tuple[State, EnvParams] | None = None
        self._seeds = np.zeros(self.count, np.uint32)  # of those starts
        self._unused = np.zeros(self.count, bool)

    def _per_world(self, params: EnvParams) -> EnvParams:
        """`params` with a leading [W]; they may have it already."""
        # Weakly typed numbers would compile everything anew.
        params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params)
        check_params(params)
        shape = params.camera_fovy.shape
        if shape == ():
            return repeat_params(params, self.count)
        if shape != (self.count,):
            raise ValueError(
                f"params: expected those of one world or of {self.count} (leading axis), got "
                f"camera_fovy of shape {list(shape)}"
            )
        return params

    def reset(self, seed: Seeds, options: dict[str, Any] | None) -> None:
        """A new episode in all worlds, under `options` until the next call."""
        self._seed(seed)
        source = self._optional(options or {})
        if source is not self._source:
            self._source, self._starts = source, None
        self.start(np.ones(self.count, bool))

    def _seed(self, seed: Seeds) -> None:
        if seed is None:
            return
        if isinstance(seed, (int, np.integer)):
            seed = [int(seed) + i for i in range(self.count)]
        if len(seed) != self.count:
            raise ValueError(
                f"seed: expected a number or a list of {self.count}, got a list of {len(seed)}"
            )
        for world, one in enumerate(seed):
            if one is not None:
                self.generators[world] = seeding.np_random(one)[0]
                self._unused[world] = False

    def _optional(self, options: dict[str, Any]) -> tuple[EnvParams, str]:
        """Where the episodes take place: params [W], and the domain on top of them."""
        if unknown := set(options) - {"domain", "params"}:
            raise ValueError(f"options: expected domain or params, got {sorted(unknown)}")
        if not options:
            return self._default
        check_domain(domain := options.get("domain", shifts.IN_DOMAIN))
        params = self._default[0]
        return self._per_world(options["params"]) if "params" in options else params, domain

    def start(self, which: np.ndarray) -> None:
        """A new episode in the worlds `which` (bool [W])."""
        if self._starts is None or not self._unused[which].all():
            for world in np.flatnonzero(~self._unused):
                self._seeds[world] = self.generators[world].integers(2**32)
            source, domain = self._source
            params = _scenes(domain)(jax.vmap(jax.random.key)(self._seeds), source)
            state = self.runner.reset(jax.vmap(jax.random.key)(self._seeds), params)
            self._starts = state, params
            self._unused[:] = True
        self._unused[which] = False
        self.steps[which] = 0
        if self.state is None:
            self.state, self.params = self._starts
        else:
            self.state, self.params = _choose(which, self._starts, (self.state, self.params))

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One control step of actions [W, 10]: (reward, terminated, truncated), each [W]."""
        state = self.running()
        actions = np.asarray(actions, np.float32)
        expected = (self.count, self.runner.env.action_size)
        if actions.shape != expected:
            raise ValueError(f"actions: expected {list(expected)}, got {list(actions.shape)}")
        self.state = self.runner.step(state, jnp.asarray(actions), self.params)
        self.steps += 1
        success = np.asarray(self.state.success)
        terminated = success | np.asarray(self.state.nan)
        reward = (success & ~np.asarray(state.success)).astype(np.float64)
        return reward, terminated, (self.steps >= self.horizon) & ~terminated

    def observe(self) -> Observation:
        """What the policies see now, with a leading [W]."""
        seen = self.runner.observe(self.running(), self.params, self.spec, frame=self.frame)
        return {"image": np.array(seen.image), "proprio": np.array(seen.proprio)}

    def info(self) -> dict[str, np.ndarray]:
        """bool [W] each: solved, physics diverged, the global policy saw the target."""
        state = self.running()
        return {name: np.array(getattr(state, name)) for name in ("success", "nan", "seen")}

    def render(self) -> np.ndarray:
        """The camera's frames [W, H, W, 3] uint8."""
        return np.array(_renderer(self.runner.env)(self.running(), self.params))

    def running(self) -> State:
        if self.state is None:
            raise gymnasium.error.ResetNeeded("there is no episode yet: call reset() first")
        return self.state


@functools.cache
def _scenes(domain: str) -> Callable[[jax.Array, EnvParams], EnvParams]:
    """(keys [W], params [W]) -> the params of an episode in each world."""
    return jax.jit(jax.vmap(functools.partial(scene, domain=domain)))


@jax.jit
def _choose(which: jax.Array, these: Any, others: Any) -> Any:
    """Of two trees with leading [W]: `these` in the worlds `which`, `others` in the rest."""

    def pick(this: jax.Array, other: jax.Array) -> jax.Array:
        return jnp.where(which.reshape(-1, *(1,) * (this.ndim - 1)), this, other)

    return jax.tree.map(pick, these, others)


@functools.cache
def _renderer(env: Env) -> Callable[[State, EnvParams], jax.Array]:
    def frame(state: State, params: EnvParams) -> jax.Array:
        image = env.render(state, params, RENDER_SIZE).rgb
        assert image is not None
        return image

    return jax.jit(jax.vmap(frame))


def observation_space(env: Env, spec: AlignSpec) -> spaces.Space[Any]:
    """Bounds of what `Env.observe` gives for a spec.

    Positions are bounded by the arm: no TCP is farther from the arm's first joint than the links
    are long together.
    """
    base = env.chain.before[0, :3, 3]
    offsets = [*env.chain.before[1:, :3, 3], env.chain.tip[:3, 3]]
    reach = float(sum(np.linalg.norm(offset) for offset in offsets))
    low: list[float] = []
    high: list[float] = []
    if "6d" in spec.layout:
        low, high = [-_ROTATION] * 6, [_ROTATION] * 6
    axes = base if spec.layout.endswith("xyz") else base[2:]
    low, high = [*low, *(axes - reach), 0.0], [*high, *(axes + reach), 1.0]
    return spaces.Dict(
        {
            "image": spaces.Box(0, 255, (spec.size, spec.size, 3), np.uint8),
            "proprio": spaces.Box(np.array(low, np.float32), np.array(high, np.float32)),
        }
    )


def action_space() -> spaces.Box:
    """6D rotation and translation (metres) in the TCP's frame, then the gripper (1 open)."""
    high = np.array([1.0] * 6 + [MAX_MOVE] * 3 + [1.0], np.float32)
    low = np.append(-high[:9], np.float32(0.0))
    return spaces.Box(low, high)


def _check_render_mode(render_mode: str | None) -> None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode: expected None or 'rgb_array', got {render_mode!r}")


def _check_rendering(render_mode: str | None) -> None:
    if render_mode is None:
        raise gymnasium.error.Error("there is nothing to render: pass render_mode='rgb_array'")


class PalmVectorEnv(gymnasium.vector.VectorEnv[Observation, np.ndarray, np.ndarray]):
    """W worlds that step together, with Gymnasium's autoreset.

    World i, given the seed s, is the world i of `SyncVectorEnv` over `PalmEnv`s with the same
    seed: the same episodes, observations and infos, in one compiled program.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": int(CONTROL_RATE)}

    def __init__(
        self,
        runner: Runner,
        *,
        params: EnvParams | None = None,
        domain: str = "in_domain",
        spec: AlignSpec | None = None,
        frame: int = WIDE_FRAME,
        horizon: int | None = None,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        """The worlds of a `Runner`.

        Args:
          runner: what steps them.
          params: of one world, or with a leading axis of one world each; the environment's
            defaults by default.
          domain: what shifts on top of them, see `palm_jax.envs.shifts.scenes`; every episode has
            its own place on the domain's axes.
          spec: the observation; the task's TCP crop by default.
          frame: side in pixels of the virtual image that the crop must stay inside.
          horizon: control steps until truncation; the task's by default.
          render_mode: "rgb_array" if `render` is going to be called.
          autoreset_mode: "NextStep" or "SameStep".

        Raises:
          ValueError: a mode or a domain that does not exist, params for another number of worlds
            or impossible ones.
        """
        mode = AutoresetMode(autoreset_mode)
        if mode == AutoresetMode.DISABLED:
            raise ValueError("autoreset_mode: expected 'NextStep' or 'SameStep', got 'Disabled'")
        _check_render_mode(render_mode)
        self.metadata = {**self.metadata, "autoreset_mode": mode}
        self.render_mode = render_mode
        self.runner = runner
        self.num_envs = runner.worlds
        spec = _default_spec(runner.env, spec)
        self.single_observation_space = observation_space(runner.env, spec)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._worlds = _Worlds(runner, params, domain, spec, frame, horizon)
        self._ended = np.zeros(self.num_envs, bool)

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode in every world.

        Args:
          seed: a number s for s, s + 1, ..., or one a world (None: goes on as it was).
          options: "domain" (its name) or "params" (`EnvParams`) or both: where this and the
            following episodes take place, until the next call of `reset`; what the environment
            was made with without them.

        Raises:
          ValueError: other options or impossible ones, another number of seeds.
          StartPoseError: the params ask for start poses that the arm cannot take.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        self._worlds.reset(seed, options)
        self._ended = np.zeros(self.num_envs, bool)
        return self._worlds.observe(), self._info()

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step of actions [W, 10].

        "NextStep": a world whose episode has ended ignores its action and shows the start of its
        next episode. "SameStep": it shows that start at once, and `final_obs` and `final_info`
        hold how the episode ended.
        """
        reward, terminated, truncated = self._worlds.step(actions)
        infos: dict[str, Any] = {}
        if self.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP:
            if self._ended.any():
                self._worlds.start(self._ended)
                for result in (reward, terminated, truncated):
                    result[self._ended] = 0
            self._ended = terminated | truncated
        elif (ended := terminated | truncated).any():
            infos = self._final(ended)
            self._worlds.start(ended)
        return self._worlds.observe(), reward, terminated, truncated, {**infos, **self._info()}

    @property
    def state(self) -> State:
        """The states of the worlds (leading [W]): `runner.expert(state)` acts from them."""
        return self._worlds.running()

    @property
    def params(self) -> EnvParams:
        """The params of the worlds' present episodes (leading [W])."""
        return self._worlds.params

    def render(self) -> tuple[np.ndarray, ...]:
        """The frame [256, 256, 3] uint8 of every world's camera."""
        _check_rendering(self.render_mode)
        return tuple(self._worlds.render())

    def _info(self) -> dict[str, Any]:
        every = {name: np.ones(self.num_envs, bool) for name in self._worlds.info()}
        return {**self._worlds.info(), **{f"_{name}": mask for name, mask in every.items()}}

    def _final(self, ended: np.ndarray) -> dict[str, Any]:
        seen, infos = self._worlds.observe(), self._worlds.info()
        final: dict[str, Any] = {}
        for world in np.flatnonzero(ended):
            last = {
                "final_obs": {name: value[world] for name, value in seen.items()},
                "final_info": {name: bool(value[world]) for name, value in infos.items()},
            }
            final = self._add_info(final, last, int(world))
        return final


class PalmEnv(gymnasium.Env[Observation, np.ndarray]):
    """One world; the same episodes as a world of `PalmVectorEnv` with the same seed."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": int(CONTROL_RATE)}

    def __init__(
        self,
        runner: Runner,
        *,
        params: EnvParams | None = None,
        domain: str = "in_domain",
        spec: AlignSpec | None = None,
        frame: int = WIDE_FRAME,
        horizon: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        """The world of a `Runner` that has one; arguments and errors as in `PalmVectorEnv`."""
        if runner.worlds != 1:
            raise ValueError(f"expected a Runner with one world, got {runner.worlds}")
        _check_render_mode(render_mode)
        self.runner = runner
        self.render_mode = render_mode
        spec = _default_spec(runner.env, spec)
        self.observation_space = observation_space(runner.env, spec)
        self.action_space = action_space()
        self._worlds = _Worlds(runner, params, domain, spec, frame, horizon)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode; see `PalmVectorEnv.reset`."""
        super().reset(seed=seed)
        # One generator, so that Gymnasium's `np_random` is what the episodes are drawn from.
        self._worlds.generators[0] = self.np_random
        self._worlds.reset(None, options)
        return self._observe(), self._info()

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One control step of an action [10]."""
        reward, terminated, truncated = self._worlds.step(np.asarray(action)[None])
        info = self._info()
        return self._observe(), float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    @property
    def state(self) -> State:
        """The state of the world, with the leading axis [1] that `runner.expert` wants."""
        return self._worlds.running()

    def render(self) -> np.ndarray:  # type: ignore[override]
        """The camera's frame [256, 256, 3] uint8."""
        _check_rendering(self.render_mode)
        return self._worlds.render()[0]

    def _observe(self) -> Observation:
        return {name: value[0] for name, value in self._worlds.observe().items()}

    def _info(self) -> dict[str, Any]:
        return {name: bool(value[0]) for name, value in self._worlds.info().items()}


def _default_spec(env: Env, spec: AlignSpec | None) -> AlignSpec:
    return AlignSpec(crop=env.task.crop) if spec is None else spec


@functools.cache
def _runner(task: str, robot: str, worlds: int) -> Runner:
    """One runner of each kind: Gymnasium makes environments anew, and each would compile."""
    return Runner(registry.make(task, robot), worlds)


def make_vec(task: str, robot: str = "panda", num_envs: int = 16, **options: Any) -> PalmVectorEnv:
    """A batch of worlds of a task on a robot.

    Args:
      task, robot: see `palm_jax.envs.make`.
      num_envs: worlds.
      options: params, domain, spec, frame, horizon, render_mode, autoreset_mode, as in
        `PalmVectorEnv`.

    Raises:
      ValueError: a name that does not exist, too many worlds for one batch on a CPU.
    """
    return PalmVectorEnv(_runner(task, robot, num_envs), **options)


def make_env(task: str, robot: str = "panda", **options: Any) -> PalmEnv:
    """One world of a task on a robot; options and errors as in `make_vec`."""
    return PalmEnv(_runner(task, robot, 1), **options)


def register_all() -> None:
    """Makes `palm_jax/TASK-v0` known to Gymnasium; keyword arguments as in `make_vec`."""
    for task in registry.TASKS:
        name = f"palm_jax/{task}-v0"
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=f"{__name__}:make_env",
                vector_entry_point=f"{__name__}:make_vec",
                kwargs={"task": task},
            )


register_all()
