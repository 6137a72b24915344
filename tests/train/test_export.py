"""A policy written as StableHLO does what the policy does."""

import hashlib
import json
from pathlib import Path

import jax
import numpy as np
import oracles
import pytest
import tiny

from palm_jax.policy import Policy, load
from palm_jax.train import export

SIZE = (60, 80)
CAMERA = oracles.looking_at(np.array([1.35, 0.0, 1.58]), np.array([0.25, 0.0, 0.8]))


@pytest.fixture(scope="module")
def policy() -> Policy:
    return load(tiny.run(), image_size=SIZE)


@pytest.fixture(scope="module")
def files(policy: Policy, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    out = tmp_path_factory.mktemp("export") / "policy.stablehlo"
    return export.write(policy, export.ExportConfig(tiny.run(), out, SIZE))


def observations(count: int) -> list[tuple[np.ndarray, ...]]:
    """The hand here and there, its gripper open and closed."""
    rng = np.random.default_rng(5)
    K = np.float32([[66.0, 0, 40.5], [0, 65.0, 29.0], [0, 0, 1]])
    return [
        (
            rng.integers(0, 256, (*SIZE, 3), np.uint8),
            K,
            CAMERA.astype(np.float32),
            oracles.pose(np.diag([1.0, -1, -1]), rng.uniform([0.2, -0.1, 0.82], [0.3, 0.1, 0.98]))
            .astype(np.float32),
            np.float32(index % 2),
        )
        for index in range(count)
    ]  # fmt: skip


def test_it_acts_as_the_policy_does(policy: Policy, files: list[Path]) -> None:
    program = jax.export.deserialize(bytearray(files[1].read_bytes()))
    actions = []
    for observation in observations(4):
        target, action, valid, coverage = program.call(*observation)
        expected = policy.decide(*observation)
        np.testing.assert_allclose(target, expected.target, atol=1e-6)
        np.testing.assert_allclose(action, expected.action, atol=1e-6)
        np.testing.assert_allclose(coverage, expected.coverage, atol=1e-6)
        assert bool(valid)
        actions.append(action)
    assert np.ptp(actions, axis=0).max() > 1e-4  # the image matters


def test_a_tcp_out_of_view_is_flagged(files: list[Path]) -> None:
    program = jax.export.deserialize(bytearray(files[1].read_bytes()))
    image, K, camera, tcp, opening = observations(1)[0]
    aside = tcp.copy()
    aside[1, 3] = 3.0
    assert not bool(program.call(image, K, camera, aside, opening)[2])


def test_the_plain_program_runs_without_jax_tracing(policy: Policy, files: list[Path]) -> None:
    """OUT itself, given to XLA's compiler as another program would."""
    device = jax.devices("cpu")[0]
    module = files[0].read_bytes()
    executable = device.client.compile_and_load(
        module, jax._src.lib.xla_client.DeviceList((device,))
    )
    (observation,) = observations(1)
    arguments = [jax.device_put(value, device) for value in observation]
    results = executable.execute_sharded(arguments).disassemble_into_single_device_arrays()
    expected = policy.decide(*observation)
    np.testing.assert_allclose(results[0][0], expected.target, atol=1e-6)
    np.testing.assert_allclose(results[1][0], expected.action, atol=1e-6)


def test_the_side_file_says_what_goes_in(files: list[Path]) -> None:
    names = [path.name for path in files]
    assert names == ["policy.stablehlo", "policy.stablehlo.jax", "policy.stablehlo.json"]
    contract = json.loads(files[2].read_text())
    assert (contract["format"], contract["version"]) == ("palm_jax.export", 1)
    inputs = {entry["name"]: (entry["dtype"], entry["shape"]) for entry in contract["inputs"]}
    assert inputs == {
        "image": ("uint8", [60, 80, 3]),
        "K": ("float32", [3, 3]),
        "cam_to_world": ("float32", [4, 4]),
        "tcp": ("float32", [4, 4]),
        "opening": ("float32", []),
    }
    outputs = {entry["name"]: (entry["dtype"], entry["shape"]) for entry in contract["outputs"]}
    assert outputs == {
        "target": ("float32", [4, 4]),
        "action": ("float32", [10]),
        "valid": ("bool", []),
        "coverage": ("float32", []),
    }
    assert all(entry["meaning"] for entry in contract["inputs"] + contract["outputs"])
    assert contract["policy"]["step"] == 10 and contract["policy"]["spec"]["crop"] == 160
    for path in files[:2]:
        assert contract["sha256"][path.name] == hashlib.sha256(path.read_bytes()).hexdigest()


def test_masks_are_an_input_where_the_method_isolates() -> None:
    isolated = load(tiny.run("arro"), image_size=None)
    program = export.exported(isolated, SIZE)
    assert [(str(a.dtype), a.shape) for a in program.in_avals][5] == ("bool", SIZE)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export.main([str(tmp_path / "nothing")]) == 2
    assert "no run here" in capsys.readouterr().err
    words = [str(tiny.run()), "--out", str(tmp_path / "p"), "--image-size", "60", "80"]
    assert export.main([*words, "--platforms", "abacus"]) == 2
    assert "abacus" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert export.main(words) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"p", "p.jax", "p.json"}
    (tmp_path / "p").unlink()
    capsys.readouterr()
    before = (tmp_path / "p.jax").read_bytes()
    assert export.main(words) == 2
    assert "p.jax exists: move it" in capsys.readouterr().err
    assert (tmp_path / "p.jax").read_bytes() == before and not (tmp_path / "p").exists()
