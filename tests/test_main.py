"""The `python -m palm_jax VERB` shell: help, unknown verbs, lazy imports, exit codes."""

import subprocess
import sys
import types
from pathlib import Path

import pytest

from palm_jax import __main__ as cli
from palm_jax import __version__
from palm_jax._quiet import without_lines

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def verb(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Replaces `report` by a stub that returns 3, and records the words it gets."""
    seen: list[list[str]] = []
    stub = types.ModuleType("stub_verb")
    stub.main = lambda argv: seen.append(list(argv)) or 3  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "stub_verb", stub)
    monkeypatch.setitem(cli.VERBS, "report", cli.Verb("stub_verb", "stub"))
    return seen


@pytest.mark.parametrize("words", [[], ["-h"], ["--help"], ["help"]])
def test_help_lists_every_verb(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == 0
    out = capsys.readouterr().out
    for name in ("train", "sweep", "report", "show", "serve", "export", "bench"):
        assert f"\n  {name} " in out


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"palm_jax {__version__}\n"


def test_unknown_verb_lists_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["tarin"]) == 2
    err = capsys.readouterr().err
    assert "unknown verb 'tarin'. Did you mean 'train'?" in err
    assert f"Known verbs: {', '.join(cli.VERBS)}" in err
    assert {"train", "table", "data", "serve", "bench"} < set(cli.VERBS)


def test_verb_gets_its_words_and_its_status_is_returned(
    verb: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["report", "runs/demo", "--open"]) == 3
    assert verb == [["runs/demo", "--open"]]
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == f"palm_jax {__version__}: report\n"


def test_a_verb_says_which_extra_it_needs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "websockets", None)
    monkeypatch.delitem(sys.modules, "palm_jax.train.serve", raising=False)
    for name in [name for name in sys.modules if name.startswith("websockets.")]:
        monkeypatch.delitem(sys.modules, name)
    assert cli.main(["serve", "runs/demo"]) == 2
    assert "serve needs websockets" in capsys.readouterr().err


def test_bench_without_a_checkout_says_how_to_run_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "_checkout_root", lambda: None)
    assert cli.main(["bench", "render"]) == 2
    assert "from a checkout" in capsys.readouterr().err


def test_bench_runs_from_a_checkout_wherever_the_caller_is(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "benchmarks").mkdir()
    # A regular package, like the real one: a namespace package would lose against that.
    (tmp_path / "benchmarks" / "__init__.py").touch()
    (tmp_path / "benchmarks" / "__main__.py").write_text("def main(argv):\n    print(argv)\n")
    monkeypatch.setattr(cli, "_checkout_root", lambda: tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    for name in ("benchmarks", "benchmarks.__main__"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    try:
        assert cli.main(["bench", "render"]) == 0
    finally:
        for name in ("benchmarks", "benchmarks.__main__"):
            sys.modules.pop(name, None)
    assert capsys.readouterr().out == "['render']\n"


def test_help_loads_no_verb() -> None:
    code = (
        "import sys; from palm_jax.__main__ import main; main(['--help']); "
        "print({'jax', 'numpy', 'mujoco', 'flax', 'matplotlib'} & set(sys.modules))"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.stdout.splitlines()[-1] == "set()", run.stderr


def test_known_import_lines_are_dropped_and_others_kept(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(RuntimeError, match="boom"), without_lines():
        print("Failed to import warp: no module")
        print("kept")
        print("Failed to import mujoco_warp: no module")
        raise RuntimeError("boom")
    assert capsys.readouterr().out == "kept\n"
