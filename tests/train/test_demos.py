"""Demonstration files: what is in them, that they are reproducible, and which are refused."""

import json
import shutil
from pathlib import Path
from typing import Any

import h5py
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import worlds
from oracles import delta

from palm_jax.align import project
from palm_jax.envs.expert import Demonstrator, Recording
from palm_jax.train import demos
from palm_jax.train.demos import DemoFileError

COUNT = 6


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small file, made once."""
    path = tmp_path_factory.mktemp("demos") / "spam.hdf5"
    told: list[int] = []
    runner = worlds.runner("lift_spam")
    made = demos.collect(runner, path, count=COUNT, seed=4, noise=0.004, progress=told.append)
    assert made == path and told == [COUNT]
    assert [file.name for file in path.parent.iterdir()] == ["spam.hdf5"]  # nothing left over
    return path


def load(path: Path, **options: Any) -> demos.Demos:
    return demos.load(path, **{"task": "lift_spam", "robot": "panda", **options})


def test_a_file_tells_how_it_was_collected(recorded: Path, tmp_path: Path) -> None:
    assert demos.collected_with(recorded) == {"seed": 4, "noise": 0.004}
    other = tmp_path / "other.hdf5"
    with h5py.File(other, "w") as file:
        file.create_group("data").attrs["seed"] = [1, 2]
    with pytest.raises(demos.DemoFileError, match="other.hdf5 is not a whole demonstration file"):
        demos.collected_with(other)
    with h5py.File(other, "a") as file:
        del file["data"].attrs["seed"]
    assert demos.collected_with(other) == {"seed": None, "noise": None}


@pytest.mark.slow
def test_the_layout_is_robomimics(recorded: Path) -> None:
    """What robomimic's own tools read: demo names, sizes, totals, env_args, model_file."""
    with h5py.File(recorded) as file:
        data = file["data"]
        assert set(data) == {f"demo_{i}" for i in range(COUNT)}
        arguments = json.loads(data.attrs["env_args"])
        assert set(arguments) == {"env_name", "env_type", "env_kwargs"}
        assert arguments["env_name"] == "lift_spam"
        lengths = []
        for demo in data.values():
            length = int(demo.attrs["num_samples"])
            lengths.append(length)
            model = mujoco.MjModel.from_xml_string(demo.attrs["model_file"])
            assert demo["states"].shape == (length, 1 + model.nq + model.nv)
            assert demo["actions"].shape == (length, 10)
            for name, shape in {"tcp": (4, 4), "opening": (), "qpos": (model.nq,)}.items():
                assert demo[f"obs/{name}"].shape == (length, *shape)
            assert demo["obs/stage"].shape == (length,) and demo["obs/stage"].dtype == np.int32
            np.testing.assert_allclose(np.diff(demo["states"][:, 0]), 0.05, atol=1e-6)
            np.testing.assert_array_equal(demo["states"][:, 1 : 1 + model.nq], demo["obs/qpos"])
            assert demo["dones"][-1] == 1 and not demo["dones"][:-1].any()
            camera = json.loads(demo.attrs["camera_info"])["front"]
            assert np.shape(camera["extrinsics"]) == (4, 4)
            focal = 256 / np.tan(np.radians(20))
            np.testing.assert_allclose(
                camera["intrinsics"], [[focal, 0, 256], [0, focal, 256], [0, 0, 1]], rtol=1e-6
            )
        assert data.attrs["total"] == sum(lengths)


@pytest.mark.slow
def test_a_file_can_be_replayed_by_mujoco_alone(recorded: Path) -> None:
    """The stored model and states give the stored TCP, and the can ends up lifted."""
    with h5py.File(recorded) as file:
        for demo in file["data"].values():
            model = mujoco.MjModel.from_xml_string(demo.attrs["model_file"])
            data, heights = mujoco.MjData(model), []
            for row, tcp in zip(demo["states"], demo["obs/tcp"], strict=True):
                data.qpos[:] = row[1 : 1 + model.nq]
                mujoco.mj_kinematics(model, data)
                np.testing.assert_allclose(data.site("tcp").xpos, tcp[:3, 3], atol=1e-5)
                heights.append(data.body("spam").xpos[2])
            assert heights[-1] - heights[0] > 0.08


@pytest.mark.slow
def test_reloaded_demonstrations_are_consistent(recorded: Path) -> None:
    found = load(recorded)
    assert found.episodes == COUNT <= found.attempts
    assert len(found.qpos) == len(found.tcp) == len(found.actions) == len(found.episode)
    assert (np.diff(found.episode) >= 0).all() and set(found.episode) == set(range(COUNT))
    assert found.params.object_low.shape == (COUNT, 2)
    assert found.stages.tolist() == [0] * len(found.qpos)  # a task of one stage
    assert demos.summary(found)["frames"] == len(found.qpos)
    fewer = load(recorded, count=2)
    assert fewer.episodes == 2
    np.testing.assert_array_equal(fewer.actions, found.actions[: len(fewer.actions)])
    columns = found.actions[:, :6].reshape(-1, 2, 3)
    np.testing.assert_allclose(np.linalg.norm(columns, axis=-1), 1, atol=1e-5)
    np.testing.assert_allclose((columns[:, 0] * columns[:, 1]).sum(-1), 0, atol=1e-5)
    assert set(np.unique(found.actions[:, 9])) == {0.0, 1.0}
    assert np.linalg.norm(found.actions[:, 6:9], axis=-1).max() <= 0.006 + 1e-5
    # Labels point where the hand then went: the motion is the command plus the disturbance.
    same = np.flatnonzero(np.diff(found.episode) == 0)
    moved = np.array([delta(found.tcp[i], found.tcp[i + 1])[6:9] for i in same])
    command = found.actions[same, 6:9]
    assert np.corrcoef(moved.ravel(), command.ravel())[0, 1] > 0.5
    assert np.linalg.norm(moved - command, axis=-1).mean() < 0.012


@pytest.mark.slow
def test_one_seed_gives_one_file(recorded: Path, tmp_path: Path) -> None:
    runner = worlds.runner("lift_spam")
    same = demos.collect(runner, tmp_path / "same.hdf5", count=COUNT, seed=4, noise=0.004)
    other = demos.collect(runner, tmp_path / "other.hdf5", count=COUNT, seed=5, noise=0.004)
    first, again, different = load(recorded), load(same), load(other)
    for name in ("qpos", "tcp", "opening", "actions", "camera_to_world"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name), name)
    assert not np.array_equal(first.qpos[0], different.qpos[0])


@pytest.mark.slow
def test_stages_are_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Frame by frame, whatever else is recorded."""

    class Staged(Demonstrator):
        def __call__(self, *arguments: Any, **options: Any) -> Recording:
            found = super().__call__(*arguments, **options)
            time = np.arange(len(found.frames.stage))[:, None]
            stage = np.broadcast_to(time // 10, found.frames.stage.shape)
            return found._replace(frames=found.frames._replace(stage=stage))

    monkeypatch.setattr(demos, "Demonstrator", Staged)
    runner = worlds.runner("lift_spam")
    path = demos.collect(runner, tmp_path / "two.hdf5", count=2, seed=4, noise=0.004)
    found = load(path)
    lengths = np.bincount(found.episode)
    np.testing.assert_array_equal(
        found.stages, np.concatenate([np.arange(length) // 10 for length in lengths])
    )
    assert found.stages.max() >= 2


@pytest.mark.slow
def test_nothing_is_overwritten(recorded: Path) -> None:
    before = recorded.read_bytes()
    with pytest.raises(FileExistsError, match="spam.hdf5 exists and is not overwritten"):
        demos.collect(worlds.runner("lift_spam"), recorded, count=1, seed=0, noise=0.0)
    assert recorded.read_bytes() == before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "lift_lid"}, "expected task 'lift_lid', found 'lift_spam'"),
        ({"robot": "ur5"}, "expected robot 'ur5', found 'panda'"),
        ({"count": COUNT + 1}, f"expected {COUNT + 1} demonstrations, found {COUNT}"),
    ],
)
def test_what_was_not_asked_for_is_refused(
    recorded: Path, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(DemoFileError, match=f"spam.hdf5.*{message}"):
        load(recorded, **options)


def break_version(file: h5py.File) -> None:
    file["data"].attrs["version"] = 1


def break_total(file: h5py.File) -> None:
    demo = file["data/demo_1"]
    short = demo["obs/tcp"][:-2]
    del demo["obs/tcp"]
    demo["obs/tcp"] = short


def break_values(file: h5py.File) -> None:
    file["data/demo_0/actions"][3, 7] = np.nan


def break_group(file: h5py.File) -> None:
    del file["data/demo_2/env_params/camera_fovy"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (break_version, "expected version 2, found 1; move it away and collect again"),
        (break_total, "tcp is incomplete or not finite"),
        (break_values, "actions is incomplete or not finite"),
        (break_group, "not a whole demonstration file"),
    ],
)
def test_damaged_files_are_refused(recorded: Path, tmp_path: Path, harm: Any, message: str) -> None:
    path = Path(shutil.copy(recorded, tmp_path / "harmed.hdf5"))
    with h5py.File(path, "r+") as file:
        harm(file)
    with pytest.raises(
        DemoFileError, match=r"harmed.hdf5.*(differs from what was written|version)"
    ):
        load(path)
    with h5py.File(path, "r+") as file:  # as from another program, which leaves no hash
        del file["data"].attrs[demos._DIGEST]
    with pytest.raises(DemoFileError, match=f"harmed.hdf5.*{message}"):
        load(path)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.3, 0.97])
def test_truncated_files_are_refused(recorded: Path, tmp_path: Path, share: float) -> None:
    content = recorded.read_bytes()
    path = tmp_path / "short.hdf5"
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DemoFileError, match="short.hdf5 is not a whole demonstration file"):
        load(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DemoFileError, match="absent.hdf5"):
        load(tmp_path / "absent.hdf5")


def test_an_expert_that_fails_is_no_endless_loop(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """No file, no leftovers, and a count of what was tried."""

    class Hopeless:
        def __init__(self, runner: Any) -> None:
            self.worlds = runner.worlds

        def __call__(self, *arguments: Any, **options: Any) -> Any:
            return type("Recording", (), {"success": np.zeros(self.worlds, bool)})()

    monkeypatch.setattr(demos, "Demonstrator", Hopeless)
    runner = worlds.runner("lift_spam")
    with pytest.raises(RuntimeError, match=f"solved only 0 of {4 * worlds.WORLDS} scenes"):
        demos.collect(runner, tmp_path / "none.hdf5", count=1, seed=0, noise=0.0)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_pictures_are_rendered_from_states(recorded: Path) -> None:
    """Any number of frames, whatever the batch; a plain spec sees what `Env.observe` sees."""
    runner, found = worlds.runner("lift_spam"), load(recorded)
    images, proprio, cameras = demos.render_observations(runner, found, worlds.SPEC, frame=1024)
    assert images.shape == (len(found.qpos), 84, 84, 3) and images.dtype == np.uint8
    assert proprio.shape == (len(found.qpos), worlds.SPEC.proprio_size)
    np.testing.assert_allclose(proprio[:, 6], found.tcp[:, 2, 3], atol=1e-5)
    # In every image the TCP is where the crop puts it: 40 of 200 pixels above the middle.
    uv = jax.vmap(lambda camera, tcp: project(camera, tcp[:3, 3])[0])(cameras, found.tcp)
    middle = np.array([42.0, 42.0 - 40 * 84 / worlds.SPEC.crop])
    assert np.abs(np.asarray(uv) - middle).max() <= 1.0
    start = int(np.flatnonzero(found.episode == 3)[0])
    # The first frame of an episode, drawn from its restored state.
    rows = np.full(worlds.WORLDS, start)
    state = runner.restore(
        *(jnp.asarray(x, jnp.float32) for x in (
            found.qpos[rows],
            found.mocap_pos[found.episode[rows]],
            found.mocap_quat[found.episode[rows]],
            found.camera_to_world[found.episode[rows]],
        )),
        jax.tree.map(lambda x: jnp.stack([x[3]] * worlds.WORLDS), found.params),
    )  # fmt: skip
    seen = runner.observe(state, worlds.params(runner.env), worlds.SPEC)
    off = np.abs(images[start].astype(int) - np.asarray(seen.image[0])).max(-1) > 1
    assert off.mean() <= 1e-3  # an edge may fall on either side
