"""The examples: the loop around a policy, with a robot of a few lines."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture(scope="module")
def loop() -> ModuleType:
    spec = importlib.util.spec_from_file_location("closed_loop", EXAMPLES / "closed_loop.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Lift:
    """A robot whose hand is to be lifted to 0.35 m; where it is told to go it is at once."""

    def __init__(self) -> None:
        self.tcp, self.commands = np.eye(4), []

    def calibration(self) -> tuple[np.ndarray, np.ndarray]:
        return 2 * np.eye(3), 3 * np.eye(4)

    def sense(self) -> tuple[np.ndarray, np.ndarray, float]:
        return np.full((2, 2, 3), len(self.commands), np.uint8), self.tcp, 0.5

    def move(self, target: np.ndarray, gripper: float) -> bool:
        self.tcp = target
        self.commands.append(gripper)
        return bool(target[2, 3] > 0.35)


def test_the_loop_goes_on_until_the_robot_says_so(loop: ModuleType) -> None:
    seen: list[Any] = []

    def act(image: Any, K: Any, cam_to_world: Any, tcp: Any, opening: Any) -> tuple[Any, float]:
        seen.append((int(image[0, 0, 0]), K[0, 0], cam_to_world[0, 0], opening))
        target = tcp.copy()
        target[2, 3] += 0.1
        return target, 1.0

    robot = Lift()
    assert loop.drive(act, robot, 10) == 4
    assert robot.commands == [1.0] * 4
    assert seen == [(step, 2, 3, 0.5) for step in range(4)]
    assert loop.drive(act, Lift(), 2) == 2


def test_what_a_policy_refuses_ends_the_loop(loop: ModuleType) -> None:
    def act(*observation: Any) -> tuple[Any, float]:
        raise ValueError("tcp: expected the TCP inside the image")

    robot = Lift()
    with pytest.raises(ValueError, match="inside the image"):
        loop.drive(act, robot, 10)
    assert robot.commands == []


def test_the_robots_side_needs_no_jax(loop: ModuleType) -> None:
    """Importing the loop loads nothing heavy: the simulator does, once it is asked for."""
    source = (EXAMPLES / "closed_loop.py").read_text()
    top = [line for line in source.splitlines() if line.startswith(("import ", "from "))]
    assert not [line for line in top if "jax" in line]
    assert "closed_loop" not in sys.modules
