"""Training on recordings: what robosuite wrote, from the file to a policy that acts."""

import dataclasses
import errno
import functools
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import datasets
import h5py
import jax
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from palm_jax.align import AlignSpec, Camera
from palm_jax.policy import Policy, load
from palm_jax.train import checkpoint, held_out, learner, methods, recorded, report, workspace
from palm_jax.train import config as configuration
from palm_jax.train.__main__ import main
from palm_jax.train.config import ConfigError, Recorded
from palm_jax.train.data import aligning, calibration
from palm_jax.train.data.errors import FormatError
from palm_jax.train.data.recording import open_recording
from palm_jax.train.files import metrics

TINY = ["--steps", "4", "--width", "2", "--batch-size", "4", "--image-size", "32",
        "--random-crop", "28", "--checkpoint-every", "2", "--overlay-warmup", "1"]  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def compiled_once() -> Iterator[None]:
    """A learner of the same configuration is the same one: what it has compiled, it keeps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learner, "make_learner", functools.cache(learner.make_learner))
        yield


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("calibration") / "calibration.json"
    calibration.save(datasets.robosuite(), path)
    return path


def words(calibrated: Path, out: Path, *more: str) -> list[str]:
    return [
        "--data", str(datasets.LIFT), "--calibration", str(calibrated), "--out", str(out), *TINY,
        *more,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def run(calibrated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "lift"
    before = datasets.digest(datasets.LIFT)
    assert main(words(calibrated, out)) == 0
    assert datasets.digest(datasets.LIFT) == before
    return out


def config_of(folder: Path) -> dict[str, Any]:
    values: dict[str, Any] = json.loads((folder / "config.json").read_text())
    return values


def model_of(folder: Path) -> learner.Learner:
    values = config_of(folder)
    config = workspace.config_in(folder, Recorded).learner(methods.find(values["method"]))
    return learner.make_learner(config, AlignSpec(**values["spec"]).proprio_size, (recorded.VIEW,))


def assert_same(one: Path, other: Path, step: int = 4) -> None:
    """Every leaf of a checkpoint, the optimiser's as well."""
    states = [
        checkpoint.load(folder / "checkpoints" / str(step), model_of(folder).abstract_state())
        for folder in (one, other)
    ]
    jax.tree.map(np.testing.assert_array_equal, *states)


# -- the command -----------------------------------------------------------------------------------


def test_a_run_holds_what_it_was_made_of(run: Path) -> None:
    values = config_of(run / "palm")
    assert values["kind"] == "recorded" and values["task"] == "Lift"
    assert values["held_out"] in (["demo_0"], ["demo_1"])
    # 200, 40 and 512 rows of the paper at 128 rows.
    assert values["spec"]["crop"] == 50 and values["spec"]["offset"] == [0, 10]
    assert config_of(run / "bc")["spec"]["crop"] is None
    with h5py.File(datasets.LIFT) as file:
        info = json.loads(file["data/demo_0"].attrs["camera_info"])["agentview"]
        length = {name: len(demo["actions"]) for name, demo in file["data"].items()}
    np.testing.assert_allclose(values["K"], info["intrinsics"])
    found = json.loads((run / "palm" / "held_out.json").read_text())
    assert found["frames"] == length[values["held_out"][0]]


def test_the_checkpoint_with_the_least_loss_is_taken(run: Path) -> None:
    for method in ("palm", "bc"):
        logged = {
            record["step"]: record["validation_loss"]
            for record in metrics.read_metrics(run / method / "metrics.jsonl")
            if "validation_loss" in record
        }
        assert set(logged) == {2, 4}
        found = json.loads((run / method / "held_out.json").read_text())
        assert found["step"] == min(logged, key=logged.__getitem__)
        assert found["loss"] == pytest.approx(min(logged.values()))


def test_the_report_says_how_good_it_is(run: Path) -> None:
    page = (run / "report.html").read_text()
    found = json.loads((run / "palm" / "held_out.json").read_text())
    assert f"{found['translation_mm']['median_error']:.1f} mm" in page
    assert "robosuite_lift.hdf5" in page and "episodes held out" in page
    for absent in ("MuJoCo MJX", "paper 72", "Not evaluated"):
        assert absent not in page
    assert report.build(run / "palm")  # one of them alone, too


def test_what_is_done_is_not_done_again(
    run: Path, calibrated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = checkpoint.content_hash(run / "palm" / "checkpoints" / "4")
    assert main(words(calibrated, run, "--resume")) == 0
    assert "palm: trained already" in capsys.readouterr().out
    assert checkpoint.content_hash(run / "palm" / "checkpoints" / "4") == before


def test_another_machines_claim_is_taken_over_when_told(
    run: Path, calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = Path(shutil.copytree(run / "palm", tmp_path / "claimed"))
    claim = {"host": "elsewhere", "processes": [{"pid": 1, "started": ""}], "since": "noon"}
    (out / ".claim").write_text(json.dumps(claim))
    command = words(calibrated, out, "--method", "palm", "--resume")
    assert main(command) == 2
    assert "--take-over" in capsys.readouterr().err
    assert main([*command, "--take-over"]) == 0
    assert "take_over" not in config_of(out) and not (out / ".claim").exists()


def test_a_resumed_training_is_the_whole_one(run: Path, calibrated: Path, tmp_path: Path) -> None:
    out = tmp_path / "cut"
    shutil.copytree(run / "palm", out)
    shutil.rmtree(out / "checkpoints" / "4")
    (out / "held_out.json").unlink()
    assert main(words(calibrated, out, "--method", "palm", "--resume")) == 0
    assert_same(out, run / "palm")
    assert (out / "held_out.json").read_bytes() == (run / "palm" / "held_out.json").read_bytes()


def test_turned_images_know_their_cameras(calibrated: Path, tmp_path: Path) -> None:
    """The preset cpu turns the camera, which needs the camera of every image."""
    out = tmp_path / "turned"
    assert main(words(calibrated, out, "--method", "palm", "--turn", "30", "10")) == 0
    assert np.isfinite(json.loads((out / "held_out.json").read_text())["loss"])


def test_large_data_lie_in_a_file(
    run: Path, calibrated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorded, "IN_MEMORY", 0)
    assert main(words(calibrated, tmp_path / "filed", "--method", "palm")) == 0
    assert_same(tmp_path / "filed", run / "palm")
    left = {path.name for path in (tmp_path / "filed").iterdir()}
    assert left <= {path.name for path in (run / "palm").iterdir()} | {
        "report.html",
        "figures",
        ".claim.lock",
    }


def test_without_episodes_held_out_the_last_checkpoint_is_taken(
    calibrated: Path, tmp_path: Path
) -> None:
    out = tmp_path / "all"
    assert main(words(calibrated, out, "--method", "palm", "--validation", "0")) == 0
    found = json.loads((out / "held_out.json").read_text())
    assert found == {"step": 4, "episodes": 0}
    assert load(out, image_size=None).contract.step == 4


# -- what acts -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def policies(run: Path) -> dict[str, Policy]:
    return {name: load(run / name, image_size=(128, 128)) for name in ("palm", "bc")}


@pytest.mark.parametrize("method", ["palm", "bc"])
def test_the_robot_is_shown_what_was_trained_on(
    method: str, policies: dict[str, Policy], run: Path
) -> None:
    """The same recorded frame, through the training's alignment and through the policy's."""
    policy = policies[method]
    spec = policy.contract.spec
    with open_recording(datasets.LIFT, datasets.robosuite()) as recording:
        (episode,) = aligning.aligned_episodes(recording, spec, episodes=["demo_0"])
        camera = recording.camera.camera("demo_0")
    stored = datasets.frames(datasets.LIFT)
    for row in (0, 7, len(stored) - 1):
        seen = {
            "image": stored[row], "K": camera.K, "cam_to_world": camera.cam_to_world,
            "tcp": episode.tcp[row], "opening": episode.opening[row],
        }  # fmt: skip
        shown = policy.see(**seen)
        np.testing.assert_array_equal(shown.image, episode.images[row])
        np.testing.assert_allclose(shown.proprio, episode.proprio[row], atol=1e-6)
        # The network itself on the training's input, and the pose that its answer leads to.
        model = model_of(run / method)
        images = {recorded.VIEW: episode.images[row : row + 1]}
        output, _ = model.predict(policy.state, images, episode.proprio[row : row + 1])
        ranges = policy.state.normalizer.action
        low, high = np.asarray(ranges.low), np.asarray(ranges.high)
        action = low + (np.asarray(output)[0] + 1) / 2 * (high - low)
        target, gripper = policy.act(**seen)
        moved = episode.tcp[row][:3, :3].T @ (target[:3, 3] - episode.tcp[row][:3, 3])
        np.testing.assert_allclose(moved, action[6:9], atol=1e-5)
        assert gripper == float(action[9] > 0.5)


def test_the_contract_is_the_recordings(policies: dict[str, Policy]) -> None:
    contract = policies["palm"].contract
    with h5py.File(datasets.LIFT) as file:
        info = json.loads(file["data/demo_0"].attrs["camera_info"])["agentview"]
        heights = np.concatenate(
            [demo["obs/robot0_eef_pos"][:, 2] for demo in file["data"].values()]
        )
        rate = json.loads(file["data"].attrs["env_args"])["env_kwargs"]["control_freq"]
    np.testing.assert_allclose(contract.K, info["intrinsics"])
    assert contract.frame == (128, 128) and not contract.rendered
    assert contract.rate == pytest.approx(rate)
    assert contract.heights is not None
    assert heights.min() - 1e-5 <= contract.heights[0] < contract.heights[1]
    assert contract.heights[1] <= heights.max() + 1e-5


def test_a_policy_of_recordings_is_not_simulated(run: Path) -> None:
    with pytest.raises(ConfigError, match="trained on recordings"):
        workspace.stored_config(run / "palm")


# -- the parts -------------------------------------------------------------------------------------


@pytest.mark.parametrize("share, count", [(None, 2), (0.1, 2), (0.5, 10), (0.001, 1), (0.999, 19)])
def test_episodes_are_split_once_and_for_all(share: float | None, count: int) -> None:
    names = [f"demo_{number}" for number in range(20)]
    split = recorded.split_episodes(names, share)
    assert len(split.held_out) == count and set(split.train) | set(split.held_out) == set(names)
    assert not set(split.train) & set(split.held_out)
    assert list(split.train) == sorted(split.train, key=names.index)
    assert recorded.split_episodes(names, share) == split


def test_the_files_own_split_comes_first(tmp_path: Path) -> None:
    def mask(file: h5py.File, valid: bytes = b"demo_0") -> None:
        file["mask/train"] = np.array([b"demo_1", b"demo_gone"])
        file["mask/valid"] = np.array([valid])

    path = datasets.changed(datasets.LIFT, tmp_path, mask)
    with open_recording(path, datasets.robosuite()) as recording:
        given = recording.source.split()
        assert given == (["demo_1"], ["demo_0"])
        split = recorded.split_episodes(recording.source.episodes, None, given)
        assert (split.train, split.held_out) == (("demo_1",), ("demo_0",))
        # What is asked for comes before it.
        assert not recorded.split_episodes(recording.source.episodes, 0, given).held_out
    (tmp_path / "both").mkdir()
    both = datasets.changed(datasets.LIFT, tmp_path / "both", lambda file: mask(file, b"demo_1"))
    with (
        open_recording(both, datasets.robosuite()) as recording,
        pytest.raises(FormatError, match="both name demo_1"),
    ):  # fmt: skip
        recording.source.split()


@pytest.mark.parametrize("crop", [50, 37, None])
def test_the_cameras_of_the_images(crop: int | None) -> None:
    """An image whose colours are its pixels' places tells which window was cut."""
    size, (height, width) = 20, (60, 90)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    image = np.stack([u, v, 0 * u], -1).astype(np.uint8)
    K = np.array([[80.0, 0, 44.0], [0, 82.0, 31.0], [0, 0, 1]], np.float32)
    camera = Camera(K, np.eye(4, dtype=np.float32), height, width)
    spec = AlignSpec(crop=crop, offset=(3, -2), size=size, overlay=False, frame=height)
    tcp = np.tile(np.eye(4, dtype=np.float32), (4, 1, 1))
    tcp[:, :3, 3] = [[0, 0, 1], [0.1, 0.05, 1], [-0.5, 0.2, 1], [0.5, -0.3, 1]]
    poses = np.tile(np.eye(4, dtype=np.float32), (4, 1, 1))
    found = recorded.window_cameras(camera, poses, tcp, spec)
    whole = dataclasses.replace(spec, size=crop) if crop else None
    for index, pose in enumerate(tcp):
        scale = np.array([size / width, size / height]) if crop is None else size / crop
        corner = np.zeros(2)
        if whole is not None:
            cut = aligning.align_frames(image[None], camera, pose[None], np.ones(1), whole)
            corner = np.asarray(cut.image[0, 0, 0, :2], float)
        expected = K.copy()
        expected[:2, 2] -= corner
        expected[:2] *= np.broadcast_to(scale, 2)[:, None]
        np.testing.assert_allclose(found.K[index], expected, rtol=1e-5)
    assert found.cam_to_world.shape == (4, 4, 4)
    assert (found.height, found.width) == (size, size)


def test_errors_of_actions_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    count = 51
    labels, answers = rng.normal(size=(2, count, 10)).astype(np.float32)
    turns = [Rotation.random(count, rng=seed) for seed in (1, 2)]
    for values, turn in zip((labels, answers), turns, strict=True):
        values[:, :6] = turn.as_matrix()[:, :, :2].transpose(0, 2, 1).reshape(count, 6)
        values[:, 9] = rng.random(count) > 0.3
    labels[:, 8] = answers[:, 8] = 0.25  # a constant
    low, high = np.full(10, -2.0), np.full(10, 4.0)

    def normalised(values: np.ndarray) -> np.ndarray:
        return (2 * (values - low) / (high - low) - 1).astype(np.float32)

    ranges = learner.Range(low.astype(np.float32), high.astype(np.float32))
    policy = learner.PolicyState({}, {}, learner.Normalizer(ranges, ranges))
    batch = learner.Batch({}, np.zeros((count, 1), np.float32), labels)
    monkeypatch.setattr(
        held_out, "predictions", lambda *_, **__: (normalised(answers), normalised(labels))
    )
    found = held_out.measure(None, policy, batch)  # type: ignore[arg-type]
    moves = np.linalg.norm(answers[:, 6:9] - labels[:, 6:9], axis=1)
    apart = (turns[0].inv() * turns[1]).magnitude()
    assert found["translation_mm"]["median_error"] == pytest.approx(1e3 * np.median(moves), 1e-4)
    assert found["translation_mm"]["standing_still"] == pytest.approx(
        1e3 * np.median(np.linalg.norm(labels[:, 6:9], axis=1)), 1e-4
    )
    assert found["rotation_deg"]["median_error"] == pytest.approx(
        np.degrees(np.median(apart)), 1e-4
    )
    assert found["rotation_deg"]["standing_still"] == pytest.approx(
        np.degrees(np.median(turns[0].magnitude())), 1e-4
    )
    right, opens = (answers[:, 9] == labels[:, 9]).mean(), labels[:, 9].mean()
    assert found["gripper"]["right"] == pytest.approx(right)
    assert found["gripper"]["constant"] == pytest.approx(max(opens, 1 - opens))
    assert found["loss"] == pytest.approx(((answers - labels) ** 2).mean() / 9, 1e-4)
    assert found["r2"]["z"] is None
    assert found["r2"]["x"] == pytest.approx(
        1 - ((answers - labels)[:, 6] ** 2).mean() / labels[:, 6].var(), 1e-3
    )


def test_a_loss_that_is_no_number_is_the_worst(
    run: Path, calibrated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last checkpoint is not finite: the first is taken."""
    losses = iter([0.5, float("nan")])
    monkeypatch.setattr(held_out, "loss", lambda *_: next(losses))
    out = tmp_path / "nan"
    assert main(words(calibrated, out, "--method", "palm")) == 0
    assert json.loads((out / "held_out.json").read_text())["step"] == 2


# -- what cannot be done ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "more, code, text",
    [
        (["--method", "arro"], 2, "needs the simulator"),
        (["--method", "mirrorduo"], 2, "on recordings: palm, "),
        (["--scenes", "3"], 2, "unknown option --scenes"),
        (["--validation", "1"], 2, "a share from 0 to 1"),
        (["--transitions", "-1"], 2, "0 or more"),
        (["--crop", "500"], 2, "OptionError: AlignSpec.crop"),
        (["--camera", "side"], 2, "CameraNameError"),
        (["--transitions", "99"], 2, "EpisodeLengthError"),
    ],
)
def test_refusals(
    more: list[str],
    code: int,
    text: str,
    calibrated: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(words(calibrated, tmp_path / "new", *more)) == code
    assert text in " ".join(capsys.readouterr().err.split())


def test_a_calibration_needs_data(capsys: pytest.CaptureFixture[str], calibrated: Path) -> None:
    assert main(["--calibration", str(calibrated)]) == 2
    assert "expected --data FILE with --calibration C" in capsys.readouterr().err


def test_one_episode_cannot_be_split(
    calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = datasets.changed(
        datasets.LIFT, tmp_path, lambda file: file["data"].__delitem__("demo_1")
    )
    command = words(calibrated, tmp_path / "new")
    command[1] = str(path)
    assert main(command) == 2
    assert "--validation 0" in capsys.readouterr().err


def test_episodes_that_never_show_the_tcp(
    calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def change(file: h5py.File) -> None:
        file["data/demo_0/obs/robot0_eef_pos"][:, 1] += 3.0
        file["mask/train"], file["mask/valid"] = np.array([b"demo_1"]), np.array([b"demo_0"])

    command = words(calibrated, tmp_path / "new", "--trust", "--least-in-view", "0.2")
    command[1] = str(datasets.changed(datasets.LIFT, tmp_path, change))
    assert main(command) == 2
    assert "no frame of demo_0 shows the TCP" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("what", ["data", "calibration"])
def test_other_data_are_not_gone_on_with(
    what: str,
    run: Path,
    calibrated: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = words(calibrated, run, "--resume")
    if what == "data":
        path = datasets.changed(
            datasets.LIFT, tmp_path, lambda file: file["data"].attrs.modify("total", 1)
        )
        command[1], named = str(path), "source"
    else:
        other = tmp_path / "other.json"
        moved = datasets.robosuite()
        moved.cameras["agentview"].cam_to_base[0, 3] += 0.001
        calibration.save(moved, other)
        command[3], named = str(other), "calibration_sha256"
    assert main(command) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert f"was begun with {named}" in error and "choose another --out" in error


def test_other_pictures_are_not_gone_on_with(
    calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    Image.new("RGB", (8, 8)).save(folder / "one.png")
    command = words(calibrated, tmp_path / "run", "--method", "palm", "--backgrounds", str(folder))
    assert main(command) == 0 and main([*command, "--resume"]) == 0
    Image.new("RGB", (8, 8), (1, 0, 0)).save(folder / "one.png")
    assert main([*command, "--resume"]) == 2
    assert "was begun with backgrounds of SHA-256" in " ".join(capsys.readouterr().err.split())


def test_no_room_for_the_images(
    calibrated: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(recorded, "IN_MEMORY", 0)
    monkeypatch.setattr(os, "posix_fallocate", full)
    assert main(words(calibrated, tmp_path / "new", "--method", "palm")) == 2
    assert "DiskFullError" in capsys.readouterr().err
    left = {path.name for path in (tmp_path / "new").iterdir()}
    assert left <= {"config.json", "env.json", ".claim.lock"}


def test_a_command_gives_itself_again(calibrated: Path) -> None:
    given = words(calibrated, Path("runs/x"), "--validation", "0.25", "--camera", "agentview",
                  "--offset", "0", "5", "--trust")  # fmt: skip
    config = configuration.parse(given)
    assert isinstance(config, Recorded)
    again = configuration.parse(configuration.command(config)[3:])
    assert again == config
