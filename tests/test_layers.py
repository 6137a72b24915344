"""The arrows between the layers, read from the source: train -> envs -> core -> jax."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# The dispatcher names train's modules as strings and looks for a checkout: a thin shell, no core.
SHELL = ROOT / "palm_jax" / "__main__.py"
# Short names for what train offers to other programs: they hold nothing but imports.
DOORS = [ROOT / "palm_jax" / "policy.py"]
# Run in a robot's process, which has no JAX.
CLIENT = [ROOT / "palm_jax" / name for name in ("policy_client.py", "wire.py")]
CORE = sorted(
    path
    for path in (ROOT / "palm_jax").rglob("*.py")
    if not {"envs", "train"} & set(path.relative_to(ROOT / "palm_jax").parts)
    and path not in (SHELL, *DOORS)
)
ENVS = sorted((ROOT / "envs").rglob("*.py"))
# Parts of train, and those that they may import besides themselves.
BELOW = {"files": (), "host": (), "reporting": ("files",)}
TRAIN = sorted((ROOT / "train").rglob("*.py"))
LIBRARY = CORE + DOORS + ENVS + TRAIN

WRITERS = {"open", "write_text", "write_bytes", "savez", "savez_compressed", "savefig", "mkdir"}
CLOCKS_AND_FILES = {"time", "datetime", "pathlib", "shutil", "tempfile"}
# MJCF models are package data, and reading them is what envs is for.
ENVS_MAY = {"pathlib"}


def imported(source: str) -> Iterator[str]:
    """Absolute names of everything a module imports, wherever in the file; no relative imports."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                raise AssertionError(f"relative import in line {node.lineno}: write it absolute")
            assert node.module is not None
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def calls(source: str) -> Iterator[str]:
    """The last part of the name of everything a module calls: `open`, `write_text`, ..."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            if isinstance(node.func, ast.Name):
                yield node.func.id
            elif isinstance(node.func, ast.Attribute):
                yield node.func.attr


def within(name: str, *packages: str) -> bool:
    return any(name == package or name.startswith(package + ".") for package in packages)


def offences(source: str, *forbidden: str) -> list[str]:
    return sorted({name for name in imported(source) if within(name, *forbidden)})


def beyond_a_door(source: str) -> list[str]:
    """What a module holds besides a docstring, imports from train, and `__all__` of just those."""
    tree, names, found = ast.parse(source), set(), []
    for node in tree.body:
        match node:
            case ast.Expr(value=ast.Constant(value=str())):
                pass
            case ast.ImportFrom(module=str(module)) if within(module, "palm_jax.train"):
                names |= {alias.asname or alias.name for alias in node.names}
            case ast.Assign(targets=[ast.Name(id="__all__")]):
                offered = ast.literal_eval(node.value)
                found += sorted(set(offered) ^ names)
            case _:
                found.append(ast.unparse(node))
    return found


def ids(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", CORE, ids=ids)
def test_core_imports_neither_mujoco_nor_upper_layers(path: Path) -> None:
    assert not offences(
        path.read_text(), "mujoco", "palm_jax.envs", "palm_jax.train", "flax", "optax", "h5py"
    )


@pytest.mark.parametrize("path", CLIENT, ids=ids)
def test_the_robots_side_imports_no_jax(path: Path) -> None:
    names = {name.split(".")[0] for name in imported(path.read_text())}
    others = names - set(sys.stdlib_module_names)
    assert others <= {"msgpack", "numpy", "websockets", "palm_jax"}
    ours = {name for name in imported(path.read_text()) if within(name, "palm_jax")}
    assert ours <= {"palm_jax", "palm_jax.wire"}


@pytest.mark.parametrize("path", DOORS, ids=ids)
def test_doors_are_nothing_but_imports(path: Path) -> None:
    assert beyond_a_door(path.read_text()) == []


@pytest.mark.parametrize("path", ENVS, ids=ids)
def test_envs_do_not_import_train(path: Path) -> None:
    assert not offences(path.read_text(), "palm_jax.train", "flax", "optax", "matplotlib")


@pytest.mark.parametrize("path", LIBRARY, ids=ids)
def test_library_imports_no_tests_and_no_second_copies(path: Path) -> None:
    helpers = ("tests", "oracles", "contracts", "conftest", "pytest", "hypothesis")
    assert not offences(path.read_text(), *helpers, "envs", "train", "benchmarks")


@pytest.mark.parametrize("path", CORE + ENVS, ids=ids)
def test_only_train_touches_files_and_clocks(path: Path) -> None:
    source = path.read_text()
    allowed = ENVS_MAY if path in ENVS else set()
    assert not offences(source, *(CLOCKS_AND_FILES - allowed))
    assert not WRITERS & set(calls(source))


@pytest.mark.parametrize("part", BELOW)
def test_parts_of_train_know_only_what_lies_below(part: str) -> None:
    known = [f"palm_jax.train.{name}" for name in (part, *BELOW[part])]
    paths = sorted((ROOT / "train" / part).rglob("*.py"))
    assert paths
    for path in paths:
        ours = {name for name in imported(path.read_text()) if within(name, "palm_jax.train")}
        above = {name for name in ours - {"palm_jax.train"} if not within(name, *known)}
        assert not above, ids(path)


def test_the_checks_see_an_offence() -> None:
    assert offences("def f():\n    from mujoco import mjx", "mujoco") == ["mujoco", "mujoco.mjx"]
    assert offences("import palm_jax.envs.base as b", "palm_jax.envs") == ["palm_jax.envs.base"]
    assert not offences("import trainer", "train")
    door = "from palm_jax.train.x import a, b\n__all__ = ['a', 'b']\n"
    assert beyond_a_door(door) == []
    assert beyond_a_door(door + "c = 1") == ["c = 1"]
    assert beyond_a_door(door.replace("'b'", "'c'")) == ["b", "c"]
    assert beyond_a_door("from palm_jax.envs import make") == ["from palm_jax.envs import make"]
    assert WRITERS & set(calls("Path('x').write_text('y')")) == {"write_text"}
    with pytest.raises(AssertionError, match="relative import in line 1"):
        list(imported("from . import x"))


@pytest.mark.parametrize("name", ["envs", "train"])
def test_a_second_copy_cannot_be_imported(name: str) -> None:
    run = subprocess.run(
        [sys.executable, "-c", f"import {name}"], cwd=ROOT, capture_output=True, text=True
    )
    assert run.returncode == 1
    assert f"import this package as `palm_jax.{name}`" in run.stderr


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, palm_jax; print({'jax', 'numpy', 'mujoco', 'flax'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.stdout.strip() == "set()", run.stderr


def test_importing_prints_nothing() -> None:
    """MJX prints when it is imported without its optional back end."""
    code = "import palm_jax.envs, palm_jax.policy"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


def test_links_point_at_the_real_folders() -> None:
    for name in ("envs", "train"):
        link = ROOT / "palm_jax" / name
        assert link.is_symlink() and link.resolve() == ROOT / name
