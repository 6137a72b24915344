"""Tasks of one kind: grasp a free object at a known point and lift it straight up."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from palm_jax.envs.control import yaw_quaternion
from palm_jax.envs.robots import Robot
from palm_jax.envs.tasks.base import Command, Placement, Task
from palm_jax.envs.tasks.fingers import OBJECT_FRICTION, pad_contacts, tip_contacts
from palm_jax.envs.tasks.skills import Hold, both_touch, hold, pick, turn_to
from palm_jax.envs.world import Contact


class LiftIds(NamedTuple):
    """Ids in the compiled model that a lift task needs."""

    body: int
    qpos: int  # address of the free joint in qpos
    grasp_site: int
    grasp_geom: int
    pads: tuple[int, int]
    hold: Hold


@dataclasses.dataclass(frozen=True)
class LiftTask(Task):
    """Grasp an object and lift it: solved when it is held by both pads at the height.

    Attributes:
      body: the free body.
      mocap: mocap bodies that stand under the object, if any, with their world z.
      grasp_geom: its collision geom that the pads close on.
      grasp_site: where the TCP should be when the gripper closes.
      grasp_width: width of the object between the pads (metres).
      supports: (geom, geom) pairs that the object rests on.
      tip_obstacles: geoms besides the table that the finger tips may push on.
      rest_height: world z of the body at rest.
      lift_height: rise (metres) that solves the task.
      lateral_limit: largest |x| and |y| displacement (metres) that still counts.
      period: yaw (radians) after which the object looks the same to two fingers; None for a round
        one, which they can take from every side.
    """

    body: str
    mocap: tuple[tuple[str, float], ...]
    grasp_geom: str
    grasp_site: str
    grasp_width: float
    supports: tuple[tuple[str, str], ...]
    tip_obstacles: tuple[str, ...]
    rest_height: float
    lift_height: float
    lateral_limit: float
    period: float | None

    def contacts(self, robot: Robot) -> tuple[Contact, ...]:
        rests = [Contact(*pair, OBJECT_FRICTION) for pair in self.supports]
        pads = pad_contacts(robot, (self.grasp_geom,))
        return (*pads, *rests, *tip_contacts(robot, self.tip_obstacles))

    def bind(self, model: mujoco.MjModel, robot: Robot) -> LiftIds:
        body = model.body(self.body).id
        left, right = (model.geom(name).id for name in robot.pads)
        return LiftIds(
            body=body,
            qpos=int(model.jnt_qposadr[model.body_jntadr[body]]),
            grasp_site=model.site(self.grasp_site).id,
            grasp_geom=model.geom(self.grasp_geom).id,
            pads=(left, right),
            hold=hold(robot, self.grasp_width),
        )

    def place(
        self,
        ids: LiftIds,
        key: jax.Array,
        qpos: jax.Array,
        xy: jax.Array,
        yaw: jax.Array,
        area: jax.Array,
    ) -> Placement:
        del key, area  # there is nothing but the target
        quat = yaw_quaternion(yaw)
        pose = jnp.concatenate([xy, jnp.array([self.rest_height]), quat])
        under = [jnp.concatenate([xy, jnp.array([height])]) for _, height in self.mocap]
        return Placement(
            qpos=jax.lax.dynamic_update_slice(qpos, pose, (ids.qpos,)),
            mocap_pos=jnp.stack(under) if under else jnp.zeros((0, 3)),
            mocap_quat=jnp.tile(quat, (len(under), 1)),
        )

    def object_position(self, ids: LiftIds, data: mjx.Data) -> jax.Array:
        return data.xpos[ids.body]

    def next_stage(
        self, ids: LiftIds, data: mjx.Data, stage: jax.Array, opening: jax.Array
    ) -> jax.Array:
        return stage

    def held(self, ids: LiftIds, data: mjx.Data) -> jax.Array:
        return both_touch(data, ids.pads, ids.grasp_geom)[None]

    def success(
        self, ids: LiftIds, data: mjx.Data, start: jax.Array, opening: jax.Array
    ) -> jax.Array:
        moved = data.xpos[ids.body] - start
        inside = jnp.all(jnp.abs(moved[:2]) <= self.lateral_limit)
        return self.held(ids, data)[0] & inside & (moved[2] >= self.lift_height)

    def expert(
        self,
        ids: LiftIds,
        data: mjx.Data,
        tcp: jax.Array,
        opening: jax.Array,
        start: jax.Array,
        stage: jax.Array,
    ) -> Command:
        grasp = data.site_xpos[ids.grasp_site]
        yaw = jnp.arctan2(tcp[1, 0], tcp[0, 0])
        return pick(
            tcp,
            opening,
            grasp,
            turn_to(data.xmat[ids.body], yaw, self.period),
            hold=ids.hold,
            bottom=start[2] + (grasp[2] - data.xpos[ids.body, 2]),
            rise=self.lift_height,
        )
