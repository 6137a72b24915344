"""Episodes in bulk.

Two executions of the same episode. `Runner` keeps physics, rendering and the policy in separate
jits, each with the compiler options it wants: the fast way on CPUs. `scan_episodes` is one
`lax.scan` over everything, for accelerators, where one program avoids the host. Both give the same
episodes up to rounding.
"""

from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, PartitionSpec

from palm_jax.align import Aligned, AlignSpec, Camera
from palm_jax.envs import physics
from palm_jax.envs.base import WIDE_FRAME, Env, EnvParams, State
from palm_jax.envs.params import ParamsError as ParamsError
from palm_jax.envs.params import check_params
from palm_jax.envs.params import repeat_params as repeat_params
from palm_jax.envs.params import take_params as take_params

Act = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]
"""Policy of a batch: (key, images [B, H, W, 3] uint8, proprio [B, P]) -> actions [B, 10]."""


class Episodes(NamedTuple):
    """Outcome of a batch of episodes; every field has the leading axis [N]."""

    success: jax.Array  # bool: solved at some step, and physics stayed finite until then
    nan: jax.Array  # bool: physics diverged before that
    seen: jax.Array  # bool: the global policy saw the target
    length: jax.Array  # int32: steps until success, or the horizon
    object_xy: jax.Array  # [N, 2] where the target started, metres
    object_yaw: jax.Array  # radians
    camera_angle: jax.Array  # radians
    draws: jax.Array  # int32: start poses drawn until one was in the arm's reach


def _outcome(state: State, length: jax.Array) -> Episodes:
    return Episodes(
        success=state.success,
        nan=state.nan,
        seen=state.seen,
        length=length,
        object_xy=state.object_start[..., :2],
        object_yaw=state.object_yaw,
        camera_angle=state.camera_angle,
        draws=state.draws,
    )


class StartPoseError(ValueError):
    """`EnvParams` ask for start poses that the arm cannot take."""


def _check_reachable(state: State, params: EnvParams) -> None:
    """Raises StartPoseError for the first world whose start poses were all out of reach."""
    lost = np.flatnonzero(~np.asarray(state.reachable))
    if len(lost):
        world = lost[0]
        x, y = np.asarray(state.located[world])
        low, high = np.asarray(params.start_height[world, 0])
        raise StartPoseError(
            f"{len(lost)} of {len(state.reachable)} worlds have no start pose in the arm's reach "
            f"after {int(state.draws[world])} draws; the first: a target located at "
            f"x {x:.2f}, y {y:.2f} m with start_radius {float(params.start_radius[world]):.2f} m "
            f"and start_height {low:.2f} to {high:.2f} m. "
            "Move object_low and object_high closer to the robot, or lower start_radius."
        )


def _jump_if_asked(env: Env) -> Callable[[State, State, EnvParams], State]:
    """(state, the same located anew, params) -> the state after the global policy, where a stage
    has changed; other worlds stay as they are."""

    def jump(state: State, located: State, params: EnvParams) -> State:
        moved = env.jump(located, params)
        return jax.tree.map(lambda new, old: jnp.where(state.jump, new, old), moved, state)

    return jump


def step_worlds(env: Env, state: State, action: jax.Array, params: EnvParams) -> State:
    """`Env.step` of W worlds in one jittable piece, for accelerators.

    Args:
      env: the environment.
      state, params: leading axis [W].
      action: [W, 10].
    """
    return jump_worlds(env, jax.vmap(env.act)(state, action), params)


def jump_worlds(env: Env, state: State, params: EnvParams) -> State:
    """The global policy of W worlds where `State.jump` asks for it: a branch for the whole batch,
    taken only when a stage has changed in one of its worlds."""
    if len(env.task.stages) == 1:
        return state

    def jump(state: State) -> State:
        located = jax.vmap(env.locate)(state, params)
        return jax.vmap(_jump_if_asked(env))(state, located, params)

    return jax.lax.cond(jnp.any(state.jump), jump, lambda state: state, state)


def _full_frame(env: Env, state: State, params: EnvParams, *, size: int) -> jax.Array:
    rgb = env.render(state, params, size).rgb
    assert rgb is not None
    return rgb


def batched_over(
    devices: Sequence[jax.Device], worlds: int
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """`jax.vmap`, or with several devices one that gives each an equal part of `worlds` examples.

    Raises:
      ValueError: the devices do not divide the worlds.
    """
    if len(devices) < 2:
        return jax.vmap
    if worlds % len(devices):
        raise ValueError(
            f"{worlds} worlds cannot be split over {len(devices)} devices: pass a multiple of "
            f"{len(devices)} worlds, or fewer devices"
        )
    axes = (AxisType.Auto,)
    mesh = jax.make_mesh((len(devices),), ("worlds",), axis_types=axes, devices=devices)
    spec = PartitionSpec("worlds")

    def batched(function: Callable[..., Any]) -> Callable[..., Any]:
        # The check would ask of every loop in the physics that its state vary over the axis.
        return jax.shard_map(
            jax.vmap(function), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False
        )

    return batched


class Runner:
    """The compiled pieces of an environment for a fixed number of worlds.

    Every function is batched over [W] worlds: keys [W], states and params with a leading [W]. One
    `Runner` compiles once and serves demonstrations, selection and evaluation alike.

    With several `devices` each of them has an equal part of the worlds, which never need each
    other: nothing is sent between devices while an episode runs.
    """

    def __init__(
        self, env: Env, worlds: int, *, devices: Sequence[jax.Device] | None = None
    ) -> None:
        """`devices`: of this process; the default one by default.

        Raises:
          ValueError: too many worlds for a CPU, or not the same number for every device.
        """
        limit = physics.MAX_CPU_WORLDS
        if not 0 < worlds <= limit and jax.default_backend() == "cpu":
            raise ValueError(
                f"expected 1 to {limit} worlds a batch on CPU, got {worlds}: use chunks"
            )
        self.env = env
        self.worlds = worlds
        self._devices = tuple(devices or ())
        self._batched = batched_over(self._devices, worlds)
        self._act = physics.jit_physics(self._batched(env.act))
        self._jump = physics.jit_physics(self._batched(_jump_if_asked(env)))
        self.expert = physics.jit_physics(self._batched(env.expert))
        self._place = physics.jit_physics(self._batched(env.place))
        self._locate = jax.jit(physics.traced_quickly(self._batched(env.locate)))
        self.restore = physics.jit_physics(self._batched(env.restore))
        self._reposition = physics.jit_physics(self._batched(env.reposition))
        self._views: dict[Hashable, Callable[..., Any]] = {}

    def halved(self) -> "Runner":
        """The same environment for half as many worlds (at least one): compiled anew.

        With several devices, half of the worlds of each, or one device if they do not divide them.
        """
        worlds = max(self.worlds // 2, 1)
        shared = len(self._devices) > 0 and worlds % len(self._devices) == 0
        return Runner(self.env, worlds, devices=self._devices if shared else None)

    def reset(self, keys: jax.Array, params: EnvParams) -> State:
        """`Env.reset` of W worlds, in three compiled pieces.

        Raises:
          ParamsError: params that contradict themselves, see `check_params`.
          StartPoseError: no start pose within the arm's reach was found for some world.
        """
        if isinstance(params, EnvParams):  # environments of other kinds bring their own
            check_params(params)
        keys = jax.vmap(jax.random.split)(keys)
        state = self._place(keys[:, 0], params)
        state = self._reposition(keys[:, 1], self._locate(state, params), params)
        _check_reachable(state, params)
        return state

    def step(self, state: State, action: jax.Array, params: EnvParams) -> State:
        """`Env.step` of W worlds: the global policy runs only when a stage has changed somewhere.

        Args:
          state, params: leading axis [W].
          action: [W, 10].
        """
        return self.jump(self._act(state, action), params)

    def jump(self, state: State, params: EnvParams) -> State:
        """The global policy in those of W worlds in which `State.jump` says that a stage has
        changed; the others stay as they are."""
        if len(self.env.task.stages) > 1 and np.asarray(state.jump).any():
            state = self._jump(state, self._locate(state, params), params)
        return state

    def observe(
        self, state: State, params: EnvParams, spec: AlignSpec, *, frame: int = WIDE_FRAME
    ) -> Aligned:
        """`Env.observe` of W worlds; compiled once for each `spec` and `frame`."""
        view = partial(self.env.observe, spec=spec, frame=frame)
        return self._view(("observe", spec, frame), view)(state, params)

    def window_camera(
        self, state: State, params: EnvParams, spec: AlignSpec, *, frame: int = WIDE_FRAME
    ) -> Camera:
        """`Env.window_camera` of W worlds; compiled once for each `spec` and `frame`."""
        view = partial(self.env.window_camera, spec=spec, frame=frame)
        return self._view(("window_camera", spec, frame), view)(state, params)

    def render(self, state: State, params: EnvParams, size: int) -> jax.Array:
        """The paper's full frame, uint8 [W, size, size, 3]; compiled once for each `size`."""
        view = partial(_full_frame, self.env, size=size)
        return self._view(("render", size), view)(state, params)

    def _view(self, name: Hashable, function: Callable[..., Any]) -> Callable[..., Any]:
        """`function` (state, params) of W worlds; whatever has the same name is compiled once."""
        if name not in self._views:
            self._views[name] = jax.jit(self._batched(function))
        return self._views[name]

    def run(
        self,
        key: jax.Array,
        keys: jax.Array,
        params: EnvParams,
        act: Act,
        spec: AlignSpec,
        *,
        frame: int = WIDE_FRAME,
        horizon: int | None = None,
        watch: Callable[[State], None] | None = None,
    ) -> Episodes:
        """Runs W episodes of a policy; stops early once all are solved.

        Args:
          key: randomness of the policy.
          keys: [W] one key a scene.
          params: leading axis [W].
          act: the policy.
          spec, frame: what the policy sees, see `Env.observe`.
          horizon: control steps, the task's own by default.
          watch: called with every state, the first included (videos).
        """
        horizon = horizon or self.env.task.horizon
        state = self.reset(keys, params)
        length = np.full(self.worlds, horizon, np.int32)
        for t in range(horizon):
            if watch:
                watch(state)
            seen = self.observe(state, params, spec, frame=frame)
            action = act(jax.random.fold_in(key, t), seen.image, seen.proprio)
            state = self.step(state, action, params)
            done = np.asarray(state.success | state.nan)
            length = np.where(done, np.minimum(length, t + 1), length)
            if done.all():
                break
        if watch:
            watch(state)
        return _outcome(state, jnp.asarray(length))


def scan_episodes(
    env: Env,
    key: jax.Array,
    keys: jax.Array,
    params: EnvParams,
    act: Act,
    spec: AlignSpec,
    *,
    frame: int = WIDE_FRAME,
    horizon: int | None = None,
) -> Episodes:
    """The same episodes as one jittable `lax.scan`; arguments as in `Runner.run`."""
    horizon = horizon or env.task.horizon

    def observe(state: State, params: EnvParams) -> Aligned:
        return env.observe(state, params, spec, frame=frame)

    def advance(
        carry: tuple[State, jax.Array], t: jax.Array
    ) -> tuple[tuple[State, jax.Array], None]:
        state, length = carry
        seen = jax.vmap(observe)(state, params)
        action = act(jax.random.fold_in(key, t), seen.image, seen.proprio)
        state = step_worlds(env, state, action, params)
        done = state.success | state.nan
        return (state, jnp.where(done, jnp.minimum(length, t + 1), length)), None

    start = jax.vmap(env.reset)(keys, params)
    length = jnp.full(keys.shape[0], horizon, jnp.int32)
    (state, length), _ = jax.lax.scan(advance, (start, length), jnp.arange(horizon))
    return _outcome(state, length)
