"""TCP overlay, against PIL and the reference."""

from functools import partial

import jax
import numpy as np
import oracles
import pytest
from contracts import check_op

from palm_jax.align import Camera, resize, tcp_crop, tcp_overlay

SIZE = 160


def scene(seed, size=SIZE):
    """A camera and a TCP somewhere in the middle of its image."""
    rng = np.random.default_rng(seed)
    target = np.array([0.25, 0.0, 0.9])
    pose = oracles.looking_at(np.array([1.2, 0.3, 1.6]) + 0.1 * rng.normal(size=3), target)
    focal = 1.3 * size
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    tcp = oracles.pose(oracles.random_rotation(rng), target + 0.02 * rng.normal(size=3))
    camera = Camera(np.float32(intrinsics), np.float32(pose), size, size)
    return camera, tcp.astype(np.float32)


def picture(seed, size=SIZE):
    return np.random.default_rng(seed).integers(0, 200, (size, size, 3), np.uint8)


def pil(image, camera, tcp, **options):
    return oracles.draw_overlay(image, camera.K, camera.cam_to_world, tcp, **options)


def same_strokes(got, expected, image_count=1):
    """PIL's rasteriser decides a few pixels on the rims of strokes differently."""
    different = (got != expected).any(-1)
    assert different.sum() <= 20 * image_count
    assert np.abs(got.astype(float) - expected).mean() <= 3


def test_tcp_overlay():
    examples = [(picture(seed), *scene(seed)) for seed in range(6)]
    check_op(tcp_overlay, pil, examples, compare=same_strokes)


def test_stroke_sizes():
    style = {"axis_length": 0.16, "thickness": 4, "arrow_length": 14, "arrow_width": 8}
    image, (camera, tcp) = picture(1), scene(1)
    got = np.asarray(tcp_overlay(image, camera, tcp, dot_radius=3, **style))
    same_strokes(got, pil(image, camera, tcp, dot_radius=3, **style))
    bare = tcp_overlay(image, camera, tcp, axis_length=0.0, dot_radius=3)
    np.testing.assert_array_equal(bare, pil(image, camera, tcp, axis_length=0.0, dot_radius=3))


def test_float_images_are_drawn_alike():
    image, (camera, tcp) = picture(2), scene(2)
    drawn = tcp_overlay(image, camera, tcp)
    drawn_float = tcp_overlay(image.astype(np.float32) / 255, camera, tcp)
    assert drawn_float.dtype == np.float32
    np.testing.assert_allclose(drawn_float, np.asarray(drawn) / 255, atol=1e-6)


@pytest.mark.parametrize("size", [80, 160, 200, 240])
def test_overlay_golden(size):
    golden, image = oracles.golden_align(), oracles.golden_image()
    for index, expected in enumerate(golden[f"overlay{size}"]):
        camera = Camera(golden["K"], golden["cam_to_world"][index], 512, 512)
        drawn = tcp_overlay(image, camera, golden["tcp"][index])
        crop = resize(tcp_crop(drawn, golden["uv"][index], size, offset=(0, 40)), 84)
        off = np.abs(np.asarray(crop).astype(int) - expected)
        assert off.mean() <= 3
        # Axes, heads and dot in place: hardly any pixel is off by more than resampling a rim.
        assert (off > 60).any(-1).sum() <= 20
        strokes = (np.abs(expected.astype(int) - golden[f"crop{size}"][index]) > 60).any(-1)
        assert strokes.sum() > 40 and (off[strokes] > 60).any(-1).mean() < 0.1


def test_drawing_order():
    # z looks into the camera: its arrow has no length, and the dot covers the origin of x and y.
    camera = Camera.from_fovy(60.0, 100, 100, np.eye(4))
    tcp = oracles.pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.4]))
    drawn = np.asarray(tcp_overlay(np.zeros((100, 100, 3), np.uint8), camera, tcp))
    assert tuple(drawn[50, 50]) == (255, 255, 255)
    assert tuple(drawn[50, 64]) == (255, 0, 0)  # x to the right
    assert tuple(drawn[36, 50]) == (0, 255, 0)  # y up
    assert not (drawn == (0, 0, 255)).all(-1).any()
    # All three axes on one line, x longest: z is drawn over y over x.
    together = np.eye(4)
    together[:3, :3] = oracles.random_rotation(np.random.default_rng(0))
    together[:3, 3] = [0, 0, 0.3]
    same_strokes(
        np.asarray(tcp_overlay(drawn * 0, camera, together)), pil(drawn * 0, camera, together)
    )


def test_nothing_is_drawn_for_a_tcp_behind_the_camera():
    camera = Camera.from_fovy(60.0, 100, 100, np.eye(4))
    tcp = oracles.pose(np.eye(3), np.array([0.01, 0.02, -0.4]))
    image = picture(3, 100)
    np.testing.assert_array_equal(jax.jit(tcp_overlay)(image, camera, tcp), image)


def test_an_axis_that_ends_behind_the_camera_is_left_out():
    camera = Camera.from_fovy(60.0, 100, 100, np.eye(4))
    tcp = oracles.pose(np.diag([1.0, -1.0, -1.0]), np.array([0.005, 0.002, 0.08]))
    drawn = np.asarray(tcp_overlay(np.zeros((100, 100, 3), np.uint8), camera, tcp))
    assert np.isfinite(drawn).all() and not (drawn == (0, 0, 255)).all(-1).any()
    assert (drawn == (255, 0, 0)).all(-1).any()


def test_calibration_error_is_a_shift_of_the_principal_point():
    image, (camera, tcp) = picture(4), scene(4)
    moved = camera.cropped((-3, 2), SIZE, SIZE)
    base = np.asarray(tcp_overlay(np.zeros_like(image), camera, tcp))
    shifted = np.asarray(tcp_overlay(np.zeros_like(image), moved, tcp))
    np.testing.assert_array_equal(shifted, np.roll(base, (-2, 3), (0, 1)))


def test_gradient_of_the_image_is_finite():
    image, (camera, tcp) = picture(5).astype(np.float32) / 255, scene(5)
    loss = jax.grad(lambda x: partial(tcp_overlay, camera=camera, tcp=tcp)(x).sum())
    gradient = np.asarray(loss(image))
    assert set(np.unique(gradient)) == {0.0, 1.0}
