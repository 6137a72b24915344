"""What scripted experts are made of: pick something up, put it down. Memoryless, from the state."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from mujoco import mjx

from palm_jax.envs.control import STEP_GAIN, pointing_down
from palm_jax.envs.physics import in_contact
from palm_jax.envs.robots import Robot
from palm_jax.envs.tasks.base import Command

# The gripper closes within this of the grasp, or lower if the object asks for it. The funnel below
# makes the height tell when that is: what a policy must see at a glance, it learns; a conjunction
# of millimetres it would wait for.
CLOSE_HEIGHT = 0.011
_CLOSE_RADIUS = 0.013
_CLOSE_ANGLE = 0.25
# The funnel: how far the hand stays up for an error sideways or in yaw. Inside the radius the open
# fingers pass the object: the hand goes all the way down and is put right there.
_FUNNEL_RADIUS = 0.009
_FUNNEL_ANGLE = 0.06
# Fingers that have yet to close fully do not slide off at this speed, and lifts take forty steps.
_LIFT_SPEED = 0.004  # metres in a control step
_HOLDING_MARGIN = 0.08  # of opening, above the width of the object: from there on the lift begins
_LIFT_MARGIN = 0.03  # the expert heads for a point this far beyond the height that counts as solved
_FUNNEL_SLOPE = 3.0  # metres of extra height per metre of lateral error
_FUNNEL_SLOPE_ANGLE = 0.08  # metres of extra height per radian of yaw error

# A hand that holds something lets go within this of its place, or tighter if the place asks for it.
_RELEASE_HEIGHT = 0.006


class Hold(NamedTuple):
    """When a gripper counts as closed on an object, by its opening (0..1)."""

    closing: float  # below: closing, or closed
    holding: float  # below: stalled on the object


def hold(robot: Robot, width: float) -> Hold:
    """For an object `width` metres wide between the pads."""
    return Hold(closing=0.95, holding=width / robot.max_width + _HOLDING_MARGIN)


def pick(
    tcp: jax.Array,
    opening: jax.Array,
    grasp: jax.Array,
    turn: jax.Array,
    *,
    hold: Hold,
    bottom: jax.Array,
    rise: float,
    close_height: float = CLOSE_HEIGHT,
) -> Command:
    """Go down to a grasp, close, lift straight up.

    Args:
      tcp: [4, 4] pose in the world.
      opening: [] of the gripper.
      grasp: [3] where the TCP should be when the gripper closes, metres.
      turn: [] yaw by which the hand must turn for it, radians.
      hold: of the object.
      bottom: [] world z of the grasp while the object rests.
      rise: metres to lift.
      close_height: metres above the grasp within which the gripper closes.
    """
    hand_yaw = jnp.arctan2(tcp[1, 0], tcp[0, 0])
    lateral = jnp.linalg.norm(grasp[:2] - tcp[:2, 3])
    above = _funnel(lateral - _FUNNEL_RADIUS, turn)
    arrived = (
        (lateral < _CLOSE_RADIUS)
        & (jnp.abs(turn) < _CLOSE_ANGLE)
        & (tcp[2, 3] - grasp[2] < close_height)
    )
    closing = opening < hold.closing
    holding = closing & (opening < hold.holding)
    lifted = jnp.minimum(bottom + rise + _LIFT_MARGIN, tcp[2, 3] + _LIFT_SPEED / STEP_GAIN)
    reach = jnp.concatenate([grasp[:2], (grasp[2] + above)[None]])
    up = jnp.concatenate([tcp[:2, 3], lifted[None]])
    stay = jnp.concatenate([tcp[:2, 3], grasp[2:]])
    position = jnp.where(holding, up, jnp.where(closing, stay, reach))
    yaw = hand_yaw + jnp.where(closing, 0.0, turn)
    return Command(pointing_down(position, yaw), jnp.where(arrived | closing, 0.0, 1.0))


def put(
    tcp: jax.Array,
    opening: jax.Array,
    carried: jax.Array,
    goal: jax.Array,
    turn: jax.Array,
    *,
    hold: Hold,
    radius: float,
    angle: float,
) -> Command:
    """Carry what is held over its place, go down, let go.

    Args:
      tcp: [4, 4] pose in the world.
      opening: [] of the gripper.
      carried: [3] position of the held object.
      goal: [3] where it should be when the hand lets go, metres.
      turn: [] yaw by which it must turn for it, radians.
      hold: of the object.
      radius, angle: how far (metres, radians) from the goal the hand may go down and let go.
    """
    hand_yaw = jnp.arctan2(tcp[1, 0], tcp[0, 0])
    error = goal - carried
    lateral = jnp.linalg.norm(error[:2])
    above = _funnel(lateral - radius, turn, angle)
    arrived = (lateral < radius) & (jnp.abs(turn) < angle) & (-error[2] < _RELEASE_HEIGHT)
    letting_go = opening > hold.holding
    position = tcp[:3, 3] + error.at[2].add(above)
    position = jnp.where(letting_go, tcp[:3, 3], position)
    yaw = hand_yaw + jnp.where(letting_go, 0.0, turn)
    return Command(pointing_down(position, yaw), jnp.where(arrived | letting_go, 1.0, 0.0))


def _funnel(excess: jax.Array, turn: jax.Array, angle: float = _FUNNEL_ANGLE) -> jax.Array:
    """Metres to stay above while `excess` metres too far sideways, `turn` radians off."""
    return jnp.clip(
        _FUNNEL_SLOPE * excess + _FUNNEL_SLOPE_ANGLE * (jnp.abs(turn) - angle), 0.0, 0.08
    )


def turn_to(rotation: jax.Array, yaw: jax.Array, period: float | None) -> jax.Array:
    """Yaw [] from `yaw` [] to a body's [3, 3], the shortest for one that looks the same after
    `period` radians (None: from every side)."""
    if period is None:
        return jnp.zeros(())
    goal = jnp.arctan2(rotation[1, 0], rotation[0, 0])
    return jnp.mod(goal - yaw + period / 2, period) - period / 2


def both_touch(data: mjx.Data, pads: tuple[int, int], geom: int) -> jax.Array:
    """bool []: both pads touch a geom (ids)."""
    return in_contact(data, pads[0], geom) & in_contact(data, pads[1], geom)
