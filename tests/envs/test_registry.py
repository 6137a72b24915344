"""Environments by name."""

import pytest

from palm_jax.envs import ROBOTS, TASKS, make


def test_make_knows_every_task_and_robot() -> None:
    for task in TASKS:
        for robot in ROBOTS:
            env = make(task, robot=robot)
            assert (env.task.name, env.robot.name) == (task, robot)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("lift_ship",), r"unknown task 'lift_ship'; known: .*lift_lid.*lift_spam"),
        (("lift_lid", "pandas"), r"unknown robot 'pandas'; known: .*panda"),
    ],
)
def test_unknown_names_list_the_known_ones(arguments: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(*arguments)
