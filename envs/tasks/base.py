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


@dataclasses.dataclass(frozen=True)
class Stage:
    """A part of a task between two calls of the global policy: pick something, place it.

    Attributes:
      target_geoms: rendered geoms whose mask the global policy looks for.
      target_height: world z (metres) of the plane on which the mask's centroid is located: the
        target's centre height (the authors' code uses the true height of the object as well).
      start_height: (low, high) height of the TCP above the table when the stage begins.
      open_hand: whether the hand is opened for it (to pick) or keeps what it holds (to place).
    """

    target_geoms: tuple[str, ...]
    target_height: float
    start_height: tuple[float, float]
    open_hand: bool = True


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
      stages: its parts; the global policy is called at the beginning of each.
      movable: names of the free bodies that a hand can carry.
      crop: side of the TCP crop in pixels of the paper's 512-pixel frame.
      horizon: control steps after which an episode has failed.
      robot_visible: whether the robot is drawn (physics is the same).
    """

    name: str
    asset: str
    stages: tuple[Stage, ...]
    movable: tuple[str, ...]
    crop: int
    horizon: int
    robot_visible: bool = dataclasses.field(default=True, kw_only=True)

    @abc.abstractmethod
    def contacts(self, robot: Robot) -> tuple[Contact, ...]:
        """Every pair of geoms that may touch."""

    @abc.abstractmethod
    def bind(self, model: mujoco.MjModel, robot: Robot) -> Any:
        """Looks names up in the compiled model, once: the `ids` that the functions below get."""

    @abc.abstractmethod
    def place(
        self,
        ids: Any,
        key: jax.Array,
        qpos: jax.Array,
        xy: jax.Array,
        yaw: jax.Array,
        area: jax.Array,
    ) -> Placement:
        """Puts the objects on the table, at rest.

        Args:
          ids: from `bind`.
          key: randomness of all but the target object.
          qpos: [nq] the model's joint positions.
          xy: [2] where the target object goes, metres.
          yaw: [] its turn about z, radians.
          area: [2, 2] lower and upper corner of where the other objects may stand, metres.
        """

    @abc.abstractmethod
    def next_stage(
        self, ids: Any, data: mjx.Data, stage: jax.Array, opening: jax.Array
    ) -> jax.Array:
        """int32 []: the stage after a control step that was taken in `stage`, from the state."""

    @abc.abstractmethod
    def success(self, ids: Any, data: mjx.Data, start: jax.Array, opening: jax.Array) -> jax.Array:
        """bool []: solved now. `start` [3] is the target object's position at the start."""

    @abc.abstractmethod
    def held(self, ids: Any, data: mjx.Data) -> jax.Array:
        """bool [M]: which of the `movable` bodies both pads touch."""

    @abc.abstractmethod
    def object_position(self, ids: Any, data: mjx.Data) -> jax.Array:
        """Position [3] of the target object in the world."""

    @abc.abstractmethod
    def expert(
        self,
        ids: Any,
        data: mjx.Data,
        tcp: jax.Array,
        opening: jax.Array,
        start: jax.Array,
        stage: jax.Array,
    ) -> Command:
        """Where a scripted expert with the true state would go from here (memoryless)."""
