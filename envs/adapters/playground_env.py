"""MuJoCo Playground: an environment behind `mujoco_playground.MjxEnv`.

Pure functions of one world, for `mujoco_playground.wrapper.wrap_for_brax_training` and what is
built on it. On CPUs compile the wrapped `reset` and `step` with `physics.jit_physics`: XLA's
default options make MJX hundreds of times slower.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from palm_jax.align import AlignSpec
from palm_jax.envs import registry
from palm_jax.envs.adapters.domains import check_domain, scene
from palm_jax.envs.base import CONTROL_RATE, WIDE_FRAME, Env
from palm_jax.envs.base import State as EnvState
from palm_jax.envs.params import EnvParams, check_params
from palm_jax.envs.world import asset_path

try:
    from ml_collections import config_dict
    from mujoco_playground import MjxEnv, State
except ImportError as error:
    raise ImportError(
        "palm_jax.envs.adapters.playground_env needs MuJoCo Playground: "
        "pip install 'palm-jax[playground]'"
    ) from error


class PlaygroundEnv(MjxEnv):
    """A task on a robot as Playground's wrappers want it.

    `obs` is {"state": proprioception [P]} and with `vision` also {"pixels/view_0": the aligned
    image, float32 [size, size, 3] in 0..1}. The reward is 1 on the step that solves the task;
    `done` is 1 once it is solved or physics has diverged. Actions are those of `Env`, in metres.

    `info["params"]` holds the episode's `EnvParams`, `info["episode"]` the rest of `Env`'s state
    and `info["start"]` what that was at the start: Playground's auto-reset puts back `data` and
    `obs` alone, and the next step notices by the time of `data` that an episode begins.

    Domain randomisation may replace any field of the MJX model that physics alone reads: masses,
    inertias, gains, damping and friction (`pair_friction`: every contact is an explicit pair, so
    `geom_friction` has no effect). Arm kinematics and colours are not read from it; colours, lights
    and cameras shift through `EnvParams`.
    """

    def __init__(
        self,
        env: Env,
        *,
        params: EnvParams | None = None,
        domain: str = "in_domain",
        spec: AlignSpec | None = None,
        frame: int = WIDE_FRAME,
        vision: bool = False,
    ) -> None:
        """Wraps an environment.

        Args:
          env: the environment.
          params: of one world; what every reset draws from. The defaults by default.
          domain: what shifts on top of them, see `palm_jax.envs.shifts.scenes`; every reset draws
            its own place on the domain's axes.
          spec: the observation; the task's TCP crop by default.
          frame: side in pixels of the virtual image that the crop must stay inside.
          vision: whether images are rendered.

        Raises:
          ValueError: a domain that does not exist, impossible params.
        """
        check_domain(domain)
        config = config_dict.create(
            ctrl_dt=1.0 / CONTROL_RATE,
            sim_dt=float(env.mj_model.opt.timestep),
            episode_length=env.task.horizon,
            action_repeat=1,
            impl="jax",
            vision=vision,
        )
        super().__init__(config)
        self._env = env
        self._params = env.default_params() if params is None else params
        check_params(self._params)
        self._domain = domain
        self._spec = AlignSpec(crop=env.task.crop) if spec is None else spec
        self._frame = frame
        self._vision = vision
        # The name that Playground's domain randomisation replaces.
        self._mjx_model = env.mjx_model

    def reset(self, rng: jax.Array) -> State:
        """Starts an episode from `rng`: a raw key (uint32, `jax.random.PRNGKey`) or a typed one.

        A start pose out of the arm's reach cannot raise here: `metrics["reachable"]` is 0.
        """
        typed = jnp.issubdtype(rng.dtype, jax.dtypes.prng_key)
        key = rng if typed else jax.random.wrap_key_data(rng)
        env = self._randomised()
        params = scene(jax.random.clone(key), self._params, self._domain)
        world = env.reset(key, params)
        rest = _without_data(world)
        info = {"rng": rng, "params": params, "episode": rest, "start": rest}
        return self._state(env, world, jnp.zeros(()), info)

    def step(self, state: State, action: jax.Array) -> State:
        """One control step of an action [10]."""
        env, before = self._randomised(), self.world(state)
        after = env.step(before, action, state.info["params"])
        reward = (after.success & ~before.success).astype(jnp.float32)
        info = {**state.info, "episode": _without_data(after)}
        result = self._state(env, after, reward, info)
        # Wrappers keep values of their own among the metrics.
        return result.replace(metrics={**state.metrics, **result.metrics})

    def world(self, state: State) -> EnvState:
        """The state that `Env`'s functions take (its expert, its renderer)."""
        begins = state.data.time <= 0.0
        rest = jax.tree.map(
            lambda start, now: jnp.where(begins, start, now),
            state.info["start"],
            state.info["episode"],
        )
        return dataclasses.replace(rest, data=state.data)

    def _state(self, env: Env, world: EnvState, reward: jax.Array, info: dict[str, Any]) -> State:
        done = (world.success | world.nan).astype(jnp.float32)
        obs = self._observe(env, world, info["params"])
        return State(world.data, obs, reward, done, self._metrics(world), info)

    def _observe(self, env: Env, world: EnvState, params: EnvParams) -> dict[str, jax.Array]:
        seen = env.observe(world, params, self._spec, frame=self._frame)
        # Without `vision` nothing uses the image, and the compiler drops its rendering.
        obs = {"state": seen.proprio}
        if self._vision:
            obs["pixels/view_0"] = seen.image.astype(jnp.float32) / 255.0
        return obs

    def _metrics(self, world: EnvState) -> dict[str, jax.Array]:
        names = ("success", "nan", "seen", "reachable")
        return {name: getattr(world, name).astype(jnp.float32) for name in names}

    def _randomised(self) -> Env:
        """The environment on the model that is in force, which a wrapper may have replaced."""
        return self._env.with_model(self._mjx_model)

    @property
    def xml_path(self) -> str:
        """The task's MJCF file, which is a part of the world; `Env.xml` has all of it as text."""
        return str(asset_path("tasks", self._env.task.asset))

    @property
    def action_size(self) -> int:
        return self._env.action_size

    @property
    def mj_model(self) -> mujoco.MjModel:
        return self._env.mj_model

    @property
    def mjx_model(self) -> mjx.Model:
        return self._mjx_model


def _without_data(world: EnvState) -> Any:
    return dataclasses.replace(world, data=None)


def make_env(task: str, robot: str = "panda", **options: Any) -> PlaygroundEnv:
    """A task on a robot.

    Args:
      task, robot: see `palm_jax.envs.make`.
      options: params, domain, spec, frame, vision, as in `PlaygroundEnv`.

    Raises:
      ValueError: a name that does not exist, impossible params.
    """
    return PlaygroundEnv(registry.make(task, robot), **options)
