"""Runners without physics: an episode is a function of its params and its key."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.envs import make
from palm_jax.envs.base import EnvParams
from palm_jax.envs.rollout import Episodes
from palm_jax.train.evaluate import Evaluator, Runners
from palm_jax.train.methods import find


class Room:
    """Stands in for a `Runner`; remembers what it was asked to run."""

    def __init__(self, worlds: int) -> None:
        self.env, self.worlds = make("lift_spam"), worlds
        self.keys: list[np.ndarray] = []
        self.params: list[EnvParams] = []
        self.fits = worlds  # more of them at once do not fit into memory

    def halved(self) -> "Room":
        """A smaller room that remembers in the same lists."""
        room = Room(max(self.worlds // 2, 1))
        room.keys, room.params, room.fits = self.keys, self.params, self.fits
        return room

    def run(
        self, key: Any, keys: jax.Array, params: EnvParams, act: Any, spec: Any, **options: Any
    ) -> Episodes:
        del key, act, spec, options
        if self.worlds > self.fits:
            raise jax.errors.JaxRuntimeError(
                "RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes.\nBuffer assignment: ..."
            )
        assert len(keys) == len(params.object_low) == self.worlds
        self.keys.append(np.asarray(jax.random.key_data(keys)))
        self.params.append(params)
        x, y = np.asarray(params.object_low).T
        angle = np.asarray(params.camera_angle)[:, 0]
        flat = np.zeros(self.worlds)
        return Episodes(
            success=jnp.asarray((x > 0.12) & (y < 0.15) & (angle < 0)),
            nan=jnp.asarray(y > 0.15),
            seen=jnp.asarray(flat == 0),
            length=jnp.asarray(flat.astype(np.int32)),
            object_xy=jnp.asarray(np.stack([x, y], -1)),
            object_yaw=jnp.asarray(np.asarray(params.align_hand)),
            camera_angle=jnp.asarray(angle),
            draws=jnp.arange(self.worlds, dtype=jnp.int32) + 1,
        )


def evaluator(
    worlds: int,
    *,
    method: str = "palm",
    robots: tuple[str, str] = ("panda", "ur5"),
    fits: int | None = None,
    tell: Callable[[str], None] | None = None,
) -> tuple[Evaluator, dict[str, Room]]:
    """An evaluator in empty rooms, and the rooms by robot as they come into being.

    `fits`: worlds that fit into memory. `tell`: see `Runners`.
    """
    rooms: dict[str, Room] = {}

    def make_room(robot: str) -> Any:
        rooms[robot] = Room(worlds)
        rooms[robot].fits = worlds if fits is None else fits
        return rooms[robot]

    learner: Any = type("Idle", (), {"jitted_act": None})()
    return Evaluator(Runners(make_room, *robots, tell=tell), find(method), learner, 84), rooms
