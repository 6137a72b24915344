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

DOMAINS: tuple[str, ...] = ("in_domain", "workspace", "viewpoint", "workspace+viewpoint")
"""The evaluation domains: in-domain, each shift, and their product."""


def shifted(params: EnvParams, domain: str, *, strength: float = 1.0) -> EnvParams:
    """`params` under a domain: `in_domain`, or names of `SHIFTS` joined by `+`.

    Raises:
      ValueError: an unknown shift; the message lists the known ones.
    """
    if domain == "in_domain":
        return params
    for name in domain.split("+"):
        if name not in SHIFTS:
            known = ", ".join(("in_domain", *SHIFTS))
            raise ValueError(f"unknown shift {name!r} in domain {domain!r}; known: {known}")
        params = SHIFTS[name](params, strength=strength)
    return params
