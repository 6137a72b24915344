"""Distribution shifts: pure functions `EnvParams -> EnvParams`, and the domains made of them.

A shift widens what an episode is drawn from; `strength` scales it (1 is the paper's, 0 none).
Sweeps that want one fixed value set equal bounds instead (`at_camera_angle`, `at_object`).
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.envs.base import EnvParams

TEST_LOW, TEST_HIGH = np.array([0.05, -0.35]), np.array([0.45, 0.35])
"""Corners of the test region: x and y of the target object in metres."""

MAX_CAMERA_ANGLE = float(np.radians(30.0))
"""Largest turn of the camera about the workspace's vertical, as in the paper."""


def workspace(params: EnvParams, *, strength: float = 1.0) -> EnvParams:
    """The target anywhere in the test region: seven times the training region's area."""
    low = params.object_low + strength * (TEST_LOW - params.object_low)
    high = params.object_high + strength * (TEST_HIGH - params.object_high)
    return dataclasses.replace(params, object_low=low, object_high=high)


def viewpoint(params: EnvParams, *, strength: float = 1.0) -> EnvParams:
    """The camera turned by up to 30 degrees either way about the workspace centre."""
    bound = jnp.asarray(strength * MAX_CAMERA_ANGLE, jnp.float32)
    return dataclasses.replace(params, camera_angle=jnp.stack([-bound, bound]))


def aligned_hand(params: EnvParams) -> EnvParams:
    """The hand's initial yaw turns with the camera, as the authors' code does for PALM policies."""
    return dataclasses.replace(params, align_hand=jnp.ones_like(params.align_hand))


def at_camera_angle(params: EnvParams, angle: jax.Array) -> EnvParams:
    """The camera turned by exactly `angle` [] radians."""
    return dataclasses.replace(params, camera_angle=jnp.stack([angle, angle]))


def at_object(params: EnvParams, xy: jax.Array) -> EnvParams:
    """The target at exactly `xy` [2] metres."""
    return dataclasses.replace(params, object_low=xy, object_high=xy)


SHIFTS: dict[str, Callable[..., EnvParams]] = {"workspace": workspace, "viewpoint": viewpoint}
"""Every shift by name."""


def lighting(params: EnvParams, *, strength: float = 1.0) -> EnvParams:
    """Brighter (1) or darker (-1) lights."""
    return dataclasses.replace(
        params, light_diffuse=params.light_diffuse * (1 + 0.5 * jnp.asarray(strength))
    )


AXES: dict[str, Callable[..., EnvParams]] = {"lighting": lighting}
"""Shifts along one axis, strength -1..1."""

EMBODIMENT = "embodiment"
"""The shift that is no function of `EnvParams`: the same task on another robot, another `Env`."""

DOMAINS: tuple[str, ...] = (
    "in_domain",
    "workspace",
    "viewpoint",
    "embodiment",
    "workspace+viewpoint",
    "workspace+embodiment",
    "viewpoint+embodiment",
    "workspace+viewpoint+embodiment",
)
"""The evaluation domains: in-domain, and every product of the three shifts."""


def strength_range(name: str) -> tuple[float, float]:
    """Strengths (low, high) that the shift or axis `name` takes."""
    return (0.0 if name in SHIFTS else -1.0), 1.0


def parts(domain: str) -> tuple[str, ...]:
    """The shifts that a domain is made of; none for `in_domain`.

    Raises:
      ValueError: an unknown shift, or one that is named twice.
    """
    if domain == "in_domain":
        return ()
    names = tuple(domain.split("+"))
    for name in names:
        if name not in SHIFTS and name not in AXES and name != EMBODIMENT:
            known = ", ".join(("in_domain", *SHIFTS, *AXES, EMBODIMENT))
            raise ValueError(f"unknown shift {name!r} in domain {domain!r}; known: {known}")
    if len(set(names)) < len(names):
        raise ValueError(f"domain {domain!r} names a shift twice")
    return names


def other_robot(domain: str) -> bool:
    """Whether a domain is played by another robot than the one of the demonstrations."""
    return EMBODIMENT in parts(domain)


def shifted(params: EnvParams, domain: str, *, strength: float = 1.0) -> EnvParams:
    """`params` under a domain, see `parts`; `embodiment` changes nothing here."""
    for name in parts(domain):
        if name != EMBODIMENT:
            params = (SHIFTS | AXES)[name](params, strength=strength)
    return params


def scenes(
    key: jax.Array, params: EnvParams, domain: str, count: int, *, strength: float = 1.0
) -> EnvParams:
    """Params of `count` scenes of a domain, leading axis [count]."""

    def one(index: jax.Array) -> EnvParams:
        here = params
        for number, name in enumerate(parts(domain)):
            draw = jax.random.fold_in(jax.random.fold_in(key, index), number)
            if name in AXES:
                drawn = strength * jax.random.uniform(draw, (), minval=-1.0, maxval=1.0)
                here = AXES[name](here, strength=drawn)
            elif name != EMBODIMENT:
                here = SHIFTS[name](here, strength=strength)
        return here

    return jax.vmap(one)(jnp.arange(count))
