"""align: its parts in a row, the rendered-window path, and what happens to bad frames."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from contracts import check_op

from palm_jax.align import (
    Aligned,
    AlignSpec,
    Camera,
    align,
    align_window,
    proprio,
    resize,
    tcp_crop,
    tcp_overlay,
    window_origin,
)

SIZE = 160
SPEC = AlignSpec(crop=60, offset=(0, 12), size=30)


def scene(seed, spread=0.02):
    """A camera that looks at a TCP; the larger the spread, the nearer the image's border."""
    rng = np.random.default_rng(seed)
    target = np.array([0.25, 0.0, 0.9])
    pose = oracles.looking_at(np.array([1.2, 0.3, 1.6]) + 0.1 * rng.normal(size=3), target)
    intrinsics = np.array([[208.0, 0, 80], [0, 208, 80], [0, 0, 1]])
    tcp = oracles.pose(oracles.random_rotation(rng), target + spread * rng.normal(size=3))
    return Camera(np.float32(intrinsics), np.float32(pose), SIZE, SIZE), tcp.astype(np.float32)


def in_view(seed, spread):
    """The first scene from this seed on whose TCP is in the image."""
    while True:
        camera, tcp = scene(seed, spread)
        if bool(camera.sees(tcp[:3, 3])):
            return camera, tcp
        seed += 1000


def picture(seed, dtype=np.uint8):
    values = np.random.default_rng(seed).integers(0, 200, (SIZE, SIZE, 3), np.uint8)
    return values if dtype == np.uint8 else values.astype(np.float32) / 255


def in_a_row(image, camera, tcp, opening, spec):
    """The definition of align."""
    if spec.overlay:
        image = tcp_overlay(image, camera, tcp, axis_length=spec.axis_length)
    if spec.crop is not None:
        uv, _ = oracles.project(camera.K, camera.cam_to_world, tcp[:3, 3])
        image = tcp_crop(image, uv, spec.crop, offset=spec.offset, border=spec.border)
    return resize(image, spec.size), proprio(tcp, opening, camera, layout=spec.layout), True


# With this spread most windows, and some arrows, leave the image.
FAR_OUT = [(picture(seed), *in_view(seed, 0.25), np.float32(seed / 6)) for seed in range(6)]


def test_align():
    check_op(partial(align, spec=SPEC), partial(in_a_row, spec=SPEC), FAR_OUT, atol=1e-6)


@pytest.mark.parametrize("border", ["edge", "constant"])
def test_borders(border):
    spec = dataclasses.replace(SPEC, border=border)
    for example in FAR_OUT:
        expected = in_a_row(*example, spec)
        for leaf, value in zip(jax.tree.leaves(align(*example, spec)), expected, strict=True):
            np.testing.assert_allclose(leaf, value, atol=1e-6)


@pytest.mark.parametrize(
    "spec",
    [
        AlignSpec(crop=None, size=84, overlay=False, layout="world6d_xyz"),
        AlignSpec(crop=None, size=40),
        AlignSpec(crop=100, size=100, axis_length=0.2, layout="z"),
        AlignSpec(crop=80, size=84, overlay=False, layout="cam6d_xyz"),
    ],
)
def test_align_specs(spec):
    image, (camera, tcp) = picture(3), scene(3)
    got = align(image, camera, tcp, 0.3, spec)
    for leaf, expected in zip(
        jax.tree.leaves(got), in_a_row(image, camera, tcp, 0.3, spec), strict=True
    ):
        np.testing.assert_allclose(leaf, expected, atol=1e-6)
    assert got.image.shape == (spec.size, spec.size, 3) and got.image.dtype == jnp.uint8
    assert got.proprio.shape == (spec.proprio_size,)


def test_wide_frames_are_squeezed_without_a_crop():
    camera = Camera.from_fovy(60.0, 60, 100, np.eye(4))
    tcp = oracles.pose(np.eye(3), np.array([0.0, 0.0, 0.5]))
    image = picture(0)[:60, :100]
    spec = AlignSpec(crop=None, size=20, overlay=False)
    np.testing.assert_array_equal(align(image, camera, tcp, 1, spec).image, resize(image, 20))
    view = spec.view_camera(camera)
    assert (view.height, view.width) == (20, 20)


def test_float_images():
    camera, tcp = scene(4)
    in_bytes = align(picture(4), camera, tcp, 1.0, SPEC).image
    in_floats = align(picture(4, np.float32), camera, tcp, 1.0, SPEC).image
    assert in_floats.dtype == jnp.float32
    # Bytes are truncated.
    off = np.asarray(in_floats) * 255 - np.asarray(in_bytes)
    assert off.min() > -1e-3 and off.max() < 1 + 1e-3


@pytest.mark.parametrize("size", [160, 200])
def test_align_golden(size):
    golden, image = oracles.golden_align(), oracles.golden_image()
    spec = AlignSpec(crop=size)
    run = jax.jit(partial(align, spec=spec))
    bare = jax.jit(partial(align, spec=dataclasses.replace(spec, overlay=False)))
    for index in range(6):
        camera = Camera(golden["K"], golden["cam_to_world"][index], 512, 512)
        args = image, camera, golden["tcp"][index], golden["opening"][index]
        off = np.abs(np.asarray(bare(*args).image).astype(int) - golden[f"crop{size}"][index])
        assert off.max() <= 1 and (off > 0).mean() <= 0.02
        aligned = run(*args)
        off = np.abs(np.asarray(aligned.image).astype(int) - golden[f"overlay{size}"][index])
        assert off.mean() <= 3 and bool(aligned.valid)


def test_result_unpacks_and_spec_passes_through_jit():
    image, (camera, tcp) = picture(5), scene(5)
    frame, numbers = jax.jit(align)(image, camera, tcp, 1.0, SPEC)
    assert frame.shape == (30, 30, 3) and numbers.shape == (8,)
    assert hash(AlignSpec(offset=[0, 40])) == hash(AlignSpec()) and not jax.tree.leaves(SPEC)


def test_one_compilation_for_all_cameras_poses_and_jitters():
    traces = []

    @jax.jit
    def run(image, camera, tcp, jitter):
        traces.append(0)
        return align(image, camera, tcp, 1.0, SPEC, crop_jitter=jitter)

    for seed in range(3):
        run(picture(seed), *scene(seed), np.float32([seed, 0]))
    assert len(traces) == 1


def behind(camera):
    pose = np.array(camera.cam_to_world)
    return oracles.pose(np.eye(3), pose[:3, 3] - 0.5 * pose[:3, 2]).astype(np.float32)


def outside(camera):
    pose = np.array(camera.cam_to_world)
    return oracles.pose(np.eye(3), pose[:3, 3] + 0.5 * pose[:3, 2] + pose[:3, 0]).astype(np.float32)


@pytest.mark.parametrize("border", ["shift", "constant"])
def test_valid_under_jit_and_vmap(border):
    camera, tcp = scene(6)
    tcps = np.stack([tcp, behind(camera), outside(camera), np.full((4, 4), np.nan, np.float32)])
    image = picture(6)
    spec = dataclasses.replace(SPEC, border=border)
    run = jax.jit(jax.vmap(lambda tcp: align(image, camera, tcp, 1.0, spec)))
    aligned = run(tcps)
    np.testing.assert_array_equal(aligned.valid, [True, False, False, False])
    assert np.isfinite(aligned.proprio[:3]).all()
    no_overlay = dataclasses.replace(spec, overlay=False)
    bare = jax.jit(jax.vmap(lambda tcp: align(image, camera, tcp, 1.0, no_overlay)))(tcps).image
    np.testing.assert_array_equal(aligned.image[1:], bare[1:])
    assert (np.asarray(aligned.image[0]) != np.asarray(bare[0])).any()
    view = spec.view_camera(camera)
    origin, valid = jax.vmap(lambda tcp: window_origin(view, tcp, spec))(tcps)
    np.testing.assert_array_equal(valid, [True, False, False, False])
    small = np.zeros((30, 30, 3), np.uint8)
    windows = jax.vmap(lambda tcp, at: align_window(small, view, at, tcp, 1.0, spec))(tcps, origin)
    np.testing.assert_array_equal(windows.valid, [True, False, False, False])
    assert not np.asarray(windows.image)[[1, 3]].any() and np.asarray(windows.image)[0].any()


def test_jitters():
    image, (camera, tcp) = picture(7), scene(7)
    plain = dataclasses.replace(SPEC, overlay=False)
    jittered = align(image, camera, tcp, 1.0, plain, crop_jitter=(3, -2)).image
    moved = dataclasses.replace(plain, offset=(3, 10))
    np.testing.assert_array_equal(jittered, align(image, camera, tcp, 1.0, moved).image)
    whole = AlignSpec(crop=None, size=SIZE)
    drawn = align(image, camera, tcp, 1.0, whole, overlay_jitter=(1.5, -2.25)).image
    shifted = tcp_overlay(image, camera.cropped((-1.5, 2.25), SIZE, SIZE), tcp)
    np.testing.assert_array_equal(drawn, shifted)
    # Neither moves the other.
    both = align(image, camera, tcp, 1.0, SPEC, crop_jitter=(3, -2), overlay_jitter=(0, 0)).image
    base = tcp_overlay(image, camera, tcp)
    np.testing.assert_array_equal(both, align(base, camera, tcp, 1.0, moved).image)


# -- the rendered window ---------------------------------------------------------------------------


def render(camera, origin, size):
    """A smooth picture of the full frame, sampled at any camera's pixels."""
    focal, center = camera.K[0, 0], camera.K[:2, 2]
    u = (np.arange(size) + origin[1] + 0.5 - center[0]) / focal
    v = (np.arange(size) + origin[0] + 0.5 - center[1]) / focal
    u, v = np.meshgrid(np.asarray(u), np.asarray(v))
    shades = [0.4 + 0.2 * np.sin(9 * u + 4 * v), 0.4 + 0.2 * np.cos(8 * v), 0.3 + 0.2 * u]
    return (255 * np.clip(np.stack(shades, -1), 0, 1)).astype(np.uint8)


def wide_scene(seed):
    rng = np.random.default_rng(seed)
    target = np.array([0.25, 0.0, 0.9])
    pose = oracles.looking_at(np.array([1.35, 0.0, 1.58]), target)
    tcp = oracles.pose(oracles.random_rotation(rng), target + 0.05 * rng.normal(size=3))
    return Camera.from_fovy(40.0, 512, 512, pose), tcp.astype(np.float32)


@pytest.mark.parametrize("crop", [160, 200])
def test_rendered_window_looks_like_the_aligned_frame(crop):
    spec, bare = AlignSpec(crop=crop), AlignSpec(crop=crop, overlay=False)
    full, windowed = jax.jit(align), jax.jit(align_window)
    ink = []
    for seed in range(6):
        camera, tcp = wide_scene(seed)
        view = spec.view_camera(camera)
        origin, _ = window_origin(view, tcp, spec)
        frame, window = render(camera, (0, 0), 512), render(view, np.asarray(origin), 84)
        reference = full(frame, camera, tcp, 0.5, spec)
        got = windowed(window, view, origin, tcp, 0.5, spec)
        # The window starts at a whole pixel of the scaled frame: the two are up to a pixel apart.
        uv, _ = oracles.project(view.K, view.cam_to_world, tcp[:3, 3])
        np.testing.assert_allclose(uv - origin[::-1], [42, 42 - 40 * 84 / crop], atol=1.01)
        off = np.abs(np.asarray(got.image).astype(float) - np.asarray(reference.image))
        assert off.mean() <= 4
        np.testing.assert_allclose(got.proprio, reference.proprio, atol=1e-6)
        drawn = [
            changes(reference.image, full(frame, camera, tcp, 0.5, bare).image),
            changes(got.image, window),
        ]
        centres = [middle(change.sum(-1)) for change in drawn]
        np.testing.assert_allclose(*centres, atol=1.5)
        ink.append([change.sum((0, 1)) for change in drawn])
    before, after = np.sum(ink, 0)
    np.testing.assert_allclose(after, before, rtol=0.15)


def changes(image, bare):
    """[H, W, 3] what the overlay changed."""
    return np.abs(np.asarray(image).astype(float) - np.asarray(bare))


def middle(weights):
    """Centre of gravity, (row, column)."""
    rows, columns = np.indices(weights.shape)
    return np.array([(rows * weights).sum(), (columns * weights).sum()]) / weights.sum()


def test_smooth_strokes_cover_the_area_of_the_shapes():
    # One straight arrow along x, the others towards the camera's axis and out of sight.
    spec = AlignSpec(crop=100, size=50, offset=(0, 0), arrow_length=20.0, arrow_width=16.0)
    camera = Camera.from_fovy(90.0, 400, 400, np.eye(4))
    tcp = oracles.pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.5]))
    view = spec.view_camera(camera)
    origin, _ = window_origin(view, tcp, spec)
    image = align_window(np.zeros((50, 50, 3), np.float32), view, origin, tcp, 1.0, spec).image
    red = np.asarray(image)[..., 0] - np.asarray(image)[..., 1:].max(-1)
    # 0.1 m at 0.5 m is 20 pixels of the scaled frame; head 10 x 8 / 2; shaft 1 wide, 2.5 hidden.
    np.testing.assert_allclose(red.clip(0).sum(), 40 + (10 - 2.5), rtol=0.06)
    dot = np.asarray(image).min(-1).sum()
    np.testing.assert_allclose(dot, np.pi * 2.5**2, rtol=0.06)


def test_window_origin():
    camera, tcp = wide_scene(0)
    low = np.array(tcp)
    low[:3, 3] = [0.45, 0.1, 0.7]  # near the lower border
    uv, _ = oracles.project(camera.K, camera.cam_to_world, low[:3, 3])
    spec = AlignSpec(crop=160)
    scale = 84 / 160
    free = np.floor(uv * scale + np.array([0, 40]) * scale - 42)[::-1]
    assert free[0] > 269 - 84, "the test wants a window that leaves the frame"
    origin, valid = window_origin(
        spec.view_camera(camera), low, dataclasses.replace(spec, border="edge")
    )
    np.testing.assert_array_equal(origin, free)
    assert origin.dtype == jnp.int32 and bool(valid)
    clamped, _ = window_origin(spec.view_camera(camera), low, spec)
    np.testing.assert_array_equal(clamped, [269 - 84, free[1]])
    jittered, _ = window_origin(spec.view_camera(camera), low, spec, jitter=(-20 / scale, 0))
    np.testing.assert_array_equal(jittered, [269 - 84, free[1] - 20])
    whole, _ = window_origin(spec.view_camera(camera), low, AlignSpec(crop=None))
    np.testing.assert_array_equal(whole, [0, 0])


def test_window_of_the_whole_frame():
    camera, tcp = wide_scene(1)
    spec = AlignSpec(crop=None)
    view = spec.view_camera(camera)
    flat = np.full((512, 512, 3), 90, np.uint8)
    got = align_window(flat[:84, :84], view, (0, 0), tcp, 1.0, spec)
    reference = align(flat, camera, tcp, 1.0, spec)
    off = np.abs(np.asarray(got.image).astype(float) - np.asarray(reference.image))
    assert off.mean() < 1 and (np.asarray(got.image) != 90).any()
    assert isinstance(got, Aligned) and bool(got.valid)


def test_overlay_off_returns_the_window():
    camera, tcp = wide_scene(2)
    spec = AlignSpec(overlay=False)
    small = np.random.default_rng(0).integers(0, 256, (84, 84, 3), np.uint8)
    origin, _ = window_origin(spec.view_camera(camera), tcp, spec)
    got = align_window(small, spec.view_camera(camera), origin, tcp, 1.0, spec)
    np.testing.assert_array_equal(got.image, small)
