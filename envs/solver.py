"""The forces of contacts and joint limits: MuJoCo's Newton solver, for many worlds at a time.

The accelerations minimise a convex, piecewise quadratic cost (MuJoCo's documentation,
"Computation: constraint model"):

    1/2 (x - smooth)' M (x - smooth) + 1/2 sum_i D_i min(J_i x - aref_i, 0)^2

`mjx.solve` does the same. Under `vmap` its line search takes every iteration that it may, with
three points each, and a world stops only when its cost no longer falls, which rounding in float32
keeps it from noticing. This one stops where the minimum is exact: a full Newton step after which
the same rows are active as before it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from mujoco import mjx

_SEARCH_STEPS = 6  # of a line search, at most one for each kink that it has to find


def covers(model: mjx.Model, data: mjx.Data) -> bool:
    """Whether `solve` can take over: pyramidal cones, no equalities, no dry friction in joints."""
    warm = not model.opt.disableflags & mjx.DisableBit.WARMSTART
    newton = model.opt.solver == mjx.SolverType.NEWTON
    pyramids = model.opt.cone == mjx.ConeType.PYRAMIDAL
    rows = data._impl.ne == 0 and data._impl.nf == 0
    return bool(warm and newton and pyramids and rows and not mjx.is_sparse(model))


class _Rows(NamedTuple):
    """What the cost is made of."""

    jacobian: jax.Array  # [E, V]
    weight: jax.Array  # [E]
    reference: jax.Array  # [E]
    inertia: jax.Array  # [V, V]
    smooth: jax.Array  # [V]


class _Point(NamedTuple):
    """Where a world's solver is."""

    qacc: jax.Array  # [V]
    momentum: jax.Array  # [V] inertia @ (qacc - smooth)
    excess: jax.Array  # [E] jacobian @ qacc - reference: negative where a row pushes
    steps: jax.Array  # int32 []
    done: jax.Array  # bool []


def solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.solve`: `qacc`, `qfrc_constraint` and `efc_force` from the constraints in `data`."""
    if not covers(model, data):
        return mjx.solve(model, data)
    impl = data._impl
    rows = _Rows(impl.efc_J, impl.efc_D, impl.efc_aref, impl.M, data.qacc_smooth)
    scale = 1.0 / jnp.trace(rows.inertia)
    tolerance = model.opt.tolerance

    def improve(point: _Point) -> _Point:
        return _newton(rows, point, scale, tolerance)

    cold, warm = _start(rows, data.qacc_smooth), _start(rows, data.qacc_warmstart)
    better = _cost(rows, warm) < _cost(rows, cold)
    start = jax.tree.map(lambda w, c: jnp.where(better, w, c), warm, cold)
    end = jax.lax.while_loop(
        lambda point: ~point.done & (point.steps < model.opt.iterations), improve, start
    )
    force = -rows.weight * jnp.minimum(end.excess, 0.0)
    return data.tree_replace(
        {
            "qacc": end.qacc,
            "qfrc_constraint": _dot(force, rows.jacobian),
            "_impl.efc_force": force,
        }
    )


def _dot(first: jax.Array, second: jax.Array) -> jax.Array:
    return jnp.matmul(first, second, precision="highest")


def _start(rows: _Rows, qacc: jax.Array) -> _Point:
    momentum = _dot(rows.inertia, qacc - rows.smooth)
    excess = _dot(rows.jacobian, qacc) - rows.reference
    return _Point(qacc, momentum, excess, jnp.zeros((), jnp.int32), jnp.zeros((), bool))


def _cost(rows: _Rows, point: _Point) -> jax.Array:
    pushed = jnp.minimum(point.excess, 0.0)
    kinetic = jnp.sum(point.momentum * (point.qacc - rows.smooth))
    return 0.5 * (kinetic + jnp.sum(rows.weight * pushed * pushed))


def _newton(rows: _Rows, point: _Point, scale: jax.Array, tolerance: jax.Array) -> _Point:
    """One step: towards the minimum that the cost would have if the active rows stayed the same."""
    active = point.excess < 0.0
    weight = jnp.where(active, rows.weight, 0.0)
    gradient = point.momentum + _dot(weight * point.excess, rows.jacobian)
    hessian = rows.inertia + _dot((rows.jacobian * weight[:, None]).T, rows.jacobian)
    # Only the lower triangle is read: no need to make rounding symmetric.
    factor = jax.lax.linalg.cholesky(hessian, symmetrize_input=False)
    search = -cho_solve((factor, True), gradient)
    along, inertial = _dot(rows.jacobian, search), _dot(rows.inertia, search)
    slope, curvature = jnp.sum(search * point.momentum), jnp.sum(search * inertial)
    exact = jnp.all((point.excess + along < 0.0) == active)
    length = _line_search(rows.weight, point.excess, along, slope, curvature)
    length = jnp.where(exact, 1.0, length)
    decrement = -0.5 * jnp.sum(search * gradient) * scale
    return _Point(
        qacc=point.qacc + length * search,
        momentum=point.momentum + length * inertial,
        excess=point.excess + length * along,
        steps=point.steps + 1,
        done=exact | (decrement < tolerance),
    )


def _line_search(
    weight: jax.Array, excess: jax.Array, along: jax.Array, slope: jax.Array, curvature: jax.Array
) -> jax.Array:
    """Length [] at which the derivative of the cost along the search direction vanishes.

    The derivative rises, and is linear between the points where a row becomes active or ceases to
    be: Newton's method, kept between the last points on either side of the root.
    """

    def derivatives(length: jax.Array) -> tuple[jax.Array, jax.Array]:
        moved = excess + length * along
        pull = jnp.where(moved < 0.0, weight * along, 0.0)
        return slope + length * curvature + jnp.sum(pull * moved), curvature + jnp.sum(pull * along)

    def improve(
        _: int, bracket: tuple[jax.Array, jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        low, high, length = bracket
        first, second = derivatives(length)
        low, high = jnp.where(first < 0.0, length, low), jnp.where(first < 0.0, high, length)
        new = length - first / second
        middle = jnp.where(jnp.isinf(high), new, 0.5 * (low + high))
        return low, high, jnp.where((new >= low) & (new <= high), new, middle)

    start = (jnp.zeros(()), jnp.full((), jnp.inf), jnp.ones(()))
    return jax.lax.fori_loop(0, _SEARCH_STEPS, improve, start)[2]
