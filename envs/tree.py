"""Kinematics and velocities along the tree of bodies, all bodies at once.

MJX walks the tree level by level, which makes long programs: `mjx.kinematics` alone has half of the
operations of a whole step and takes 5 s to compile. The same results follow from a few operations
on arrays over all bodies: poses by pointer jumping (after n rounds every body knows its pose
relative to its ancestor 2^n levels up), sums over ancestors and descendants by constant masks.

For models in which no body has more than one joint and none is a ball; others get MJX's own.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.scipy.linalg import cho_solve
from mujoco import mjx

_FREE, _SLIDE, _HINGE = (
    int(joint)
    for joint in (
        mujoco.mjtJoint.mjJNT_FREE,
        mujoco.mjtJoint.mjJNT_SLIDE,
        mujoco.mjtJoint.mjJNT_HINGE,
    )
)


class Tree(NamedTuple):
    """Constants of a model's tree, NumPy."""

    joint: np.ndarray  # [nbody] id of the body's joint, 0 where it has none
    hinge: np.ndarray  # bool [nbody]
    slide: np.ndarray  # bool [nbody]
    qpos: np.ndarray  # [nbody] address in qpos of that joint, 0 where there is none
    free: np.ndarray  # [F] ids of the free bodies
    free_qpos: np.ndarray  # [F, 7] addresses of their positions and quaternions
    mocap: np.ndarray  # [M] ids of the mocap bodies, in the order of data.mocap_pos
    source: np.ndarray  # [nbody] where a body's pose is found in (jointed, free, mocap)
    jumps: tuple[np.ndarray, ...]  # [nbody] ancestors 1, 2, 4, ... levels up, while any is a body
    above: np.ndarray  # float [nbody, nbody] 1 where the second is the first or its ancestor
    moved_by: np.ndarray  # float [nbody, nv] 1 where a degree of freedom moves a body
    before: np.ndarray  # float [nv, nv] 1 where one moves the frame in which another is defined


def tree_of(model: mjx.Model) -> Tree | None:
    """The tree of a model; None for one that this module does not cover."""
    kinds, owner = np.asarray(model.jnt_type), np.asarray(model.jnt_bodyid)
    covered = np.isin(kinds, (_FREE, _SLIDE, _HINGE)).all()
    if not len(kinds) or not covered or len(set(owner.tolist())) < len(owner):
        return None
    count, parent = model.nbody, np.asarray(model.body_parentid)
    joint = np.full(count, -1)
    joint[owner] = np.arange(len(owner))
    kind = np.where(joint >= 0, kinds[joint], -1)
    free = np.flatnonzero(kind == _FREE)
    order = np.asarray(model.body_mocapid)
    mocap = np.argsort(order)[np.sum(order < 0) :]
    source = np.arange(count)
    source[free] = count + np.arange(len(free))
    source[mocap] = count + len(free) + np.arange(len(mocap))
    jumps, up = [], parent
    while up.any():
        jumps.append(up)
        up = up[up]
    address = np.asarray(model.jnt_qposadr)[joint]
    above, moved_by, before = _masks(model, parent)
    return Tree(
        joint=np.maximum(joint, 0),
        hinge=kind == _HINGE,
        slide=kind == _SLIDE,
        qpos=np.where(joint >= 0, address, 0),
        free=free,
        free_qpos=address[free, None] + np.arange(7),
        mocap=mocap,
        source=source,
        jumps=tuple(jumps),
        above=above,
        moved_by=moved_by,
        before=before,
    )


def _masks(model: mjx.Model, parent: np.ndarray) -> tuple[np.ndarray, ...]:
    """`above`, `moved_by` and `before`."""
    dof_body = np.asarray(model.dof_bodyid)
    above = np.eye(len(parent), dtype=bool)  # [body, ancestor or itself]
    for body in range(1, len(parent)):
        above[body] |= above[parent[body]]
    moved_by = above[:, dof_body]
    before = moved_by[parent[dof_body]]
    # A free body turns about axes that its own translations carry.
    address = np.asarray(model.jnt_dofadr)[np.asarray(model.jnt_type) == _FREE]
    for first in address:
        before[first + 3 : first + 6, first : first + 3] = True
    return tuple(mask.astype(np.float32) for mask in (above, moved_by, before))


# -- quaternions and rotations, leading axes free --------------------------------------------------

# Sums are written out: XLA's reductions over three numbers are ten times slower on a CPU, and its
# matrix products of float32 are not exact on every device.


def _quat_mul(first: jax.Array, second: jax.Array) -> jax.Array:
    """Product [..., 4] of quaternions, w first."""
    w, x, y, z = (first[..., i] for i in range(4))
    a, b, c, d = (second[..., i] for i in range(4))
    parts = (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
    return jnp.stack(parts, -1)


def _matrix(quat: jax.Array) -> jax.Array:
    """Rotations [..., 3, 3] of unit quaternions [..., 4]."""
    w, x, y, z = (quat[..., i] for i in range(4))
    entries = (
        w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z,
    )  # fmt: skip
    return jnp.stack(entries, -1).reshape(*quat.shape[:-1], 3, 3)


def _times(first: jax.Array, second: jax.Array) -> jax.Array:
    """Product [..., 3, 3] of matrices."""
    a, b = first, second
    terms = [a[..., :, i : i + 1] * b[..., i : i + 1, :] for i in range(3)]
    return terms[0] + terms[1] + terms[2]


def _turned(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """[..., 3] vectors [..., 3] turned by [..., 3, 3]."""
    terms = [matrix[..., :, i] * vector[..., i : i + 1] for i in range(3)]
    return terms[0] + terms[1] + terms[2]


def _unit(quat: jax.Array) -> jax.Array:
    # Zeros, as they are in a state that was never set, stay zeros.
    return quat / jnp.sqrt(jnp.maximum(jnp.sum(quat * quat, -1, keepdims=True), 1e-30))


# -- stages of a step ------------------------------------------------------------------------------


def kinematics(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.kinematics`: poses of bodies, geoms and sites at `data.qpos`, up to rounding."""
    tree = tree_of(model)
    if tree is None:
        return mjx.kinematics(model, data)
    move = data.qpos[tree.qpos] - jnp.asarray(model.qpos0)[tree.qpos]
    angle, shift = jnp.where(tree.hinge, move, 0.0), jnp.where(tree.slide, move, 0.0)
    axis, anchor = jnp.asarray(model.jnt_axis)[tree.joint], jnp.asarray(model.jnt_pos)[tree.joint]
    turn = jnp.concatenate([jnp.cos(angle / 2)[:, None], jnp.sin(angle / 2)[:, None] * axis], -1)
    fixed = _matrix(jnp.asarray(model.body_quat))
    offset = anchor + shift[:, None] * axis - _turned(_matrix(turn), anchor)
    free = data.qpos[tree.free_qpos]
    free_quat = _unit(free[:, 3:])
    # Relative to the parent; free and mocap bodies are children of the world.
    pos = jnp.concatenate(
        [model.body_pos + _turned(fixed, offset), free[:, :3], data.mocap_pos.reshape(-1, 3)]
    )[tree.source]
    quat = jnp.concatenate(
        [_quat_mul(model.body_quat, turn), free_quat, _unit(data.mocap_quat.reshape(-1, 4))]
    )[tree.source]
    matrix = _matrix(quat)
    for up in tree.jumps:
        pos = pos[up] + _turned(matrix[up], pos)
        quat, matrix = _quat_mul(quat[up], quat), _times(matrix[up], matrix)
    owner = np.asarray(model.jnt_bodyid)
    is_free = np.isin(owner, tree.free)[:, None]
    at_rest = model.jnt_pos - shift[owner, None] * model.jnt_axis
    placed = data.replace(
        qpos=_with_unit_quaternions(tree, data.qpos, free_quat),
        xanchor=pos[owner] + _turned(matrix[owner], at_rest),
        xaxis=jnp.where(
            is_free, jnp.array([0.0, 0.0, 1.0]), _turned(matrix[owner], model.jnt_axis)
        ),
        xpos=pos,
        xquat=quat,
        xmat=matrix,
        xipos=pos + _turned(matrix, model.body_ipos),
        ximat=_times(matrix, _matrix(jnp.asarray(model.body_iquat))),
    )
    return _attached(model, placed)


def _with_unit_quaternions(tree: Tree, qpos: jax.Array, quat: jax.Array) -> jax.Array:
    source = np.arange(len(qpos))
    source[tree.free_qpos[:, 3:]] = len(qpos) + np.arange(quat.size).reshape(quat.shape)
    return jnp.concatenate([qpos, quat.reshape(-1)])[source]


def _attached(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`data` with the poses of geoms and sites that go with its bodies'."""
    for kind in ("geom", "site"):
        body = np.asarray(getattr(model, f"{kind}_bodyid"))
        if not len(body):
            continue
        matrix, pos = data.xmat[body], data.xpos[body]
        local = _matrix(jnp.asarray(getattr(model, f"{kind}_quat")))
        poses = {
            f"{kind}_xpos": pos + _turned(matrix, getattr(model, f"{kind}_pos")),
            f"{kind}_xmat": _times(matrix, local),
        }
        data = data.replace(**poses)
    return data


def com_pos(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.com_pos`: centres of mass, inertias and axes of motion about them, up to rounding."""
    tree = tree_of(model)
    if tree is None:
        return mjx.com_pos(model, data)
    weighted = jnp.concatenate([data.xipos, jnp.ones((model.nbody, 1))], -1)
    sums = _masked_sum(tree.above.T, weighted * model.body_mass[:, None])
    mass = sums[:, 3:]
    centre = sums[:, :3] / jnp.maximum(mass, mujoco.mjMINVAL)
    centre = jnp.where(mass < mujoco.mjMINVAL, data.xipos, centre)
    offset = data.xipos - centre[np.asarray(model.body_rootid)]
    data = data.replace(subtree_com=centre, cdof=_axes_of_motion(model, tree, data, centre))
    return data.tree_replace({"_impl.cinert": _inertia(model, data.ximat, offset)})


def _inertia(model: mjx.Model, matrix: jax.Array, offset: jax.Array) -> jax.Array:
    """Inertia [nbody, 10] about points `offset` [nbody, 3] before the centres of mass."""
    mass, moment = model.body_mass, jnp.asarray(model.body_inertia)
    columns = [[matrix[:, i, k] for i in range(3)] for k in range(3)]
    x = [offset[:, i] for i in range(3)]

    def entry(i: int, j: int) -> jax.Array:
        turned = [moment[:, k] * columns[k][i] * columns[k][j] for k in range(3)]
        square = x[0] * x[0] + x[1] * x[1] + x[2] * x[2] if i == j else 0.0
        return turned[0] + turned[1] + turned[2] + mass * (square - x[i] * x[j])

    entries = [entry(i, j) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    return jnp.stack([*entries, *(mass * xi for xi in x), mass], -1)


def _axes_of_motion(model: mjx.Model, tree: Tree, data: mjx.Data, centre: jax.Array) -> jax.Array:
    """Motion [nv, 6] (angular, then linear) of each degree of freedom at its tree's `centre`."""
    joint, body = np.asarray(model.dof_jntid), np.asarray(model.dof_bodyid)
    first = np.arange(model.nv) - np.asarray(model.jnt_dofadr)[joint]
    free = np.asarray(model.jnt_type)[joint] == _FREE
    shifts = (np.asarray(model.jnt_type)[joint] == _SLIDE) | (free & (first < 3))
    # Columns of the body's rotation for a free body's turns, of the world's for its translations.
    own = jnp.swapaxes(data.xmat, 1, 2)[body, first % 3]
    world = np.eye(3, dtype=np.float32)[first % 3]
    axis = jnp.where((free & ~shifts)[:, None], own, data.xaxis[joint])
    axis = jnp.where((free & shifts)[:, None], world, axis)
    offset = centre[np.asarray(model.body_rootid)[body]] - data.xanchor[joint]
    angular = jnp.where(shifts[:, None], 0.0, axis)
    linear = jnp.where(shifts[:, None], axis, _cross(axis, offset))
    return jnp.concatenate([angular, linear], -1)


def accelerations(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.fwd_acceleration`: all forces but the constraints', and what they do, up to rounding."""
    tree = tree_of(model)
    if tree is None or mjx.is_sparse(model):
        return mjx.fwd_acceleration(model, data)
    force, torque = data.xfrc_applied[:, :3], data.xfrc_applied[:, 3:]
    arm = data.xipos - data.subtree_com[np.asarray(model.body_rootid)]
    wrench = jnp.concatenate([torque + _cross(arm, force), force], -1)
    applied = (data.cdof * _masked_sum(tree.moved_by.T, wrench)).sum(-1)
    smooth = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + data.qfrc_applied + applied
    qacc = cho_solve((data._impl.qLD, False), smooth)
    return data.replace(qfrc_smooth=smooth, qacc_smooth=qacc)


def velocities(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.fwd_velocity` for a model without tendons: velocities of bodies, passive and bias forces
    at `data.qvel`, up to rounding."""
    tree = tree_of(model)
    if tree is None:
        return mjx.fwd_velocity(model, data)
    moving = data.cdof * data.qvel[:, None]
    cvel = _masked_sum(tree.moved_by, moving)
    cdof_dot = _motion_cross(_masked_sum(tree.before, moving), data.cdof)
    falls = not model.opt.disableflags & mjx.DisableBit.GRAVITY
    gravity = jnp.concatenate([jnp.zeros(3), -model.opt.gravity * falls])
    acceleration = gravity + _masked_sum(tree.moved_by, cdof_dot * data.qvel[:, None])
    inertia = data._impl.cinert
    force = _inert_mul(inertia, acceleration) + _force_cross(cvel, _inert_mul(inertia, cvel))
    bias = (data.cdof * _masked_sum(tree.moved_by.T, force)).sum(-1)
    data = data.tree_replace(
        {
            "_impl.actuator_velocity": data._impl.actuator_moment @ data.qvel,
            "cvel": cvel,
            "cdof_dot": cdof_dot,
            "qfrc_bias": bias,
        }
    )
    return mjx.passive(model, data)


def _masked_sum(mask: np.ndarray, values: jax.Array) -> jax.Array:
    """[A, C] sums of the rows of `values` [B, C] that a constant mask [A, B] picks."""
    return jnp.matmul(mask, values, precision="highest")


def _cross(first: jax.Array, second: jax.Array) -> jax.Array:
    """Cross product [..., 3], written out like the sums above."""
    x, y, z = (first[..., i] for i in range(3))
    a, b, c = (second[..., i] for i in range(3))
    return jnp.stack([y * c - z * b, z * a - x * c, x * b - y * a], -1)


def _motion_cross(frame: jax.Array, motion: jax.Array) -> jax.Array:
    """Change [..., 6] of a motion [..., 6] (angular, then linear) that a moving frame carries."""
    turn, move = frame[..., :3], frame[..., 3:]
    angular, linear = motion[..., :3], motion[..., 3:]
    change = _cross(move, angular) + _cross(turn, linear)
    return jnp.concatenate([_cross(turn, angular), change], -1)


def _force_cross(frame: jax.Array, force: jax.Array) -> jax.Array:
    """The same of a force [..., 6] (torque, then force)."""
    turn, move = frame[..., :3], frame[..., 3:]
    torque, push = force[..., :3], force[..., 3:]
    change = _cross(turn, torque) + _cross(move, push)
    return jnp.concatenate([change, _cross(turn, push)], -1)


def _inert_mul(inertia: jax.Array, motion: jax.Array) -> jax.Array:
    """Force [..., 6] of a motion [..., 6] of a body's inertia [..., 10] (xx yy zz xy xz yz of the
    matrix, mass times offset, mass)."""
    xx, yy, zz, xy, xz, yz = (inertia[..., i] for i in range(6))
    x, y, z = (motion[..., i] for i in range(3))
    offset, linear = inertia[..., 6:9], motion[..., 3:]
    rows = (xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z)
    torque = jnp.stack(rows, -1) + _cross(offset, linear)
    return jnp.concatenate(
        [torque, inertia[..., 9:] * linear - _cross(offset, motion[..., :3])], -1
    )
