"""Episodes as seen: traces kept while a domain is evaluated, drawn afterwards by its runner."""

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.align import AlignSpec
from palm_jax.envs.base import EnvParams, State
from palm_jax.envs.rollout import Runner, take_params

FULL_SIZE = 224
"""Side of the full frame in videos, pixels."""


class Trace:
    """Joint positions of W worlds over an episode; call it with every state.

    Another number of worlds begins a new one: the batch did not fit into memory.
    """

    def __init__(self) -> None:
        self.qpos: list[np.ndarray] = []
        self.solved: list[np.ndarray] = []
        self.last: State | None = None

    def __call__(self, state: State) -> None:
        if self.qpos and len(self.qpos[0]) != len(state.data.qpos):
            self.qpos, self.solved = [], []
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


@dataclasses.dataclass(frozen=True)
class Camera:
    """Draws the traces of a domain: as a policy saw it, and the paper's full frame."""

    runner: Runner  # that played the domain
    params: EnvParams  # of its scenes, leading axis [count]
    spec: AlignSpec  # what the policy sees, see `Env.observe`
    frame: int

    def film(self, trace: Trace, world: int) -> Film:
        """The episode of one world."""
        length = trace.length(world)
        parts = [
            (inputs[:count], frames[:count])
            for inputs, frames, count in self._pictures(trace, world, length)
        ]
        inputs, frames = (np.concatenate(pictures) for pictures in zip(*parts, strict=True))
        return Film(inputs, frames, bool(np.stack(trace.solved)[:, world].any()))

    def first(self, trace: Trace) -> tuple[np.ndarray, np.ndarray]:
        """Policy input and full frame of world 0 at the start of its episode."""
        inputs, frames, _ = next(self._pictures(trace, 0, 1))
        return inputs[0], frames[0]

    def _pictures(
        self, trace: Trace, world: int, length: int
    ) -> Iterator[tuple[np.ndarray, np.ndarray, int]]:
        """Batches of the runner's size: policy inputs, full frames, and how many of them count."""
        for state, params, count in self._states(trace, world, length):
            seen = self.runner.observe(state, params, self.spec, frame=self.frame)
            full = self.runner.render(state, params, FULL_SIZE)
            yield np.asarray(seen.image), np.asarray(full), count

    def _states(
        self, trace: Trace, world: int, length: int
    ) -> Iterator[tuple[State, EnvParams, int]]:
        """Batches of the runner's size of consecutive states of one world."""
        assert trace.last is not None
        worlds = self.runner.worlds
        params = take_params(self.params, np.full(worlds, world))

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
