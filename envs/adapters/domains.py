"""Domains as the adapters need them: one robot, and a scene for every episode."""

import jax
import numpy as np

from palm_jax.envs import shifts
from palm_jax.envs.params import EnvParams, take_params


def check_domain(domain: str) -> None:
    """Raises ValueError for a domain that does not exist, or that is on another robot."""
    if shifts.other_robot(domain):
        rest = [name for name in shifts.parts(domain) if name != shifts.EMBODIMENT]
        raise ValueError(
            f"domain {domain!r} is on another robot, which is another environment: pass its name "
            f"as robot=, and the domain {'+'.join(rest) or shifts.IN_DOMAIN!r}"
        )


def scene(key: jax.Array, params: EnvParams, domain: str) -> EnvParams:
    """One world's params for one episode: a place of its own on each of the domain's axes."""
    return take_params(shifts.scenes(key, params, domain, 1), np.asarray(0))
