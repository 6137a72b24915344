"""`data check`: the reprojection error, which mistake it names, the sheet; and the command line."""

import dataclasses
import json
import re
from pathlib import Path

import datasets
import h5py
import numpy as np
import oracles
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from palm_jax.__main__ import main
from palm_jax.train.data import aligning, calibration, check, commands, errors, job, motion
from palm_jax.train.data.calibration import Calibration
from palm_jax.train.data.recording import Recording, open_recording

SAMPLES = [datasets.LIFT, datasets.CAN]
MEASURED = "obs/agentview_tcp_uv"


def with_camera(path: Path, **changes) -> Calibration:
    found = datasets.robosuite(path)
    camera = dataclasses.replace(found.cameras["agentview"], **changes)
    return dataclasses.replace(found, cameras={"agentview": camera})


def posed(path: Path, turn) -> Calibration:
    """The pose of the camera replaced by `turn(pose)`."""
    pose = datasets.robosuite(path).cameras["agentview"].cam_to_base
    return with_camera(path, cam_to_base=turn(pose))


def camera_of(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """K and pose that robosuite wrote."""
    with h5py.File(path) as file:
        info = json.loads(file["data/demo_0"].attrs["camera_info"])["agentview"]
    return np.array(info["intrinsics"]), np.array(info["extrinsics"])


@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.stem)
def test_the_tcp_is_where_robosuite_renders_it(path: Path) -> None:
    """Against pixels that robosuite's renderer showed the grip site at, without any matrix."""
    with open_recording(path, datasets.robosuite(path)) as recording:
        report = check.check(recording)
        assert report.problem is None and report.motion.tells
        assert report.survey.in_view == 1.0 and report.survey.behind == 0.0
        found = report.reprojection
        assert found is not None and found.frames == report.survey.frames
        assert found.mean < 0.1 and found.most < 0.2
        distances = []
        with h5py.File(path) as file:
            for demo in file["data"].values():
                info = json.loads(demo.attrs["camera_info"])["agentview"]
                matrices = np.array(info["intrinsics"]), np.array(info["extrinsics"])
                uv, _ = oracles.project(*matrices, demo["obs/robot0_eef_pos"][()])
                seen = demo["obs/agentview_tcp_uv"][()]
                distances += list(np.linalg.norm(uv - seen, axis=1))
        assert found.mean == pytest.approx(np.mean(distances), abs=1e-5)
        assert found.most == pytest.approx(np.max(distances), abs=1e-5)


@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.stem)
def test_pixels_measured_elsewhere_are_a_problem(path: Path, tmp_path: Path) -> None:
    """K of another lens has the TCP in view, and the images may move as with another flip. By how
    much it is off is computed from what robosuite wrote."""
    K, pose = camera_of(path)
    K[[0, 1], [0, 1]] /= 2
    expected = []
    with h5py.File(path) as file:
        for demo in file["data"].values():
            uv, _ = oracles.project(K, pose, demo["obs/robot0_eef_pos"][()])
            expected += list(np.linalg.norm(uv - demo[MEASURED][()], axis=1))
    with open_recording(path, with_camera(path, K=K)) as recording:
        report = check.check(recording)
        assert report.survey.in_view == 1.0 and report.reprojection is not None
        assert report.reprojection.median == pytest.approx(np.median(expected), abs=1e-4)
        assert report.reprojection.median > 5 and type(report.problem) is errors.ReprojectionError
        with pytest.raises(errors.ReprojectionError, match=r"tcp_uv, got \d+\.\d px \(median of"):
            job.preflight(recording)
        assert job.preflight(recording, trust=True).in_view == 1.0
    moved = posed(path, lambda pose: pose @ oracles.pose(np.eye(3), [0.03, 0, 0]))
    with open_recording(path, moved) as recording:
        problem = check.check(recording).problem
    assert type(problem) is errors.ReprojectionError
    bare = datasets.changed(
        path, tmp_path, lambda f: [d.pop(MEASURED) for d in f["data"].values()] and None
    )
    with open_recording(bare, moved) as recording:
        assert check.check(recording).problem is None  # nobody can know


def distorted(uv: np.ndarray, K: np.ndarray, dist: tuple[float, ...]) -> np.ndarray:
    """OpenCV's formula for k1, k2, p1, p2, in NumPy."""
    x, y = ((uv - K[:2, 2]) / K[[0, 1], [0, 1]]).T
    k1, k2, p1, p2 = dist
    square = x**2 + y**2
    radial = 1 + k1 * square + k2 * square**2
    moved = [
        x * radial + 2 * p1 * x * y + p2 * (square + 2 * x**2),
        y * radial + 2 * p2 * x * y + p1 * (square + 2 * y**2),
    ]
    return np.stack(moved, 1) * K[[0, 1], [0, 1]] + K[:2, 2]


def test_measured_pixels_are_those_of_the_lens(tmp_path: Path) -> None:
    """Measured in the images as stored: distorted, and upside down."""
    dist = (-0.3, 0.1, 0.01, -0.02)
    K, _ = camera_of(datasets.LIFT)
    far = []

    def bend(file: h5py.File) -> None:
        for demo in file["data"].values():
            before = demo[MEASURED][()]
            after = distorted(before, K, dist)
            far.append(np.linalg.norm(after - before, axis=1).max())
            demo[MEASURED][...] = after * [1, -1] + [0, 128]

    path = datasets.changed(datasets.LIFT, tmp_path, bend)
    assert max(far) > 1
    with open_recording(path, with_camera(path, dist=dist, flip="ud")) as recording:
        found = check.reprojection(recording)
    assert found is not None and found.most < 0.2


def test_points_that_the_lens_puts_nowhere() -> None:
    """A barrel distortion folds: far outside, the model leads back into the image."""
    camera = with_camera(datasets.LIFT, dist=(-0.3, 0.0, 0.0, 0.0)).cameras["agentview"]
    folded = np.array([[64.0 + 154.5 * 1.8, 64.0]])
    assert 0 < distorted(folded, camera.K, (-0.3, 0.0, 0.0, 0.0))[0, 0] < 128
    assert np.isnan(motion.seen_uv(camera, folded, "none")).all()
    inside = np.array([[[100.0, 30.0], [np.nan, np.nan]]])
    got = motion.seen_uv(camera, inside, "none")
    np.testing.assert_allclose(got[0, :1], distorted(inside[0, :1], camera.K, (-0.3, 0, 0, 0)),
                               atol=1e-4)  # fmt: skip
    assert np.isnan(got[0, 1]).all()


def test_motion_is_looked_for_where_the_lens_shows_it() -> None:
    """Changes that were drawn where NumPy says that the lens puts the TCP."""
    dist = (0.9, 0.1, 0.01, 0.0)
    camera = with_camera(datasets.LIFT, dist=dist).cameras["agentview"]
    K, pose = camera_of(datasets.LIFT)
    points = np.random.default_rng(0).uniform((-0.4, -0.4, 0.7), (0.4, 0.4, 1.2), (60, 2, 3))
    uv, _ = oracles.project(K, pose, points.reshape(-1, 3))
    u, v = distorted(uv, K, dist).T.reshape(2, 60, 2, 1, 1) * 48 / 128
    row, column = np.mgrid[:48, :48] + 0.5
    maps = np.exp(-((row - v) ** 2 + (column - u) ** 2) / (2 * 4**2)).sum(1).reshape(60, -1)
    pairs = motion._Pairs(["demo_0"] * 60, points, maps - maps.mean(0))
    parts, _ = motion._contributions(camera, pairs, motion.Reading("none"))
    assert parts.mean() > 0.999
    pinhole = dataclasses.replace(camera, dist=None)
    assert motion._contributions(pinhole, pairs, motion.Reading("none"))[0].mean() < 0.95


@pytest.mark.parametrize("flip", ["ud", "lr", "180", "cw", "ccw"])
@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.stem)
def test_flips_are_named(path: Path, flip: str) -> None:
    """The calibration says that the images are flipped, and they are not."""
    with open_recording(path, with_camera(path, flip=flip)) as recording:
        report = check.check(recording)
    assert report.motion.best.reading == motion.Reading("none")
    assert type(report.problem).__name__ == "ImageOrientationError"
    assert "--flip none" in str(report.problem)


@pytest.mark.parametrize("flip", ["ud", "lr", "180"])
def test_flipped_files_are_named(flip: str, tmp_path: Path) -> None:
    def turn(file: h5py.File) -> None:
        demo = file["data/demo_0"]
        datasets.replace(
            demo, datasets.IMAGES, calibration.FLIPS[flip](datasets.frames(datasets.CAN))
        )
        u, v = demo[MEASURED][()].T
        left, up = flip in ("lr", "180"), flip in ("ud", "180")
        demo[MEASURED][...] = np.stack([128 - u if left else u, 128 - v if up else v], 1)

    path = datasets.changed(datasets.CAN, tmp_path, turn)
    with open_recording(path, datasets.robosuite(path)) as recording:
        report = check.check(recording)
    assert f"--flip {flip} --out" in str(report.problem)
    with open_recording(path, with_camera(path, flip=flip)) as recording:
        assert check.check(recording).problem is None


GL = np.diag([1.0, -1.0, -1.0, 1.0])
MISTAKES = {
    "inverted": (np.linalg.inv, "--flip none --inverse --out", "inverted"),
    "opengl": (lambda pose: pose @ GL, "--flip none --axes opengl --out", "OpenGL"),
    "inverted, opengl": (lambda pose: np.linalg.inv(pose @ GL), "--inverse", "OpenGL"),
}


@pytest.mark.parametrize("mistake", list(MISTAKES))
@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.stem)
def test_readings_of_the_pose_are_named(path: Path, mistake: str) -> None:
    turn, command, words = MISTAKES[mistake]
    with open_recording(path, posed(path, turn)) as recording:
        report = check.check(recording)
    best = report.motion.best
    assert report.problem is not None
    readings = [best.reading, *best.same]
    texts = [check.told(reading) for reading in readings]
    commands_ = [check.remedy(reading, "agentview") for reading in readings]
    assert any(command in line for line in commands_), commands_
    assert any(words in text for text in texts), texts
    # Taken at its word, the remedy gives the right camera back.
    pose = posed(path, turn).cameras["agentview"].cam_to_base
    fits = [
        np.abs(
            motion.pose_as(pose, reading)
            - posed(path, lambda p: p).cameras["agentview"].cam_to_base
        ).max()
        for reading in readings
        if reading.flip == "none"
    ]
    assert min(fits) < 1e-6


@pytest.mark.parametrize("wrong", ["xyz", "XYZ"])
def test_the_order_of_angles_is_named(wrong: str, tmp_path: Path) -> None:
    """Six numbers written in one order and imported in the other. The images are bent by Pillow to
    what a rolled camera sees: robosuite's own has angles that mean the same in both orders."""
    right = "XYZ" if wrong == "xyz" else "xyz"
    K, pose = camera_of(datasets.CAN)
    roll = Rotation.from_euler("zx", [0.35, 0.1]).as_matrix()
    bend = K @ roll @ np.linalg.inv(K)
    how = (128, 128), Image.Transform.PERSPECTIVE, tuple((bend / bend[2, 2]).ravel()[:8])

    def rolled(file: h5py.File) -> None:
        demo = file["data/demo_0"]
        frames = [Image.fromarray(frame) for frame in demo[datasets.IMAGES][()]]
        seen = [np.asarray(i.transform(*how, Image.Resampling.BILINEAR)) for i in frames]
        datasets.replace(demo, datasets.IMAGES, np.stack(seen))
        del demo[MEASURED]

    path = datasets.changed(datasets.CAN, tmp_path, rolled)
    true = pose @ oracles.pose(roll, np.zeros(3))
    angles = Rotation.from_matrix(true[:3, :3]).as_euler(right)
    misread = oracles.pose(Rotation.from_euler(wrong, angles).as_matrix(), true[:3, 3])
    with open_recording(path, posed(path, lambda _: misread)) as recording:
        report = check.check(recording)
    assert report.motion.wrong and report.problem is not None
    reading = report.motion.best.reading
    assert reading == motion.Reading("none", euler=right)
    np.testing.assert_allclose(motion.pose_as(misread, reading), true, atol=1e-9)
    assert f"--euler {right} --flip none" in check.remedy(reading, "agentview")
    with open_recording(path, posed(path, lambda _: true)) as recording:
        assert check.check(recording).problem is None


def test_remedies_leave_nothing_out() -> None:
    every = check.remedy(motion.Reading("ud", inverse=True, euler="xyz"), "front")
    assert every == "Import the camera again with --euler xyz --flip ud --inverse"
    other = check.remedy(motion.Reading("lr", axes="opengl", inverse=True), "left eye")
    assert "--camera 'left eye' --flip lr --axes opengl --inverse --out" in other


def test_angles_are_the_last_guess() -> None:
    """Readings that fit about as well: the one without angles is advised."""

    def found(score: float, **reading) -> motion.Finding:
        return motion.Finding(motion.Reading("none", **reading), score, 1.0, 5.0)

    angles, inverse, axes = (
        found(0.30, euler="xyz"), found(0.28, inverse=True), found(0.2, axes="opengl")
    )  # fmt: skip
    grouped = motion._grouped([axes, angles, inverse])
    assert [f.reading for f in grouped] == [inverse.reading, angles.reading, axes.reading]
    now = motion.Finding(motion.Reading("none"), 0.01, 1.0, 0.0)
    assert motion.Motion(20, now, grouped).best.reading == inverse.reading
    assert motion._grouped([found(0.2, inverse=True), angles])[0].reading == angles.reading
    same = motion._grouped([angles, found(0.30, axes="opengl", inverse=True)])
    assert same[0].reading.euler is None and same[0].same == (angles.reading,)


def test_a_hand_that_stands_still_tells_nothing(tmp_path: Path) -> None:
    def freeze(file: h5py.File) -> None:
        demo = file["data/demo_0"]
        for key in (datasets.IMAGES, "obs/robot0_eef_pos"):
            demo[key][...] = demo[key][:1]
        del demo[MEASURED]

    path = datasets.changed(datasets.CAN, tmp_path, freeze)
    with open_recording(path, with_camera(path, flip="ud")) as recording:
        report = check.check(recording)
    assert report.motion.pairs == 0 and not report.motion.tells and report.problem is None


def test_noise_is_not_taken_for_a_flip(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, datasets.frames(datasets.CAN).shape, np.uint8)
    path = datasets.changed(
        datasets.CAN,
        tmp_path,
        lambda file: datasets.replace(file["data/demo_0"], datasets.IMAGES, noise),
    )
    with open_recording(path, datasets.robosuite(path)) as recording:
        assert not motion.examine(recording).wrong


def test_areas_are_averaged() -> None:
    picture = np.random.default_rng(0).uniform(size=(120, 97))
    pooled = motion._pooled(picture, 48)
    assert pooled.shape == (48, 48)
    rows, columns = np.arange(49) * 120 // 48, np.arange(49) * 97 // 48
    for i, j in ((0, 0), (13, 20), (47, 47)):
        area = picture[rows[i] : rows[i + 1], columns[j] : columns[j + 1]]
        assert pooled[i, j] == pytest.approx(area.mean())


# -- the sheet -------------------------------------------------------------------------------------


def drawn(recording: Recording, path: Path) -> Image.Image:
    report = check.check(recording)
    check.sheet(recording, report, aligning.paper_spec(128), path)
    with Image.open(path) as picture:
        return picture.convert("RGB")


def test_the_sheet_shows_the_overlay_where_the_hand_is(tmp_path: Path) -> None:
    with open_recording(datasets.CAN, datasets.robosuite(datasets.CAN)) as recording:
        picture = drawn(recording, tmp_path / "good.png")
        name, index = check._chosen(recording, check.PANELS)[0]
    panel = check.PANEL + check.CAPTION
    assert picture.size == (4 * check.PANEL, check.CAPTION + 3 * panel)
    with h5py.File(datasets.CAN) as file:
        u, v = file[f"data/{name}/obs/agentview_tcp_uv"][index] * check.PANEL / 128
    dot = np.asarray(picture)[check.CAPTION + round(v), round(u)]
    assert (dot == 255).all()
    with open_recording(datasets.CAN, with_camera(datasets.CAN, flip="lr")) as recording:
        both = drawn(recording, tmp_path / "flipped.png")
    assert both.size == (picture.width, 2 * (check.CAPTION + 2 * panel))


def test_the_sheet_says_what_is_behind(tmp_path: Path) -> None:
    with open_recording(datasets.CAN, posed(datasets.CAN, lambda pose: pose @ GL)) as recording:
        assert drawn(recording, tmp_path / "behind.png").height > 1000


# -- the command line ------------------------------------------------------------------------------


def run(*words: object) -> int:
    return main(["data", *map(str, words)])


def test_ten_minutes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The commands of docs/your_data.md."""
    monkeypatch.chdir(tmp_path)
    assert run("inspect", datasets.CAN) == 0
    assert "1 episodes, 31 frames" in capsys.readouterr().out
    made = ["--from", "robosuite", "--file", datasets.CAN, "--out", "calibration.json"]
    assert run("calibrate", *made) == 0
    assert run("calibrate", *made) == 2
    assert "OutputError: calibration.json exists" in capsys.readouterr().err
    assert run("check", datasets.CAN, "--calibration", "calibration.json") == 0
    out = capsys.readouterr().out
    assert "TCP in the image in 100.0%" in out and "mean 0.061 px" in out and "\ngood\n" in out
    assert Path("robosuite_can-agentview.png").stat().st_size > 10_000
    assert run("align", datasets.CAN, "--calibration", "calibration.json", "--out", "a.hdf5") == 0
    assert "crop 50, 84 x 84 pixels, 8 numbers" in capsys.readouterr().out
    assert run("verify", "a.hdf5") == 0
    assert "a.hdf5: sound" in capsys.readouterr().out
    flipped = ["--from", "palm", "--file", "calibration.json", "--flip", "ud", "--out", "ud.json"]
    assert run("calibrate", *flipped) == 0
    assert run("check", datasets.CAN, "--calibration", "ud.json", "--out", "ud.png") == 1
    assert "ImageOrientationError" in capsys.readouterr().out
    assert run("align", datasets.CAN, "--calibration", "ud.json", "--out", "b.hdf5") == 2
    assert "error: ImageOrientationError" in capsys.readouterr().err
    assert not Path("b.hdf5").exists()
    assert run("repair", "a.hdf5", "--out", "c.hdf5") == 0
    assert "1 episodes written: c.hdf5" in capsys.readouterr().out


@pytest.mark.parametrize("place", ["data", "calibration", "notes", "folder"])
def test_a_sheet_replaces_a_sheet_and_nothing_else(
    place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = datasets.changed(datasets.CAN, tmp_path, lambda file: None)
    told = calibration.save(datasets.robosuite(given), tmp_path / "c.json")
    (tmp_path / "notes.png").write_text("not a picture")
    (tmp_path / "folder").mkdir()
    out = {"data": given, "calibration": told, "notes": tmp_path / "notes.png"}
    out |= {"folder": tmp_path / "folder"}
    before = datasets.digest(tmp_path)
    assert run("check", given, "--calibration", told, "--out", out[place]) == 2
    assert "OutputError: " in capsys.readouterr().err and datasets.digest(tmp_path) == before
    for _ in range(2):
        assert run("check", given, "--calibration", told, "--out", tmp_path / "sheet.png") == 0


def test_a_sheet_does_not_lie_in_the_data(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = datasets.lerobot(tmp_path)
    told = calibration.save(datasets.lerobot_calibration(), tmp_path / "c.json")
    Image.new("RGB", (4, 4)).save(root / "a.png")
    before = datasets.digest(root)
    assert run("check", root, "--calibration", told, "--out", root / "a.png") == 2
    assert "lies inside the source" in capsys.readouterr().err and datasets.digest(root) == before


def test_the_code_of_the_page_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = (datasets.SAMPLES.parents[1] / "docs" / "your_data.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names = {
        "path": datasets.CAN,
        "calibration_path": calibration.save(
            datasets.robosuite(datasets.CAN), tmp_path / "calibration.json"
        ),
    }
    exec(compile(code, "your_data.md", "exec"), names)
    assert capsys.readouterr().out == "demo_0 (31, 84, 84, 3) (31, 8) (31, 10)\n"
    for command in commands.COMMANDS:
        assert f"palm_jax data {command} " in page
    for error in (value for value in vars(errors).values() if isinstance(value, type)):
        if issubclass(error, errors.DataError) and error is not errors.DataError:
            assert f"`{error.__name__}`" in page


def test_options_of_align() -> None:
    config = commands.Align(
        Path("x"), Path("c"), Path("o"), crop=60, size=64, overlay=False, layout="world6d_xyz",
        spec='{"border": "edge"}',
    )  # fmt: skip
    spec = commands.make_spec(config, 128)
    assert (spec.crop, spec.size, spec.overlay, spec.layout) == (60, 64, False, "world6d_xyz")
    assert spec.border == "edge" and spec.dot_radius == 1
    whole = commands.make_spec(dataclasses.replace(config, full_frame=True, spec=None), 128)
    assert whole.crop is None
    for text, words in (
        ("[1]", "expected"),
        ('{"crops": 3}', "some of arrow_length"),
        ("n", "JSON"),
    ):
        with pytest.raises(commands.DataError, match=words):
            commands.make_spec(dataclasses.replace(config, spec=text), 128)


def test_unknown_commands_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("algin") == 2
    assert "Did you mean 'align'?" in capsys.readouterr().err
    assert run("--help") == 0
    out = capsys.readouterr().out
    assert all(f"\n  {name} " in out for name in commands.COMMANDS)


def test_ctrl_c_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(commands.job, "align_file", stop)
    path = calibration.save(datasets.robosuite(), tmp_path / "c.json")
    words = ["align", datasets.LIFT, "--calibration", path, "--out", tmp_path / "new.hdf5"]
    assert run(*words) == 130
    out = capsys.readouterr().out
    assert "Saved: finished episodes" in out and f"palm_jax data align {datasets.LIFT}" in out
