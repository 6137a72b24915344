"""Augmentation: the deterministic ops against oracles, the draws by their statistics."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from contracts import check_op
from hypothesis import given
from hypothesis import strategies as st

from palm_jax.align import (
    Camera,
    center_crop,
    overlay_blend,
    perspective_warp,
    project,
    random_crop,
    random_overlay,
    random_perspective,
    random_turn,
    subpixel_crop,
    turn_view,
)

FULL = np.array([[0, 0], [26, 0], [26, 20], [0, 20]], np.float32)


def images(count, height=20, width=26, dtype=np.uint8, seed=0):
    values = np.random.default_rng(seed).integers(0, 256, (count, height, width, 3), np.uint8)
    return values if dtype == np.uint8 else values.astype(np.float32) / 255


def within_rounding(got, expected):
    """uint8 results are rounded to nearest; floats agree."""
    if got.dtype == np.uint8:
        np.testing.assert_allclose(got, expected, atol=0.501)
    else:
        np.testing.assert_allclose(got, expected, atol=2e-5)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("background_dtype", [np.uint8, np.float32])
def test_overlay_blend(dtype, background_dtype):
    pairs = zip(images(3, dtype=dtype), images(3, dtype=background_dtype, seed=1), strict=True)
    examples = [
        (*pair, np.float32(alpha)) for pair, alpha in zip(pairs, (0.5, 0.0, 0.8), strict=True)
    ]

    def oracle(image, background, alpha):
        scale = 255.0 if image.dtype == np.uint8 else 1.0
        if background.dtype != image.dtype:
            background = background * scale if scale > 1 else background / 255.0
        return (1 - float(alpha)) * image + float(alpha) * background

    check_op(overlay_blend, oracle, examples, compare=within_rounding)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_perspective_warp(dtype):
    rng = np.random.default_rng(2)
    inwards = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    moves = rng.uniform(-2, 6, (4, 4, 2)).astype(np.float32)
    examples = [
        (image, (FULL + move * inwards).astype(np.float32))
        for image, move in zip(images(4, dtype=dtype), moves, strict=True)
    ]

    def compare(got, expected):
        # float32 coordinates are good to about 1e-5 pixels.
        scale = 255 if got.dtype == np.uint8 else 1
        np.testing.assert_allclose(got, expected, atol=1e-4 * scale + (0.5 if scale > 1 else 0))

    check_op(perspective_warp, oracles.perspective, examples, compare=compare)


def test_warp_moves_whole_pixels_exactly():
    image = images(1)[0]
    np.testing.assert_array_equal(perspective_warp(image, FULL), image)
    moved = np.asarray(perspective_warp(image, FULL + [4, -3]))
    np.testing.assert_allclose(moved[:17, 4:].astype(int), image[3:, :22], atol=1)
    assert not moved[17:].any() and not moved[:, :4].any()


def test_traced_impossible_corners_are_black_where_there_is_no_source():
    crossed = jax.jit(perspective_warp)(images(1)[0], FULL[[0, 2, 1, 3]])
    collapsed = jax.jit(perspective_warp)(images(1, dtype=np.float32)[0], FULL * 0)
    assert crossed.shape == (20, 26, 3)
    assert np.isfinite(collapsed).all() and not np.asarray(collapsed).any()


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("size", [18, 20, 5])
def test_subpixel_crop(dtype, size):
    slack = np.array([25 * (1 - size / 26), 19 * (1 - size / 20)])
    starts = [slack * part for part in (0.0, 0.37, 1.0)]
    examples = [
        (image, np.float32(s)) for image, s in zip(images(3, dtype=dtype), starts, strict=True)
    ]

    def compare(got, expected):
        scale = 255 if got.dtype == np.uint8 else 1
        np.testing.assert_allclose(got, expected, atol=1e-5 * scale + (0.5 if scale > 1 else 0))

    check_op(
        partial(subpixel_crop, size=size),
        lambda image, start: oracles.grid_crop(image, start, size),
        examples,
        compare=compare,
    )


def test_center_crop_takes_whole_pixels():
    batch = images(2, 21, 26)
    np.testing.assert_array_equal(center_crop(batch, 18), batch[:, 1:19, 4:22])
    np.testing.assert_array_equal(center_crop(batch[0], 18), batch[0, 1:19, 4:22])


@given(
    st.integers(0, 2**31),
    st.sampled_from([(1, 0.5), (7, 0.5), (10, 0.3), (8, 1.0), (8, 0.0), (64, 0.5)]),
)
def test_random_overlay_blends_exactly_the_fraction(seed, case):
    batch, fraction = case
    x, bank = np.full((batch, 4, 4, 3), 40, np.uint8), np.full((3, 4, 4, 3), 240, np.uint8)
    out = np.asarray(random_overlay(jax.random.key(seed), x, bank, fraction=fraction, alpha=0.5))
    changed = (out != x).all((1, 2, 3))
    assert changed.sum() == int(fraction * batch)
    np.testing.assert_array_equal(out[changed], 140)
    np.testing.assert_array_equal(out[~changed], x[~changed])


def test_random_overlay_chooses_images_and_backgrounds_evenly():
    x = np.zeros((8, 2, 2, 3), np.float32)
    bank = np.broadcast_to(
        np.linspace(0.2, 1, 5, dtype=np.float32)[:, None, None, None], (5, 2, 2, 3)
    )
    keys = jax.random.split(jax.random.key(0), 1000)
    out = jax.jit(jax.vmap(lambda key: random_overlay(key, x, bank, fraction=0.25)))(keys)
    values = np.asarray(out)[:, :, 0, 0, 0]
    # 2000 choices: each image 250 times, each background 400 times, five standard deviations.
    assert np.abs((values > 0).sum(0) - 250).max() < 75
    counts = [np.isclose(values, level / 2).sum() for level in np.linspace(0.2, 1, 5)]
    assert sum(counts) == 2000 and np.abs(np.array(counts) - 400).max() < 90


def test_random_overlay_can_be_switched_by_a_traced_alpha():
    x, bank = images(6), images(4, seed=1)
    op = jax.jit(random_overlay)
    np.testing.assert_array_equal(op(jax.random.key(3), x, bank, alpha=0.0), x)
    assert (np.asarray(op(jax.random.key(3), x, bank, alpha=0.5)) != x).any((1, 2, 3)).sum() == 3
    assert op._cache_size() == 1


def test_random_perspective_probability():
    x = images(400, 6, 6)
    op = jax.jit(random_perspective)

    def changed(distortion, probability):
        out = op(jax.random.key(0), x, distortion=distortion, probability=probability)
        return (np.asarray(out) != x).any((1, 2, 3)).sum()

    assert changed(0.9, 0.0) == 0
    assert changed(0.0, 1.0) == 0
    assert abs(changed(0.9, 0.5) - 200) < 50
    assert changed(0.9, 1.0) > 395
    assert op._cache_size() == 1


def test_random_perspective_reach():
    # Black appears within distortion * size / 2 of the border, and nearly up to there.
    white = np.full((300, 40, 80, 1), 1, np.float32).repeat(3, -1)
    out = np.asarray(random_perspective(jax.random.key(1), white, distortion=0.4, probability=1.0))
    black = (out[..., 0] < 0.5).any(0)
    assert not black[8:-8, 16:-16].any()
    assert black[:, 13].any() and black[:, -14].any() and black[6].any() and black[-7].any()
    # The four corners move independently.
    pulled = [out[:, row, column, 0] < 0.5 for row, column in ((2, 4), (2, -5), (-3, 4), (-3, -5))]
    assert len({tuple(corner) for corner in pulled}) == 4 and all(corner.any() for corner in pulled)


def window_camera(rng, height=20, width=26):
    """A camera that sees the origin in a small, cropped image."""
    eye = np.array([1.0, 0.0, 0.8]) + 0.2 * rng.normal(size=3)
    centre = rng.uniform(8, 14, 2)
    intrinsics = np.array([[40, 0.5, centre[0]], [0, 42, centre[1]], [0, 0, 1]])
    looking = oracles.looking_at(eye, np.zeros(3))
    return Camera(np.float32(intrinsics), np.float32(looking), height, width)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_turn_view(dtype):
    rng = np.random.default_rng(3)
    examples = []
    for image, (pan, tilt) in zip(
        images(3, dtype=dtype), ((0.3, 0.1), (-0.25, 0.0), (0.1, -0.2)), strict=True
    ):
        camera = window_camera(rng)
        turned = jax.tree.map(np.asarray, camera.turned(pan, tilt, 0.05 * rng.normal(size=3)))
        examples.append((image, camera, turned))

    def compare(got, expected):
        scale = 255 if got.dtype == np.uint8 else 1
        np.testing.assert_allclose(got, expected, atol=2e-4 * scale + (0.5 if scale > 1 else 0))

    check_op(turn_view, oracles.turn_view, examples, compare=compare)


def test_random_turn():
    """About half are turned, within the limits; the points keep their pixels, the rest stays."""
    rng = np.random.default_rng(4)
    count, x = 300, images(300)
    one = window_camera(rng)
    cameras = jax.tree.map(lambda leaf: np.repeat(leaf[None], count, 0), one)
    points = (0.1 * rng.normal(size=(count, 3))).astype(np.float32)
    out, turned = random_turn(jax.random.key(0), x, cameras, points, pan=0.3, tilt=0.1)
    moved = (np.asarray(out) != x).any((1, 2, 3))
    assert abs(moved.sum() - 150) < 45
    seen, place = (
        jax.vmap(lambda camera, point: project(camera, point)[0])(c, points)
        for c in (cameras, turned)
    )
    np.testing.assert_allclose(seen, place, atol=1e-3)
    pose = np.asarray(turned.cam_to_world)
    same = np.isclose(pose, one.cam_to_world, atol=1e-6).all((1, 2))
    np.testing.assert_array_equal(same, ~moved)
    np.testing.assert_array_equal(pose[:, :3, 3], np.asarray(cameras.cam_to_world)[:, :3, 3])
    # The pan turns the x axis in the ground plane, the tilt turns z about it.
    x0, x1 = one.cam_to_world[:2, 0], pose[moved][:, :2, 0]
    pans = np.arctan2(x0[0] * x1[:, 1] - x0[1] * x1[:, 0], x1 @ x0)
    tilts = np.arcsin(pose[moved][:, 2, 2]) - np.arcsin(one.cam_to_world[2, 2])
    for angles, limit in ((pans, 0.3), (tilts, 0.1)):
        assert np.abs(angles).max() <= limit + 1e-3
        assert angles.min() < -0.9 * limit and angles.max() > 0.9 * limit
    assert abs(np.corrcoef(pans, tilts)[0, 1]) < 0.25
    still, _ = random_turn(jax.random.key(0), x, cameras, points, probability=0.0)
    np.testing.assert_array_equal(still, x)


def test_random_crop_covers_all_positions():
    ramp = np.broadcast_to(np.arange(84, dtype=np.float32)[None, :, None], (84, 84, 1))
    both = np.concatenate([ramp, ramp.transpose(1, 0, 2)], -1)
    crops = np.asarray(random_crop(jax.random.key(0), np.repeat(both[None], 500, 0), 76))
    assert crops.shape == (500, 76, 76, 2)
    starts = np.stack([crops[:, 5, 0, 0], crops[:, 0, 5, 1]], -1)
    most = 83 * (1 - 76 / 84)
    assert starts.min() >= 0 and starts.max() <= most + 1e-4
    assert starts.min() < 0.1 and starts.max() > most - 0.1
    assert (np.abs(starts.mean(0) - most / 2) < 0.5).all() and abs(
        np.corrcoef(starts.T)[0, 1]
    ) < 0.2
    assert len(np.unique(np.round(starts % 1, 2))) > 50, "positions are sub-pixel"
    for index in (0, 7):
        again = subpixel_crop(both, starts[index], 76)
        np.testing.assert_allclose(again, crops[index], atol=1e-3)


def test_same_key_same_images_other_key_others():
    x, bank = images(8), images(4, seed=1)
    ops = {
        "overlay": lambda key: random_overlay(key, x, bank),
        "perspective": lambda key: random_perspective(key, x),
        "crop": lambda key: random_crop(key, x, 16),
    }
    for name, op in ops.items():
        first, again, other = (op(jax.random.key(seed)) for seed in (0, 0, 1))
        np.testing.assert_array_equal(first, again, name)
        assert (np.asarray(first) != np.asarray(other)).any(), name
        assert first.dtype == jnp.uint8


def test_ops_in_a_row_keep_to_their_cost():
    """Fused into the next op's gather, an augmentation would be computed four times over."""

    def chain(key, x, bank):
        a, b, c = jax.random.split(key, 3)
        return random_crop(c, random_overlay(b, random_perspective(a, x), bank), 16)

    compiled = jax.jit(chain).lower(jax.random.key(0), images(8), images(4)).compile()
    assert compiled.as_text().count(" conditional(") >= 2
