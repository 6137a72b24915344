"""The built wheel: complete, and usable from a folder that is not the checkout."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("palm_jax", "envs", "train")
SKIPPED = {"__pycache__", ".mypy_cache", ".ruff_cache"}


def source_files() -> set[str]:
    """What git tracks (or would track) in the package's folders; every file outside of git."""
    try:
        listing = subprocess.run(
            ["git", "ls-files", "--cached", "--others", "--exclude-standard", *SOURCES],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.splitlines()
        # A file may be tracked and deleted; the two links are tracked as files of their own.
        return {name for name in listing if (ROOT / name).is_file()}
    except (OSError, subprocess.CalledProcessError):  # no git, or an unpacked archive
        return {
            str(path.relative_to(ROOT))
            for folder in SOURCES
            for path in (ROOT / folder).rglob("*")
            if path.is_file() and not SKIPPED & set(path.parts) and not path.is_symlink()
        }


def packaged_name(name: str) -> str:
    """Where a source file lies in the wheel: envs/ and train/ move below palm_jax/."""
    return name if name.startswith("palm_jax/") else f"palm_jax/{name}"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A copy, so that setuptools' build/ and egg-info appear neither in the checkout nor, stale
    # from an earlier build, in the wheel.
    place = tmp_path_factory.mktemp("build")
    copy = place / "checkout"
    copy.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy / name)
    for name in SOURCES:
        shutil.copytree(
            ROOT / name, copy / name, symlinks=True, ignore=shutil.ignore_patterns(*SKIPPED)
        )
    run = subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(place), "."],
        cwd=copy,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    (built,) = place.glob("palm_jax-*.whl")
    return built


@pytest.fixture(scope="module")
def unpacked(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def run_elsewhere(unpacked: Path, cwd: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(unpacked), "JAX_PLATFORMS": "cpu"}
    return subprocess.run(
        [sys.executable, *words], cwd=cwd, env=environment, capture_output=True, text=True
    )


def test_wheel_holds_exactly_the_source_files(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert names == {packaged_name(name) for name in source_files()}


def test_wheel_carries_the_licence_and_the_console_script(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        info = {Path(name).name: name for name in archive.namelist() if ".dist-info/" in name}
        assert b"Apache License" in archive.read(info["LICENSE"])
        assert b"palm-jax = palm_jax.__main__:main" in archive.read(info["entry_points.txt"])


def test_wheel_is_what_gets_imported_elsewhere(unpacked: Path, tmp_path: Path) -> None:
    run = run_elsewhere(unpacked, tmp_path, "-c", "import palm_jax; print(palm_jax.__file__)")
    assert run.stdout.strip() == str(unpacked / "palm_jax" / "__init__.py"), run.stderr


@pytest.mark.parametrize("module", ["palm_jax", "palm_jax.train"])
def test_help_runs_from_the_wheel(module: str, unpacked: Path, tmp_path: Path) -> None:
    run = run_elsewhere(unpacked, tmp_path, "-m", module, "--help")
    assert run.returncode == 0, run.stderr
    assert "usage" in run.stdout.lower()
    assert "Failed to import" not in run.stdout


def test_bench_from_the_wheel_points_to_a_checkout(unpacked: Path, tmp_path: Path) -> None:
    run = run_elsewhere(unpacked, tmp_path, "-m", "palm_jax", "bench")
    assert run.returncode == 2
    assert "from a checkout" in run.stderr
