"""MJX stepping that is fast on CPUs and on accelerators.

Two facts of XLA's CPU backend shape this file (figures in docs/performance.md):

* its default fusion emitters make MJX hundreds of times slower, so physics is compiled with
  `compiler_options()` of its own; the renderer and the networks want the default, so they live in
  other jits (`jit_physics` is for physics alone);
* inside `lax.scan`, fusions recompute kinematics across MJX's stages unless an optimisation
  barrier stands between them.

And one of jaxlib's LAPACK calls, which wait inside the thread pool that they hand their work to:
as many of them at a time as there are threads wait for ever (`_after_the_solver`).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from mujoco import mjx

MAX_CPU_WORLDS = 128
"""Larger batches are no faster on CPUs and take more memory: run them in chunks of at most this."""


def compiler_options() -> dict[str, Any] | None:
    """Options for `jax.jit` of anything that steps MJX on the default backend."""
    if jax.default_backend() == "cpu":
        return {"xla_cpu_use_fusion_emitters": False}
    return None


def jit_physics(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`jax.jit` with the compiler options that MJX needs."""
    return jax.jit(function, compiler_options=compiler_options(), **options)


def _after_the_solver(data: mjx.Data) -> mjx.Data:
    """`data` with an inertia matrix that cannot be factorised before the solver has ended.

    `mjx.implicit` factorises the mass matrix, the solver factorises its Hessian, and neither needs
    the other: XLA runs both at once. With two threads and a batch that LAPACK divides among threads
    (128 worlds of 21 degrees of freedom) each then holds one thread and waits for the other. The
    zero, which XLA does not fold (it may be NaN), puts them in order; barriers do not, as they are
    gone when thunks are scheduled.
    """
    zero = 0.0 * jnp.sum(data.qacc)
    return data.tree_replace({"_impl.M": data._impl.M + zero})


_STAGES: tuple[Callable[[mjx.Model, mjx.Data], mjx.Data], ...] = (
    mjx.kinematics,
    mjx.com_pos,
    mjx.crb,
    mjx.factor_m,
    mjx.collision,
    mjx.make_constraint,
    mjx.transmission,
    mjx.fwd_velocity,
    mjx.fwd_actuation,
    mjx.fwd_acceleration,
    mjx.solve,
    lambda _, data: _after_the_solver(data),
    mjx.implicit,
)


def step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """One physics step: `mjx.step` for a model without tendons, sensors or moving cameras."""
    for stage in _STAGES:
        data = jax.lax.optimization_barrier(stage(model, data))
    return data


def substeps(model: mjx.Model, data: mjx.Data, count: int) -> mjx.Data:
    """`count` physics steps with constant controls, then kinematics at the final `qpos`.

    MuJoCo's step leaves body poses one step behind `qpos`; the final kinematics make what is
    rendered and observed agree with the stored state.
    """
    data, _ = jax.lax.scan(lambda d, _: (step(model, d), None), data, None, length=count)
    return mjx.kinematics(model, data)


def in_contact(data: mjx.Data, first: int, second: int) -> jax.Array:
    """Whether two geoms (ids) touch: bool []."""
    contact = data._impl.contact
    ids = jnp.asarray(contact.geom)
    pair = ((ids[:, 0] == first) & (ids[:, 1] == second)) | (
        (ids[:, 0] == second) & (ids[:, 1] == first)
    )
    return jnp.any(pair & (contact.dist < 0.0))
