"""The arms: golden poses, C MuJoCo's kinematics, and how well commanded deltas are reached."""

import json

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import worlds
from oracles import GOLDEN, pose

from palm_jax.envs import ROBOTS, control, make
from palm_jax.envs.base import Env

TABLE = 0.752
TCP_DISTANCE = {"panda": 0.1034, "ur5": 0.145, "xarm7": 0.163}
"""From the flange to the TCP, metres."""


@pytest.fixture(scope="module", params=ROBOTS)
def env(request: pytest.FixtureRequest) -> Env:
    return make("lift_spam", request.param)


@pytest.fixture(scope="module")
def joints(env: Env) -> np.ndarray:
    """[32, J] joint positions inside the limits."""
    low, high = env.chain.limits.T
    return np.random.default_rng(0).uniform(low, high, (32, len(low))).astype(np.float32)


def with_arm(env: Env, q: np.ndarray) -> mujoco.MjData:
    data = mujoco.MjData(env.mj_model)
    for name, value in zip(env.robot.arm_joints, q, strict=True):
        data.joint(name).qpos[0] = value
    mujoco.mj_kinematics(env.mj_model, data)
    mujoco.mj_comPos(env.mj_model, data)
    return data


def body_pose(data: mujoco.MjData, name: str) -> np.ndarray:
    return pose(data.body(name).xmat.reshape(3, 3), data.body(name).xpos)


def site_pose(data: mujoco.MjData, name: str) -> np.ndarray:
    return pose(data.site(name).xmat.reshape(3, 3), data.site(name).xpos)


def golden(robot: str) -> list[dict]:
    return json.loads((GOLDEN / "fk.json").read_text())[robot]


@pytest.mark.parametrize("env", ["panda"], indirect=True)
@pytest.mark.parametrize("row", golden("panda"))
def test_panda_matches_an_independent_urdf(env: Env, row: dict) -> None:
    """Last link, flange and TCP: 0.107 m along z, a turn of -45 degrees, 0.1034 m further."""
    # The golden angles lie a little beyond the limits in places; kinematics know none.
    data = with_arm(env, np.array(row["q"]))
    base = body_pose(data, "robot_base")
    link = pose(np.array(row["rot"]), np.array(row["pos"]))
    np.testing.assert_allclose(np.linalg.inv(base) @ body_pose(data, "link7"), link, atol=2e-6)
    flange = link @ pose(np.eye(3), np.array([0, 0, 0.107]))
    cos = np.sqrt(0.5)
    hand = pose(np.array([[cos, cos, 0], [-cos, cos, 0], [0, 0, 1]]), np.zeros(3))
    tcp = flange @ hand @ pose(np.eye(3), np.array([0, 0, 0.1034]))
    np.testing.assert_allclose(np.linalg.inv(base) @ site_pose(data, "flange"), flange, atol=2e-6)
    np.testing.assert_allclose(np.linalg.inv(base) @ site_pose(data, "tcp"), tcp, atol=2e-6)
    ours = control.forward_kinematics(env.chain, jnp.array(row["q"], jnp.float32)).tcp
    np.testing.assert_allclose(ours, base @ tcp, atol=5e-6)


@pytest.mark.parametrize("env", ["ur5"], indirect=True)
@pytest.mark.parametrize("row", golden("ur5"))
def test_ur5_matches_an_independent_urdf(env: Env, row: dict) -> None:
    """Last link and flange: 0.0823 m along the link's y, which is the flange's z.

    The TCP is 0.145 m further, the hand turned by -90 degrees about z.
    """
    data = with_arm(env, np.array(row["q"]))
    base = body_pose(data, "robot_base")
    link = pose(np.array(row["rot"]), np.array(row["pos"]))
    to_flange = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    flange = link @ pose(to_flange, np.array([0, 0.0823, 0]))
    tcp = flange @ pose(np.array([[0, 1.0, 0], [-1, 0, 0], [0, 0, 1]]), np.array([0, 0, 0.145]))
    # Our link frame has the joint's axis as its z.
    ours = np.linalg.inv(base) @ body_pose(data, "wrist_3_link")
    np.testing.assert_allclose(ours, link @ pose(to_flange, np.zeros(3)), atol=2e-6)
    np.testing.assert_allclose(np.linalg.inv(base) @ site_pose(data, "flange"), flange, atol=2e-6)
    np.testing.assert_allclose(np.linalg.inv(base) @ site_pose(data, "tcp"), tcp, atol=2e-6)
    chain = control.forward_kinematics(env.chain, jnp.array(row["q"], jnp.float32)).tcp
    np.testing.assert_allclose(chain, base @ tcp, atol=5e-6)


XARM7_TABLE = (
    (0.0, 0.0, 0.267),
    (0.0, -90.0, 0.0),
    (0.0, 90.0, 0.293),
    (0.0525, 90.0, 0.0),
    (0.0775, 90.0, 0.3425),
    (0.0, 90.0, 0.0),
    (0.076, -90.0, 0.097),
)
"""The maker's modified Denavit-Hartenberg table: a (m), alpha (degrees), d (m) of each joint."""


def from_table(rows: tuple[tuple[float, float, float], ...], q: np.ndarray) -> np.ndarray:
    """The last frame [4, 4] in the base's, after Craig: Rx(alpha) Tx(a) Rz(q) Tz(d) a joint."""
    frame = np.eye(4)
    for (a, alpha, d), angle in zip(rows, q, strict=True):
        ca, sa = np.cos(np.radians(alpha)), np.sin(np.radians(alpha))
        c, s = np.cos(angle), np.sin(angle)
        frame = frame @ np.array(
            [
                [c, -s, 0, a],
                [s * ca, c * ca, -sa, -d * sa],
                [s * sa, c * sa, ca, d * ca],
                [0, 0, 0, 1],
            ]
        )
    return frame


@pytest.mark.parametrize("env", ["xarm7"], indirect=True)
def test_xarm7_matches_the_makers_table(env: Env) -> None:
    """The flange is the last joint's frame; the hand sits on it unturned, the TCP 0.163 m ahead."""
    poses = np.random.default_rng(3).uniform(-np.pi, np.pi, (64, 7))
    forward = jax.jit(jax.vmap(lambda q: control.forward_kinematics(env.chain, q).tcp))
    for q, chain in zip(poses, forward(poses.astype(np.float32)), strict=True):
        data = with_arm(env, q)
        base, flange = body_pose(data, "robot_base"), from_table(XARM7_TABLE, q)
        tcp = flange @ pose(np.eye(3), np.array([0, 0, 0.163]))
        ours = np.linalg.inv(base) @ site_pose(data, "flange")
        np.testing.assert_allclose(ours, flange, atol=1e-9)
        np.testing.assert_allclose(chain, base @ tcp, atol=5e-6)


def test_kinematics_and_jacobian_are_mujocos(env: Env, joints: np.ndarray) -> None:
    forward = jax.jit(jax.vmap(lambda q: control.forward_kinematics(env.chain, q)))
    ours = forward(joints)
    site, arm = env.mj_model.site("tcp").id, len(env.robot.arm_joints)
    for i, q in enumerate(joints):
        data = with_arm(env, q)
        linear, angular = np.zeros((2, 3, env.mj_model.nv))
        mujoco.mj_jacSite(env.mj_model, data, linear, angular, site)
        np.testing.assert_allclose(ours.tcp[i], site_pose(data, "tcp"), atol=5e-6)
        expected = np.concatenate([linear, angular])[:, :arm]
        np.testing.assert_allclose(ours.jacobian[i], expected, atol=5e-6)


def test_tcp_frame_is_between_the_pads(env: Env, joints: np.ndarray) -> None:
    """Origin between the finger pads, y from one to the other, z the way they point."""
    for q in joints[:4]:
        data = with_arm(env, q)
        for name in env.robot.gripper_joints:
            data.joint(name).qpos[0] = 0.03
        mujoco.mj_kinematics(env.mj_model, data)
        tcp = site_pose(data, "tcp")
        left, right = (data.geom(name).xpos for name in env.robot.pads)
        across = left - right
        inward = tcp[:3, :3].T @ across
        np.testing.assert_allclose(inward, [0, np.linalg.norm(across), 0], atol=1e-9)
        middle = tcp[:3, :3].T @ ((left + right) / 2 - tcp[:3, 3])
        np.testing.assert_allclose(middle[:2], [0, 0], atol=1e-9)
        # The pads reach along z over the origin.
        half = env.mj_model.geom(env.robot.pads[0]).size[2]
        assert abs(middle[2]) < half
        wrist = data.site("flange").xpos
        ahead = [0, 0, TCP_DISTANCE[env.robot.name]]
        np.testing.assert_allclose(tcp[:3, :3].T @ (tcp[:3, 3] - wrist), ahead, atol=1e-9)


def test_all_hands_hold_alike() -> None:
    """Pads and tips have the same size and the same place at the TCP; open, they are as far apart
    as the robot says. A policy that knows one hand meets no other grasp with the next."""
    seen = []
    for robot in ROBOTS.values():
        env = make("lift_spam", robot.name)
        data = mujoco.MjData(env.mj_model)
        mujoco.mj_kinematics(env.mj_model, data)  # all joints at 0: the gripper is closed
        tcp = site_pose(data, "tcp")
        for name in (*robot.pads, *robot.tips):
            place = tcp[:3, :3].T @ (data.geom(name).xpos - tcp[:3, 3])
            seen.append(np.concatenate([place, env.mj_model.geom(name).size]))
        width = np.subtract(robot.gripper_open, robot.gripper_closed).sum()
        np.testing.assert_allclose(width, robot.max_width, atol=1e-12)
    hands = np.reshape(seen, (len(ROBOTS), -1))
    np.testing.assert_allclose(hands, hands[:1].repeat(len(hands), 0), atol=1e-9)


def test_home_points_down_with_the_hand_along_x(env: Env) -> None:
    """And high enough: the front camera sees all of the table's test region below the hand."""
    data = with_arm(env, np.array(env.robot.home))
    tcp = site_pose(data, "tcp")
    np.testing.assert_allclose(tcp[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-9)
    eye, farthest = np.array([1.35, 0, 1.58]), np.array([0.05, 0, TABLE + 0.1])
    share = (eye[0] - tcp[0, 3]) / (eye[0] - farthest[0])
    assert tcp[2, 3] - 0.01 > (eye + share * (farthest - eye))[2] + 0.05


@pytest.fixture(scope="module")
def region(env: Env) -> np.ndarray:
    """[W, 4, 4] TCP poses over the whole test region, low and high, hand turned and tilted."""
    rng = np.random.default_rng(1)
    low, high = [0.05, -0.35, TABLE + 0.01], [0.45, 0.35, TABLE + 0.24]
    positions = rng.uniform(low, high, (4 * worlds.WORLDS, 3)).astype(np.float32)
    yaws = rng.uniform(-1.0, 1.0, len(positions)).astype(np.float32)
    return np.asarray(jax.vmap(control.pointing_down)(positions, yaws))


@pytest.fixture(scope="module")
def reached(env: Env, region: np.ndarray) -> np.ndarray:
    """[W, J] joint positions that `control.reach` finds for the poses of the region."""
    reach = jax.jit(jax.vmap(lambda target: control.reach(env.chain, env.chain.home, target)))
    return np.asarray(reach(region))


def test_reach_finds_every_pose_of_the_region(
    env: Env, region: np.ndarray, reached: np.ndarray
) -> None:
    """Start poses are exact: C MuJoCo's TCP is within 0.1 mm and 0.02 degrees of what was asked."""
    for q, target in zip(reached, region, strict=True):
        found = site_pose(with_arm(env, q), "tcp")
        np.testing.assert_allclose(found[:3, 3], target[:3, 3], atol=1e-4)
        np.testing.assert_allclose(found[:3, :3], target[:3, :3], atol=4e-4)


def test_the_arm_stays_above_the_table(env: Env, reached: np.ndarray) -> None:
    """The elbow is up: every joint is 0.17 m above the table, if it ever is, wherever the hand."""
    links = [int(env.mj_model.joint(name).bodyid[0]) for name in env.robot.arm_joints]
    home = with_arm(env, np.array(env.robot.home)).xpos[links, 2]
    for q in reached:
        heights = with_arm(env, q).xpos[links, 2]
        assert (heights > np.minimum(home, TABLE + 0.17) - 1e-6).all(), heights - TABLE


def deltas(count: int) -> np.ndarray:
    """[count, 10] actions: up to 15 mm and 5 degrees in any direction, the gripper open."""
    rng = np.random.default_rng(2)
    moves, axes = rng.normal(size=(2, count, 3))
    moves *= rng.uniform(0.005, 0.015, (count, 1)) / np.linalg.norm(moves, axis=1, keepdims=True)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.radians(rng.uniform(0, 5, count))
    actions = []
    for move, axis, angle in zip(moves, axes, angles, strict=True):
        quaternion, matrix = np.zeros(4), np.zeros(9)
        mujoco.mju_axisAngle2Quat(quaternion, axis, angle)
        mujoco.mju_quat2Mat(matrix, quaternion)
        rotation = matrix.reshape(3, 3)
        actions.append(np.concatenate([rotation[:, 0], rotation[:, 1], move, [1.0]]))
    return np.array(actions, np.float32)


def remaining(target: np.ndarray, pose: np.ndarray) -> tuple[float, float]:
    """Distance (m) and angle (degrees) from a pose to its target."""
    trace = np.trace(target[:3, :3].T @ pose[:3, :3])
    angle = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    return float(np.linalg.norm(target[:3, 3] - pose[:3, 3])), float(angle)


@pytest.mark.slow
def test_a_commanded_delta_is_reached_within_one_step(
    env: Env, region: np.ndarray, reached: np.ndarray
) -> None:
    """From rest, anywhere in the region: joint targets are exact, the servos cover most of the way.

    Measured with the Panda over 64 poses: inverse kinematics leaves well under 1 % of the way. In
    the 50 ms of one step the servos, starting at rest, cover 96 % of it (median; 94 % in the worst
    tenth). The UR5's, over 256 poses: 97 % and 95 %. The next command starts from the measured
    pose, so that the rest is not lost.
    """
    runner = worlds.runner("lift_spam", env.robot.name)
    params, actions = worlds.params(env), deltas(len(region))
    solved, covered, turned = [], [], []
    for first in range(0, len(region), worlds.WORLDS):
        rows = slice(first, first + worlds.WORLDS)
        state = runner.reset(worlds.keys(first), params)
        qpos = np.array(state.data.qpos)
        qpos[:, env._arm_qpos] = reached[rows]
        qpos[:, env._ids.qpos : env._ids.qpos + 2] = (-0.8, 0.6)  # the can is out of the way
        state = runner.restore(
            jnp.asarray(qpos),
            state.data.mocap_pos,
            state.data.mocap_quat,
            state.camera_to_world,
            params,
        )
        after = runner.step(state, jnp.asarray(actions[rows]), params)
        before, now = worlds.tcp(env, state), worlds.tcp(env, after)
        for world, action in enumerate(actions[rows]):
            columns = action[:3], action[3:6]
            turn = np.stack([*columns, np.cross(*columns)], -1)
            target = before[world] @ pose(turn, action[6:9])
            arm = np.asarray(after.data.ctrl[world, : len(env.robot.arm_joints)])
            way = np.linalg.norm(action[6:9])
            solved.append(remaining(target, site_pose(with_arm(env, arm), "tcp")))
            left, angle = remaining(target, now[world])
            covered.append(1 - left / way)
            turned.append(angle)
    # Near the edge of the reach, the joints' speed limits cut a few deltas short.
    distance, angle = np.quantile(solved, 0.9, 0)
    assert distance < 2e-4 and angle < 0.1, np.quantile(solved, [0.9, 1.0], 0)
    assert np.median(covered) > 0.95, np.percentile(covered, [0, 10, 50, 90])
    assert np.percentile(covered, 10) > 0.9, np.percentile(covered, [0, 10, 50, 90])
    assert np.percentile(turned, 90) < 0.5, np.percentile(turned, [50, 90, 100])


def test_speed_limit_of_the_expert() -> None:
    """`step_towards` covers half of a small error, and never more than its limits."""
    start = pose(np.diag([1.0, -1.0, -1.0]), np.array([0.2, 0.1, 1.0]))
    for distance, covered in ((0.004, 0.002), (0.1, 0.006)):
        target = start.copy()
        target[0, 3] += distance
        moved = np.asarray(control.step_towards(jnp.asarray(start), jnp.asarray(target)))
        np.testing.assert_allclose(moved[:3, 3] - start[:3, 3], [covered, 0, 0], atol=1e-6)
        np.testing.assert_allclose(moved[:3, :3], start[:3, :3], atol=1e-6)
    cos, sin = np.cos(1.0), np.sin(1.0)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
    turned = pose(turn @ start[:3, :3], start[:3, 3])
    moved = np.asarray(control.step_towards(jnp.asarray(start), jnp.asarray(turned)))
    relative = moved[:3, :3] @ start[:3, :3].T
    np.testing.assert_allclose(np.arctan2(relative[1, 0], relative[0, 0]), 0.03, atol=1e-5)


def test_joints_keep_their_speed_limits(env: Env) -> None:
    """However far away the commanded pose, no servo target is further than the limit allows."""
    runner = worlds.runner("lift_spam", env.robot.name)
    params = worlds.params(env)
    state = runner.reset(worlds.keys(1), params)
    far = jnp.tile(jnp.array([1.0, 0, 0, 0, 1.0, 0, 0.3, 0.3, 0.1, 1.0]), (worlds.WORLDS, 1))
    after = runner.step(state, far, params)
    makers = {"panda": [2.175] * 4 + [2.61] * 3, "ur5": [np.pi] * 6, "xarm7": [np.pi] * 7}  # rad/s
    limits = makers[env.robot.name]
    joints = slice(len(limits))
    move = np.abs(np.asarray(after.data.ctrl)[:, joints] - np.asarray(state.data.qpos)[:, joints])
    allowed = np.array(limits) * 0.05
    assert (move < allowed + 1e-5).all()
    np.testing.assert_allclose((move / allowed).max(1), 1.0, atol=1e-4)  # as fast as allowed


def test_joints_stay_inside_their_limits(env: Env) -> None:
    """Out of reach is no failure: the nearest pose that the iterations find, inside the limits."""
    far = jnp.asarray(pose(np.eye(3), np.array([3.0, 0.0, 0.2])), jnp.float32)
    q = np.asarray(control.reach(env.chain, jnp.asarray(env.chain.home), far))
    assert np.isfinite(q).all()
    assert (q >= env.chain.limits[:, 0] - 1e-6).all() and (q <= env.chain.limits[:, 1] + 1e-6).all()
