"""One camera's image out of another's, and the alignment on top of it."""

import dataclasses
from functools import partial

import jax
import numpy as np
import oracles
import pytest
import render_worlds as rw
from contracts import check_op

from palm_jax import render
from palm_jax.align import (
    Aligned,
    AlignSpec,
    Camera,
    DtypeError,
    OptionError,
    PoseError,
    ProjectionError,
    ShapeError,
    align,
    align_like,
    align_window,
    reframe,
    window_origin,
)

OTHER = Camera(np.float32([[31, 1.5, 11.2], [0, 27, 15.1], [0, 0, 1]]), np.eye(4), 26, 22)
"""Sees more than the cameras below: its image has borders that were not taken."""


def taken(seed: int, dtype: type = np.uint8) -> tuple[np.ndarray, Camera]:
    """An image of random pixels, and a camera with skew, unequal focal lengths and no middle."""
    rng = np.random.default_rng(seed)
    intrinsics = [[60 + seed, -2, 29.4], [0, 55 - seed, 23 + seed], [0, 0, 1]]
    image = rng.integers(0, 256, (40, 50, 3), np.uint8)
    if dtype != np.uint8:
        image = image.astype(np.float32) / 255
    return image, Camera(np.float32(intrinsics), np.eye(4, dtype=np.float32), 40, 50)


@pytest.mark.parametrize(("dtype", "atol"), [(np.uint8, 0.51), (np.float32, 1e-4)])
def test_reframe(dtype: type, atol: float) -> None:
    """Bytes are rounded: half a grey level off, and the rounding of the positions."""
    examples = [taken(seed, dtype) for seed in range(3)]
    check_op(
        lambda image, camera: reframe(image, camera, OTHER)[0],
        lambda image, camera: oracles.reframed(image, camera, OTHER),
        examples,
        atol=atol,
    )
    assert reframe(*examples[0], OTHER)[0].dtype == dtype


def test_real_pixels_are_those_whose_rays_meet_the_image() -> None:
    image, camera = taken(0)
    _, real = reframe(image, camera, OTHER)
    rays = rw.pixel_rays(OTHER)
    uv, _ = oracles.project(camera.K, np.eye(4), rays)
    inside = ((uv >= 0) & (uv < [camera.width, camera.height])).all(-1)
    np.testing.assert_array_equal(real, inside)
    assert 0.2 < inside.mean() < 0.9


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_the_own_camera_and_its_windows_change_nothing(dtype: type) -> None:
    image, camera = taken(1, dtype)
    same, real = reframe(image, camera, camera)
    atol = 0 if dtype == np.uint8 else 1e-4
    np.testing.assert_allclose(same, image, atol=atol)
    assert np.asarray(real).all()
    window, _ = reframe(image, camera, camera.cropped((7, 11), 20, 30))
    np.testing.assert_allclose(window, image[11:31, 7:37], atol=atol)


SPEC = AlignSpec(crop=60, offset=(0, 12), size=30)
REFERENCE = Camera.from_fovy(42.0, 160, 160, np.eye(4))


def seen(seed: int) -> tuple[np.ndarray, Camera, np.ndarray, np.float32]:
    """A random image of the reference camera somewhere, the TCP well inside of it."""
    rng = np.random.default_rng(seed)
    target = np.array([0.25, 0.0, 0.9])
    pose = oracles.looking_at(np.array([1.2, 0.3, 1.6]) + 0.1 * rng.normal(size=3), target)
    tcp = oracles.pose(oracles.random_rotation(rng), target + 0.04 * rng.normal(size=3))
    image = rng.integers(0, 200, (160, 160, 3), np.uint8)
    camera = dataclasses.replace(REFERENCE, cam_to_world=pose.astype(np.float32))
    return image, camera, tcp.astype(np.float32), np.float32(seed / 4)


@pytest.mark.parametrize(
    "spec",
    [
        SPEC,
        dataclasses.replace(SPEC, border="edge", crop=90, layout="cam6d_xyz"),
        AlignSpec(crop=None, size=40, overlay=False, layout="world6d_xyz"),
        AlignSpec(crop=None, size=40),
    ],
    ids=["crop", "edge", "frame", "frame with overlay"],
)
def test_with_the_reference_camera_it_is_align(spec: AlignSpec) -> None:
    for seed in range(4):
        example = seen(seed)
        got, coverage = align_like(*example[:2], REFERENCE, *example[2:], spec)
        jax.tree.map(np.testing.assert_array_equal, got, align(*example, spec))
        assert spec.border == "edge" or coverage == 1


def test_align_like_is_an_op() -> None:
    """Eagerly, jitted and batched alike."""
    check_op(
        lambda *example: align_like(*example[:2], REFERENCE, *example[2:], SPEC)[0],
        lambda *example: align(*example, SPEC),
        [seen(seed) for seed in range(3)],
    )


@pytest.fixture(scope="module")
def world() -> render.Scene:
    """Solids of flat colours under one lamp."""
    model, data = rw.random_model(4)
    rng = np.random.default_rng(4)
    return rw.scene_of(model, data, rgb=rng.uniform(0.2, 0.9, (model.ngeom, 3)))


PLACE = np.array([0.1, 0.05, 0.5])
TOWARDS = rw.pose_looking_at(np.array([1.4, -0.5, 1.2]), PLACE)


def camera_of(fx: float, fy: float, cx: float, cy: float, height: int, width: int) -> Camera:
    intrinsics = np.float32([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return Camera(intrinsics, TOWARDS, height, width)


SMALL = camera_of(350, 350, 128, 128, 256, 256)
CAMERAS = {
    "twice the pixels": camera_of(700, 700, 256, 256, 512, 512),
    "wide, squeezed, off the middle": camera_of(300, 410, 210, 170, 330, 400),
}


@pytest.mark.parametrize("name", list(CAMERAS))
def test_every_camera_shows_the_policy_what_the_reference_would(
    world: render.Scene, name: str
) -> None:
    """Against the renderer, asked for the reference's window itself."""
    camera = CAMERAS[name]
    frame = render.render(world, camera).rgb
    tcp = oracles.pose(np.diag([1.0, -1.0, -1.0]), PLACE).astype(np.float32)
    for spec in (AlignSpec(crop=100, size=42), AlignSpec(crop=None, size=42, overlay=False)):
        view = spec.view_camera(SMALL)
        origin, _ = window_origin(view, tcp, spec)
        window = render.render(world, view, render.Window(origin, spec.size, spec.size)).rgb
        expected = align_window(window, view, origin, tcp, 1.0, spec)
        got, coverage = align_like(frame, camera, SMALL, tcp, 1.0, spec, rendered=True)
        off = np.abs(np.asarray(got.image, int) - np.asarray(expected.image, int)).max(-1)
        # Only edges between solids differ: bilinear here, one ray a pixel in the renderer.
        assert np.median(off) <= 1 and (off < 12).mean() > 0.9
        np.testing.assert_allclose(got.proprio, expected.proprio, atol=1e-6)
        assert bool(got.valid) and coverage == 1
        if "wide" in name:  # without regard to K: another picture
            wrong = np.asarray(align(frame, camera, tcp, 1.0, spec).image, int)
            assert (np.abs(wrong - np.asarray(expected.image, int)).max(-1) < 12).mean() < 0.85


def test_what_was_not_taken_repeats_the_border() -> None:
    image, camera, tcp, opening = seen(2)
    narrow = camera.cropped((65, 70), 60, 60)
    part = image[70:130, 65:125]
    whole, _ = align_like(image, camera, REFERENCE, tcp, opening, SPEC, rendered=True)
    got, coverage = align_like(part, narrow, REFERENCE, tcp, opening, SPEC, rendered=True)
    _, real = reframe(part, narrow, camera)
    assert 0.5 < coverage < 1 and np.asarray(real).sum() == 60 * 60
    same = (np.asarray(got.image) == np.asarray(whole.image)).all(-1)
    assert same.mean() > coverage - 0.05
    spec = dataclasses.replace(SPEC, border="constant", overlay=False)
    black, _ = align_like(part, narrow, REFERENCE, tcp, opening, spec)
    assert (np.asarray(black.image) == 0).all(-1).mean() > 1 - coverage - 0.08


def test_masks_follow_the_image() -> None:
    image, camera, tcp, opening = seen(0)
    spec = AlignSpec(crop=None, size=40, overlay=False, isolate=True)
    mask = np.zeros((160, 160), bool)
    mask[:, 80:] = True
    for rendered in (True, False):
        got, _ = align_like(
            image, camera, REFERENCE, tcp, opening, spec, mask=mask, rendered=rendered
        )
        plain = dataclasses.replace(spec, isolate=False)
        bare, _ = align_like(image, camera, REFERENCE, tcp, opening, plain, rendered=rendered)
        np.testing.assert_array_equal(got.image[:, 21:], bare.image[:, 21:])
        assert (np.asarray(got.image[:, :19]) <= 96).all()


IMAGE, CAMERA, TCP, _ = seen(0)
AWAY = np.diag([1.0, -1, -1, 1])  # looks down from the origin
call = partial(align_like, reference=REFERENCE, opening=1.0, spec=SPEC)


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"image": IMAGE[:100]}, ShapeError, "160 x 160 pixels, got 100 x 160"),
        ({"image": IMAGE[..., 0]}, ShapeError, "rank 3"),
        ({"image": IMAGE.astype(np.int32)}, DtypeError, "uint8"),
        ({"tcp": np.eye(3)}, ShapeError, "tcp"),
        ({"tcp": 2 * TCP}, PoseError, "tcp"),
        ({"tcp": np.full((4, 4), np.nan)}, PoseError, "finite"),
        ({"camera": dataclasses.replace(CAMERA, cam_to_world=2 * np.eye(4))}, PoseError, "Camera"),
        ({"camera": dataclasses.replace(CAMERA, cam_to_world=AWAY)}, ProjectionError, "tcp"),
        ({"mask": np.ones((160, 160))}, OptionError, "mask: expected one if and only if"),
        ({"spec": dataclasses.replace(SPEC, isolate=True)}, OptionError, "got none"),
        (
            {"spec": dataclasses.replace(SPEC, isolate=True), "mask": np.ones((160, 160))},
            OptionError,
            "rendered",
        ),
        (
            {
                "spec": AlignSpec(crop=None, isolate=True, overlay=False),
                "mask": np.ones((2, 2)),
                "rendered": True,
            },
            ShapeError,
            "mask: expected the image's",
        ),
        ({"spec": AlignSpec(crop=161)}, OptionError, "161"),
    ],
)
def test_bad_input(arguments: dict, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        call(**{"image": IMAGE, "camera": CAMERA, "tcp": TCP} | arguments)
    with pytest.raises(ShapeError, match="40 x 50"):
        reframe(IMAGE, taken(0)[1], OTHER)


def test_the_flag_is_about_the_cameras_image() -> None:
    """A TCP in the reference's image that the camera's image does not reach, traced."""
    image, camera, tcp, opening = seen(1)
    narrow = camera.cropped((100, 100), 40, 40)

    @jax.jit
    def see(image: jax.Array, camera: Camera) -> Aligned:
        return align_like(image, camera, REFERENCE, tcp, opening, SPEC)[0]

    assert bool(see(image, camera).valid)
    assert not bool(see(image[100:140, 100:140], narrow).valid)
