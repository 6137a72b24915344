"""Demonstrations: the scripted expert, perturbed, with the clean command as the label."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.envs import physics
from palm_jax.envs.base import EnvParams, State
from palm_jax.envs.rollout import Runner

NOISE = 0.004
"""Default standard deviation (metres) of the disturbance of each commanded translation."""

_CORRELATION = 0.8  # of the disturbance from one control step to the next: it pushes, not trembles
# Share of the disturbance that is left from when the gripper closes until it is open again. A lift
# rises 4 mm a step, no more than the whole disturbance: with that it would neither rise steadily
# nor straight; and fingers that let go would knock what they put down off its place.
_HELD_SHARE = 0.3
_FREE_OPENING = 0.95  # of the gripper (0..1): from there on it holds nothing
_YAW_NOISE = 4.0  # radians of disturbance per metre: 4 mm go with about 1 degree


class Frames(NamedTuple):
    """What is recorded of W worlds at one control step, before the action is executed."""

    qpos: jax.Array  # [W, nq]
    qvel: jax.Array  # [W, nv]
    tcp: jax.Array  # [W, 4, 4]
    opening: jax.Array  # [W]
    stage: jax.Array  # int32 [W]
    action: jax.Array  # [W, 10] the expert's command
    success: jax.Array  # bool [W] solved after the action


class Recording(NamedTuple):
    """T control steps of W worlds."""

    frames: Frames  # every field [T, W, ...]
    start: State  # [W] the states that the episodes began with
    length: np.ndarray  # int [W] control steps up to and with the one that solved the task, or T
    success: np.ndarray  # bool [W]


class _Command(NamedTuple):
    """What the expert wants in W worlds, and what is executed."""

    action: jax.Array  # [W, 10] the clean command: the label
    executed: jax.Array  # [W, 10]
    push: jax.Array  # [W, 4] disturbance: metres in x, y, z; metres that stand for yaw
    tcp: jax.Array  # [W, 4, 4]
    opening: jax.Array  # [W]


class Demonstrator:
    """The perturbed expert on W worlds, compiled once."""

    def __init__(self, runner: Runner) -> None:
        self.runner = runner
        self._command = physics.jit_physics(jax.vmap(self._one_command, in_axes=(0, 0, 0, None)))

    def __call__(
        self, key: jax.Array, keys: jax.Array, params: EnvParams, *, noise: float = NOISE
    ) -> Recording:
        """Runs one episode in every world.

        The executed translation is the command plus a disturbance that is correlated in time, so
        that states off the expert's path are visited and labelled with the way back.

        Args:
          key: randomness of the disturbance.
          keys: [W] one key a scene.
          params: leading axis [W].
          noise: standard deviation of the disturbance in metres; 0 turns it off.
        """
        worlds, horizon = self.runner.worlds, self.runner.env.task.horizon
        state = start = self.runner.reset(keys, params)
        push, frames = jnp.zeros((worlds, 4)), []
        for t in range(horizon):
            step_keys = jax.random.split(jax.random.fold_in(key, t), worlds)
            command = self._command(step_keys, state, push, jnp.float32(noise))
            before, push = state, command.push
            state = self.runner.step(state, command.executed, params)
            frame = Frames(
                qpos=before.data.qpos,
                qvel=before.data.qvel,
                tcp=command.tcp,
                opening=command.opening,
                stage=before.stage,
                action=command.action,
                success=state.success,
            )
            frames.append(jax.tree.map(np.asarray, frame))
            if np.all(frames[-1].success | np.asarray(state.nan)):
                break
        stacked: Frames = jax.tree.map(lambda *steps: np.stack(steps), *frames)
        solved = np.asarray(stacked.success)
        length = np.where(solved.any(0), solved.argmax(0) + 1, len(frames))
        return Recording(stacked, start, length, solved.any(0) & ~np.asarray(state.nan))

    def _one_command(
        self, key: jax.Array, state: State, push: jax.Array, noise: jax.Array
    ) -> "_Command":
        env = self.runner.env
        action = env.expert(state)
        opening = env.opening(state)
        free = (action[9] > 0.5) & (opening > _FREE_OPENING)
        push = next_push(key, push, noise)
        scaled = jnp.where(free, 1.0, _HELD_SHARE) * push
        return _Command(action, disturbed(action, scaled), push, env.tcp(state), opening)


def next_push(key: jax.Array, push: jax.Array, noise: jax.Array) -> jax.Array:
    """The disturbance [4] that follows on `push` [4], of standard deviation `noise` [] (metres)."""
    fresh = jax.random.normal(key, (4,)) * noise
    return _CORRELATION * push + jnp.sqrt(1 - _CORRELATION**2) * fresh


def disturbed(action: jax.Array, push: jax.Array) -> jax.Array:
    """`action` [10], its translation moved by `push[:3]`, its yaw by 4 rad/m of `push[3]`."""
    angle = _YAW_NOISE * push[3]
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    turn = (
        jnp.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
        .at[:2, :2]
        .set(jnp.stack([cos, -sin, sin, cos]).reshape(2, 2))
    )
    columns = turn @ jnp.stack([action[:3], action[3:6]], -1)
    return jnp.concatenate([columns[:, 0], columns[:, 1], action[6:9] + push[:3], action[9:]])
