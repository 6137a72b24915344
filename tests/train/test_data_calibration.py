"""calibration.json: what is in it, what is refused, and where it comes from."""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path

import datasets
import h5py
import mujoco
import numpy as np
import oracles
import pytest
from scipy.spatial.transform import Rotation

from palm_jax.align import project
from palm_jax.train.data import calibration as calib
from palm_jax.train.data import commands, importers, motion, rotations
from palm_jax.train.data.calibration import Calibration, CameraCalibration
from palm_jax.train.data.errors import (
    CalibrationError,
    CameraNameError,
    DataError,
    EulerAmbiguityError,
    FormatError,
    ImageSizeError,
    PoseDataError,
)
from palm_jax.train.data.recording import open_recording, range_problem
from palm_jax.train.data.source import open_source

POSE = oracles.looking_at(np.array([1.0, -0.4, 1.5]), np.array([0.2, 0.1, 0.8]))
K = np.array([[600.0, 0.0, 330.0], [0.0, 610.0, 235.0], [0.0, 0.0, 1.0]])


def camera(**changes) -> CameraCalibration:
    return dataclasses.replace(CameraCalibration("front", K, 640, 480, POSE), **changes)


def content(**changes) -> dict:
    entry = Calibration({"front": camera()}).to_json()
    for place, value in changes.items():
        *path, last = place.split("__")
        target = entry
        for part in path:
            target = target[part]
        target[last] = value
    return entry


# -- orientations ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("reading", "numbers"),
    [
        ("euler_xyz", lambda r: r.as_euler("xyz")),
        ("euler_XYZ", lambda r: r.as_euler("XYZ")),
        ("quat_xyzw", lambda r: r.as_quat()),
        ("quat_wxyz", lambda r: r.as_quat(scalar_first=True)),
        ("rotvec", lambda r: r.as_rotvec()),
        ("rot6d", lambda r: np.swapaxes(r.as_matrix()[..., :2], 1, 2).reshape(-1, 6)),
    ],
)
def test_orientations_read_as_scipy_writes_them(reading: str, numbers) -> None:
    rotation = Rotation.random(20, rng=np.random.default_rng(0))
    position = np.arange(60.0).reshape(20, 3)
    poses = rotations.poses(np.concatenate([position, numbers(rotation)], 1), reading)
    np.testing.assert_allclose(poses[:, :3, :3], rotation.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(poses[:, :3, 3], position)
    again = rotations.poses(poses.reshape(20, 16), "matrix")
    np.testing.assert_array_equal(again, poses)


def test_apart_is_the_angle_between() -> None:
    first, second = Rotation.from_euler("z", 0.3), Rotation.from_euler("z", 1.1)
    angle = rotations.apart(first.as_matrix()[None], second.as_matrix()[None])
    assert angle == pytest.approx(np.degrees(0.8))


@pytest.mark.parametrize(
    ("numbers", "reading", "error", "words"),
    [
        (np.full((3, 6), np.nan), "euler_xyz", PoseDataError, "NaN or infinity in 3 frames"),
        (np.ones((3, 7)), "quat_xyzw", PoseDataError, "length 1, got lengths from 2"),
        (np.ones((3, 7)), "euler_xyz", FormatError, r"expected 3 \+ 3 numbers"),
        (np.ones((3, 6)), "yaw", FormatError, "known: euler_xyz"),
        (np.ones((3, 12)), "matrix", FormatError, "4 x 4"),
    ],
)
def test_numbers_that_are_no_poses(numbers, reading: str, error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        rotations.poses(numbers, reading)


@pytest.mark.parametrize("order", ["xyz", "XYZ"])
def test_a_pose_reread_in_the_other_order(order: str) -> None:
    """What `data check` tries: the same three angles, read as the other order."""
    angles = np.array([-2.1, 0.3, 1.2])
    other = "XYZ" if order == "xyz" else "xyz"
    pose = oracles.pose(Rotation.from_euler(other, angles).as_matrix(), np.zeros(3))
    reading = motion.Reading("none", euler=order)
    again = motion.pose_as(pose, reading)[:3, :3]
    np.testing.assert_allclose(again, Rotation.from_euler(order, angles).as_matrix(), atol=1e-9)


# -- the file --------------------------------------------------------------------------------------


def test_the_file_comes_back_as_it_was(tmp_path: Path) -> None:
    other = oracles.looking_at(np.array([0.9, 0.5, 1.2]), np.array([0.2, 0.1, 0.8]))
    whole = Calibration(
        {"front": camera(dist=(0.1, 0.0, 0.0, 0.01), flip="180", by_episode={"demo_3": other})},
        oracles.pose(np.eye(3), np.array([0.0, 0.0, 0.1])),
        calib.RobotKeys("state[0:7]", "quat_wxyz", "state[7]", 0.1, 0.9),
        "hand",
    )
    path = calib.save(whole, tmp_path / "calibration.json")
    again = calib.load(path)
    assert again.to_json() == whole.to_json() and again.sha256 == whole.sha256
    found = again.cameras["front"]
    np.testing.assert_allclose(found.camera("demo_3").cam_to_world, other, atol=1e-6)
    np.testing.assert_allclose(found.camera("demo_4").cam_to_world, POSE, atol=1e-6)
    assert json.loads(path.read_text())["cameras"]["front"]["T_base_cam"] == POSE.tolist()
    moved = dataclasses.replace(whole, made_from="elsewhere")
    assert moved.sha256 == whole.sha256
    assert dataclasses.replace(whole, ee_to_tcp=np.eye(4)).sha256 != whole.sha256


MIRROR = (POSE @ np.diag([1.0, -1.0, 1.0, 1.0])).tolist()


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"format": "palm-calib/2"}, CalibrationError, "expected 'palm-calib/1'"),
        ({"axes": "opengl"}, CalibrationError, "--axes opengl"),
        ({"cameras": {}}, CalibrationError, "at least one"),
        ({"cameras__front": 3}, CalibrationError, "expected an object"),
        ({"cameras__front__mount": "wrist"}, CalibrationError, "stands still"),
        ({"cameras__front__K": None}, CalibrationError, "cameras.front.K: missing"),
        ({"cameras__front__K": [[1.0]]}, CalibrationError, "3 x 3"),
        ({"cameras__front__K": (-K).tolist()}, CalibrationError, "positive focal"),
        ({"cameras__front__K": K.T.tolist()}, CalibrationError, "transposed"),
        ({"cameras__front__K": "no"}, CalibrationError, "expected numbers"),
        ({"cameras__front__width": 0}, CalibrationError, "number of pixels"),
        ({"cameras__front__width": 320}, ImageSizeError, "another resolution"),
        (
            {"cameras__front__width": 1280},
            ImageSizeError,
            "cx = 330.0 of 1280; .*another resolu",
        ),
        (
            {"cameras__front__height": 900},
            ImageSizeError,
            "cy = 235.0 of 900; .*--off-centre",
        ),
        ({"cameras__front__off_centre": -1}, CalibrationError, "off_centre: expected a share"),
        ({"cameras__front__off_centre": "no"}, CalibrationError, "off_centre: expected a share"),
        ({"cameras__front__flip": "left"}, CalibrationError, "none, ud, lr"),
        ({"cameras__front__dist": [0.1]}, CalibrationError, "4, 5, 8"),
        ({"cameras__front__dist": [None] * 5}, CalibrationError, "finite|numbers"),
        ({"cameras__front__T_base_cam": MIRROR}, CalibrationError, r"det = -1"),
        ({"cameras__front__T_base_cam": (2 * POSE).tolist()}, CalibrationError, "T_base_cam"),
        ({"cameras__front__T_base_cam": POSE[:3].tolist()}, CalibrationError, "4 x 4"),
        ({"cameras__front__T_base_cam": POSE.T.tolist()}, CalibrationError, "last column"),
        ({"cameras__front__by_episode": {"a": MIRROR}}, CalibrationError, "by_episode.a"),
        ({"T_ee_tcp": MIRROR}, CalibrationError, "T_ee_tcp"),
        ({"robot": {"hand": 1}}, CalibrationError, "unknown entries hand"),
        ({"robot": [1]}, CalibrationError, "robot: expected an object, got list"),
        ({"robot": {"pose": 3}}, CalibrationError, "robot.pose: expected a text, got 3"),
        ({"robot": {"rotation": "yaw"}}, CalibrationError, "robot.rotation: .*euler_xyz.* 'yaw'"),
        ({"robot": {"closed": "a"}}, CalibrationError, "robot.closed: expected a finite number"),
        ({"robot": {"open": math.nan}}, CalibrationError, "robot.open: expected a finite number"),
        ({"cameras": [1]}, CalibrationError, "cameras: expected an object, got list"),
        ({"cameras__front__flip": []}, CalibrationError, "none, ud, lr"),
        ({"cameras__front__image": 5}, CalibrationError, "front.image: expected a key, got 5"),
        ({"cameras__front__by_episode": [1]}, CalibrationError, "by_episode: expected an object"),
        ({"cameras__front__mount": None}, CalibrationError, "mount: expected 'static', got None"),
        ({"T_ee_tcp": None}, CalibrationError, "T_ee_tcp: expected finite"),
    ],
)
def test_what_is_refused(changes: dict, error: type, words: str, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(content(**changes)))
    with pytest.raises(error, match=words) as caught:
        calib.load(path)
    assert str(path) in str(caught.value) and isinstance(caught.value, CalibrationError)


def test_every_entry_may_be_odd(tmp_path: Path) -> None:
    """Whatever stands in a calibration.json: it is read, and can be used, or refused by name."""
    whole = content(cameras__front__by_episode={"demo_0": POSE.tolist()}, robot__pose="tcp")
    tried = refused = 0
    for place, entry in datasets.spoiled(whole):
        tried += 1
        path = tmp_path / "calibration.json"
        path.write_text(json.dumps(entry))
        try:
            found = calib.load(path)
            for each in found.cameras.values():
                each.camera("demo_0"), calib.image_key(each, ["front", "x"])
            assert len(found.sha256) == 64
        except CalibrationError:
            refused += 1
        except Exception as error:
            raise AssertionError(place) from error
    assert tried > 500 and refused > tried / 2


def test_no_file_and_no_json(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="data calibrate --from robosuite"):
        calib.load(tmp_path / "none.json")
    (tmp_path / "cut.json").write_text('{"format": "palm-')
    with pytest.raises(CalibrationError, match="not a readable JSON"):
        calib.load(tmp_path / "cut.json")


# -- pixels ----------------------------------------------------------------------------------------


def test_rescaled_cameras_see_the_same_at_other_pixels() -> None:
    points = np.random.default_rng(0).uniform((0, -0.3, 0.7), (0.5, 0.3, 1.0), (9, 3))
    uv, _ = project(camera().camera(), points)
    small, _ = project(camera().rescaled(320, 240).camera(), points)
    np.testing.assert_allclose(2 * np.asarray(small), uv, atol=1e-3)
    assert camera().rescaled(427, 320).width == 427  # 426.67 rounded
    with pytest.raises(ImageSizeError, match="cropped or padded"):
        camera().rescaled(256, 256)


@pytest.mark.parametrize("flip", list(calib.FLIPS))
def test_flips_of_images_and_of_pixels_agree(flip: str) -> None:
    upright = np.zeros((48, 64, 3), np.uint8)
    u, v = 51, 7
    upright[v, u] = 200
    stored = {
        "none": upright, "ud": np.flipud(upright), "lr": np.fliplr(upright),
        "180": np.rot90(upright, 2), "cw": np.rot90(upright, 1), "ccw": np.rot90(upright, -1),
    }[flip]  # fmt: skip
    small = dataclasses.replace(camera(), width=64, height=48, K=np.diag([60.0, 60, 1]), flip=flip)
    np.testing.assert_array_equal(small.upright(stored), upright)
    (row,), (column,) = np.nonzero(stored[..., 0])
    place = motion.stored_uv(flip, np.array([u + 0.5, v + 0.5]), 64, 48)
    np.testing.assert_array_equal(place, [column + 0.5, row + 0.5])
    with pytest.raises(ImageSizeError, match="--rescale 32 24"):
        small.upright(np.zeros((24, 32, 3), np.uint8))


def test_which_images_belong_to_a_camera() -> None:
    both = Calibration({"front": camera(), "side": camera(name="side")})
    keys = ["obs/front_image", "observation.images.side", "obs/other_image"]
    assert both.find("front", keys)[1] == "obs/front_image"
    assert both.find("side", keys)[1] == "observation.images.side"
    with pytest.raises(CameraNameError, match="choose one with --camera"):
        both.find(None, keys)
    assert both.find(None, keys[:1])[0].name == "front"
    with pytest.raises(CameraNameError, match="'top' is not in the calibration.*front, side"):
        both.find("top", keys)
    with pytest.raises(CameraNameError, match='as "image"'):
        both.find(None, keys[2:])
    named = Calibration({"front": camera(image="obs/other_image")})
    assert named.find(None, keys)[1] == "obs/other_image"


def test_cameras_are_named_after_their_images(tmp_path: Path) -> None:
    with open_source(datasets.LIFT) as source:
        assert importers.with_images(source, []) == ["agentview"]
    with open_source(datasets.lerobot(tmp_path)) as source:
        assert importers.with_images(source, []) == ["front"]
        assert importers.image_size(source, "front") == (128, 128)
    assert calib.short_names("obs/_image") == {"obs/_image", "_image"}


# -- importers -------------------------------------------------------------------------------------


def options(kind: str, **values) -> commands.Calibrate:
    return commands.Calibrate(kind, Path("unused.json"), **values)  # type: ignore[arg-type]


def test_robosuite_says_the_same_in_both_ways(tmp_path: Path) -> None:
    """camera_info was computed by robosuite; model_file is compiled and read by MuJoCo here."""

    def forget(file: h5py.File) -> None:
        for demo in file["data"].values():
            del demo.attrs["camera_info"]

    told = datasets.robosuite().cameras["agentview"]
    path = datasets.changed(datasets.LIFT, tmp_path, forget)
    compiled = datasets.robosuite(path).cameras["agentview"]
    np.testing.assert_allclose(compiled.cam_to_base, told.cam_to_base, atol=1e-5)
    np.testing.assert_allclose(compiled.K, told.K, rtol=1e-6)
    assert (compiled.width, compiled.height) == (told.width, told.height) == (128, 128)

    def move(file: h5py.File) -> None:
        for demo in file["data"].values():
            del demo.attrs["model_file"]

    (tmp_path / "again").mkdir()
    bare = datasets.changed(path, tmp_path / "again", move)
    with pytest.raises(CalibrationError, match="neither camera_info nor model_file"):
        datasets.robosuite(bare)


def test_a_camera_that_stands_elsewhere_in_one_episode(tmp_path: Path) -> None:
    def move(file: h5py.File) -> None:
        attributes = file["data/demo_1"].attrs
        info = json.loads(attributes["camera_info"])
        info["agentview"]["extrinsics"][0][3] += 0.25
        attributes["camera_info"] = json.dumps(info)

    found = datasets.robosuite(datasets.changed(datasets.LIFT, tmp_path, move))
    camera = found.cameras["agentview"]
    assert list(camera.by_episode) == ["demo_1"]
    shift = camera.camera("demo_1").cam_to_world - camera.camera("demo_0").cam_to_world
    np.testing.assert_allclose(shift[:, 3], [0.25, 0, 0, 0], atol=1e-6)


def information(change) -> Callable[[h5py.File], None]:
    """Changes `camera_info` of agentview in the second episode, or with its names in all."""

    def apply(file: h5py.File) -> None:
        for name, demo in file["data"].items():
            info = json.loads(demo.attrs["camera_info"])
            change(name, info["agentview"])
            demo.attrs["camera_info"] = json.dumps(info)

    return apply


def test_intrinsics_of_smaller_images(tmp_path: Path) -> None:
    """camera_info of 64 pixels beside images of 128."""

    def halve(_: str, entry: dict) -> None:
        entry["intrinsics"] = (np.array(entry["intrinsics"]) * [[0.5], [0.5], [1]]).tolist()

    path = datasets.changed(datasets.LIFT, tmp_path, information(halve))
    with pytest.raises(ImageSizeError, match="cx = 32.0 of 128; K belongs to another resolution"):
        datasets.robosuite(path)
    told = datasets.robosuite(path, size=(64, 64), rescale=(128, 128))
    right = datasets.robosuite().cameras["agentview"]
    np.testing.assert_allclose(told.cameras["agentview"].K, right.K, rtol=1e-9)
    cropped = datasets.robosuite(path, off_centre=0.3)
    again = calib.load(calib.save(cropped, tmp_path / "c.json"))
    assert again.cameras["agentview"].off_centre == 0.3 and again.sha256 == cropped.sha256


def test_intrinsics_that_differ_between_episodes(tmp_path: Path) -> None:
    def zoom(name: str, entry: dict) -> None:
        if name == "demo_1":
            entry["intrinsics"][0][0] *= 2

    path = datasets.changed(datasets.LIFT, tmp_path, information(zoom))
    with pytest.raises(CalibrationError, match="same K in every episode.* in demo_0 .* in demo_1"):
        datasets.robosuite(path)
    models = {"a": MODEL, "b": MODEL.replace('fovy="45"', 'fovy="46"')}
    sizes = {"low": (640, 480), "high": (640, 480)}
    with pytest.raises(CalibrationError, match="low: expected the same K"):
        importers.from_models(models, [], sizes)
    with h5py.File(tmp_path / "sensors.hdf5", "w") as file:
        for number in range(2):
            for key, value in sensor(intrinsic_cv=K + number * np.eye(3) * [1, 1, 0]).items():
                file[f"traj_{number}/sensor_param/front/{key}"] = value[None]
    with pytest.raises(CalibrationError, match="same K .* in traj_0 .* in traj_1"):
        importers.from_maniskill(tmp_path / "sensors.hdf5", None, [], (640, 480))


MODEL = """<mujoco><compiler meshdir="/nowhere"/><asset><mesh name="m" file="absent.stl"/></asset>
<default><camera fovy="50"/><geom density="3"/></default>
<worldbody><geom type="mesh" mesh="m"/>
  <body pos="0.1 0.2 0.3" euler="10 20 30"><camera name="high" pos="0 0 1" euler="0 20 0"/></body>
  <camera name="low" pos="1 0 .4" xyaxes="0 1 0 -.4 0 1" fovy="45"/>
  <body name="arm"><joint type="hinge"/><geom size=".1"/><camera name="hand"/></body>
</worldbody><actuator><motor joint="x"/></actuator></mujoco>"""


def test_mujoco_models_without_their_files() -> None:
    found = importers.from_mujoco(MODEL, [], (640, 480))
    assert set(found) == {"high", "low"}
    clean = mujoco.MjModel.from_xml_string(
        MODEL.replace('<mesh name="m" file="absent.stl"/>', "")
        .replace('<geom type="mesh" mesh="m"/>', "")
        .replace('<motor joint="x"/>', "")
    )
    data = mujoco.MjData(clean)
    mujoco.mj_forward(clean, data)
    for name, camera in found.items():
        index = clean.camera(name).id
        axes = data.cam_xmat[index].reshape(3, 3)
        expected = oracles.pose(axes * [1, -1, -1], data.cam_xpos[index])
        np.testing.assert_allclose(camera.cam_to_base, expected, atol=1e-9)
        half = np.tan(np.radians(clean.cam_fovy[index] / 2))
        assert camera.K[1, 1] * half == pytest.approx(240) and camera.K[0, 2] == 320
    assert found["low"].K[1, 1] != pytest.approx(found["high"].K[1, 1])
    with pytest.raises(CalibrationError, match="hangs on a joint"):
        importers.from_mujoco(MODEL, ["hand"], (640, 480))
    with pytest.raises(CameraNameError, match="it has low, high"):
        importers.from_mujoco(MODEL, ["top"], (640, 480))
    with pytest.raises(CalibrationError, match="--size"):
        importers.from_mujoco(MODEL, ["low"], None)
    for text, words in (("<a>", "not a readable MJCF"), ("<a/>", "not an MJCF")):
        with pytest.raises(CalibrationError, match=words):
            importers.from_mujoco(text, [], (640, 480))


GL = np.diag([1.0, -1.0, -1.0, 1.0])


def sensor(**changes) -> dict:
    arrays = {"intrinsic_cv": K, "extrinsic_cv": np.linalg.inv(POSE)[:3], "cam2world_gl": POSE @ GL}
    return {k: v for k, v in (arrays | changes).items() if v is not None}


@pytest.mark.parametrize("changes", [{}, {"cam2world_gl": None}, {"extrinsic_cv": None}])
@pytest.mark.parametrize("kind", ["hdf5", "json"])
def test_maniskill(changes: dict, kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"sensors.{kind}"
    arrays = sensor(**changes)
    if kind == "json":
        path.write_text(json.dumps({"base_camera": {k: v.tolist() for k, v in arrays.items()}}))
    else:
        with h5py.File(path, "w") as file:
            for key, value in arrays.items():
                place = f"traj_0/obs/sensor_param/base_camera/{key}"
                file[place] = np.repeat(value[None].astype(np.float32), 5, 0)
    made = commands.make_calibration(options("maniskill", file=path, size=(640, 480)))
    found = made.cameras["base_camera"]
    np.testing.assert_allclose(found.cam_to_base, POSE, atol=1e-5)
    np.testing.assert_allclose(found.K, K, rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"cam2world_gl": POSE}, "contradict each other"),
        ({"intrinsic_cv": None}, "needs intrinsic_cv"),
        ({"extrinsic_cv": np.stack([POSE, POSE @ oracles.pose(np.eye(3), np.ones(3))])}, "moves"),
    ],
)
def test_maniskill_that_cannot_be(changes: dict, words: str, tmp_path: Path) -> None:
    path = tmp_path / "sensors.json"
    entry = {key: np.asarray(value).tolist() for key, value in sensor(**changes).items()}
    path.write_text(json.dumps({"front": entry}))
    with pytest.raises(CalibrationError, match=words):
        commands.make_calibration(options("maniskill", file=path, size=(640, 480)))
    with pytest.raises(CameraNameError, match="only front"):
        importers.from_maniskill(path, None, ["side"], (640, 480))


VECTOR = "0.4,-0.5,0.6,-2.1,0.3,1.2"


@pytest.mark.parametrize("order", ["xyz", "XYZ"])
def test_droid_reads_angles_as_told(order: str) -> None:
    config = options(
        "droid", camera=("front",), K="600,610,330,235", size=(640, 480), extrinsics=VECTOR,
        euler=order,
    )  # fmt: skip
    found = commands.make_calibration(config).cameras["front"]
    angles = [float(text) for text in VECTOR.split(",")]
    expected = oracles.pose(Rotation.from_euler(order, angles[3:]).as_matrix(), angles[:3])
    np.testing.assert_allclose(found.cam_to_base, expected, atol=1e-12)
    np.testing.assert_array_equal(found.K, K)


def test_droid_does_not_choose_by_itself() -> None:
    config = options(
        "droid", camera=("front",), K="600,610,330,235", size=(640, 480), extrinsics=VECTOR
    )
    with pytest.raises(EulerAmbiguityError, match=r"euler_xyz .* or euler_XYZ .* degrees apart"):
        commands.make_calibration(config)


@pytest.mark.parametrize("axes", ["opencv", "opengl", "coppelia"])
@pytest.mark.parametrize("inverse", [False, True])
def test_arrays(axes: str, inverse: bool, tmp_path: Path) -> None:
    turn = {
        "opencv": np.eye(4),
        "opengl": GL,
        "coppelia": np.diag([-1.0, -1.0, 1.0, 1.0]),
    }[axes]
    stored = np.linalg.inv(POSE @ turn) if inverse else POSE @ turn
    np.save(tmp_path / "pose.npy", stored[:3])
    np.save(tmp_path / "K.npy", K)
    config = options(
        "npy", camera=("front",), K=str(tmp_path / "K.npy"), size=(640, 480), axes=axes,
        extrinsics=str(tmp_path / "pose.npy"), inverse=inverse, dist="0.1 0 0 0 0",
        pixel_origin="centre",
    )  # fmt: skip
    found = commands.make_calibration(config).cameras["front"]
    np.testing.assert_allclose(found.cam_to_base, POSE, atol=1e-9)
    np.testing.assert_array_equal(found.K[:2, 2], K[:2, 2] + 0.5)
    assert found.dist == (0.1, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("kind", "values", "error", "words"),
    [
        ("npy", {}, CalibrationError, "name it with --camera"),
        ("npy", {"camera": ("a",)}, CalibrationError, "--K"),
        ("npy", {"camera": ("a",), "K": "1,2"}, CalibrationError, "fx,fy,cx,cy"),
        ("npy", {"camera": ("a",), "K": "f.npy"}, FormatError, "cannot be read"),
        ("npy", {"camera": ("a",), "K": "x"}, FormatError, "expected numbers"),
        ("npy", {"camera": ("a",), "K": "5,5,1,1"}, CalibrationError, "--size"),
        (
            "npy",
            {"camera": ("a",), "K": "5,5,1,1", "size": (4, 4)},
            CalibrationError,
            "--extrinsics",
        ),
        ("robosuite", {}, CalibrationError, "needs a --file"),
        ("mujoco", {"file": Path("absent.xml")}, CalibrationError, "cannot be read"),
        ("robosuite", {"file": datasets.LIFT, "camera": ("side",)}, CameraNameError, "agentview"),
    ],
)
def test_options_that_are_missing(kind: str, values: dict, error: type, words: str) -> None:
    with pytest.raises(error, match=words) as caught:
        commands.make_calibration(options(kind, **values))
    assert isinstance(caught.value, DataError)


def test_changing_a_calibration(tmp_path: Path) -> None:
    path = calib.save(datasets.robosuite(), tmp_path / "first.json")
    before = calib.load(path).cameras["agentview"]
    config = options(
        "palm", file=path, flip="ud", rescale=(64, 64), axes="opengl", tcp_turn=90.0,
        tcp_offset=(0.0, 0.0, 0.01), opening="grip", closed=1.0, open=0.0,
    )  # fmt: skip
    changed = commands.make_calibration(config)
    after = changed.cameras["agentview"]
    assert after.flip == "ud" and after.width == 64
    np.testing.assert_allclose(after.K[:2] * 2, before.K[:2])
    np.testing.assert_allclose(after.cam_to_base, before.cam_to_base @ GL)
    expected = oracles.pose(Rotation.from_euler("z", np.pi / 2).as_matrix(), [0, 0, 0.01])
    np.testing.assert_allclose(changed.ee_to_tcp, expected, atol=1e-12)
    assert changed.robot.opening == "grip" and changed.robot.closed == 1.0
    kept = commands.make_calibration(options("palm", file=path))
    assert kept.to_json() == calib.load(path).to_json()


def test_one_camera_is_changed_and_the_others_stay(tmp_path: Path) -> None:
    """What `data check` advises for a camera must not break those that are right."""
    both = Calibration({"front": camera(), "side": camera(name="side", flip="lr")})
    path = calib.save(both, tmp_path / "both.json")
    changes = {"flip": "ud", "axes": "opengl", "image": "obs/x", "rescale": (320, 240)}
    made = commands.make_calibration(options("palm", file=path, camera=("front",), **changes))
    assert made.to_json()["cameras"]["side"] == both.to_json()["cameras"]["side"]
    front = made.cameras["front"]
    assert (front.flip, front.image, front.width) == ("ud", "obs/x", 320)
    np.testing.assert_allclose(front.cam_to_base, POSE @ GL)
    assert list(made.cameras) == ["front", "side"]
    every = commands.make_calibration(options("palm", file=path, flip="ud"))
    assert {each.flip for each in every.cameras.values()} == {"ud"}
    with pytest.raises(CameraNameError, match="'top' is not in the calibration.*front, side"):
        commands.make_calibration(options("palm", file=path, camera=("top",), flip="ud"))
    with pytest.raises(CalibrationError, match="--image .*front, side; choose it with --camera"):
        commands.make_calibration(options("palm", file=path, image="obs/x"))


@pytest.mark.parametrize(
    ("kind", "values", "users"),
    [
        ("robosuite", {"inverse": True}, "droid, npy, palm"),
        ("mujoco", {"axes": "opengl"}, "droid, npy, palm"),
        ("maniskill", {"K": "1,1,1,1"}, "droid, npy"),
        ("palm", {"size": (64, 64)}, "robosuite, mujoco, maniskill, droid, npy"),
        ("palm", {"extrinsics": "1,1,1,1,1,1"}, "droid, npy"),
        ("npy", {"euler": "xyz"}, "droid"),
    ],
)
def test_options_without_an_effect_are_refused(kind: str, values: dict, users: str) -> None:
    (name,) = values
    with pytest.raises(CalibrationError, match=f"--{name}: .*{kind} does not .*only {users};"):
        commands.make_calibration(options(kind, file=Path("absent"), **values))


def test_the_other_orientation_that_robosuite_writes() -> None:
    """`robot0_eef_quat_site` is that of the grip site, a quarter turn from the hand's."""
    other = datasets.robosuite(
        pose="robot0_eef_pos+robot0_eef_quat_site", rotation="quat_xyzw", tcp_turn=90.0
    )
    with (
        open_recording(datasets.LIFT, datasets.robosuite()) as first,
        open_recording(datasets.LIFT, other) as second,
    ):
        expected, got = first.trajectory("demo_1").tcp, second.trajectory("demo_1").tcp
    np.testing.assert_allclose(got, expected, atol=1e-3)


@pytest.mark.parametrize(("closed", "opened"), [(1.0, -1.0), (-1.0, 1.0), (-0.04, 0.0)])
def test_a_single_gripper_value_keeps_its_sign(
    closed: float, opened: float, tmp_path: Path
) -> None:
    """robosuite's, LIBERO's and Bridge's command is -1 open, 1 closed; only of several fingers,
    which mirror each other, is the sign nothing."""
    share = np.linspace(0, 1, 15)

    def add(file: h5py.File) -> None:
        values = (closed + share * (opened - closed))[:, None]
        file["data/demo_0/obs/grip"] = values
        file["data/demo_0/obs/fingers"] = np.concatenate([share, -share]).reshape(2, 15).T

    path = datasets.changed(datasets.LIFT, tmp_path, add)
    for key, ends in (("grip", (closed, opened)), ("fingers", (0.0, 1.0))):
        told = datasets.robosuite(path, opening=key, closed=ends[0], open=ends[1])
        with open_recording(path, told) as recording:
            got = recording.trajectory("demo_0").opening
        np.testing.assert_allclose(got, share, atol=1e-12)


@pytest.mark.parametrize(
    ("reach", "words"),
    [
        ((0.0, 1.0), ""), ((-0.1, 1.1), ""),
        ((0.6, 1.0), ""),  # closes around something wide
        ((0.0, 0.03), ""), ((0.0, 0.0), ""),  # closed throughout
        ((0.3, 0.32), ""),  # holds something throughout
        ((0.0, 0.1), "never half open"), ((0.05, 0.4), "never half open"),
        ((0.0, 25.0), "far outside"), ((-1.0, 0.0), "far outside"),
    ],
)  # fmt: skip
def test_ranges_of_a_gripper(reach: tuple[float, float], words: str) -> None:
    for closed, opened in ((0.0, 0.04), (1.0, 0.0), (1.0, -1.0)):
        keys = calib.RobotKeys("p", "matrix", "grip", closed, opened)
        problem = range_problem(keys, reach)
        assert words in problem and bool(words) == bool(problem)
        if problem:
            ends = sorted(closed + share * (opened - closed) for share in reach)
            assert f"grip goes from {ends[0]:.4g} to {ends[1]:.4g}" in problem


def test_sources_name_their_keys_and_columns() -> None:
    with open_source(datasets.LIFT) as source:
        assert source.resolve("robot0_eef_pos") == "obs/robot0_eef_pos"
        columns = source.columns("demo_0", "robot0_eef_pos[1:3]+robot0_gripper_qpos[0]")
        position = source.numbers("demo_0", "obs/robot0_eef_pos")
        gripper = source.numbers("demo_0", "obs/robot0_gripper_qpos")
        np.testing.assert_array_equal(columns, np.c_[position[:, 1:], gripper[:, :1]])
        with pytest.raises(FormatError, match="has 3 columns"):
            source.columns("demo_0", "robot0_eef_pos[2:5]")
