"""Sweeps: what is asked for, in which order it runs, and where its results end up."""

import dataclasses
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rooms
import tiny

from palm_jax.envs import make
from palm_jax.envs.base import EnvParams
from palm_jax.train import sweep
from palm_jax.train.config import ConfigError
from palm_jax.train.files import locks, records, shards, versions
from palm_jax.train.files.shards import ShardError
from palm_jax.train.reporting import runs
from palm_jax.train.sweep import SweepConfig


@pytest.mark.parametrize(
    ("text", "degrees"),
    [("-30:30:5", [-30, -15, 0, 15, 30]), ("12.5", [12.5]), ("-7", [-7]), ("0:10:1", [0])],
)
def test_angles(text: str, degrees: list[float]) -> None:
    np.testing.assert_allclose(np.degrees(sweep.angles_of(text)), degrees, atol=1e-9)


@pytest.mark.parametrize("text", ["", "a", "1:2", "1:2:0", "1:2:x", "1:2:3:4", "--1", "1.2.3:4:5"])
def test_angles_that_are_none(text: str) -> None:
    with pytest.raises(ValueError):
        sweep.angles_of(text)


def test_cells_are_centres_of_the_test_region() -> None:
    xs, ys = sweep.cells_of("2x7")
    np.testing.assert_allclose(xs, [0.15, 0.35])
    np.testing.assert_allclose(ys, [-0.3, -0.2, -0.1, 0, 0.1, 0.2, 0.3], atol=1e-9)


@pytest.mark.parametrize("text", ["", "3", "3x", "0x3", "3x0", "-1x3", "3 x 3", "3x3x3"])
def test_cells_that_are_none(text: str) -> None:
    with pytest.raises(ValueError, match="COLUMNSxROWS"):
        sweep.cells_of(text)


ANGLES, XS, YS = np.array([-0.2, 0.1]), np.array([0.1, 0.2, 0.3]), np.array([-0.1, 0.0, 0.1, 0.2])


@pytest.fixture(scope="module")
def default() -> EnvParams:
    return make("lift_spam").default_params()


def test_cell_params_pin_angle_and_object(default: EnvParams) -> None:
    cells = sweep.cell_params(default, ANGLES, XS, YS, 2)
    count = 2 * 3 * 4 * 2
    for field in dataclasses.fields(EnvParams):
        cell, base = getattr(cells, field.name), getattr(default, field.name)
        assert cell.shape == (count, *base.shape) and cell.dtype == base.dtype, field.name
        if field.name not in ("camera_angle", "object_low", "object_high"):
            np.testing.assert_array_equal(cell, np.broadcast_to(base, cell.shape))
    np.testing.assert_array_equal(cells.object_low, cells.object_high)
    np.testing.assert_array_equal(cells.camera_angle[:, 0], cells.camera_angle[:, 1])
    row = np.ravel_multi_index((1, 2, 3, 0), (2, 3, 4, 2))
    np.testing.assert_allclose(cells.object_low[row], [XS[2], YS[3]])
    np.testing.assert_allclose(cells.camera_angle[row], ANGLES[1])


POLICY: Any = None


@pytest.mark.parametrize("worlds", [5, 48, 64])
def test_every_result_lands_in_its_cell(worlds: int) -> None:
    """Whatever the batch: axes are angle, x, y, episode."""
    runner, made = rooms.evaluator(worlds)
    finished: list[int] = []
    found = sweep.sweep(
        runner,
        POLICY,
        angles=ANGLES,
        xs=XS,
        ys=YS,
        episodes=2,
        seed=0,
        aligned=True,
        progress=finished.append,
    )
    angle, x, y, _ = np.meshgrid(ANGLES, XS, YS, range(2), indexing="ij")
    np.testing.assert_array_equal(found.success, (x > 0.12) & (y < 0.15) & (angle < 0))
    np.testing.assert_array_equal(found.nan, y > 0.15)
    room = made["panda"]
    assert sum(finished) == 48 and len(room.keys) == -(-48 // worlds)
    keys = np.concatenate(room.keys)[:48]
    assert len(np.unique(keys, axis=0)) == 48  # every episode is a scene of its own
    assert list(made) == ["panda"]


@pytest.mark.parametrize("worlds", [4, 6])
def test_every_strength_sees_the_same_scenes(worlds: int) -> None:
    """The camera's bounds grow with the strength; the scenes' keys are those of the seed."""
    runner, made = rooms.evaluator(worlds)
    finished: list[int] = []
    strengths = np.array([0.0, 0.5, 1.0])
    found = sweep.sweep_strength(
        runner,
        POLICY,
        shift="viewpoint",
        strengths=strengths,
        episodes=6,
        seed=3,
        aligned=True,
        progress=finished.append,
    )
    assert found.shift == "viewpoint" and sum(finished) == 18
    np.testing.assert_array_equal(found.strengths, strengths)
    # In this room success needs a negative lower bound, and an object in the training region.
    np.testing.assert_array_equal(found.success, (strengths > 0)[:, None] & np.ones((3, 6), bool))
    room = made["panda"]
    batches = -(-6 // worlds)
    for row, strength in enumerate(strengths):
        batch = slice(row * batches, (row + 1) * batches)
        keys = np.concatenate(room.keys[batch])
        np.testing.assert_array_equal(keys, np.concatenate(room.keys[:batches]))
        for params in room.params[batch]:
            low = np.degrees(np.asarray(params.camera_angle))
            np.testing.assert_allclose(low, np.tile([[-30, 30]], (worlds, 1)) * strength, atol=1e-4)
            assert (np.asarray(params.align_hand) == 1).all()


def test_jobs_have_the_size_of_what_was_asked_for() -> None:
    grid = sweep.job(SweepConfig(run=Path(), camera="-30:30:3", workspace="2x5", batch=16))
    assert (grid.worlds, grid.episodes) == (16, 30)
    curve = sweep.job(SweepConfig(run=Path(), shift="lighting"))
    # No more worlds than there are scenes at a strength.
    assert (curve.worlds, curve.episodes) == (24, 5 * 24)
    few = sweep.job(SweepConfig(run=Path(), shift="lighting", strength="0.5", episodes=200))
    assert (few.worlds, few.episodes) == (64, 200)


@pytest.mark.parametrize(
    ("shift", "strengths"),
    [("lighting", [-1, -0.5, 0, 0.5, 1]), ("workspace", [0, 0.25, 0.5, 0.75, 1]),
     ("lighting+viewpoint", [0, 0.25, 0.5, 0.75, 1])],
)  # fmt: skip
def test_the_whole_range_of_a_shift(shift: str, strengths: list[float]) -> None:
    found = sweep.strengths_of(sweep.default_strengths(shift))
    np.testing.assert_allclose(found, strengths)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"shift": "light"}, "unknown shift 'light'.*known: .*lighting"),
        ({"shift": "embodiment"}, "expected shifts with a strength, got 'embodiment'.*--robot"),
        ({"shift": "in_domain"}, "expected shifts with a strength, got 'in_domain'"),
        ({"shift": "lighting", "strength": "0:1"}, "strength: expected LOW:HIGH:COUNT.*'0:1'"),
        ({"camera": "left"}, "camera: expected LOW:HIGH:COUNT in degrees.*'left'"),
    ],
)
def test_jobs_that_are_none(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sweep.job(SweepConfig(run=Path(), **options))


def test_files_are_named_after_robot_and_shift(tmp_path: Path) -> None:
    """And found again by what reads a run folder."""
    cells = np.zeros((1, 1, 1, 2), bool)
    grid = records.Sweep(np.zeros(1), np.zeros(1), np.zeros(1), cells, cells)
    names = []
    for robot in ("", "ur5"):
        path = records.save_sweep(records.sweep_path(tmp_path, robot), grid)
        names.append(path.name)
        for shift in ("lighting", "object_color+viewpoint"):
            curve = records.StrengthSweep(
                shift, np.array([0.0, 1]), np.ones((2, 3), bool), np.zeros((2, 3), bool)
            )
            path = records.sweep_path(tmp_path, robot, shift=shift)
            assert records.swept_robot(records.save_sweep(path, curve)) == robot
            names.append(path.name)
    assert names == [
        "sweep.npz", "strength-lighting.npz", "strength-object_color+viewpoint.npz",
        "sweep-ur5.npz", "strength-lighting-ur5.npz", "strength-object_color+viewpoint-ur5.npz",
    ]  # fmt: skip
    run = runs.load_run(tmp_path)
    assert not run.problems and set(run.sweeps) == {"", "ur5"}
    both = ("lighting", "object_color+viewpoint")
    assert set(run.strengths) == {(robot, shift) for robot in ("", "ur5") for shift in both}


def save(path: Path, arrays: dict[str, Any], header: dict[str, Any]) -> None:
    """A shard."""
    records.save_arrays(path, {**arrays, "header": np.asarray(json.dumps(header))})


def in_shards(options: SweepConfig, count: int, worlds: int) -> tuple[sweep.Job, list[Any], Any]:
    """The job, its shards, and the undivided sweep."""
    asked = sweep.job(options)
    run = partial(asked.run, seed=0, aligned=True)
    parts = []
    for index in range(1, count + 1):
        finished: list[int] = []
        runner, _ = rooms.evaluator(worlds)
        only = asked.part((index, count))
        parts.append(run(runner, POLICY, only=only, progress=finished.append))
        assert sum(finished) == len(only)
    return asked, parts, run(rooms.evaluator(worlds)[0], POLICY)


@pytest.mark.parametrize(
    ("options", "count"),
    [
        ({"camera": "-20:20:5", "workspace": "3x4", "batch": 7}, 3),
        ({"camera": "-5", "workspace": "1x1", "batch": 7}, 2),  # the second one has nothing to do
        ({"shift": "viewpoint", "episodes": 6, "batch": 3}, 2),
    ],
)
def test_shards_join_to_the_undivided_sweep(
    options: dict[str, Any], count: int, tmp_path: Path
) -> None:
    config = SweepConfig(run=tmp_path, **options)
    asked, parts, whole = in_shards(config, count, config.batch)
    path, header = records.sweep_path(tmp_path, shift=config.shift), {"seed": 0}
    for index, part in enumerate(parts, 1):
        save(shards.path_of(path, index, count), vars(part), header)
    arrays = shards.merge(path, asked.shape, asked.part, asked.grid, header)
    assert whole.success.any() or whole.success.size == 1
    for name in ("success", "nan"):
        np.testing.assert_array_equal(arrays[name], getattr(whole, name))
    assert arrays["worlds"] == config.batch
    records.save_sweep(path, asked.record(**asked.grid, **arrays), header)
    assert not runs.load_run(tmp_path).problems and runs.find_runs(tmp_path) == []


def test_shards_of_two_kinds_are_not_joined(tmp_path: Path) -> None:
    config = SweepConfig(run=tmp_path, camera="-20:20:3", workspace="2x2", batch=4)
    asked, parts, _ = in_shards(config, 3, 4)
    path, header = records.sweep_path(tmp_path), {"seed": 0, "policy": "ab"}

    def joined(expected: dict[str, Any] = header) -> Any:
        return shards.merge(path, asked.shape, asked.part, asked.grid, expected)

    with pytest.raises(ShardError, match="expected the shards of one sweep.*found none"):
        joined()
    for index in (1, 3):
        save(shards.path_of(path, index, 3), vars(parts[index - 1]), header)
    with pytest.raises(ShardError, match="the shards 2/3 are missing.*--shard 2/3"):
        joined()
    second = shards.path_of(path, 2, 3)
    save(second, vars(parts[1]), {**header, "policy": "cd"})
    with pytest.raises(ShardError, match="2-of-3.npz was made with policy = 'cd', here it is 'ab'"):
        joined()
    save(second, {**vars(parts[1]), "xs": parts[1].xs + 0.1}, header)
    with pytest.raises(ShardError, match="2-of-3.npz: its xs are not those of this command"):
        joined()
    save(second, {**vars(parts[1]), "nan": parts[1].nan[:1]}, header)
    with pytest.raises(ShardError, match=r"nan: expected shape \(3, 2, 2, 1\), got \(1, 2, 2, 1\)"):
        joined()
    records.save_sweep(second, parts[1])
    with pytest.raises(ShardError, match="not a shard of a sweep"):
        joined()
    save(second, vars(parts[1]), header)
    assert joined()["success"].shape == (3, 2, 2, 1)
    save(shards.path_of(path, 1, 2), vars(parts[0]), header)
    with pytest.raises(ShardError, match="found 2 parts and 3 parts"):
        joined()


@pytest.mark.parametrize("text", ["0/2", "3/2", "1", "1/", "/2", "-1/2", "1/2/3", "a/b"])
def test_shards_that_are_none(text: str) -> None:
    assert shards.parse("2/3") == (2, 3)
    with pytest.raises(ShardError, match="expected i/n with i from 1 to n"):
        shards.parse(text)


def test_wrong_sweep_commands_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, message in (
        ([str(tmp_path)], "no run folder here"),
        ([str(tmp_path), "--robot", "r2d2"], "unknown robot 'r2d2'; known: panda"),
        ([str(tmp_path), "--shift", "fog"], "unknown shift 'fog'"),
        ([str(tmp_path), "--shard", "3/2"], "shard: expected i/n with i from 1 to n, got '3/2'"),
        ([str(tmp_path), "--shard", "1/2", "--merge"], "--merge alone joins the shards"),
    ):
        assert sweep.main(words) == 2
        assert message in " ".join(capsys.readouterr().out.split())


def test_what_is_left_to_another_process_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, swept = tiny.write(tmp_path / "run"), []
    (folder / "eval.json").write_text("{}")
    monkeypatch.setattr(sweep.Runners, "of", lambda *_, **__: None)
    monkeypatch.setattr(sweep, "_sweep_one", lambda folder, *_: swept.append(folder))
    claim = {"host": "elsewhere", "processes": [{"pid": 1, "started": ""}], "since": "noon"}
    name = ".sweep-1-of-2.claim"
    (folder / name).write_text(json.dumps(claim))
    words = [str(folder), "--shard", "1/2"]
    assert sweep.main(words) == locks.LEFT == 3 and not swept
    said = " ".join(capsys.readouterr().out.split())
    assert "is left to another process" in said and "--take-over" in said
    assert sweep.main([*words, "--take-over"]) == 0 and swept == [folder]


class Killed(Exception):
    """Stands in for the end of the process."""


@pytest.mark.parametrize("kind", ["grid", "strength"])
def test_a_sweep_goes_on_from_its_last_batch_and_not_from_anothers(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if kind == "grid":
        options = SweepConfig(run=Path(), camera="-10:10:2", workspace="3x4", episodes=2)
    else:
        options = SweepConfig(run=Path(), shift="viewpoint", strength="0:1:3", episodes=16)
    job, total = sweep.job(options), 48

    def perform(
        name: str, *, seed: int = 0, left: int = total, other_versions: bool = False
    ) -> tuple[int, bytes]:
        """Runs until `left` episodes have been told; the batches it took, and the file."""
        runner, made = rooms.evaluator(5)

        def progress(count: int) -> None:
            nonlocal left
            left -= count
            if left < 0:
                raise Killed

        path = tmp_path / name
        path.unlink(missing_ok=True)
        try:
            job.perform(
                path,
                runner,
                POLICY,
                header={},
                seed=seed,
                aligned=True,
                progress=progress,
                other_versions=other_versions,
            )
        except Killed:
            assert not path.exists()
            return len(made["panda"].keys), b""
        assert not list(tmp_path.glob(".*.partial"))
        return len(made["panda"].keys), path.read_bytes()

    whole, expected = perform("whole.npz")
    begun, _ = perform("sweep.npz", left=20)
    finished, content = perform("sweep.npz")
    assert content == expected and finished <= whole - begun + 1
    perform("sweep.npz", left=20)  # what another question found is not taken over
    assert perform("sweep.npz", seed=1)[0] == whole
    perform("sweep.npz", left=20)  # under other versions only when told
    with monkeypatch.context() as other:
        real = versions.current()
        other.setattr(versions, "current", lambda: {**real, "jax": "0.0.1"})
        with pytest.raises(ConfigError, match=rf"partial was begun with jax {real['jax']}, now it"):
            perform("sweep.npz")
        finished, content = perform("sweep.npz", other_versions=True)
    assert content == expected and finished <= whole - begun + 1
    perform("sweep.npz", left=20)  # versions were not always noted
    kept = tmp_path / ".sweep.npz.partial"
    with np.load(kept) as file:
        arrays = {name: file[name] for name in file.files if name != "header"}
    kept.write_bytes(records.save_arrays(tmp_path / "old.npz", arrays).read_bytes())
    finished, content = perform("sweep.npz")
    assert content == expected and finished <= whole - begun + 1
    perform("sweep.npz", left=20)
    (tmp_path / ".sweep.npz.partial").write_bytes(b"PK damaged")
    assert perform("sweep.npz") == (whole, expected)
