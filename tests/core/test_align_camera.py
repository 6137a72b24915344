"""Camera: projection, the way back, and what moving the camera does."""

import dataclasses

import jax
import numpy as np
import oracles
import pytest
from contracts import check_op
from hypothesis import given
from hypothesis import strategies as st

from palm_jax.align import Camera, ProjectionError, project, unproject, unproject_to_height

SEEDS = st.integers(0, 2**31)
# The reference's front camera, from its published pose.
FRONT = (
    np.array(
        [
            [0.0, -0.42262, -0.90631, 1.35],
            [-1.0, 0.0, 0.0, 0.0],
            [0.0, 0.90631, -0.42262, 1.58],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    @ oracles.TO_OPENCV
)


def front_camera(size=512):
    return Camera.from_fovy(40.0, size, size, FRONT)


def random_camera(rng, size=128):
    eye = np.array([1.0, 0.0, 1.5]) + 0.3 * rng.normal(size=3)
    intrinsics = np.array([[rng.uniform(80, 200), rng.normal(), 60], [0, 150, 70], [0, 0, 1]])
    looking = oracles.looking_at(eye, 0.1 * rng.normal(size=3))
    return Camera(np.float32(intrinsics), np.float32(looking), size, size)


@pytest.mark.parametrize(
    ("point", "uv"),
    [
        ((0.25, 0.0, 0.752), (256.0, 405.1)),
        ((0.25, 0.2, 0.752), (360.4, 405.1)),
        ((0.25, 0.0, 0.952), (256.0, 314.1)),
        ((0.1, 0.0, 0.752), (256.0, 361.4)),
        ((0.4, 0.0, 0.752), (256.0, 458.7)),
    ],
)
def test_front_camera_hand_derived(point, uv):
    camera = front_camera()
    np.testing.assert_allclose(camera.K[0, 0], 703.354, atol=1e-3)
    np.testing.assert_allclose(project(camera, np.array(point))[0], uv, atol=0.06)


def test_project_golden():
    golden = oracles.golden_align()
    for pose, tcp, uv in zip(golden["cam_to_world"], golden["tcp"], golden["uv"], strict=True):
        camera = Camera(golden["K"], pose, 512, 512)
        np.testing.assert_allclose(project(camera, tcp[:3, 3])[0], uv, atol=1e-2)


def test_project():
    rng = np.random.default_rng(0)
    examples = [
        (random_camera(rng), (0.2 * rng.normal(size=(2, 3, 3))).astype(np.float32))
        for _ in range(3)
    ]
    check_op(
        project,
        lambda camera, points: oracles.project(camera.K, camera.cam_to_world, points),
        examples,
        atol=1e-2,
    )


def test_points_behind_are_finite_and_out_of_every_image():
    camera = front_camera()
    behind = FRONT[:3, 3] - 2 * FRONT[:3, 2]
    for call in (project, jax.jit(project)):
        uv, depth = call(camera, np.stack([behind, FRONT[:3, 3]]))
        assert np.isfinite(uv).all() and (np.asarray(uv) < -1e5).all()
        np.testing.assert_allclose(depth, [-2.0, 0.0], atol=1e-4)
    assert not camera.sees(behind)


def test_sees_is_the_frame():
    camera = Camera.from_fovy(90.0, 20, 40, np.eye(4))
    # One metre ahead a pixel is 0.1 m: u = 20 + 10 x, v = 10 + 10 y.
    points = np.array([[-1.95, 0, 1], [-2.05, 0, 1], [1.95, -0.95, 1], [0, 1.05, 1], [0, 0, -1]])
    np.testing.assert_array_equal(camera.sees(points), [True, False, True, False, False])


@given(SEEDS)
def test_unproject_inverts_project(seed):
    rng = np.random.default_rng(seed)
    camera, points = random_camera(rng), 0.3 * rng.normal(size=(8, 3))
    uv, depth = project(camera, points)
    np.testing.assert_allclose(unproject(camera, uv, depth), points, atol=1e-4)


@given(SEEDS)
def test_unproject_to_height_inverts_project(seed):
    rng = np.random.default_rng(seed)
    camera, points = random_camera(rng), 0.2 * rng.normal(size=(8, 3))
    uv, _ = project(camera, points)
    np.testing.assert_allclose(unproject_to_height(camera, uv, points[:, 2]), points, atol=2e-4)


def test_unproject_to_height_without_a_hit():
    camera = front_camera()
    above = project(camera, np.array([[-4.0, 0.0, 1.58], [0.2, 0.0, 0.8]]))[0]
    with pytest.raises(ProjectionError, match="below the horizon"):
        unproject_to_height(camera, above - np.array([[0.0, 300.0], [0.0, 0.0]]), 0.752)
    points = jax.jit(unproject_to_height)(camera, above - np.array([[0, 300.0], [0, 0]]), 0.752)
    assert np.isnan(points[0]).all() and np.isfinite(points[1]).all()


@given(SEEDS, st.floats(-3, 3))
def test_rotated_about_keeps_the_centre_in_place(seed, angle):
    rng = np.random.default_rng(seed)
    camera, center = random_camera(rng), 0.1 * rng.normal(size=3)
    turned = camera.rotated_about(center, angle).check()
    for height in (0.0, 0.4):  # any point of the axis, seen as before
        point = center + [0, 0, height]
        before, after = project(camera, point), project(turned, point)
        np.testing.assert_allclose(after[0], before[0], atol=2e-2)
        np.testing.assert_allclose(after[1], before[1], atol=1e-4)


def test_rotated_about_turns_counter_clockwise_and_carries_the_scene():
    camera = front_camera()
    turned = camera.rotated_about((0.0, 0.0, 5.0), np.pi / 2)
    np.testing.assert_allclose(turned.cam_to_world[:3, 3], [0.0, 1.35, 1.58], atol=1e-5)
    point = np.array([0.3, 0.1, 0.8])
    turned_point = np.array([-0.1, 0.3, 0.8])
    np.testing.assert_allclose(
        project(turned, turned_point)[0], project(camera, point)[0], atol=2e-2
    )


@given(SEEDS, st.floats(-0.4, 0.4), st.floats(-0.3, 0.3))
def test_turned_keeps_the_place_the_horizon_and_a_point(seed, pan, tilt):
    rng = np.random.default_rng(seed)
    camera = random_camera(rng)
    keep = 0.2 * rng.normal(size=3)
    turned = camera.turned(pan, tilt, keep)
    expected = oracles.turned_pose(camera.cam_to_world, pan, tilt)
    np.testing.assert_allclose(turned.cam_to_world, expected, atol=1e-6)
    np.testing.assert_allclose(project(turned, keep)[0], project(camera, keep)[0], atol=2e-3)
    np.testing.assert_allclose(turned.cam_to_world[2, 0], camera.cam_to_world[2, 0], atol=1e-6)
    np.testing.assert_array_equal(turned.K[:2, :2], np.asarray(camera.K)[:2, :2])


def test_scaled_and_cropped_move_pixels():
    camera, point = front_camera(), np.array([0.3, 0.1, 0.8])
    uv = np.asarray(project(camera, point)[0])
    scaled = camera.scaled(0.42)
    assert (scaled.height, scaled.width) == (215, 215)
    np.testing.assert_allclose(project(scaled, point)[0], 0.42 * uv, atol=1e-2)
    stretched = camera.scaled((2.0, 0.5))
    assert (stretched.height, stretched.width) == (256, 1024)
    np.testing.assert_allclose(project(stretched, point)[0], uv * [2.0, 0.5], atol=1e-2)
    cropped = camera.cropped((-7.5, 100.0), 30, 40)
    assert (cropped.height, cropped.width) == (30, 40)
    np.testing.assert_allclose(project(cropped, point)[0], uv - [-7.5, 100.0], atol=1e-2)


def test_camera_is_a_pytree_and_compiles_once_for_a_sweep():
    traces = []

    @jax.jit
    def sweep(camera, angles):
        traces.append(0)
        turned = jax.vmap(lambda angle: camera.rotated_about((0.25, 0.0, 0.752), angle))(angles)
        return jax.vmap(project, (0, None))(turned, np.array([0.3, 0.0, 0.8]))

    camera = front_camera()
    assert len(jax.tree.leaves(camera)) == 2
    for angles in (np.linspace(-0.5, 0.5, 4), np.zeros(4)):
        for moved in (camera, dataclasses.replace(camera, K=camera.K * 1.0)):
            uv, _ = sweep(moved, np.float32(angles))
    assert uv.shape == (4, 2) and len(traces) == 1
