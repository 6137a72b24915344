"""MJX stepping that is fast on CPUs and on accelerators.

XLA's default fusion emitters for CPUs make MJX hundreds of times slower (figures in
docs/performance.md), so physics is compiled with `compiler_options()` of its own; the renderer and
the networks want the default, so they live in other jits (`jit_physics` is for physics alone).

jaxlib's batched LAPACK calls wait inside the thread pool that they hand their work to: as many of
them at a time as there are threads wait for ever (`_after_the_solver`).
"""

import functools
import gc
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from mujoco import mjx

from palm_jax.envs import constraints, solver, tree

MAX_CPU_WORLDS = 128
"""Larger batches are no faster on CPUs and take more memory: run them in chunks of at most this."""


def compiler_options() -> dict[str, Any] | None:
    """Options for `jax.jit` of anything that steps MJX on the default backend."""
    if jax.default_backend() == "cpu":
        return {"xla_cpu_use_fusion_emitters": False}
    return None


def jit_physics(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`jax.jit` with the compiler options that MJX needs, for a function that is long to trace."""
    return jax.jit(traced_quickly(function), compiler_options=compiler_options(), **options)


def traced_quickly(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, which Python runs when it is traced only, without garbage collection meanwhile.

    Tracing MJX makes objects by the million that all stay alive, and the collector walks through
    them again and again: a quarter of the time.
    """

    @functools.wraps(function)
    def run(*arguments: Any, **options: Any) -> Any:
        enabled = gc.isenabled()
        gc.disable()
        try:
            return function(*arguments, **options)
        finally:
            if enabled:
                gc.enable()

    return run


def _after_the_solver(data: mjx.Data) -> mjx.Data:
    """`data` with an inertia matrix that cannot be factorised before the solver has ended.

    `mjx.implicit` factorises the mass matrix, the solver factorises its Hessian, and neither needs
    the other: XLA runs both at once. With two threads and a batch that LAPACK divides among threads
    (128 worlds of 21 degrees of freedom) each then holds one thread and waits for the other. The
    zero, which XLA does not fold (it may be NaN), puts them in order; optimisation barriers do not,
    as XLA drops them for CPUs.
    """
    zero = 0.0 * jnp.sum(data.qacc)
    return data.tree_replace({"_impl.M": data._impl.M + zero})


_STAGES: tuple[Callable[[mjx.Model, mjx.Data], mjx.Data], ...] = (
    tree.kinematics,
    tree.com_pos,
    mjx.crb,
    mjx.factor_m,
    mjx.collision,
    constraints.make_constraint,
    mjx.transmission,
    tree.velocities,
    mjx.fwd_actuation,
    tree.accelerations,
    solver.solve,
    lambda _, data: _after_the_solver(data),
    mjx.implicit,
)


def forward(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.forward` for such a model: everything that follows from the state, up to `qacc`."""
    for stage in _STAGES[:-2]:
        data = stage(model, data)
    return data


def step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """One physics step: `mjx.step` for a model without tendons, sensors or moving cameras."""
    for stage in _STAGES:
        data = stage(model, data)
    return data


def substeps(model: mjx.Model, data: mjx.Data, count: int) -> mjx.Data:
    """`count` physics steps with constant controls, then kinematics at the final `qpos`.

    MuJoCo's step leaves body poses one step behind `qpos`; the final kinematics make what is
    rendered and observed agree with the stored state.
    """
    data, _ = jax.lax.scan(lambda d, _: (step(model, d), None), data, None, length=count)
    return tree.kinematics(model, data)


def in_contact(data: mjx.Data, first: int, second: int) -> jax.Array:
    """Whether two geoms (ids) touch: bool []."""
    contact = data._impl.contact
    ids = jnp.asarray(contact.geom)
    pair = ((ids[:, 0] == first) & (ids[:, 1] == second)) | (
        (ids[:, 0] == second) & (ids[:, 1] == first)
    )
    return jnp.any(pair & (contact.dist < 0.0))
