"""Compiled programs are kept where nobody else can write them."""

import os
import stat
from pathlib import Path

import pytest

from palm_jax.train import table
from palm_jax.train.host import compiled


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that the user's settings lead to; not made yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv(compiled.VARIABLE, raising=False)
    return tmp_path / "cache" / "palm_jax"


def test_it_is_the_users_alone(cache: Path) -> None:
    before = os.umask(0)
    try:
        assert compiled.folder() == cache
    finally:
        os.umask(before)
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700
    assert compiled.folder() == cache


@pytest.mark.parametrize("name", ["", "relative/cache"])
def test_home_is_the_default(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", name)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert compiled.folder() == tmp_path / ".cache" / "palm_jax"


def test_somebody_elses_is_refused(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache.mkdir(parents=True)
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(compiled.CacheError, match="belongs to another user.*of your own"):
        compiled.folder()


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777])
def test_one_that_others_can_write_is_refused(mode: int, cache: Path) -> None:
    cache.mkdir(parents=True)
    cache.chmod(mode)
    with pytest.raises(compiled.CacheError, match="can be written by others.*delete it"):
        compiled.folder()
    cache.chmod(0o755)
    assert compiled.folder() == cache


def test_a_link_counts_as_its_owners_and_as_what_it_points_at(cache: Path, tmp_path: Path) -> None:
    cache.parent.mkdir()
    (tmp_path / "mine").mkdir(mode=0o700)
    cache.symlink_to(tmp_path / "mine")
    assert compiled.folder() == cache
    (tmp_path / "mine").chmod(0o777)
    with pytest.raises(compiled.CacheError):
        compiled.folder()


def test_without_a_place_nothing_is_kept(cache: Path) -> None:
    cache.parent.write_text("a file")
    assert compiled.folder() is None
    assert compiled.VARIABLE not in table._environment()


def test_a_tables_cells_share_it_unless_the_user_says_otherwise(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert table._environment()[compiled.VARIABLE] == str(cache)
    for chosen in ("/somewhere", ""):
        monkeypatch.setenv(compiled.VARIABLE, chosen)
        assert table._environment()[compiled.VARIABLE] == chosen


def test_a_table_says_what_is_wrong_with_it(
    cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cache.mkdir(parents=True)
    cache.chmod(0o777)
    words = ["--preset", "quick", "--tasks", "lift_lid", "--methods", "bc"]
    assert table.main([*words, "--out", str(tmp_path / "table")]) == 2
    assert "can be written by others" in capsys.readouterr().err
    assert not (tmp_path / "table/lift_lid/bc-s0/config.json").exists()
