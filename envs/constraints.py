"""Rows of the constraint solver: limits of joints, and contacts.

`mjx.make_constraint` walks the tree of bodies for both bodies of every contact and computes the
impedance of all four edges of a friction pyramid, which are equal. The same rows come here from the
masks of `palm_jax.envs.tree` and one impedance a contact.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from palm_jax.envs import tree

_EDGES = 4  # of a pyramid: friction in two directions


class _Rows(NamedTuple):
    """N constraints of which each stands for one row or more."""

    jacobian: jax.Array  # [N, E, V]
    position: jax.Array  # [N] metres or radians, negative: violated
    inverse_weight: jax.Array  # [N]
    solref: jax.Array  # [N, 2]
    solimp: jax.Array  # [N, 5]
    margin: jax.Array  # [N]


def covers(model: mjx.Model, data: mjx.Data) -> bool:
    """Whether `make_constraint` can take over: only limits of hinges and slides, and contacts that
    slide but do neither twist nor roll."""
    impl = data._impl
    flags = mjx.DisableBit
    plain = not model.opt.disableflags & (flags.CONSTRAINT | flags.LIMIT | flags.REFSAFE)
    pyramids = (
        model.opt.cone == mjx.ConeType.PYRAMIDAL and (np.asarray(impl.contact.dim) == 3).all()
    )
    limits = len(_limited(model)) == impl.nl
    rows = impl.ne == 0 and impl.nf == 0 and tree.tree_of(model) is not None
    return bool(plain and pyramids and limits and rows)


def make_constraint(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.make_constraint`: Jacobian, weights and reference accelerations of all rows."""
    if not covers(model, data):
        return mjx.make_constraint(model, data)
    parts = [_limits(model, data)] if data._impl.nl else []
    parts += [_contacts(model, data)] if len(data._impl.contact.dim) else []
    if not parts:
        return mjx.make_constraint(model, data)
    ready = [_efc(model, data, part) for part in parts]
    return data.tree_replace(
        {name: jnp.concatenate([part[name] for part in ready]) for name in ready[0]}
    )


def _efc(model: mjx.Model, data: mjx.Data, rows: _Rows) -> dict[str, jax.Array]:
    """What MJX keeps of them, by name, [N * E] each."""
    stiffness, damping, impedance = _impedance(model, rows)
    active = rows.position < 0.0
    depth = jnp.where(active, rows.position, 0.0)
    jacobian = jnp.where(active[:, None, None], rows.jacobian, 0.0)
    speed = jnp.matmul(jacobian, data.qvel, precision="highest")
    reference = -damping[:, None] * speed - (stiffness * impedance * depth)[:, None]
    softness = jnp.maximum(rows.inverse_weight * (1.0 - impedance) / impedance, mujoco.mjMINVAL)
    edges = jacobian.shape[1]
    return {
        "_impl.efc_J": jacobian.reshape(-1, jacobian.shape[-1]),
        "_impl.efc_D": jnp.repeat(1.0 / softness, edges),
        "_impl.efc_aref": reference.reshape(-1),
        "_impl.efc_pos": jnp.repeat(depth + rows.margin, edges),
        "_impl.efc_margin": jnp.repeat(rows.margin, edges),
        "_impl.efc_frictionloss": jnp.zeros(reference.size),
    }


def _impedance(model: mjx.Model, rows: _Rows) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Stiffness, damping and impedance [N] (MuJoCo's documentation, "Solver parameters")."""
    low, high = mujoco.mjMINIMP, mujoco.mjMAXIMP
    time, ratio = rows.solref[:, 0], rows.solref[:, 1]
    time_constant = jnp.maximum(time, 2 * model.opt.timestep)
    first, last, width, middle, power = (rows.solimp[:, i] for i in range(5))
    first, last, middle = (jnp.clip(value, low, high) for value in (first, last, middle))
    power = jnp.maximum(1.0, power)
    stiffness = jnp.where(time <= 0.0, -time / last**2, 1.0 / (last * time_constant * ratio) ** 2)
    damping = jnp.where(ratio <= 0.0, -ratio / last, 2.0 / (last * time_constant))
    x = jnp.abs(rows.position) / jnp.maximum(mujoco.mjMINVAL, width)
    rising = middle ** (1.0 - power) * x**power
    settling = 1.0 - (1.0 - middle) ** (1.0 - power) * jnp.maximum(1.0 - x, 0.0) ** power
    shape = jnp.where(x < middle, rising, settling)
    impedance = jnp.clip(
        first + shape * (last - first), jnp.minimum(first, last), jnp.maximum(first, last)
    )
    return stiffness, damping, jnp.where(x > 1.0, last, impedance)


def _limited(model: mjx.Model) -> np.ndarray:
    """Ids of hinges and slides with a range."""
    kinds = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
    turning = np.isin(np.asarray(model.jnt_type), [int(kind) for kind in kinds])
    return np.flatnonzero(turning & np.asarray(model.jnt_limited, bool))


def _limits(model: mjx.Model, data: mjx.Data) -> _Rows:
    joints = _limited(model)
    qpos = data.qpos[np.asarray(model.jnt_qposadr)[joints]]
    dof = np.asarray(model.jnt_dofadr)[joints]
    bounds, margin = model.jnt_range[joints], model.jnt_margin[joints]
    below, above = qpos - bounds[:, 0], bounds[:, 1] - qpos
    direction = jnp.where(below < above, 1.0, -1.0)
    return _Rows(
        jacobian=(direction[:, None] * np.eye(model.nv, dtype=np.float32)[dof])[:, None],
        position=jnp.minimum(below, above) - margin,
        inverse_weight=model.dof_invweight0[dof],
        solref=model.jnt_solref[joints],
        solimp=model.jnt_solimp[joints],
        margin=margin,
    )


def _contacts(model: mjx.Model, data: mjx.Data) -> _Rows:
    contact = data._impl.contact
    body = jnp.asarray(model.geom_bodyid)[contact.geom]
    friction = contact.friction[:, :2]
    normal, first, second = _relative_motion(model, data, body)
    one, two = friction[:, :1] * first, friction[:, 1:] * second
    edges = jnp.stack([normal + one, normal - one, normal + two, normal - two], 1)
    weight = model.body_invweight0[:, 0][body].sum(1)
    squared = friction[:, 0] ** 2
    return _Rows(
        jacobian=edges,
        position=contact.dist - contact.includemargin,
        inverse_weight=2.0 * squared * (1.0 + squared) * weight / model.opt.impratio,
        solref=contact.solref,
        solimp=contact.solimp,
        margin=contact.includemargin,
    )


def _relative_motion(
    model: mjx.Model, data: mjx.Data, body: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """How each degree of freedom moves the second body [C, 2] of a contact against the first, along
    the axes of its frame: three of [C, V]."""
    known = tree.tree_of(model)
    assert known is not None
    moved_by = jnp.asarray(known.moved_by)
    sign = moved_by[body[:, 1]] - moved_by[body[:, 0]]
    root = np.asarray(model.body_rootid)[np.asarray(model.dof_bodyid)]
    # Components apart, dofs last: arrays of three numbers are slow on a CPU.
    contact = data._impl.contact
    x, y, z = (contact.pos[:, i : i + 1] - data.subtree_com[root, i] for i in range(3))
    a, b, c = (data.cdof[:, i] for i in range(3))
    motion = (
        (data.cdof[:, 3] + b * z - c * y) * sign,
        (data.cdof[:, 4] + c * x - a * z) * sign,
        (data.cdof[:, 5] + a * y - b * x) * sign,
    )
    axes = [sum(contact.frame[:, axis, i, None] * motion[i] for i in range(3)) for axis in range(3)]
    return axes[0], axes[1], axes[2]
