"""Tasks of one kind: grasp a free object at a known point and lift it straight up."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from palm_jax.envs.control import STEP_GAIN, pointing_down
from palm_jax.envs.physics import in_contact
from palm_jax.envs.robots import Robot
from palm_jax.envs.tasks.base import Command, Placement, Task
from palm_jax.envs.world import Contact

PAD_FRICTION = 1.5
OBJECT_FRICTION = 0.3  # metal or plastic on wood: a finger that arrives first shifts the object
# The gripper closes within this of the grasp. The funnel below makes the height tell when that is:
# what a policy must see at a glance, it learns; a conjunction of millimetres it would wait for.
_CLOSE_HEIGHT = 0.011
_CLOSE_RADIUS = 0.013
_CLOSE_ANGLE = 0.25
# The funnel: how far the hand stays up for an error sideways or in yaw. Inside the radius the open
# fingers pass the object: the hand goes all the way down and is put right there.
_FUNNEL_RADIUS = 0.009
_FUNNEL_ANGLE = 0.06
# The lift begins slowly: fingers that have yet to close fully do not slide off.
_LIFT_SPEED = 0.004  # metres of the first control step
_LIFT_GAIN = 0.3  # metres a step, per metre risen
_HOLDING_MARGIN = 0.08  # of opening, above the object's width: from there on the lift begins
_LIFT_MARGIN = 0.03  # the expert heads for a point this far beyond the height that counts as solved
_FUNNEL_SLOPE = 3.0  # metres of extra height per metre of lateral error
_FUNNEL_SLOPE_ANGLE = 0.08  # metres of extra height per radian of yaw error


class LiftIds(NamedTuple):
    """What a lift task needs of the compiled model and the robot."""

    body: int
    qpos: int  # address of the free joint in qpos
    grasp_site: int
    grasp_geom: int
    pads: tuple[int, int]
    holding: float  # opening (0..1) of the gripper below which the fingers have closed


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
      aligned: whether the opening axis must follow the object's yaw (a round knob needs none).
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
    aligned: bool

    def contacts(self, robot: Robot) -> tuple[Contact, ...]:
        pads = [Contact(pad, self.grasp_geom, PAD_FRICTION, stiff=True) for pad in robot.pads]
        rests = [Contact(*pair, OBJECT_FRICTION) for pair in self.supports]
        obstacles = ("table", *self.tip_obstacles)
        tips = [
            Contact(tip, geom, OBJECT_FRICTION, stiff=True)
            for tip in robot.tips
            for geom in obstacles
        ]
        return (*pads, *rests, *tips)

    def bind(self, model: mujoco.MjModel, robot: Robot) -> LiftIds:
        body = model.body(self.body).id
        left, right = (model.geom(name).id for name in robot.pads)
        return LiftIds(
            body=body,
            qpos=int(model.jnt_qposadr[model.body_jntadr[body]]),
            grasp_site=model.site(self.grasp_site).id,
            grasp_geom=model.geom(self.grasp_geom).id,
            pads=(left, right),
            holding=self.grasp_width / robot.max_width + _HOLDING_MARGIN,
        )

    def place(self, ids: LiftIds, qpos: jax.Array, xy: jax.Array, yaw: jax.Array) -> Placement:
        quat = jnp.stack([jnp.cos(yaw / 2), jnp.zeros(()), jnp.zeros(()), jnp.sin(yaw / 2)])
        pose = jnp.concatenate([xy, jnp.array([self.rest_height]), quat])
        under = [jnp.concatenate([xy, jnp.array([height])]) for _, height in self.mocap]
        return Placement(
            qpos=jax.lax.dynamic_update_slice(qpos, pose, (ids.qpos,)),
            mocap_pos=jnp.stack(under) if under else jnp.zeros((0, 3)),
            mocap_quat=jnp.tile(quat, (len(under), 1)),
        )

    def object_position(self, ids: LiftIds, data: mjx.Data) -> jax.Array:
        return data.xpos[ids.body]

    def success(self, ids: LiftIds, data: mjx.Data, start: jax.Array) -> jax.Array:
        moved = data.xpos[ids.body] - start
        held = in_contact(data, ids.pads[0], ids.grasp_geom) & in_contact(
            data, ids.pads[1], ids.grasp_geom
        )
        inside = jnp.all(jnp.abs(moved[:2]) <= self.lateral_limit)
        return held & inside & (moved[2] >= self.lift_height)

    def expert(
        self, ids: LiftIds, data: mjx.Data, tcp: jax.Array, opening: jax.Array, start: jax.Array
    ) -> Command:
        hand_yaw = jnp.arctan2(tcp[1, 0], tcp[0, 0])
        turn = self._turn_to_object(data.xmat[ids.body], hand_yaw)
        grasp = data.site_xpos[ids.grasp_site]
        lateral = jnp.linalg.norm(grasp[:2] - tcp[:2, 3])
        above = jnp.clip(
            _FUNNEL_SLOPE * (lateral - _FUNNEL_RADIUS)
            + _FUNNEL_SLOPE_ANGLE * (jnp.abs(turn) - _FUNNEL_ANGLE),
            0.0,
            0.08,
        )
        arrived = (
            (lateral < _CLOSE_RADIUS)
            & (jnp.abs(turn) < _CLOSE_ANGLE)
            & (tcp[2, 3] - grasp[2] < _CLOSE_HEIGHT)
        )
        closing = opening < 0.95
        holding = closing & (opening < ids.holding)
        bottom = start[2] + (grasp[2] - data.xpos[ids.body, 2])
        speed = _LIFT_SPEED + _LIFT_GAIN * jnp.maximum(tcp[2, 3] - bottom, 0.0)
        lifted = jnp.minimum(
            bottom + self.lift_height + _LIFT_MARGIN, tcp[2, 3] + speed / STEP_GAIN
        )
        reach = jnp.concatenate([grasp[:2], (grasp[2] + above)[None]])
        up = jnp.concatenate([tcp[:2, 3], lifted[None]])
        stay = jnp.concatenate([tcp[:2, 3], grasp[2:]])
        position = jnp.where(holding, up, jnp.where(closing, stay, reach))
        yaw = hand_yaw + jnp.where(closing, 0.0, turn)
        return Command(pointing_down(position, yaw), jnp.where(arrived | closing, 0.0, 1.0))

    def _turn_to_object(self, rotation: jax.Array, hand_yaw: jax.Array) -> jax.Array:
        """Yaw [] by which the hand must turn; two fingers are the same after half a turn."""
        if not self.aligned:
            return jnp.zeros(())
        yaw = jnp.arctan2(rotation[1, 0], rotation[0, 0])
        return jnp.mod(yaw - hand_yaw + jnp.pi / 2, jnp.pi) - jnp.pi / 2
