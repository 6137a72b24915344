"""Episodes as seen: traces kept while a domain is evaluated, drawn afterwards."""

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.align import AlignSpec
from palm_jax.envs.base import EnvParams, State
from palm_jax.envs.rollout import Runner, repeat_params

FULL_SIZE = 224
"""Side of the full frame in videos, pixels."""


class Trace:
    """Joint positions of W worlds over an episode; call it with every state."""

    def __init__(self) -> None:
        self.qpos: list[np.ndarray] = []
        self.solved: list[np.ndarray] = []
        self.last: State | None = None

    def __call__(self, state: State) -> None:
        self.qpos.append(np.asarray(state.data.qpos))
        self.solved.append(np.asarray(state.success))
        self.last = state

    def length(self, world: int) -> int:
        """States up to and with the first solved one, or all."""
        solved = np.stack(self.solved)[:, world]
        return int(solved.argmax()) + 1 if solved.any() else len(solved)


@dataclasses.dataclass(frozen=True)
class Film:
    """One episode in pictures."""

    inputs: np.ndarray  # [T, size, size, 3] uint8, what the policy got
    frames: np.ndarray  # [T, FULL_SIZE, FULL_SIZE, 3] uint8, the paper's full frame
    success: bool


class Camera:
    """Draws traces; compiled once for a runner."""

    def __init__(self, runner: Runner, *, size: int = FULL_SIZE) -> None:
        self.runner = runner
        self._full = jax.jit(
            jax.vmap(lambda state, params: runner.env.render(state, params, size).rgb)
        )

    def film(self, trace: Trace, world: int, spec: AlignSpec, *, frame: int) -> Film:
        """The episode of one world; see `Env.observe` for `spec` and `frame`."""
        length = trace.length(world)
        inputs, frames = [], []
        for state, params, count in self._states(trace, world, length):
            inputs.append(
                np.asarray(self.runner.observe(state, params, spec, frame=frame).image)[:count]
            )
            frames.append(np.asarray(self._full(state, params))[:count])
        solved = bool(np.stack(trace.solved)[:, world].any())
        return Film(np.concatenate(inputs), np.concatenate(frames), solved)

    def first(self, trace: Trace, spec: AlignSpec, *, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Policy input and full frame of world 0 at the start of its episode."""
        state, params, _ = next(self._states(trace, 0, 1))
        seen = self.runner.observe(state, params, spec, frame=frame)
        return np.asarray(seen.image)[0], np.asarray(self._full(state, params))[0]

    def _states(
        self, trace: Trace, world: int, length: int
    ) -> Iterator[tuple[State, EnvParams, int]]:
        """Batches of the runner's size of consecutive states of one world."""
        assert trace.last is not None
        worlds = self.runner.worlds
        params = repeat_params(self.runner.env.default_params(), worlds)

        def fixed(array: jax.Array) -> jax.Array:
            return jnp.broadcast_to(array[world], (worlds, *array.shape[1:]))

        data = trace.last.data
        qpos = np.stack(trace.qpos)[:, world]
        for first in range(0, length, worlds):
            rows = np.minimum(np.arange(first, first + worlds), length - 1)
            state = self.runner.restore(
                jnp.asarray(qpos[rows]),
                fixed(data.mocap_pos),
                fixed(data.mocap_quat),
                fixed(trace.last.camera_to_world),
                params,
            )
            yield state, params, min(worlds, length - first)
