"""Rules that every public name keeps, read off the package itself."""

import dataclasses
import inspect
import subprocess
import sys

import pytest

import palm_jax.align

PUBLIC = {name: getattr(palm_jax.align, name) for name in palm_jax.align.__all__}
FUNCTIONS = {name: value for name, value in PUBLIC.items() if inspect.isfunction(value)}
CLASSES = {name: value for name, value in PUBLIC.items() if inspect.isclass(value)}
METHODS = {
    f"{name}.{member}": value
    for name, cls in CLASSES.items()
    for member, value in inspect.getmembers(cls, callable)
    if member in vars(cls) and not member.startswith("_")
}

# design.md, section 4: other people's code relies on these.
CONTRACT = """Camera project unproject unproject_to_height tcp_crop tcp_overlay resize rotation_6d
matrix_from_6d proprio encode_delta apply_delta random_overlay random_perspective random_crop
center_crop AlignSpec align Aligned""".split()


def test_contract_names_are_public():
    assert set(CONTRACT) <= set(PUBLIC)


@pytest.mark.parametrize("name", sorted(FUNCTIONS | METHODS))
def test_signature(name):
    function = (FUNCTIONS | METHODS)[name]
    parameters = inspect.signature(function).parameters
    names = [parameter for parameter in parameters if parameter not in ("self", "cls")]
    assert not {"rng", "seed", "prng", "random_key"} & set(names)
    assert "key" not in names or names[0] == "key", "key comes first"
    for parameter in parameters.values():
        if parameter.name not in ("self", "cls"):
            assert parameter.annotation is not parameter.empty, f"{parameter} has no type"
        if parameter.default is not parameter.empty:
            assert parameter.kind is parameter.KEYWORD_ONLY, f"{parameter} must be keyword-only"


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_function_is_documented(name):
    text = inspect.getdoc(FUNCTIONS[name])
    assert text is not None and "Raises:" in text and "[" in text, "shapes and errors are missing"
    for parameter in inspect.signature(FUNCTIONS[name]).parameters:
        assert parameter in text, f"{parameter} is not described"


@pytest.mark.parametrize("name", sorted(CLASSES | METHODS))
def test_class_is_documented(name):
    assert inspect.getdoc((CLASSES | METHODS)[name])


def test_every_spec_field_is_described():
    for field in dataclasses.fields(palm_jax.align.AlignSpec):
        assert field.name in inspect.getdoc(palm_jax.align.AlignSpec)


def test_core_imports_neither_simulator_nor_learner():
    code = (
        "import sys, palm_jax.align; "
        "heavy = {'mujoco', 'flax', 'optax', 'orbax', 'matplotlib', 'PIL', 'palm_jax.envs', "
        "'palm_jax.train'} & set(sys.modules); print(sorted(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
