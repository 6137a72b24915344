"""The examples: the loop around a policy, with a robot of a few lines; what is seen of failures; a
hand in other colours or of another robot; what is known by heart."""

import dataclasses
import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def loop() -> ModuleType:
    return example("closed_loop")


@pytest.fixture(scope="module")
def failures() -> ModuleType:
    return example("failures")


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


def test_an_object_is_hidden_by_what_stands_on_the_way_to_the_camera(failures: ModuleType) -> None:
    # The camera looks from +x; places at 0, 40, 50, 180 and -40 degrees from that direction.
    angles = np.radians([0, 40, 50, 180, -40])
    objects = np.tile([0.2, 0.1, 0.0], (5, 1))
    places = objects + 0.17 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
    places[:, 2] = 0.5
    cameras = np.tile([1.3, 0.1, 1.6], (5, 1))
    found = failures.hidden(objects, places, cameras)
    assert found.tolist() == [True, True, False, False, True]


def state(heights: list[float], tcp: float, openings: list[float]) -> SimpleNamespace:
    """Worlds with the object (body 1) at these heights and its place (body 2) beside it; the first
    place stands towards the camera."""
    count = len(heights)
    xpos, camera = np.zeros((count, 3, 3)), np.tile(np.eye(4), (count, 1, 1))
    xpos[:, 1, 2] = heights
    xpos[:, 2, 0] = [0.2, *[-0.2] * (count - 1)]
    camera[:, :3, 3] = [2, 0, 1]
    hand = np.full(count, tcp), np.array(openings)
    return SimpleNamespace(data=SimpleNamespace(xpos=xpos), camera_to_world=camera, hand=hand)


def test_episodes_are_counted_by_what_was_seen_of_them(failures: ModuleType) -> None:
    """Three worlds, the third of which only fills the batch; the second's hand never closes."""
    watcher = failures.Watcher(1, 2, lambda state: state.hand)
    watcher(state([0.0, 0.0, 0.0], 0.1, [1.0, 1.0, 1.0]))
    watcher(state([0.05, 0.02, 0.4], 0.058, [0.79, 0.81, 0.0]))
    watcher(state([0.01, 0.0, 0.0], 0.2, [0.5, 0.9, 0.0]))
    found = watcher.outcomes(np.array([False, False]))
    assert found.lifted.tolist() == [True, False] and found.hidden.tolist() == [True, False]
    np.testing.assert_allclose(found.closed_mm, [8.0, np.nan])
    assert failures.lines("in_domain", found) == [
        "in_domain: 0 of 2 solved",
        "object behind its place: 0 of 1 solved",
        "object elsewhere: 0 of 1 solved",
        "failures: 1 never lifted it, 1 did",
        "mm above it when the hand closed, solved: -",
        "mm above it when the hand closed, never lifted: -",
    ]


def test_a_batch_that_begins_again_with_fewer_worlds_is_counted_once(failures: ModuleType) -> None:
    watcher = failures.Watcher(1, 2, lambda state: state.hand)
    watcher(state([0.0, 0.0, 0.0, 0.0], 0.1, [0.5, 0.5, 0.5, 0.5]))
    watcher(state([0.0, 0.0], 0.03, [1.0, 1.0]))
    watcher(state([0.1, 0.0], 0.02, [0.3, 0.3]))
    found = watcher.outcomes(np.array([True, False, True, True]))
    assert found.solved.tolist() == [True, False] and found.lifted.tolist() == [True, False]
    np.testing.assert_allclose(found.closed_mm, [-80.0, 20.0])


def test_a_hand_in_other_colours_keeps_everything_else() -> None:
    """Against the colours and the tree of the model, geom by geom."""
    from palm_jax.envs import make

    repainted = example("repainted")
    env = make("lift_lid", "ur5")
    rgb = np.tile(np.asarray(env.default_params().geom_rgb), (2, 1, 1))
    params = dataclasses.replace(env.default_params(), geom_rgb=rgb)
    light, dark = repainted.hand_colours(make("lift_lid", "panda"))
    np.testing.assert_allclose([light, dark], [[0.93, 0.93, 0.95], [0.22, 0.23, 0.26]], atol=1e-6)
    plain = repainted.repainted(params, env, light)
    tipped = repainted.repainted(params, env, light, dark)
    model, ends = env.mj_model, 0
    for row, geom in enumerate(env.scene_model.geoms):
        body = model.geom(geom).bodyid[0]
        while model.body(body).name not in ("gripper", "world"):
            body = model.body(body).parentid[0]
        own = model.geom(geom).rgba[:3]
        wanted = light if model.body(body).name == "gripper" else own
        np.testing.assert_allclose(plain.geom_rgb[:, row], [wanted, wanted], atol=1e-6)
        end = model.geom(geom).name in [
            f"{side}_finger_{part}" for side in ("left", "right") for part in ("tip", "rubber")
        ]
        ends += end
        wanted = dark if end else wanted
        np.testing.assert_allclose(tipped.geom_rgb[:, row], [wanted, wanted], atol=1e-6)
    assert ends == 4
    same = dataclasses.replace(tipped, geom_rgb=rgb)
    jax.tree.map(np.testing.assert_array_equal, same, params)


@pytest.mark.parametrize("arm", [False, True])
def test_a_borrowed_hand_is_at_the_tcp_and_as_wide_as_the_own(arm: bool) -> None:
    """Against C MuJoCo's kinematics of both robots, each relative to its own TCP."""
    from palm_jax.envs import make

    own, lender = make("lift_lid", "ur5"), make("lift_lid", "panda")
    data, tcp = posed(own, finger=0.015)
    lent, lent_tcp = posed(lender, finger=0.015)
    looks = example("borrowed").looking_like(own, lender, arm=arm).scene_model
    params = own.default_params()
    scene = jax.jit(looks)(data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3), params)

    model = lender.scene_model
    drawn = np.flatnonzero(model.robot if arm else model.hand)
    assert len(scene.types) == len(own.scene_model.geoms) + len(drawn)
    moved = tcp @ np.linalg.inv(lent_tcp)
    for row, index in enumerate(drawn, len(own.scene_model.geoms)):
        # An arm of another kind has another elbow: only its hand is where the other's is.
        if model.hand[index]:
            geom = int(model.geoms[index])
            position = (moved @ np.append(lent.geom_xpos[geom], 1.0))[:3]
            rotation = moved[:3, :3] @ lent.geom_xmat[geom].reshape(3, 3)
            np.testing.assert_allclose(scene.pos[row], position, atol=1e-3)
            np.testing.assert_allclose(scene.mat[row], rotation, atol=5e-3)
            np.testing.assert_allclose(scene.rgb[row], lender.mj_model.geom(geom).rgba[:3])
            assert scene.visible[row] and scene.ids[row] in own.scene_model.handled

    before = own.scene_model(data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3), params)
    gone = own.scene_model.robot if arm else own.scene_model.hand
    rest = np.asarray(scene.visible)[: len(gone)]
    np.testing.assert_array_equal(rest, np.asarray(before.visible) & ~gone)


def posed(env: Any, *, finger: float) -> tuple[Any, np.ndarray]:
    """C MuJoCo's data of a robot at home with its fingers somewhere, and the TCP [4, 4]."""
    data = mujoco.MjData(env.mj_model)
    for joint, value in zip(env.robot.arm_joints, env.robot.home, strict=True):
        data.joint(joint).qpos[0] = value
    for joint in env.robot.gripper_joints:
        data.joint(joint).qpos[0] = finger
    mujoco.mj_kinematics(env.mj_model, data)
    tcp = np.eye(4)
    tcp[:3, :3], tcp[:3, 3] = data.site("tcp").xmat.reshape(3, 3), data.site("tcp").xpos
    return data, tcp


def test_what_a_policy_foretells_is_told_axis_by_axis() -> None:
    found = {
        "frames": 7,
        "r2": {"x": 0.716, "y": None, "z": 0.999},
        "translation_mm": {"median_error": 1.26, "standing_still": 5.0},
    }
    assert example("memorised").line("new ones", found) == (
        "new ones: 7 frames; share of variance explained: x 0.72, y -, z 1.00; "
        "off by 1.3 mm of 5.0 (medians)"
    )
