"""One table of tasks. Adding one: an MJCF in `assets/tasks/`, a file here, a row below."""

from palm_jax.envs.tasks.base import TABLE_HEIGHT, WORKSPACE_CENTRE, Stage, Task
from palm_jax.envs.tasks.insert_peg import INSERT_PEG
from palm_jax.envs.tasks.lift_lid import LIFT_LID
from palm_jax.envs.tasks.lift_spam import LIFT_SPAM, LIFT_SPAM_INVISIBLE
from palm_jax.envs.tasks.rearrange_veggies import REARRANGE_VEGGIES

TASKS: dict[str, Task] = {
    task.name: task
    for task in (LIFT_LID, LIFT_SPAM, LIFT_SPAM_INVISIBLE, INSERT_PEG, REARRANGE_VEGGIES)
}

__all__ = ["TABLE_HEIGHT", "TASKS", "WORKSPACE_CENTRE", "Stage", "Task"]
