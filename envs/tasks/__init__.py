"""One table of tasks. Adding one: an MJCF in `assets/tasks/`, a file here, a row below."""

from palm_jax.envs.tasks.base import TABLE_HEIGHT, WORKSPACE_CENTRE, Task
from palm_jax.envs.tasks.lift_lid import LIFT_LID
from palm_jax.envs.tasks.lift_spam import LIFT_SPAM

TASKS: dict[str, Task] = {task.name: task for task in (LIFT_LID, LIFT_SPAM)}

__all__ = ["TABLE_HEIGHT", "TASKS", "WORKSPACE_CENTRE", "Task"]
