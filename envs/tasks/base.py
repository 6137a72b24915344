"""What a task is: its objects, where they start, when it is solved, how an expert solves it."""

import abc
import dataclasses
from typing import Any, NamedTuple

import jax
import mujoco
from mujoco import mjx

from palm_jax.envs.robots import Robot
from palm_jax.envs.world import Contact

TABLE_HEIGHT = 0.752
"""World z of the table top in metres."""

WORKSPACE_CENTRE = (0.25, 0.0, TABLE_HEIGHT)
"""Point on the table that the workspace and the camera's rotation are centred on."""


class Placement(NamedTuple):
    """Where an episode puts a task's objects."""

    qpos: jax.Array  # [nq] the model's joint positions, with the objects' entries set
    mocap_pos: jax.Array  # [m, 3] of the task's own mocap bodies (the distractors come before)
    mocap_quat: jax.Array  # [m, 4]


class Command(NamedTuple):
    """What the expert wants: a TCP pose to head for, and the gripper."""

    target: jax.Array  # [4, 4] TCP pose in the world
    gripper: jax.Array  # [] 1 open, 0 close


@dataclasses.dataclass(frozen=True)
class Task(abc.ABC):
    """A manipulation task, independent of the robot.

    Attributes:
      name: key in `TASKS`.
      asset: MJCF file name inside `assets/tasks/`.
      target_geoms: rendered geoms whose mask the global policy looks for.
      target_height: world z (metres) of the plane on which the mask's centroid is located: the
        object's centre height (the authors' code uses the true height of the object as well).
      start_height: (low, high) height of the TCP above the table at the start of an episode.
      crop: side of the TCP crop in pixels of the paper's 512-pixel frame.
      horizon: control steps after which an episode has failed.
    """

    name: str
    asset: str
    target_geoms: tuple[str, ...]
    target_height: float
    start_height: tuple[float, float]
    crop: int
    horizon: int

    @abc.abstractmethod
    def contacts(self, robot: Robot) -> tuple[Contact, ...]:
        """Every pair of geoms that may touch."""

    @abc.abstractmethod
    def bind(self, model: mujoco.MjModel, robot: Robot) -> Any:
        """Looks names up in the compiled model, once: the `ids` that the functions below get."""

    @abc.abstractmethod
    def place(self, ids: Any, qpos: jax.Array, xy: jax.Array, yaw: jax.Array) -> Placement:
        """Puts the target object at `xy` [2] (metres), turned by `yaw` [] about z, at rest."""

    @abc.abstractmethod
    def success(self, ids: Any, data: mjx.Data, start: jax.Array) -> jax.Array:
        """bool []: solved now. `start` [3] is the target object's position at the start."""

    @abc.abstractmethod
    def object_position(self, ids: Any, data: mjx.Data) -> jax.Array:
        """Position [3] of the target object in the world."""

    @abc.abstractmethod
    def expert(
        self, ids: Any, data: mjx.Data, tcp: jax.Array, opening: jax.Array, start: jax.Array
    ) -> Command:
        """Where a scripted expert with the true state would go from here (memoryless)."""
