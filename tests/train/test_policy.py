"""Policies on a robot: what is loaded, what comes out, and what is refused."""

import dataclasses
import json
import logging
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import oracles
import pytest
import tiny
from contracts import compilations

import palm_jax.policy
from palm_jax.align import (
    CameraError,
    DtypeError,
    OptionError,
    PoseError,
    ProjectionError,
    ShapeError,
    undistort,
)
from palm_jax.policy import (
    CalibrationError,
    NonFiniteActionError,
    OutsideTrainingError,
    Policy,
    PolicyError,
    load,
)
from palm_jax.train import policy as module

SIZE = (60, 80)
K = np.array([[66.0, 0, 40.5], [0, 65.0, 29.0], [0, 0, 1]])
CAMERA = oracles.looking_at(np.array([1.35, 0.0, 1.58]), np.array([0.25, 0.0, 0.8]))
DOWN = np.diag([1.0, -1.0, -1.0])
TCP = oracles.pose(DOWN, np.array([0.25, 0.02, 0.9]))
IMAGE = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), np.uint8)
GOOD: dict[str, Any] = {
    "image": IMAGE, "K": K, "cam_to_world": CAMERA, "tcp": TCP, "opening": 1.0
}  # fmt: skip


@pytest.fixture(scope="module")
def policy() -> Policy:
    return load(tiny.run(), image_size=SIZE)


@pytest.fixture(scope="module")
def isolated() -> Policy:
    return load(tiny.run("arro"), image_size=SIZE)


# -- what is loaded --------------------------------------------------------------------------------


def test_the_average_of_the_best_checkpoint_acts(policy: Policy) -> None:
    """Not the newest, not the last parameters: what the run's own evaluation uses."""
    expected = tiny.state("palm", 10)
    jax.tree.map(np.testing.assert_array_equal, policy.state.params, expected.ema_params)
    jax.tree.map(np.testing.assert_array_equal, policy.state.normalizer, expected.normalizer)
    assert policy.contract.step == 10


def test_the_contract_is_the_runs(policy: Policy) -> None:
    contract = policy.contract
    assert (contract.method, contract.task, contract.robot) == ("palm", "lift_lid", "panda")
    assert (contract.spec.crop, contract.spec.size, contract.spec.layout) == (160, 32, "cam6d_z")
    # 40 degrees over 512 pixels: half of them over the tangent of half of it.
    focal = 256 / 0.36397023
    np.testing.assert_allclose(contract.K, [[focal, 0, 512], [0, focal, 512], [0, 0, 1]])
    assert contract.heights == pytest.approx(tiny.HEIGHTS)
    # RLBench's front camera and the middle of the table.
    assert contract.distance == pytest.approx(np.hypot(1.35 - 0.25, 1.58 - 0.752))
    assert json.dumps(module.describe(policy))


def test_windows_move_at_the_border_only_as_in_training() -> None:
    """The wide frame was never left in training; the paper's was, and the window moved."""
    borders = {
        name: module.contract_of(tiny.config(name), 0).spec.border
        for name in ("palm", "palm-prop", "palm-paper-frame")
    }
    assert borders == {"palm": "edge", "palm-prop": "edge", "palm-paper-frame": "shift"}


def test_loading_leaves_nothing_to_compile(policy: Policy) -> None:
    with compilations() as names:
        policy.act(**GOOD)
    assert names == []


def damaged(folder: Path) -> None:
    for file in (folder / "checkpoints").glob("*/manifest.json"):
        file.write_text("{}")


def unscored(folder: Path) -> None:
    for step in ("10", "20"):
        shutil.rmtree(folder / "checkpoints" / step)


def other_network(folder: Path) -> None:
    values = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**values, "width": 3}))


def unknown_method(folder: Path) -> None:
    values = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**values, "method": "plam"}))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (damaged, "no whole, scored checkpoint"),
        (unscored, "no whole, scored checkpoint"),
        (lambda folder: shutil.rmtree(folder / "checkpoints"), "train first"),
        (other_network, "another configuration"),
        (unknown_method, "unknown method 'plam'"),
        (lambda folder: (folder / "config.json").write_text("{"), "not readable as JSON"),
        (lambda folder: (folder / "config.json").write_text("{}"), "another version's run"),
        (lambda folder: (folder / "config.json").unlink(), "no config.json"),
        (lambda folder: shutil.rmtree(folder), "no run here"),
    ],
)
def test_runs_that_are_none(tmp_path: Path, spoil: Any, words: str) -> None:
    folder = tmp_path / "run"
    shutil.copytree(tiny.run(), folder)
    spoil(folder)
    with pytest.raises(PolicyError, match=words):
        load(folder)


def test_a_folder_of_several_runs_is_not_guessed_in(tmp_path: Path) -> None:
    for name in ("palm", "bc"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text("{}")
    with pytest.raises(PolicyError, match=r"2: choose .*bc, .*palm"):
        load(tmp_path)


@pytest.mark.parametrize(
    "options", [{"zoom": 0.0}, {"zoom": float("nan")}, {"image_size": (0, 5)}, {"off_centre": -1}]
)
def test_impossible_options(options: dict[str, Any]) -> None:
    with pytest.raises(PolicyError, match=next(iter(options))):
        load(tiny.run(), **options)


# -- what comes out --------------------------------------------------------------------------------


def test_the_target_is_the_pose_moved_by_the_action(policy: Policy) -> None:
    decision = policy.decide(**GOOD)
    x, y = decision.action[:3].astype(float), decision.action[3:6].astype(float)
    motion = oracles.pose(np.stack([x, y, np.cross(x, y)], -1), decision.action[6:9])
    np.testing.assert_allclose(motion[:3, :3].T @ motion[:3, :3], np.eye(3), atol=1e-5)
    np.testing.assert_allclose(decision.target, TCP @ motion, atol=1e-5)
    assert decision.gripper == decision.action[9] and decision.gripper in (0.0, 1.0)
    target, gripper = policy.act(**GOOD)
    np.testing.assert_array_equal(target, decision.target)
    assert gripper == decision.gripper and target.dtype == np.float32


def test_the_network_gets_what_is_shown(policy: Policy) -> None:
    """`see` is what acts: the learner, asked directly, gives the same action."""
    seen = policy.see(**GOOD)
    assert seen.image.shape == (32, 32, 3) and isinstance(seen.image, np.ndarray)
    learner, state = tiny.learner("palm"), policy.state
    prediction, _ = learner.jitted_predict(state, {"front": seen.image[None]}, seen.proprio[None])
    low, high = (np.asarray(x) for x in jax.tree.leaves(state.normalizer.action))
    plain = low + (np.asarray(prediction)[0] + 1) / 2 * (high - low)
    np.testing.assert_allclose(policy.decide(**GOOD).action[6:9], plain[6:9], atol=1e-5)


def test_equal_inputs_give_equal_actions_unless_noise_is_asked_for(policy: Policy) -> None:
    first, second = policy.decide(**GOOD), policy.decide(**GOOD)
    np.testing.assert_array_equal(first.action, second.action)
    noisy = load(tiny.run(), image_size=SIZE, noise_seed=3)
    one = [noisy.decide(**GOOD).action for _ in range(3)]
    assert not np.array_equal(one[0], one[1])
    noisy.reset()
    again = [noisy.decide(**GOOD).action for _ in range(3)]
    np.testing.assert_array_equal(one, again)
    # Of the size that evaluations have: small.
    np.testing.assert_allclose(one[0], first.action, atol=5e-3)


def test_poses_may_be_nested_lists_and_float64(policy: Policy) -> None:
    words = {
        name: value.tolist() for name, value in GOOD.items() if name not in ("image", "opening")
    }
    given = policy.decide(**{**GOOD, **words, "opening": 1}, mask=None)
    np.testing.assert_array_equal(given.action, policy.decide(**GOOD).action)


def test_the_view_is_that_of_the_training_whatever_the_camera(policy: Policy) -> None:
    """A white square, placed on the table: equally large for a camera of twice the focal length,
    and twice as large with zoom=2."""

    def white(shown: Policy, factor: int) -> float:
        image = np.zeros((240 * factor, 320 * factor, 3), np.uint8)
        intrinsics = np.array([[350.0, 0, 160], [0, 350, 120], [0, 0, 1]])
        intrinsics[:2] *= factor
        (u, v), _ = oracles.project(intrinsics, CAMERA, np.array([0.25, 0.02, 0.86]))
        reach = 16 * factor
        image[int(v) - reach : int(v) + reach, int(u) - reach : int(u) + reach] = 255
        seen = shown.see(**{**GOOD, "image": image, "K": intrinsics})
        # Without the strokes of the overlay, which are coloured.
        return float((np.asarray(seen.image).min(-1) > 128).mean())

    near = white(policy, 1)
    # 32 pixels at 350 are 64 at 703, of a crop of 160; less what the overlay hides.
    assert (64.3 / 160) ** 2 * 0.5 < near < (64.3 / 160) ** 2 * 1.1
    assert white(policy, 2) == pytest.approx(near, rel=0.1)
    zoomed = load(tiny.run(), image_size=SIZE, zoom=2.0)
    assert 2.5 * near < white(zoomed, 1) < 4.6 * near


def test_what_the_image_lacks_of_the_view_is_told(policy: Policy) -> None:
    assert policy.decide(**GOOD).coverage > 0.99
    aside = {**GOOD, "tcp": oracles.pose(DOWN, np.array([0.2, 0.75, 0.9]))}
    assert 0.3 < policy.decide(**aside).coverage < 0.9


def test_masks_are_for_policies_that_isolate(isolated: Policy) -> None:
    everything = isolated.decide(**GOOD, mask=np.ones(SIZE, bool))
    nothing = isolated.see(**GOOD, mask=np.zeros(SIZE, bool))
    assert (np.asarray(nothing.image) <= 96).all()
    part = np.zeros(SIZE, bool)
    part[20:40, 30:50] = True
    assert not np.array_equal(everything.action, isolated.decide(**GOOD, mask=part).action)


def test_the_latency_of_calls_is_kept(monkeypatch: pytest.MonkeyPatch, policy: Policy) -> None:
    fresh = load(tiny.run(), image_size=SIZE)
    assert str(fresh.latency) == "no calls yet"
    ticks = iter([0.0, 0.010, 1.0, 1.002, 5.0, 5.004])
    monkeypatch.setattr(module.time, "perf_counter", lambda: next(ticks))
    for _ in range(3):
        fresh.act(**GOOD)
    found = fresh.latency
    assert (found.count, round(found.median_ms, 6), round(found.worst_ms, 6)) == (3, 4.0, 10.0)
    assert str(found).startswith("median 4.0 ms") and "(3 calls)" in str(found)


def test_other_sizes_are_compiled_for_and_told(
    policy: Policy, caplog: pytest.LogCaptureFixture
) -> None:
    few = load(tiny.run(), image_size=SIZE)
    few._sizes |= {(1, n) for n in range(6)}
    wide = {**GOOD, "image": IMAGE[:, :78]}
    with caplog.at_level(logging.WARNING):
        before = few.latency.count
        few.act(**wide)
        few.act(**wide)
    assert few.latency.count == before + 1  # the compiling call is no latency
    assert "image_size=(60, 78)" in caplog.text and len(caplog.records) == 1
    with pytest.raises(ShapeError, match="one of the 8 sizes"):
        few.act(**{**GOOD, "image": IMAGE[:58]})


# -- what is refused -------------------------------------------------------------------------------


def changed(matrix: np.ndarray, place: tuple[int, int], value: float) -> np.ndarray:
    matrix = matrix.copy()
    matrix[place] = value
    return matrix


BEHIND = oracles.pose(DOWN, np.array([2.4, 0.0, 0.9]))
ASIDE = oracles.pose(DOWN, np.array([0.25, 2.5, 0.9]))
MIRROR = CAMERA @ np.diag([-1.0, 1, 1, 1])
BAD: list[tuple[str, Any, type[Exception], str]] = [
    ("image", IMAGE.astype(np.float32) / 255, DtypeError, "expected uint8.*got float32"),
    ("image", IMAGE.astype(np.int64), DtypeError, "got int64"),
    ("image", IMAGE[None], ShapeError, r"\[H, W, 3\], got \[1, 60, 80, 3\]"),
    ("image", np.concatenate([IMAGE, IMAGE[..., :1]], -1), ShapeError, "alpha"),
    ("image", IMAGE.transpose(2, 0, 1), ShapeError, "leading channel axis"),
    ("image", IMAGE[..., 0], ShapeError, r"got \[60, 80\]"),
    ("image", IMAGE[:0], ShapeError, r"got \[0, 80, 3\]"),
    ("image", None, DtypeError, "image: expected uint8"),
    ("K", None, CalibrationError, "K: expected the camera's intrinsics.*got None"),
    ("K", np.eye(4), ShapeError, r"K: .*\[3, 3\], got \[4, 4\]"),
    ("K", "calibrated", DtypeError, "K: expected numbers"),
    ("K", K.T, CameraError, "do not pass K transposed"),
    ("K", changed(K, (0, 0), -66.0), CameraError, "positive focal lengths"),
    ("K", changed(K, (1, 1), 0.0), CameraError, "positive focal lengths"),
    ("K", changed(K, (0, 2), np.nan), CameraError, "finite"),
    ("K", np.diag([2.0, 2, 1]) @ K, CameraError, "cx = 81.0 of 80; K belongs to another"),
    ("K", np.diag([1.0, 2, 1]) @ K, CameraError, "cy = 58.0 of 60"),
    ("K", np.diag([1 / 80, 1 / 60, 1]) @ K, CameraError, "cx = 0.5 of 80"),
    ("cam_to_world", None, CalibrationError, "cam_to_world: expected the camera's pose"),
    ("cam_to_world", CAMERA[:3], ShapeError, r"\[4, 4\], got \[3, 4\]"),
    ("cam_to_world", 1.1 * CAMERA, PoseError, "cam_to_world: expected"),
    ("cam_to_world", CAMERA.T, PoseError, "the last column"),
    ("cam_to_world", MIRROR, PoseError, "right-handed"),
    ("cam_to_world", changed(CAMERA, (0, 0), 0.9), PoseError, "orthonormal"),
    ("cam_to_world", changed(CAMERA, (1, 3), np.nan), PoseError, "finite"),
    ("cam_to_world", np.linalg.inv(CAMERA), ProjectionError, "tcp: expected the TCP"),
    ("cam_to_world", CAMERA @ np.diag([1.0, -1, -1, 1]), ProjectionError, "in front"),
    ("tcp", None, ShapeError, "tcp: expected the TCP's pose"),
    ("tcp", TCP[:3, 3], ShapeError, r"got \[3\]"),
    ("tcp", changed(TCP, (2, 3), np.inf), PoseError, "tcp: expected finite"),
    ("tcp", np.diag([1.0, 1, -1, 1]) @ TCP, PoseError, "right-handed"),
    ("tcp", BEHIND, ProjectionError, "in front of the camera"),
    ("tcp", ASIDE, ProjectionError, "inside the 60 x 80 image"),
    ("tcp", changed(TCP, (2, 3), 0.148), OutsideTrainingError, "0.800 to 1.000 m, got 0.148"),
    ("tcp", changed(TCP, (2, 3), 1.3), OutsideTrainingError, "got 1.300"),
    ("opening", 1.2, OptionError, "0 .closed. to 1 .open., got 1.2"),
    ("opening", -0.2, OptionError, "opening"),
    ("opening", 85, OptionError, "divide the fingers' distance"),
    ("opening", float("nan"), OptionError, "opening"),
    ("opening", None, OptionError, "got None"),
    ("opening", [0.5, 0.5], ShapeError, "opening"),
    ("mask", np.ones(SIZE, bool), OptionError, "method palm takes none"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value", "error", "words"), BAD)
def test_bad_input(
    policy: Policy, name: str, value: Any, error: type[Exception], words: str
) -> None:
    for call in (policy.act, policy.see):
        with pytest.raises(error, match=words):
            call(**{**GOOD, name: value})


@pytest.mark.parametrize(
    ("mask", "error", "words"),
    [
        (None, OptionError, "method arro takes one: expected a bool .* got None"),
        (np.ones((60, 81), bool), ShapeError, r"bool \[60, 80\], the image's"),
        (np.ones(SIZE), ShapeError, "got float64"),
    ],
)
def test_bad_masks(isolated: Policy, mask: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        isolated.act(**GOOD, mask=mask)


def test_cut_out_images_are_taken_when_told_so(policy: Policy) -> None:
    lenient = load(tiny.run(), image_size=SIZE, off_centre=0.4)
    shifted = changed(K, (0, 2), 60.0)
    with pytest.raises(CameraError, match="larger off_centre"):
        policy.act(**{**GOOD, "K": shifted})
    lenient.act(**{**GOOD, "K": shifted})


def test_a_lens_is_undone_before_all_else(policy: Policy) -> None:
    """As if the image had been undistorted by hand; by what, tests/core/test_align_lens.py says."""
    dist = (-0.3, 0.1, 0.001, -0.002)
    lens = load(tiny.run(), image_size=SIZE, dist=dist)
    by_hand = np.asarray(undistort(IMAGE, K, np.array(dist)))
    shown, expected = lens.see(**GOOD), policy.see(**{**GOOD, "image": by_hand})
    np.testing.assert_array_equal(shown.image, expected.image)
    assert (shown.image != policy.see(**GOOD).image).any()
    np.testing.assert_array_equal(lens.act(**GOOD)[0], policy.act(**{**GOOD, "image": by_hand})[0])


@pytest.mark.parametrize("dist", [(0.1,), (0.1, 0.0, 0.0, np.nan)])
def test_bad_lens_coefficients(dist: tuple[float, ...]) -> None:
    with pytest.raises(PolicyError, match="dist: expected 4, 5, 8 finite"):
        load(tiny.run(), image_size=None, dist=dist)


def test_the_time_of_an_action_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    load(tiny.run(), image_size=SIZE)
    assert "ms an action for images of 60 x 80" in capsys.readouterr().err


def test_slightly_wrong_sensors_pass(policy: Policy) -> None:
    """A gripper that reads 1.02, a rotation that is rounded."""
    target, gripper = policy.act(**{**GOOD, "opening": 1.02, "cam_to_world": CAMERA.round(4)})
    assert np.isfinite(target).all() and gripper in (0.0, 1.0)


@pytest.fixture
def broken(policy: Policy) -> Iterator[Policy]:
    """A policy one weight of which is not a number."""
    leaves, structure = jax.tree.flatten(policy.state.params)
    leaves[-1] = leaves[-1].at[0].set(np.nan)
    params = jax.tree.unflatten(structure, leaves)
    state = dataclasses.replace(policy.state, params=params)
    yield Policy(tiny.learner("palm"), state, policy.contract)


def test_nothing_is_returned_that_is_not_finite(broken: Policy) -> None:
    with pytest.raises(NonFiniteActionError, match="stop the robot"):
        broken.act(**GOOD)


def test_parameters_that_are_not_finite_are_not_loaded(tmp_path: Path, broken: Policy) -> None:
    folder = tiny.run()
    shutil.copytree(folder, tmp_path / "run")
    state = dataclasses.replace(tiny.state("palm", 40), ema_params=broken.state.params)
    meta = {"score": 1.0}
    module.checkpoint.save(tmp_path / "run" / "checkpoints", 40, state, meta)
    with pytest.raises(PolicyError, match="not finite; train again"):
        load(tmp_path / "run")


def test_the_errors_are_those_of_the_package() -> None:
    for name in palm_jax.policy.__all__:
        value = getattr(palm_jax.policy, name)
        if isinstance(value, type) and issubclass(value, Exception):
            assert issubclass(value, ValueError), name
