"""JSONL log and atomic JSON: what survives a kill, and what is refused."""

import dataclasses
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from palm_jax.train.files import metrics
from palm_jax.train.files.metrics import MetricsLog, plain, read_metrics, write_json


def lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


def test_every_line_is_on_disk_at_once_and_is_strict_json(tmp_path: Path) -> None:
    path = tmp_path / "run" / "metrics.jsonl"
    with MetricsLog(path) as log:
        log.write(50, {"loss": jnp.float32(0.5), "bad": float("nan"), "big": np.inf})
        # Read while the log is open: nothing may wait in a buffer.
        assert lines(path) == ['{"step": 50, "loss": 0.5, "bad": null, "big": null}']
        log.write(100, {"loss": 0.25})
    assert [record["step"] for record in read_metrics(path)] == [50, 100]


def test_resume_drops_the_half_line_and_the_steps_to_come(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    with MetricsLog(path) as log:
        for step in (50, 100, 150):
            log.write(step, {"loss": 1 / step})
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"step": 200, "lo')
    assert [record["step"] for record in read_metrics(path)] == [50, 100, 150]

    with MetricsLog(path, resume_step=100) as log:
        assert [json.loads(line)["step"] for line in lines(path)] == [50, 100]
        log.write(150, {"loss": 1 / 150})
    assert path.read_bytes() == whole  # as if never interrupted


def test_what_the_log_has_is_not_written_twice(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text(
        '{"step": 4, "loss": 2.0}\n{"step": 4, "score": 0.5}\n{"step": 8, "score": 1}\n'
    )
    with MetricsLog(path, resume_step=4) as log:
        for step in (4, 8):
            log.write_once(step, {"score": 0.5})
        log.write_once(4, {"other": 0.5})
    assert [(record["step"], *list(record)[1:]) for record in read_metrics(path)] == [
        (4, "loss"), (4, "score"), (8, "score"), (4, "other"),
    ]  # fmt: skip


def test_a_complete_last_line_without_newline_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1, "loss": 2.0}\n{"step": 2, "loss": 1.0}')
    with MetricsLog(path, resume_step=2) as log:
        log.write(3, {"loss": 0.5})
    assert [record["step"] for record in read_metrics(path)] == [1, 2, 3]


def test_damage_in_the_middle_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1}\n\x00\x00garbage\n{"no": "step"}\n{"step": 2}\n')
    with pytest.warns(UserWarning, match="2 unreadable lines"):
        assert [record["step"] for record in read_metrics(path)] == [1, 2]
    with pytest.warns(UserWarning, match="2 unreadable lines"):
        MetricsLog(path, resume_step=2).close()
    assert lines(path) == ['{"step": 1}', '{"step": 2}']


def test_a_new_run_does_not_append_to_another_runs_log(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    with MetricsLog(path) as log:
        log.write(1, {"loss": 1.0})
    with pytest.raises(FileExistsError, match="another run"):
        MetricsLog(path)
    with (
        MetricsLog(tmp_path / "other.jsonl") as log,
        pytest.raises(ValueError, match="'step' is given twice"),
    ):
        log.write(1, {"step": 2})


def test_a_log_that_died_in_its_first_line_starts_anew(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"ste')
    with MetricsLog(path) as log:
        log.write(1, {})
    assert lines(path) == ['{"step": 1}']


@dataclasses.dataclass(frozen=True)
class Options:
    rate: float
    out: Path


def test_plain() -> None:
    value = {
        1: Options(0.5, Path("a/b")),
        "array": np.arange(3, dtype=np.int16),
        "scalar": jnp.float32(2),
        "flag": np.bool_(True),
        "nested": [(1, None), np.array([[np.nan, 1.0]])],
        "half": jnp.ones((), jnp.bfloat16),
        "set": {3, 1},
    }
    assert plain(value) == {
        "1": {"rate": 0.5, "out": "a/b"},
        "array": [0, 1, 2],
        "scalar": 2.0,
        "flag": True,
        "nested": [[1, None], [[None, 1.0]]],
        "half": 1.0,
        "set": [1, 3],
    }
    with pytest.raises(TypeError, match="cannot write a complex"):
        plain({"z": 1j})


def test_write_json_replaces_whole_files_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run" / "eval.json"
    write_json(path, {"in_domain": {"successes": np.int64(3)}})
    assert json.loads(path.read_text()) == {"in_domain": {"successes": 3}}

    def killed(source: object, target: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(metrics.os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_json(path, {"in_domain": {"successes": 4}})
    monkeypatch.undo()
    assert json.loads(path.read_text()) == {"in_domain": {"successes": 3}}
    assert [file.name for file in path.parent.iterdir()] == ["eval.json"]  # no litter
    with pytest.raises(TypeError):
        write_json(path, object())
    assert json.loads(path.read_text()) == {"in_domain": {"successes": 3}}


def test_written_files_have_ordinary_permissions(tmp_path: Path) -> None:
    ordinary = tmp_path / "ordinary"
    ordinary.touch()
    assert write_json(tmp_path / "a.json", 1).stat().st_mode == ordinary.stat().st_mode
