"""Bad input raises at the entry: what was expected, what came, what to do."""

import dataclasses
from functools import partial

import jax
import numpy as np
import oracles
import pytest

from palm_jax import align as pa

IMAGE = np.zeros((100, 120, 3), np.uint8)
BATCH = np.zeros((4, 20, 20, 3), np.uint8)
CAMERA = pa.Camera.from_fovy(60.0, 100, 120, np.eye(4))
TCP = oracles.pose(np.eye(3), np.array([0.0, 0.0, 0.5]))
SPEC = pa.AlignSpec(crop=60, size=30)
KEY = jax.random.key(0)
UV = (50.0, 50.0)


def camera_with(**changes):
    return dataclasses.replace(CAMERA, **changes)


def intrinsics(**entries):
    matrix = np.array(CAMERA.K)
    for name, value in entries.items():
        matrix[int(name[1]), int(name[2])] = value
    return matrix


def tcp_at(*position):
    return oracles.pose(np.eye(3), np.array(position))


run = partial(pa.align, IMAGE, CAMERA, TCP, 1.0)

# name, call, error, words of the message: expected, got, advice.
CASES = [
    # Cameras.
    (
        "negative focal length",
        lambda: pa.project(camera_with(K=intrinsics(k00=-90)), TCP[:3, 3]),
        pa.CameraError,
        ["positive focal", "-90", "diag(-1, -1, 1, 1)"],
    ),
    (
        "zero focal length",
        lambda: camera_with(K=intrinsics(k11=0)).check(),
        pa.CameraError,
        ["positive focal", "0.0"],
    ),
    (
        "transposed K",
        lambda: camera_with(K=np.array(CAMERA.K).T).check(),
        pa.CameraError,
        ["last row", "transposed"],
    ),
    (
        "K with NaN",
        lambda: camera_with(K=intrinsics(k00=np.nan)).check(),
        pa.CameraError,
        ["finite"],
    ),
    (
        "K of wrong shape",
        lambda: camera_with(K=np.eye(4)).check(),
        pa.ShapeError,
        ["[3, 3]", "[4, 4]", "vmap"],
    ),
    (
        "scaled rotation",
        lambda: run_with(camera=camera_with(cam_to_world=np.diag([2.0, 1, 1, 1]))),
        pa.PoseError,
        ["orthonormal", "= 3", "matrix_from_6d"],
    ),
    (
        "mirrored axes",
        lambda: run_with(camera=camera_with(cam_to_world=np.diag([-1.0, 1, 1, 1]))),
        pa.PoseError,
        ["right-handed", "det = -1", "flip two axes"],
    ),
    (
        "transposed pose",
        lambda: pa.unproject(camera_with(cam_to_world=tcp_at(1, 2, 3).T), UV, 1.0),
        pa.PoseError,
        ["last row", "last column"],
    ),
    (
        "field of view",
        lambda: pa.Camera.from_fovy(180.0, 10, 10, np.eye(4)),
        pa.CameraError,
        ["between 0 and 180", "180"],
    ),
    (
        "camera without pixels",
        lambda: camera_with(height=0).check(),
        pa.CameraError,
        ["at least 1", "0 x 120"],
    ),
    ("negative scale", lambda: CAMERA.scaled(-1.0), pa.OptionError, ["positive", "-1.0"]),
    # Where the TCP is.
    (
        "TCP behind, align",
        lambda: run_with(tcp=tcp_at(0, 0, -0.5)),
        pa.ProjectionError,
        ["in front", "-0.5", "not its inverse"],
    ),
    (
        "TCP behind, overlay",
        lambda: pa.tcp_overlay(IMAGE, CAMERA, tcp_at(0, 0, -0.5)),
        pa.ProjectionError,
        ["in front"],
    ),
    (
        "TCP outside, align",
        lambda: run_with(tcp=tcp_at(1, 0, 0.5)),
        pa.ProjectionError,
        ["inside the 100 x 120", "233", "valid"],
    ),
    (
        "TCP outside, overlay",
        lambda: pa.tcp_overlay(IMAGE, CAMERA, tcp_at(0, -1, 0.5)),
        pa.ProjectionError,
        ["inside the 100 x 120"],
    ),
    (
        "uv outside",
        lambda: pa.tcp_crop(IMAGE, (120.0, 5.0), 20),
        pa.ProjectionError,
        ["inside the 100 x 120", "(120.0, 5.0)"],
    ),
    ("uv not finite", lambda: pa.tcp_crop(IMAGE, (np.nan, 5.0), 20), pa.ProjectionError, ["nan"]),
    # Poses.
    (
        "sheared TCP",
        lambda: run_with(tcp=TCP + np.eye(4, k=1)),
        pa.PoseError,
        ["tcp", "orthonormal"],
    ),
    (
        "TCP of wrong shape",
        lambda: run_with(tcp=TCP[:3]),
        pa.ShapeError,
        ["[4, 4]", "[3, 4]", "vmap"],
    ),
    (
        "batch of TCPs",
        lambda: run_with(tcp=np.stack([TCP, TCP])),
        pa.ShapeError,
        ["one example", "vmap"],
    ),
    ("6D of a scaled matrix", lambda: pa.rotation_6d(2 * np.eye(3)), pa.PoseError, ["orthonormal"]),
    ("6D of wrong length", lambda: pa.matrix_from_6d(np.zeros(9)), pa.ShapeError, ["[6]", "[9]"]),
    (
        "delta with gripper",
        lambda: pa.apply_delta(TCP, np.zeros(10)),
        pa.ShapeError,
        ["9 numbers", "got 10", "[..., :9]"],
    ),
    (
        "delta from a bad pose",
        lambda: pa.encode_delta(np.zeros((4, 4)), TCP),
        pa.PoseError,
        ["tcp", "last row"],
    ),
    (
        "points of wrong length",
        lambda: pa.project(CAMERA, np.zeros((5, 2))),
        pa.ShapeError,
        ["[3]", "[5, 2]"],
    ),
    # Images.
    (
        "batch where one image goes",
        lambda: pa.tcp_crop(IMAGE[None], UV, 20),
        pa.ShapeError,
        ["rank 3", "[1, 100, 120, 3]", "vmap"],
    ),
    (
        "one image where a batch goes",
        lambda: pa.random_crop(KEY, IMAGE, 20),
        pa.ShapeError,
        ["rank 4", "batch axis"],
    ),
    (
        "grey image",
        lambda: run_with(image=IMAGE[..., :1]),
        pa.ShapeError,
        ["3 colour channels", "[100, 120, 1]"],
    ),
    (
        "CHW image",
        lambda: pa.perspective_warp(IMAGE.transpose(2, 0, 1), np.zeros((4, 2))),
        pa.ShapeError,
        ["3 colour channels", "to the end"],
    ),
    (
        "int image",
        lambda: pa.resize(IMAGE.astype(np.int32), 8),
        pa.DtypeError,
        ["uint8", "int32", "astype"],
    ),
    ("bool image", lambda: pa.random_perspective(KEY, BATCH > 0), pa.DtypeError, ["uint8", "bool"]),
    (
        "floats up to 255",
        lambda: run_with(image=IMAGE + np.float32(255)),
        pa.OptionError,
        ["[0, 1]", "255", "divide"],
    ),
    (
        "image of another camera",
        lambda: run_with(image=IMAGE[:90]),
        pa.ShapeError,
        ["100 x 120", "90 x 120", "camera.scaled"],
    ),
    (
        "window of another size",
        lambda: pa.align_window(IMAGE, CAMERA, (0, 0), TCP, 1.0, SPEC),
        pa.ShapeError,
        ["30 x 30", "view_camera"],
    ),
    (
        "bank of another size",
        lambda: pa.random_overlay(KEY, BATCH, BATCH[:, :9]),
        pa.ShapeError,
        ["[N, 20, 20, 3]", "[4, 9, 20, 3]", "resize"],
    ),
    ("empty bank", lambda: pa.random_overlay(KEY, BATCH, BATCH[:0]), pa.ShapeError, ["at least 1"]),
    (
        "background of another size",
        lambda: pa.overlay_blend(IMAGE, IMAGE[:9], 0.5),
        pa.ShapeError,
        ["resize it"],
    ),
    # Options.
    (
        "crop too large",
        lambda: pa.tcp_crop(IMAGE, UV, 101),
        pa.OptionError,
        ["at most", "100 x 120", "101"],
    ),
    (
        "spec's crop too large",
        lambda: run_with(spec=pa.AlignSpec(crop=200)),
        pa.OptionError,
        ["AlignSpec.crop", "100 x 120", "200"],
    ),
    (
        "crop without pixels",
        lambda: pa.center_crop(BATCH, 0),
        pa.OptionError,
        ["positive whole", "0"],
    ),
    (
        "fractional crop",
        lambda: pa.random_crop(KEY, BATCH, 7.5),
        pa.OptionError,
        ["whole number", "7.5"],
    ),
    ("resize to nothing", lambda: pa.resize(IMAGE, (0, 4)), pa.OptionError, ["positive"]),
    (
        "border",
        lambda: pa.tcp_crop(IMAGE, UV, 20, border="wrap"),
        pa.OptionError,
        ["shift, edge, constant", "'wrap'"],
    ),
    (
        "spec's border",
        lambda: pa.AlignSpec(border="wrap"),
        pa.OptionError,
        ["shift, edge, constant"],
    ),
    (
        "layout",
        lambda: pa.proprio(TCP, 1.0, CAMERA, layout="xyz"),
        pa.OptionError,
        ["cam6d_z, world6d_xyz", "'xyz'"],
    ),
    ("spec's layout", lambda: pa.AlignSpec(layout="cam"), pa.OptionError, ["cam6d_z", "'cam'"]),
    ("spec's size", lambda: pa.AlignSpec(size=0), pa.OptionError, ["AlignSpec.size", "positive"]),
    (
        "spec's stroke",
        lambda: pa.AlignSpec(thickness=-1),
        pa.OptionError,
        ["thickness", "at least 0"],
    ),
    ("spec's offset", lambda: pa.AlignSpec(offset=(40,)), pa.OptionError, ["(u, v)"]),
    (
        "stroke sizes of an unknown frame",
        lambda: pa.AlignSpec(crop=None).view_camera(CAMERA),
        pa.OptionError,
        ["100 rows", "512", "frame"],
    ),
    (
        "layout without a camera",
        lambda: pa.proprio(TCP, 1.0, None),
        pa.OptionError,
        ["camera", "None"],
    ),
    (
        "stroke",
        lambda: pa.tcp_overlay(IMAGE, CAMERA, TCP, dot_radius=-1),
        pa.OptionError,
        ["dot_radius", "-1"],
    ),
    (
        "fraction",
        lambda: pa.random_overlay(KEY, BATCH, BATCH, fraction=1.5),
        pa.OptionError,
        ["from 0 to 1", "1.5"],
    ),
    (
        "alpha",
        lambda: pa.random_overlay(KEY, BATCH, BATCH, alpha=-0.1),
        pa.OptionError,
        ["from 0 to 1", "-0.1"],
    ),
    (
        "distortion",
        lambda: pa.random_perspective(KEY, BATCH, distortion=1.0),
        pa.OptionError,
        ["distortion"],
    ),
    (
        "probability",
        lambda: pa.random_perspective(KEY, BATCH, probability=2),
        pa.OptionError,
        ["probability", "2"],
    ),
    (
        "turned camera elsewhere",
        lambda: pa.turn_view(IMAGE, CAMERA, camera_with(cam_to_world=tcp_at(0.0, 0.0, 0.1))),
        pa.CameraError,
        ["place of the first", "0.1000 m"],
    ),
    (
        "pan in degrees",
        lambda: pa.random_turn(KEY, BATCH, CAMERA, np.zeros((4, 3)), pan=20),
        pa.OptionError,
        ["pan", "20"],
    ),
    (
        "points of another batch",
        lambda: pa.random_turn(KEY, BATCH, CAMERA, np.zeros((3, 3))),
        pa.ShapeError,
        ["each of the 4 images", "[3, 3]"],
    ),
    (
        "corners out of order",
        lambda: pa.perspective_warp(IMAGE, np.array([[0, 0], [0, 9], [9, 9], [9, 0]])),
        pa.OptionError,
        ["convex", "top left"],
    ),
    (
        "too many overwritten frames",
        lambda: pa.overwrite_transitions(np.zeros((3, 9)), 4),
        pa.OptionError,
        ["0 to 3", "4"],
    ),
    ("labels of one frame", lambda: pa.gripper_labels(np.zeros(1)), pa.ShapeError, ["at least 2"]),
]


def run_with(image=IMAGE, camera=CAMERA, tcp=TCP, spec=SPEC):
    return pa.align(image, camera, tcp, 1.0, spec)


@pytest.mark.parametrize(
    ("call", "error", "words"), [case[1:] for case in CASES], ids=[case[0] for case in CASES]
)
def test_bad_input(call, error, words):
    with pytest.raises(error) as caught:
        call()
    message = str(caught.value)
    assert "expected" in message
    for word in words:
        assert word in message, message


def test_errors_are_the_builtin_ones_too():
    for error in (pa.ShapeError, pa.OptionError, pa.PoseError, pa.CameraError, pa.ProjectionError):
        assert issubclass(error, ValueError)
    assert issubclass(pa.DtypeError, TypeError)


def test_good_input_passes():
    run_with()
    seen = pa.align(np.float64(IMAGE) / 255, CAMERA, TCP.tolist(), True, SPEC)
    assert bool(seen.valid) and np.isfinite(seen.image).all() and np.isfinite(seen.proprio).all()


def test_a_traced_fraction_is_refused():
    with pytest.raises(pa.OptionError, match="alpha instead"):
        jax.jit(lambda f: pa.random_overlay(KEY, BATCH, BATCH, fraction=f))(0.5)


def test_shapes_are_checked_while_tracing():
    with pytest.raises(pa.ShapeError, match="vmap"):
        jax.jit(pa.project)(camera_with(K=np.zeros((2, 3, 3), np.float32)), TCP[:3, 3])


def test_values_are_not_checked_while_tracing():
    bad = camera_with(cam_to_world=np.diag([2.0, 1, 1, 1]).astype(np.float32))
    jax.jit(pa.project)(bad, TCP[:3, 3])
