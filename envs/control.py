"""Body-frame TCP deltas to joint targets: forward kinematics and damped least squares.

The arm is a chain of hinges about each link's z axis, read once from the MuJoCo model. Poses are
4x4 matrices in the world frame; the TCP frame has z along the approach and y along the opening
axis.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from palm_jax.envs.robots import Robot

STEP_GAIN = 0.5
"""Share of the way to its target that a scripted hand covers in one control step."""


@dataclasses.dataclass(frozen=True)
class Chain:
    """Constants of a serial arm.

    Attributes:
      before: [J, 4, 4] fixed transform from joint frame i-1 (the world for i = 0) to joint frame i.
      tip: [4, 4] from the last joint frame to the TCP.
      limits: [J, 2] joint range in radians.
      home: [J] joint positions that the null space is drawn to.
    """

    before: np.ndarray
    tip: np.ndarray
    limits: np.ndarray
    home: np.ndarray


def _transform(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = matrix.reshape(3, 3), position
    return pose


def arm_chain(model: mujoco.MjModel, robot: Robot) -> Chain:
    """Reads the arm's chain from the world to the site `tcp`."""
    site = model.site("tcp")
    bodies = [int(site.bodyid[0])]
    while bodies[0] != 0:
        bodies.insert(0, int(model.body(bodies[0]).parentid[0]))
    joint_of = {int(model.joint(name).bodyid[0]): model.joint(name) for name in robot.arm_joints}
    before, pose = [], np.eye(4)
    for body in bodies[1:]:
        pose = pose @ _transform(model.body_pos[body], model.body_quat[body])
        if body in joint_of:
            before.append(pose)
            pose = np.eye(4)
    return Chain(
        before=np.stack(before).astype(np.float32),
        tip=(pose @ _transform(site.pos, site.quat)).astype(np.float32),
        limits=np.stack([model.joint(name).range for name in robot.arm_joints]).astype(np.float32),
        home=np.asarray(robot.home, np.float32),
    )


class Kinematics(NamedTuple):
    """Result of `forward_kinematics`."""

    tcp: jax.Array  # [4, 4] pose of the TCP in the world
    jacobian: jax.Array  # [6, J] TCP twist (linear, then angular; world axes) per joint velocity


def forward_kinematics(chain: Chain, qpos: jax.Array) -> Kinematics:
    """TCP pose and geometric Jacobian at the arm's joint positions `qpos` [J] (radians)."""
    cos, sin = jnp.cos(qpos), jnp.sin(qpos)
    zero, one = jnp.zeros_like(cos), jnp.ones_like(cos)
    turn = jnp.stack(
        [cos, -sin, zero, zero, sin, cos, zero, zero, zero, zero, one, zero, zero, zero, zero, one],
        axis=-1,
    ).reshape(-1, 4, 4)

    def advance(pose: jax.Array, joint: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        pose = pose @ joint[0]
        return pose @ joint[1], pose[:3, 2:]  # the joint's axis and anchor, in the world

    last, axes_anchors = jax.lax.scan(advance, jnp.eye(4), (jnp.asarray(chain.before), turn))
    tcp = last @ chain.tip
    axes, anchors = axes_anchors[..., 0], axes_anchors[..., 1]
    return Kinematics(tcp, jnp.concatenate([jnp.cross(axes, tcp[:3, 3] - anchors), axes], -1).T)


def _rotation_vector(matrix: jax.Array) -> jax.Array:
    """Axis times angle [3] of a rotation [3, 3] away from half turns."""
    vee = 0.5 * jnp.stack(
        [
            matrix[2, 1] - matrix[1, 2],
            matrix[0, 2] - matrix[2, 0],
            matrix[1, 0] - matrix[0, 1],
        ]
    )
    sine = jnp.linalg.norm(vee)
    angle = jnp.arctan2(sine, 0.5 * (jnp.trace(matrix) - 1.0))
    return vee * jnp.where(sine > 1e-6, angle / jnp.maximum(sine, 1e-6), 1.0)


def pose_error(tcp: jax.Array, target: jax.Array) -> jax.Array:
    """Twist [6] (metres, radians; world axes) that carries `tcp` to `target`, both [4, 4]."""
    return jnp.concatenate(
        [target[:3, 3] - tcp[:3, 3], _rotation_vector(target[:3, :3] @ tcp[:3, :3].T)]
    )


def solve_ik(
    chain: Chain,
    qpos: jax.Array,
    target: jax.Array,
    *,
    iterations: int = 2,
    damping: float = 0.02,
    nullspace: float = 0.01,
) -> jax.Array:
    """Joint positions [J] whose TCP approaches `target` [4, 4], starting at `qpos` [J].

    Damped least squares; the null space drifts towards the chain's home pose. Joints stay in their
    limits. There is no failure: out of reach gives the nearest pose the iterations find (compare
    `forward_kinematics` with the target to know).
    """
    regular = damping**2 * jnp.eye(6)

    def improve(_: int, q: jax.Array) -> jax.Array:
        tcp, jacobian = forward_kinematics(chain, q)
        # One factorisation serves the step and the projection of the pull towards home.
        pull = nullspace * (chain.home - q)
        rhs = jnp.stack([pose_error(tcp, target), jacobian @ pull], -1)
        solved = jnp.linalg.solve(jacobian @ jacobian.T + regular, rhs)
        q = q + jacobian.T @ (solved[:, 0] - solved[:, 1]) + pull
        return jnp.clip(q, chain.limits[:, 0], chain.limits[:, 1])

    return jax.lax.fori_loop(0, iterations, improve, qpos)


def reach(chain: Chain, qpos: jax.Array, target: jax.Array) -> jax.Array:
    """Joint positions [J] at `target` [4, 4], far away from `qpos` [J] or not: for start poses."""
    coarse = solve_ik(chain, qpos, target, iterations=40, damping=0.05)
    return solve_ik(chain, coarse, target, iterations=15, damping=0.01, nullspace=0.0)


def inverse(pose: jax.Array) -> jax.Array:
    """Inverse [4, 4] of a rigid transform [4, 4]."""
    rotation = pose[:3, :3].T
    return jnp.eye(4).at[:3, :3].set(rotation).at[:3, 3].set(-rotation @ pose[:3, 3])


def carried(motion: jax.Array, pose: jax.Array) -> jax.Array:
    """Position and unit quaternion [7] of a body after a rigid `motion` [4, 4] of the world.

    The motion turns by less than half a turn.
    """
    vector = _rotation_vector(motion[:3, :3])
    half = jnp.linalg.norm(vector) / 2
    w, v = jnp.cos(half), 0.5 * jnp.sinc(half / jnp.pi) * vector
    scalar, axis = pose[3], pose[4:]
    turned = jnp.append(w * scalar - v @ axis, w * axis + scalar * v + jnp.cross(v, axis))
    return jnp.concatenate([motion[:3, :3] @ pose[:3] + motion[:3, 3], turned])


def yaw_quaternion(yaw: jax.Array) -> jax.Array:
    """Unit quaternion [4], w first, of a turn by `yaw` [] radians about z."""
    zero = jnp.zeros(())
    return jnp.stack([jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)])


def pointing_down(position: jax.Array, yaw: jax.Array) -> jax.Array:
    """TCP pose [4, 4] at `position` [3], approaching straight down, x axis at `yaw` []."""
    cos, sin, zero = jnp.cos(yaw), jnp.sin(yaw), jnp.zeros(())
    rotation = jnp.stack([cos, sin, zero, sin, -cos, zero, zero, zero, zero - 1.0]).reshape(3, 3)
    return jnp.eye(4).at[:3, :3].set(rotation).at[:3, 3].set(position)


def step_towards(
    tcp: jax.Array,
    target: jax.Array,
    *,
    gain: float = STEP_GAIN,
    max_distance: float = 0.006,
    max_angle: float = 0.03,
) -> jax.Array:
    """Next pose [4, 4] on the way from `tcp` to `target`, both [4, 4]: a saturated proportional
    step.

    Args:
      gain: share of the remaining error covered in one control step.
      max_distance, max_angle: largest translation (metres) and rotation (radians) of one step.
    """
    error = gain * pose_error(tcp, target)
    move, turn = _saturate(error[:3], max_distance), _saturate(error[3:], max_angle)
    rotation = rotation_matrix(turn) @ tcp[:3, :3]
    return jnp.eye(4).at[:3, :3].set(rotation).at[:3, 3].set(tcp[:3, 3] + move)


def _saturate(vector: jax.Array, limit: float) -> jax.Array:
    return vector * jnp.minimum(1.0, limit / jnp.maximum(jnp.linalg.norm(vector), 1e-9))


def rotation_matrix(vector: jax.Array) -> jax.Array:
    """Rotation [3, 3] about `vector` [3] by its length (Rodrigues)."""
    angle = jnp.linalg.norm(vector)
    x, y, z = vector / jnp.maximum(angle, 1e-9)
    zero = jnp.zeros(())
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    return jnp.eye(3) + jnp.sin(angle) * cross + (1 - jnp.cos(angle)) * cross @ cross
