"""A trained policy that moves a robot: `load(RUN)`, then `act` on the robot's own camera images.

See `palm_jax.train.policy`, whose names these are, and docs/deploy.md.
"""

from palm_jax.train.policy import (
    CalibrationError,
    Contract,
    Decision,
    Latency,
    NonFiniteActionError,
    OutsideTrainingError,
    Policy,
    PolicyError,
    load,
)

__all__ = [
    "CalibrationError",
    "Contract",
    "Decision",
    "Latency",
    "NonFiniteActionError",
    "OutsideTrainingError",
    "Policy",
    "PolicyError",
    "load",
]
