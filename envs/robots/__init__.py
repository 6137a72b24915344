"""One table of robots. Adding one is one MJCF in `assets/robots/` and one row here."""

from palm_jax.envs.robots.base import Robot
from palm_jax.envs.robots.panda import PANDA
from palm_jax.envs.robots.ur5 import UR5
from palm_jax.envs.robots.xarm7 import XARM7

ROBOTS: dict[str, Robot] = {robot.name: robot for robot in (PANDA, UR5, XARM7)}

__all__ = ["ROBOTS", "Robot"]
