"""Objects on the table that no task is about: in the picture, but nothing touches them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from palm_jax.envs.control import yaw_quaternion
from palm_jax.envs.params import EnvParams
from palm_jax.envs.tasks.base import TABLE_HEIGHT
from palm_jax.envs.world import DISTRACTORS

TARGET_DISTANCE = 0.12
"""Least distance in metres between the target object's xy and the middle of a distractor."""

_CANDIDATES = 64  # places drawn for each distractor
_GAP = 0.01  # metres that are to be left between things
_PARKED = (0.25, 0.0, -1.0)  # below the floor


class MocapPoses(NamedTuple):
    """Poses of the D distractors."""

    pos: jax.Array  # [D, 3] metres, world
    quat: jax.Array  # [D, 4]


class Distractors:
    """Where an episode's distractors stand.

    Attributes:
      bodies: ids of the D distractors in the MuJoCo model, in the order of `DISTRACTORS`.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.bodies = np.array([model.body(name).id for name in DISTRACTORS])
        mocap = model.body_mocapid[self.bodies]
        if not np.array_equal(mocap, np.arange(len(DISTRACTORS))):
            raise ValueError(
                f"expected {', '.join(DISTRACTORS)} to be the model's first mocap bodies, got the "
                f"places {mocap.tolist()}; assets/table.xml must come first and keep their order"
            )
        self._radius = np.array([_footprint(model, body) for body in self.bodies], np.float32)
        # What must not stand in another's place: all that is drawn of the task's objects.
        self._obstacles = np.flatnonzero(task_geoms(model) & (model.geom_group != 3))
        self._obstacle_radius = model.geom_rbound[self._obstacles].astype(np.float32)

    def parked(self) -> MocapPoses:
        """All of them out of view."""
        count = len(self.bodies)
        quat = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (count, 1))
        return MocapPoses(jnp.tile(jnp.array(_PARKED), (count, 1)), quat)

    def arrange(
        self, key: jax.Array, params: EnvParams, data: mjx.Data, target: jax.Array
    ) -> MocapPoses:
        """The first `params.distractors` on the table, the others parked.

        Each takes the first of its drawn places in the area that is clear of the task's objects, of
        the distractors before it and of the target's surroundings; if none is, the clearest.

        Args:
          key: of the episode's distractors; the first ones stand in the same places however many
            there are.
          params: area and count.
          data: the task's objects in their places.
          target: [2] xy of the target object.
        """
        taken = data.geom_xpos[self._obstacles, :2]
        taken_radius = jnp.asarray(self._obstacle_radius)
        parked = self.parked()
        pos, quat = [], []
        drawn, yaws = jax.vmap(lambda index: _draw(jax.random.fold_in(key, index), params))(
            jnp.arange(len(self.bodies))
        )
        for index, (radius, candidates, yaw) in enumerate(
            zip(self._radius, drawn, yaws, strict=True)
        ):
            away = jnp.linalg.norm(candidates[:, None] - taken, axis=-1) - taken_radius - radius
            apart = jnp.linalg.norm(candidates - target, axis=-1) - TARGET_DISTANCE
            clear = jnp.minimum(away.min(-1) - _GAP, apart)
            xy = candidates[jnp.argmax(jnp.minimum(clear, 0.0))]
            shown = index < params.distractors
            at = jnp.append(xy, TABLE_HEIGHT)
            turn = yaw_quaternion(yaw)
            pos.append(jnp.where(shown, at, parked.pos[index]))
            quat.append(jnp.where(shown, turn, parked.quat[index]))
            taken = jnp.concatenate([taken, xy[None]])
            taken_radius = jnp.append(taken_radius, radius)
        return MocapPoses(jnp.stack(pos), jnp.stack(quat))


def _draw(key: jax.Array, params: EnvParams) -> tuple[jax.Array, jax.Array]:
    """Candidates [C, 2] for a distractor's xy, and its yaw."""
    xy_key, yaw_key = jax.random.split(key)
    candidates = jax.random.uniform(
        xy_key, (_CANDIDATES, 2), minval=params.area_low, maxval=params.area_high
    )
    return candidates, jax.random.uniform(yaw_key, (), minval=-jnp.pi, maxval=jnp.pi)


def task_geoms(model: mujoco.MjModel) -> np.ndarray:
    """bool [ngeom]: geoms of the task's objects: not robot, furniture or distractors."""
    others = {0, model.body("robot_base").id, *(model.body(name).id for name in DISTRACTORS)}
    return ~np.isin(model.body_rootid[model.geom_bodyid], list(others))


def _footprint(model: mujoco.MjModel, body: int) -> float:
    """Radius (metres) of a circle about the body's origin that holds its geoms."""
    own = np.flatnonzero(model.geom_bodyid == body)
    reach = np.linalg.norm(model.geom_pos[own, :2], axis=-1) + model.geom_rbound[own]
    return float(reach.max())
