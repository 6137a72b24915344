"""Environments by name."""

from palm_jax.envs.base import Env
from palm_jax.envs.robots import ROBOTS
from palm_jax.envs.tasks import TASKS


def make(task: str, robot: str = "panda") -> Env:
    """The environment of a task on a robot.

    Raises:
      ValueError: an unknown name; the message lists the known ones.
    """
    if task not in TASKS:
        raise ValueError(f"unknown task {task!r}; known: {', '.join(TASKS)}")
    if robot not in ROBOTS:
        raise ValueError(f"unknown robot {robot!r}; known: {', '.join(ROBOTS)}")
    return Env(TASKS[task], ROBOTS[robot])


__all__ = ["ROBOTS", "TASKS", "make"]
