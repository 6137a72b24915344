"""The order of a table's cells, and that none is lost, mixed or done twice. Training is faked."""

import dataclasses
import json
import os
import signal
import threading
import time
from importlib import metadata
from pathlib import Path

import h5py
import numpy as np
import pytest

from palm_jax.train import config as configuration
from palm_jax.train import table
from palm_jax.train.config import Config, ConfigError
from palm_jax.train.files import locks, records, tables
from palm_jax.train.table import TableConfig

SMALL = TableConfig(
    preset="quick", tasks=("lift_lid", "lift_spam"), methods=("arro", "bc", "palm"), seeds=(0, 1)
)

TIMES = {
    "updates": 2400,
    "training_and_selection_s": 30.0,
    "selection_s": 6.0,
    "evaluation_s": 10.0,
}


class Trainer:
    """Stands in for the training process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.asked: list[str] = []
        self.failing: set[str] = set()
        self.stop_at: str | None = None
        self.times = json.dumps(TIMES)
        self.env: object = {}
        self.demonstrations: dict[str, str] = {}  # SHA-256 by task
        monkeypatch.setattr(table, "_train", self)

    def __call__(self, config: Config, log: Path) -> int:
        assert config.out is not None
        name = f"{config.task}/{config.out.name}"
        self.asked.append(name)
        if name == self.stop_at:
            raise KeyboardInterrupt
        if name in self.failing:
            return 3
        config.out.mkdir(parents=True, exist_ok=True)
        count = {"successes": len(self.asked), "episodes": 24, "nan": 0}
        (config.out / "eval.json").write_text(json.dumps({"in_domain": count}))
        episodes = {
            "success": np.arange(24) < len(self.asked), "nan": np.zeros(24, bool),
            "object_xy": np.zeros((24, 2)), "camera_angle": np.zeros(24), "length": np.ones(24),
        }  # fmt: skip
        records.save_eval(config.out / "eval.npz", {"in_domain": episodes})
        (config.out / "times.json").write_text(self.times)
        (config.out / "env.json").write_text(json.dumps(self.env))
        if config.task in self.demonstrations:
            digests = {"demonstrations": self.demonstrations[config.task]}
            (config.out / "config.json").write_text(json.dumps({"digests": digests}))
        return 0


@pytest.fixture
def trainer(monkeypatch: pytest.MonkeyPatch) -> Trainer:
    return Trainer(monkeypatch)


def run(config: TableConfig) -> int:
    words = ["--preset", config.preset, "--tasks", *config.tasks, "--methods", *config.methods]
    words += ["--seeds", *map(str, config.seeds), "--shard", config.shard]
    words += ["--out", str(config.folder), "--json", str(config.file)]
    words += ["--take-over"] if config.take_over else []
    if config.merge:
        words += ["--merge", *map(str, config.merge)]
    return table.main(words)


def test_palm_and_bc_come_first() -> None:
    names = [cell.name for cell in table.cells(SMALL)]
    assert names[:5] == [
        "lift_lid/palm-s0", "lift_spam/palm-s0", "lift_lid/palm-s1", "lift_spam/palm-s1",
        "lift_lid/bc-s0",
    ]  # fmt: skip
    assert len(names) == 12 and names[-1] == "lift_spam/arro-s1"


def test_shards_divide_the_cells() -> None:
    parts = [
        {cell.name for cell in table.cells(dataclasses.replace(SMALL, shard=f"{i}/5"))}
        for i in range(1, 6)
    ]
    assert sum(map(len, parts)) == 12 and len(set().union(*parts)) == 12


def test_a_shard_that_is_none_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(dataclasses.replace(SMALL, out=tmp_path, shard="3/2")) == 2
    assert "shard: expected i/n with i from 1 to n, got '3/2'" in capsys.readouterr().err


def test_a_cell_is_a_training_command(tmp_path: Path) -> None:
    config = dataclasses.replace(SMALL, out=tmp_path)
    cell = table.cell_config(config, tables.Cell("lift_spam", "arro", 1))
    again = configuration.parse(configuration.command(cell)[3:])
    assert again == cell
    assert again.method == ("arro",) and again.seed == 1 and not again.sweep
    # Demonstrations are of the task alone.
    other = table.cell_config(config, tables.Cell("lift_spam", "palm", 0))
    assert cell.data == other.data and cell.out != other.out


def test_a_stop_loses_the_running_cell_alone(tmp_path: Path, trainer: Trainer) -> None:
    config = dataclasses.replace(SMALL, out=tmp_path, seeds=(0,))
    trainer.stop_at = "lift_lid/bc-s0"
    assert run(config) == 130
    stored = json.loads(config.file.read_text())
    assert stored["results"]["lift_spam"]["palm"]["0"]["in_domain"]["successes"] == 2
    trainer.stop_at = None
    assert run(config) == 0
    assert trainer.asked == [
        "lift_lid/palm-s0", "lift_spam/palm-s0", "lift_lid/bc-s0",
        "lift_lid/bc-s0", "lift_spam/bc-s0", "lift_lid/arro-s0", "lift_spam/arro-s0",
    ]  # fmt: skip
    before = config.file.read_bytes()
    assert run(config) == 0 and len(trainer.asked) == 7 and config.file.read_bytes() == before


def test_a_failed_cell_is_named_and_the_others_go_on(
    tmp_path: Path, trainer: Trainer, capsys: pytest.CaptureFixture[str]
) -> None:
    config = dataclasses.replace(SMALL, out=tmp_path, seeds=(0,), methods=("palm",))
    trainer.failing = {"lift_lid/palm-s0"}
    assert run(config) == 1
    stored = json.loads(config.file.read_text())
    log = stored["failed"]["lift_lid"]["palm"]["0"]
    assert log == str(tmp_path / "lift_lid/palm-s0.log")
    assert set(stored["results"]) == {"lift_spam"}
    assert "lift_lid/palm-s0 failed (exit code 3)" in capsys.readouterr().out.replace("\n", " ")
    trainer.failing = set()  # it is tried again, and no failure remains
    assert run(config) == 0
    assert set(json.loads(config.file.read_text())["results"]) == {"lift_lid", "lift_spam"}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("preset",), "preset = 'cpu', now it is 'quick'"),
        (("recipe", "steps"), "recipe.steps = 'cpu', now it is 2400"),
        (("versions", "jax"), "versions.jax = 'cpu', now it is"),
    ],
)
def test_other_conditions_are_refused_by_name(
    change: tuple[str, ...],
    words: str,
    tmp_path: Path,
    trainer: Trainer,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = dataclasses.replace(SMALL, out=tmp_path, seeds=(0,), methods=("palm",))
    assert run(config) == 0
    stored = json.loads(config.file.read_text())
    place = stored["header"]
    for name in change[:-1]:
        place = place[name]
    place[change[-1]] = "cpu"
    tables.store(config.file, stored)
    before = config.file.read_bytes()
    assert run(dataclasses.replace(config, methods=("bc",))) == 2
    assert words in capsys.readouterr().err
    assert config.file.read_bytes() == before and len(trainer.asked) == 2


def test_shards_are_merged(tmp_path: Path, trainer: Trainer) -> None:
    parts = [
        dataclasses.replace(SMALL, out=tmp_path / str(i), shard=f"{i}/2", seeds=(0,))
        for i in (1, 2)
    ]
    assert [run(part) for part in parts] == [0, 0]
    whole = dataclasses.replace(
        SMALL, out=tmp_path / "whole", seeds=(0,), merge=tuple(part.file for part in parts)
    )
    assert run(whole) == 0
    found = json.loads(whole.file.read_text())["results"]
    every = {(task, method) for task in SMALL.tasks for method in SMALL.methods}
    assert {(t, m) for t, row in found.items() for m in row} == every
    # Episode by episode, too: each policy's are its own.
    episodes = records.load_eval(tables.episodes_file(whole.file))
    assert len(episodes) == len(every)
    for task, method in every:
        counted = found[task][method]["0"]["in_domain"]["successes"]
        assert episodes[f"{task}/{method}/0/in_domain"].success.sum() == counted


def test_what_cannot_be_merged_is_named_and_changes_nothing(
    tmp_path: Path, trainer: Trainer, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = (
        dataclasses.replace(SMALL, out=tmp_path / name, seeds=(0,), methods=(name,))
        for name in ("palm", "bc")
    )
    assert run(first) == run(second) == 0
    beside = tables.episodes_file(second.file)
    whole = beside.read_bytes()
    before = first.file.read_bytes(), tables.episodes_file(first.file).read_bytes()

    def refused(*paths: Path) -> str:
        assert run(dataclasses.replace(first, merge=paths)) == 2
        after = first.file.read_bytes(), tables.episodes_file(first.file).read_bytes()
        assert after == before
        return " ".join(capsys.readouterr().err.split())

    wrong = tmp_path / "wrong" / "table.json"
    assert f"expected the JSON file of a shard, got {wrong}" in refused(second.file, wrong)
    with np.load(beside) as file:
        arrays = dict(file)
    some = {name: array for name, array in arrays.items() if not name.startswith("lift_spam")}
    np.savez(beside, **some)
    error = refused(second.file)
    assert f"{second.file}: lift_spam/bc-s0: in_domain" in error and "count None" in error
    name = "lift_spam/bc/0/in_domain/success"
    np.savez(beside, **arrays | {name: ~arrays[name]})
    assert "lift_spam/bc-s0: in_domain: {'successes': 4" in refused(second.file)
    beside.unlink()
    assert "the episodes of its cells are expected in table.npz" in refused(second.file)
    beside.write_bytes(whole)
    assert run(dataclasses.replace(first, merge=(second.file,))) == 0
    assert len(records.load_eval(tables.episodes_file(first.file))) == 4


def test_every_cell_notes_its_demonstrations(tmp_path: Path, trainer: Trainer) -> None:
    """Machines round differently: a table that another one goes on with has two collections."""
    config = dataclasses.replace(SMALL, out=tmp_path / "one", seeds=(0,), methods=("palm",))
    assert run(config) == 0  # by a version that did not note them
    assert "demonstrations" not in json.loads(config.file.read_text())
    trainer.demonstrations = {"lift_lid": "a" * 64, "lift_spam": "b" * 64}
    assert run(dataclasses.replace(config, methods=("bc",))) == 0
    trainer.demonstrations["lift_spam"] = "c" * 64
    other = dataclasses.replace(config, out=tmp_path / "two", methods=("arro",))
    assert run(other) == 0
    assert run(dataclasses.replace(config, merge=(other.file,))) == 0
    content = json.loads(config.file.read_text())
    assert set(content["results"]["lift_lid"]) == {"palm", "bc", "arro"}
    assert content["demonstrations"] == {
        "lift_lid": {"bc": {"0": "a" * 64}, "arro": {"0": "a" * 64}},
        "lift_spam": {"bc": {"0": "b" * 64}, "arro": {"0": "c" * 64}},
    }


def test_the_header_says_where_cells_were_made(tmp_path: Path, trainer: Trainer) -> None:
    """Not where they are entered or merged, nor where one failed."""
    config = dataclasses.replace(SMALL, out=tmp_path / "one", seeds=(0,), methods=("palm",))
    trainer.env = {"sessions": [{"machine": "A", "commit": "x"}, {"machine": "B", "commit": "x"}]}
    assert run(dataclasses.replace(config, tasks=("lift_lid",))) == 0
    trainer.env, trainer.failing = {"machine": "D", "commit": "z"}, {"lift_spam/palm-s0"}
    assert run(config) == 1
    header = json.loads(config.file.read_text())["header"]
    assert (header["machine"], header["commit"]) == ("A; B", "x")
    trainer.env = {"sessions": [{"machine": "C", "commit": "y"}]}
    other = dataclasses.replace(config, out=tmp_path / "two", methods=("bc",))
    assert run(other) == 0
    joined = dataclasses.replace(config, json=tmp_path / "joined.json")
    merged = run(dataclasses.replace(joined, merge=(config.file, other.file)))
    assert merged == 1  # the one that failed comes along
    header = json.loads(joined.file.read_text())["header"]
    assert (header["machine"], header["commit"]) == ("A; B; C", "x; y")


@pytest.mark.parametrize(("name", "value"), [("noise", 0.01), ("seed", 5)])
def test_demonstrations_of_another_recipe_are_refused(
    name: str, value: float, tmp_path: Path, trainer: Trainer, capsys: pytest.CaptureFixture[str]
) -> None:
    config = dataclasses.replace(SMALL, out=tmp_path, seeds=(0,), methods=("palm",))
    path = tmp_path / "demos" / "lift_spam.hdf5"
    path.parent.mkdir()
    recipe = configuration.PRESETS[config.preset]()
    with h5py.File(path, "w") as file:
        attributes = {"seed": recipe.demo_seed, "noise": recipe.demo_noise}
        file.create_group("data").attrs.update({**attributes, name: value})
    assert run(config) == 2
    assert trainer.asked == ["lift_lid/palm-s0"]
    error = " ".join(capsys.readouterr().err.split())
    assert f"{path} was collected with {name} {value}, the table's recipe says" in error
    with h5py.File(path, "a") as file:
        file["data"].attrs.update(attributes)
    assert run(config) == 0
    path.write_bytes(b"no HDF5")  # is told by the command itself, which fails alone
    assert run(dataclasses.replace(config, methods=("bc",))) == 0
    assert trainer.asked[-1] == "lift_spam/bc-s0"


@pytest.mark.parametrize("kind", ["one of the sessions", "the only one"])
def test_a_cell_of_other_versions_is_not_entered(
    kind: str, tmp_path: Path, trainer: Trainer, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was made before an upgrade, and taken from its folder after it."""
    config = dataclasses.replace(SMALL, out=tmp_path, seeds=(0,), methods=("palm",))
    here = metadata.version("jax")
    old, now = {"versions": {"jax": "0.0.1"}}, {"versions": {"jax": here}}
    trainer.env = {"sessions": [old, now]} if kind == "one of the sessions" else old
    assert run(config) == 1
    content = json.loads(config.file.read_text())
    assert not content["results"] and set(content["failed"]) == {"lift_lid", "lift_spam"}
    said = " ".join(capsys.readouterr().out.split())
    assert f"lift_lid/palm-s0 was made with jax 0.0.1, the table with {here}" in said
    trainer.env = {"sessions": [now, now]}
    assert run(config) == 0


@pytest.mark.parametrize(
    "notes", ["{", "[]", '{"quoted": ["x"], "x": 1}', '{"quoted": "a", "a": {"in_domain": 3}}']
)
def test_notes_of_hands_that_are_none_cost_no_results(notes: str, tmp_path: Path) -> None:
    (tmp_path / "eval_variants.json").write_text(notes)
    assert table._hands(tmp_path) is None


@pytest.mark.parametrize("name", ["env.json", "eval.json", "eval.npz"])
def test_a_cell_that_left_a_damaged_file_costs_that_cell_alone(
    name: str,
    tmp_path: Path,
    trainer: Trainer,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = dataclasses.replace(SMALL, out=tmp_path, seeds=(0,), methods=("palm",))

    def damaging(asked: Config, log: Path) -> int:
        code = trainer(asked, log)
        if asked.task == "lift_lid":
            assert asked.out is not None
            (asked.out / name).write_bytes(b"{")
        return code

    monkeypatch.setattr(table, "_train", damaging)
    assert run(config) == 1
    content = json.loads(config.file.read_text())
    assert set(content["results"]) == {"lift_spam"} and set(content["failed"]) == {"lift_lid"}
    assert str(tmp_path / "lift_lid/palm-s0" / name) in capsys.readouterr().out
    monkeypatch.setattr(table, "_train", trainer)
    assert run(config) == 0


def test_a_table_does_not_go_on_without_its_episodes(
    tmp_path: Path, trainer: Trainer, capsys: pytest.CaptureFixture[str]
) -> None:
    config = dataclasses.replace(SMALL, out=tmp_path, seeds=(0,), methods=("palm",))
    assert run(config) == 0
    tables.episodes_file(config.file).unlink()
    assert run(dataclasses.replace(config, methods=("bc",))) == 2 and len(trainer.asked) == 2
    assert "are expected in table.npz beside it" in " ".join(capsys.readouterr().err.split())


def test_a_cell_tells_its_commit_and_both_hands(
    tmp_path: Path, trainer: Trainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = dataclasses.replace(SMALL, out=tmp_path / "one", seeds=(0,), methods=("bc",))
    trainer.env = {"sessions": [{"commit": "b", "devices": ["gpu:0"]}, {"commit": "a"}]}

    def varied(asked: Config, log: Path) -> int:
        code = trainer(asked, log)
        assert asked.out is not None
        count = {"episodes": 24, "nan": 0}
        variants = {
            "quoted": "unaligned",
            "unaligned": {"viewpoint": {"successes": 9, **count}},
            "aligned": {"viewpoint": {"successes": 7, **count}},
        }
        (asked.out / "eval_variants.json").write_text(json.dumps(variants))
        return code

    monkeypatch.setattr(table, "_train", varied)
    assert run(config) == 0
    merged = dataclasses.replace(config, json=tmp_path / "merged.json", merge=(config.file,))
    assert run(merged) == 0
    for file in (config.file, merged.file):
        content, cell = json.loads(file.read_text()), tables.Cell("lift_lid", "bc", 0)
        assert content["header"]["devices"] == "gpu:0"
        assert tables.get(content, "commits", cell) == "a; b"
        assert tables.get(content, "hands", cell) == {
            "quoted": "unaligned",
            "successes": {"unaligned": {"viewpoint": 9}, "aligned": {"viewpoint": 7}},
        }


def test_of_a_cell_that_was_run_twice_the_first_one_counts(
    tmp_path: Path, trainer: Trainer, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = (
        dataclasses.replace(SMALL, out=tmp_path / name, seeds=(0,), methods=("palm",))
        for name in ("one", "two")
    )
    trainer.env = {"machine": "A"}
    assert run(first) == 0
    trainer.env = {"machine": "B"}
    assert run(second) == 0
    before = json.loads(first.file.read_text())
    assert run(dataclasses.replace(first, merge=(second.file,))) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"lift_spam/palm-s0: {second.file} has other results of it" in said
    after = json.loads(first.file.read_text())
    assert after["results"] == before["results"] and after["header"]["machine"] == "A"


def test_the_header_tells_the_speed(tmp_path: Path, trainer: Trainer) -> None:
    config = dataclasses.replace(SMALL, out=tmp_path, seeds=(0,), methods=("palm",))
    assert run(config) == 0
    header = json.loads(config.file.read_text())["header"]
    assert header["samples_per_second"] == 2400 * 32 / (30.0 - 6.0)
    assert header["evaluation_seconds"] == 10.0


@pytest.mark.parametrize(
    "left",
    [
        # killed before the last number
        '{"updates": 2400, "training_and_selection_s": 30.0, "selection_s": 6.0}',
        '{"updates": 2400, "training_and_selection_s": 30.0, "evaluation_s": null}',
        '{"updates": 2400, "training_and_selection_s": "30", "evaluation_s": 10.0}',
        '{"training_and_selection_s": 30.0, "evaluation_s": 10.0}',
        "{",
    ],
)
def test_a_cell_whose_times_are_not_known_is_entered(
    left: str, tmp_path: Path, trainer: Trainer
) -> None:
    """Its results are whole: no further command would ever write the times."""
    config = dataclasses.replace(SMALL, out=tmp_path, seeds=(0,), methods=("palm",))
    trainer.times = left
    assert run(config) == 0
    stored = json.loads(config.file.read_text())
    assert set(stored["results"]) == {"lift_lid", "lift_spam"} and not stored.get("times")
    assert "samples_per_second" not in stored["header"]
    # The next cells' times count alone.
    trainer.times = json.dumps(TIMES)
    assert run(dataclasses.replace(config, methods=("bc",))) == 0
    header = json.loads(config.file.read_text())["header"]
    assert header["samples_per_second"] == 2400 * 32 / 24.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tasks": ("lid",)}, "unknown task 'lid'; known: lift_lid"),
        ({"methods": ("plam",)}, "unknown method 'plam'; known: palm"),
        ({"preset": "huge"}, "unknown preset 'huge'; known: quick"),
        ({"seeds": (1, 1)}, "seeds: expected one or more, each once"),
    ],
)
def test_what_does_not_exist_is_refused(change: dict, words: str) -> None:
    with pytest.raises(ConfigError, match="unknown|expected") as error:
        table.cells(dataclasses.replace(SMALL, **change))
    assert words in str(error.value)


def test_two_processes_never_run_the_same_cell(
    tmp_path: Path, trainer: Trainer, capsys: pytest.CaptureFixture[str]
) -> None:
    """What another one has claimed is left to it; what it finished meanwhile is not done again."""
    config = dataclasses.replace(SMALL, out=tmp_path, seeds=(0,), methods=("palm",))
    other = tmp_path / "lift_lid/palm-s0"
    other.mkdir(parents=True)
    here = locks.Process.own()
    claim = {"processes": [dataclasses.asdict(here)], "since": "noon"}
    (other / locks.CLAIM).write_text(json.dumps({**claim, "host": locks.host()}))
    assert run(config) == locks.LEFT == 3 and trainer.asked == ["lift_spam/palm-s0"]
    said = " ".join(capsys.readouterr().out.split())
    assert f"in use since noon by process {here.pid} on this machine" in said
    assert said.endswith("1 cells are left to other processes")
    # Those of another share do not count.
    assert run(dataclasses.replace(config, shard="2/2")) == 0
    # Of another machine: only when told.
    (other / locks.CLAIM).write_text(json.dumps({**claim, "host": "elsewhere"}))
    assert run(config) == locks.LEFT and len(trainer.asked) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "on elsewhere, which cannot be seen from here" in said and "--take-over" in said
    assert run(dataclasses.replace(config, take_over=True)) == 0
    assert trainer.asked[1:] == ["lift_lid/palm-s0"] and not (other / locks.CLAIM).exists()


def test_a_file_that_another_process_wrote_meanwhile_keeps_its_cells(
    tmp_path: Path, trainer: Trainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = dataclasses.replace(SMALL, out=tmp_path, seeds=(0,), methods=("palm",))

    def beside(asked: Config, log: Path) -> int:
        if asked.task == "lift_lid":  # a second command runs while the first trains
            monkeypatch.setattr(table, "_train", trainer)
            assert run(dataclasses.replace(config, tasks=("lift_spam",))) == 0
        return trainer(asked, log)

    monkeypatch.setattr(table, "_train", beside)
    assert run(config) == 0
    assert sorted(trainer.asked) == ["lift_lid/palm-s0", "lift_spam/palm-s0"]
    assert set(json.loads(config.file.read_text())["results"]) == {"lift_lid", "lift_spam"}
    assert len(records.load_eval(tables.episodes_file(config.file))) == 2


STUBBORN = """
import signal, sys, time
def save(*_):
    print("saved"); sys.exit(130)
signal.signal(signal.SIGTERM, save)
signal.signal(signal.SIGINT, signal.SIG_IGN)
print("ready", flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_lets_the_running_cell_save(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = table.cell_config(
        dataclasses.replace(SMALL, out=tmp_path), tables.Cell("lift_lid", "palm", 0)
    )
    log = tmp_path / "cell.log"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(configuration, "command", lambda *_, **__: ["python", "-c", STUBBORN])

    def when_ready() -> None:
        while not log.exists() or "ready\n" not in log.read_text().splitlines(keepends=True):
            time.sleep(0.01)
        os.kill(os.getpid(), number)

    threading.Thread(target=when_ready).start()
    with pytest.raises(KeyboardInterrupt):
        table._train(config, log)
    assert log.read_text().endswith("saved\n")
