"""6D rotations, proprioception, body-frame actions and labels."""

from functools import partial

import jax
import numpy as np
import oracles
import pytest
from contracts import check_op
from hypothesis import given
from hypothesis import strategies as st

from palm_jax.align import (
    Camera,
    achieved_deltas,
    apply_delta,
    encode_delta,
    gripper_labels,
    matrix_from_6d,
    overwrite_transitions,
    proprio,
    rotation_6d,
)

SEEDS = st.integers(0, 2**31)
# The reference's camera axes negate x and y of every vector given in the camera frame.
FROM_COPPELIA = np.array([-1, -1, 1, -1, -1, 1, 1])


def poses(count, seed=0):
    rng = np.random.default_rng(seed)
    return np.stack([oracles.random_pose(rng) for _ in range(count)]).astype(np.float32)


def assert_rotation(matrix, atol=1e-5):
    np.testing.assert_allclose(
        np.swapaxes(matrix, -1, -2) @ matrix, np.broadcast_to(np.eye(3), matrix.shape), atol=atol
    )
    np.testing.assert_allclose(np.linalg.det(matrix), 1, atol=atol)


def test_rotation_6d_takes_columns():
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(rotation_6d(turn), [0, 1, 0, -1, 0, 0])
    check_op(rotation_6d, oracles.rotation_6d, [(pose[:3, :3],) for pose in poses(3)], atol=1e-7)


@given(SEEDS)
def test_6d_round_trip(seed):
    rotations = poses(4, seed)[:, :3, :3]
    np.testing.assert_allclose(matrix_from_6d(rotation_6d(rotations)), rotations, atol=1e-5)


@given(SEEDS, st.floats(-3, 3))
def test_any_vector_gives_a_rotation(seed, log_scale):
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(8, 6)) * 10.0**log_scale
    matrix = np.asarray(matrix_from_6d(vectors))
    assert_rotation(matrix)
    first = vectors[:, :3] / np.linalg.norm(vectors[:, :3], axis=-1, keepdims=True)
    np.testing.assert_allclose(matrix[..., 0], first, atol=1e-5)
    # y stays in the plane of the two halves, on the side of the second.
    assert ((matrix[..., 1] * vectors[:, 3:]).sum(-1) > 0).all()
    np.testing.assert_allclose(
        (matrix[..., 2] * vectors[:, 3:]).sum(-1) / 10.0**log_scale, 0, atol=1e-4
    )


@pytest.mark.parametrize(
    "vector",
    [
        [0, 0, 0, 0, 0, 0],
        [0, 0, 0, 1, 0, 0],
        [2, 0, 0, 4, 0, 0],
        [0, 3, 0, 0, -3, 0],
        [1, 1, 1, 1, 1, 1 + 1e-7],
        [np.nan, 0, 0, 0, 1, 0],
        [1, 0, 0, np.inf, 0, 0],
    ],
)
def test_degenerate_vectors_give_a_rotation(vector):
    assert_rotation(np.asarray(jax.jit(matrix_from_6d)(np.float32(vector))))


def test_gradient_at_degenerate_vectors_is_finite():
    gradient = jax.grad(lambda v: matrix_from_6d(v).sum())(np.zeros(6, np.float32))
    assert np.isfinite(gradient).all()


def test_home_pose_hand_derived():
    # method: R_H = diag(-1, 1, -1) under the front camera, OpenCV axes.
    tilt = np.deg2rad(25)
    rotation = np.array(
        [[0, -np.sin(tilt), -np.cos(tilt)], [1, 0, 0], [0, -np.cos(tilt), np.sin(tilt)]]
    )
    # Camera 1.58 m up, looking along -X, 25 degrees down: x right is +Y.
    rotation[:, 2] = [-np.cos(tilt), 0, -np.sin(tilt)]
    rotation[:, 1] = np.cross(rotation[:, 2], rotation[:, 0])
    camera = Camera.from_fovy(40.0, 512, 512, oracles.pose(rotation, np.array([1.35, 0, 1.58])))
    tcp = oracles.pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.25, 0.0, 1.1]))
    expected = [0, -0.4226, 0.9063, 1, 0, 0, 1.1, 1]
    np.testing.assert_allclose(proprio(tcp, 1.0, camera), expected, atol=1e-4)


def oracle_proprio(layout):
    def oracle(tcp, opening, camera):
        rotation = tcp[:3, :3].astype(np.float64)
        in_camera = np.linalg.inv(camera.cam_to_world[:3, :3].astype(np.float64)) @ rotation
        parts = {
            "cam6d_z": [oracles.rotation_6d(in_camera), tcp[2:3, 3]],
            "world6d_xyz": [oracles.rotation_6d(rotation), tcp[:3, 3]],
            "cam6d_xyz": [oracles.rotation_6d(in_camera), tcp[:3, 3]],
            "world6d_z": [oracles.rotation_6d(rotation), tcp[2:3, 3]],
            "z": [tcp[2:3, 3]],
        }[layout]
        return np.concatenate([*parts, [opening > 0.95]])

    return oracle


@pytest.mark.parametrize("layout", ["cam6d_z", "world6d_xyz", "cam6d_xyz", "world6d_z", "z"])
def test_proprio(layout):
    intrinsics = np.float32([[100, 0, 50], [0, 100, 50], [0, 0, 1]])
    cameras = [Camera(intrinsics, pose, 100, 100) for pose in poses(3, seed=1)]
    openings = np.float32([0.95, 0.951, 0.4])
    examples = list(zip(poses(3), openings, cameras, strict=True))
    check_op(partial(proprio, layout=layout), oracle_proprio(layout), examples, atol=1e-5)


def test_proprio_golden():
    golden = oracles.golden_align()
    for index, tcp in enumerate(golden["tcp"]):
        camera = Camera(golden["K"], golden["cam_to_world"][index], 512, 512)
        in_camera = golden["rot6d_cam_z"][index] * FROM_COPPELIA
        np.testing.assert_allclose(proprio(tcp, 0.0, camera)[:7], in_camera, atol=1e-5)
        world = proprio(tcp, 0.0, None, layout="world6d_xyz")
        np.testing.assert_allclose(world[:9], golden["rot6d_xyz"][index], atol=1e-5)


def test_encode_delta():
    examples = list(zip(poses(3), poses(3, seed=1), strict=True))
    check_op(encode_delta, oracles.delta, examples, atol=1e-5)


def test_delta_is_in_the_body_frame():
    # A hand turned by 90 degrees about z: its x axis is the world's y.
    tcp = oracles.pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([0.5, 0, 1]))
    moved = np.asarray(apply_delta(tcp, np.array([1, 0, 0, 0, 1, 0, 0.1, 0, 0])))
    np.testing.assert_allclose(moved[:3, 3], [0.5, 0.1, 1.0], atol=1e-6)
    np.testing.assert_allclose(encode_delta(tcp, moved)[6:], [0.1, 0, 0], atol=1e-6)


def test_apply_delta():
    examples = [
        (a, oracles.delta(a, b).astype(np.float32), b)
        for a, b in zip(poses(3), poses(3, seed=1), strict=True)
    ]
    check_op(
        lambda tcp, delta, _: apply_delta(tcp, delta),
        lambda tcp, delta, target: target,
        examples,
        atol=1e-5,
    )


@given(SEEDS)
def test_apply_inverts_encode(seed):
    tcp, target = poses(5, seed), poses(5, seed + 1)
    np.testing.assert_allclose(apply_delta(tcp, encode_delta(tcp, target)), target, atol=2e-5)


def test_deltas_golden():
    golden = oracles.golden_align()
    deltas = overwrite_transitions(achieved_deltas(golden["tcp"]), 1)
    np.testing.assert_allclose(deltas, golden["delta"], atol=1e-5)


def test_overwrite_takes_the_largest_translations():
    deltas = np.tile(np.float32([0, 1, 0, -1, 0, 0, 0, 0, 0]), (5, 1))
    deltas[:, 7] = [0.1, -0.5, 0.2, 0.3, 0.0]
    np.testing.assert_array_equal(overwrite_transitions(deltas, 0), deltas)
    expected = deltas.copy()
    expected[[1, 3]] = [1, 0, 0, 0, 1, 0, 0, 0, 0]
    np.testing.assert_array_equal(overwrite_transitions(deltas, 2), expected)


def test_gripper_labels():
    golden = oracles.golden_align()
    np.testing.assert_array_equal(gripper_labels(golden["opening"]), golden["gripper_label"][:, 0])
    rng = np.random.default_rng(0)
    walks = np.clip(np.cumsum(rng.choice([-0.05, 0, 0.01, 0.05], (4, 30)), -1) + 0.5, 0, 1)
    walks[0] = 0.95
    check_op(gripper_labels, oracles.gripper_labels, [(walk.astype(np.float32),) for walk in walks])
