"""The learner: normalisation, loss, update, order of the samples, determinism and resumption.

Two tiny learners are compiled, once each. `full` has everything on (both augmentations, crop, batch
norm, averaged parameters, a slower encoder); `bare` has all of it off, so that its numbers can be
computed by hand.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palm_jax import align
from palm_jax.train import checkpoint, held_out, learner, loop
from palm_jax.train.learner import Batch, LearnerConfig, Normalizer, TrainState

P = 5  # numbers of proprioception
SIDE, CROP = 40, 36
SAMPLES = 22
SMALL: dict[str, Any] = {"width": 8, "embed": 6, "hidden": (16, 16), "batch_size": 8, "steps": 6}
FULL = LearnerConfig(
    **SMALL,
    norm="batch",
    crop=CROP,
    ema=0.9,
    encoder_lr_scale=0.25,
    weight_decay=0.0,
    learning_rate=4e-3,
    schedule="cosine",
    warmup_steps=2,
    overlay_warmup_steps=2,
    max_skipped_steps=1,
)
BARE = LearnerConfig(
    **SMALL,
    crop=None,
    learning_rate=5e-3,
    schedule="constant",
    warmup_steps=0,
    proprio_noise=0.0,
    overlay_fraction=0.0,
    perspective_probability=0.0,
)


def make_data(seed: int = 0, count: int = SAMPLES) -> Batch:
    """Images whose brightness tells the first action number; columns near orthonormal."""
    rng = np.random.default_rng(seed)
    level = rng.uniform(0, 1, count)
    images = rng.integers(0, 60, (count, SIDE, SIDE, 3)) + 190 * level[:, None, None, None]
    actions = rng.normal(0, 0.1, (count, 10)) + np.array([1, 0, 0, 0, 1, 0, 0, 0, 0, 0])
    actions[:, 6] = level
    actions[:, 9] = rng.integers(0, 2, count)
    return Batch(
        {"front": images.astype(np.uint8)},
        rng.normal(size=(count, P)).astype(np.float32),
        actions.astype(np.float32),
    )


DATA = make_data()
BANK = np.random.default_rng(9).integers(0, 256, (5, SIDE, SIDE, 3), dtype=np.uint8)


TRACES: list[str] = []  # grows whenever the step of `full` is traced


class TracedLearner(learner.Learner):
    def step(self, *arguments: Any) -> Any:
        TRACES.append("step")
        return super().step(*arguments)


@pytest.fixture(scope="module")
def full() -> learner.Learner:
    return TracedLearner(FULL, P, ("front",))


@pytest.fixture(scope="module")
def bare() -> learner.Learner:
    return learner.make_learner(BARE, P)


def train(full: learner.Learner, **options: Any) -> TrainState:
    return loop.run(full, DATA, **{"seed": 3, "bank": BANK, "log_every": 1, **options})


@pytest.fixture(scope="module")
def uninterrupted(full: learner.Learner) -> tuple[TrainState, list[tuple[int, dict[str, float]]]]:
    log: list[tuple[int, dict[str, float]]] = []
    return train(full, on_log=lambda step, values: log.append((step, values))), log


def start(full: learner.Learner, seed: int = 0) -> TrainState:
    normalizer = learner.fit_normalizer(DATA.proprio, DATA.actions)
    return full.jitted_init(jax.random.key(seed), normalizer, trunk=None)


def copy(state: TrainState) -> TrainState:
    """In host memory, for calls that consume their argument."""
    return jax.tree.map(np.array, state)


def batch(count: int = 8) -> Batch:
    return loop.take(DATA, np.arange(count))


def bits(tree: Any) -> list[bytes]:
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


def norm(tree: Any) -> float:
    leaves = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(tree)]
    return float(np.sqrt(sum(np.square(leaf).sum() for leaf in leaves)))


# ------------------------------------------------------------------------------------ small parts


def test_normalizer_maps_ranges_and_keeps_constants() -> None:
    values = np.array([[0.0, 5.0, -2.0], [4.0, 5.0, 2.0], [1.0, 5.0, 0.0]], np.float32)
    action = np.zeros((3, 10), np.float32)
    action[:, 9] = [0, 1, 1]
    fitted = learner.fit_normalizer(values, action)
    expected = [[-1, 0, -1], [1, 0, 1], [-0.5, 0, 0]]
    np.testing.assert_allclose(fitted.proprio.normalize(values), expected, atol=1e-6)
    np.testing.assert_allclose(fitted.proprio.denormalize(np.array(expected)), values, atol=1e-6)
    np.testing.assert_array_equal(fitted.action.normalize(action)[:, 9], [-1, 1, 1])
    # A prediction for a constant dimension cannot leave the constant.
    assert fitted.proprio.denormalize(np.array([[0.0, 0.7, 0.0]]))[0, 1] == 5.0


def test_normalizer_refuses_bad_data() -> None:
    good, actions = np.zeros((3, P)), np.zeros((3, 10))
    bad = good.copy()
    bad[1, 2] = np.inf
    with pytest.raises(ValueError, match="proprio: frame 1 has a non-finite value"):
        learner.fit_normalizer(bad, actions)
    with pytest.raises(ValueError, match=r"actions: expected \[N, D\]"):
        learner.fit_normalizer(good, np.zeros((0, 10)))


def test_image_normalisation() -> None:
    image = np.random.default_rng(0).integers(0, 256, (4, 5, 3), dtype=np.uint8)
    expected = (image / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    np.testing.assert_allclose(learner.normalize_image(jnp.asarray(image)), expected, atol=1e-5)
    as_float = jnp.asarray(image, jnp.float32) / 255
    np.testing.assert_allclose(learner.normalize_image(as_float), expected, atol=1e-5)


def test_loss_refuses_to_broadcast() -> None:
    prediction = jnp.array([[1.0, 2.0], [3.0, 5.0]])
    assert learner.mean_squared_error(prediction, jnp.ones((2, 2))) == (0 + 1 + 4 + 16) / 4
    for shape in ((2,), (2, 1), (1, 2), (1, 2, 2)):
        with pytest.raises(ValueError, match=r"must have one shape, got \(2, 2\)"):
            learner.mean_squared_error(prediction, jnp.ones(shape))


@pytest.mark.parametrize("index", range(10))
def test_no_number_that_is_not_finite_is_hidden(index: int) -> None:
    """Orthonormal columns and a threshold would turn it into a good action."""
    prediction = np.random.default_rng(0).normal(size=(2, 10)).astype(np.float32)
    prediction[1, index] = np.nan
    action = np.asarray(learner.to_action(jnp.asarray(prediction)))
    assert np.isfinite(action[0]).all() and np.isnan(action[1]).all()


def test_to_action_by_hand() -> None:
    prediction = jnp.array(
        [[0, 2.0, 0, 3.0, 4.0, 0, 0.1, 0.2, 0.3, 0.5], [1.0] * 3 + [0, 0, 2.0] * 2 + [0.51]]
    )
    action = np.asarray(learner.to_action(prediction))
    # First column (0, 2, 0) -> y; second (3, 4, 0) loses its y part and becomes x.
    np.testing.assert_allclose(action[0], [0, 1, 0, 1, 0, 0, 0.1, 0.2, 0.3, 0.0], atol=1e-6)
    first, second = action[1, :3], action[1, 3:6]
    np.testing.assert_allclose(first, np.ones(3) / np.sqrt(3), atol=1e-6)
    np.testing.assert_allclose([second @ second, first @ second], [1, 0], atol=1e-6)
    assert action[1, 9] == 1.0  # 0.51 is open, 0.5 is not


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"norm": "layer"}, "norm is 'layer'; known: batch, group"),
        ({"schedule": "step"}, "schedule is 'step'; known: constant, cosine"),
        ({"dtype": "float16"}, "dtype is 'float16'"),
        ({"batch_size": 0}, "batch_size is 0; expected at least 1"),
        ({"learning_rate": -1.0}, "learning_rate is -1.0; expected 0 or more"),
        ({"learning_rate": float("nan")}, "learning_rate is nan"),
        ({"overlay_fraction": 1.5}, "overlay_fraction is 1.5; expected 0 to 1"),
        ({"ema": 1.0}, "ema is 1.0"),
        ({"turn": (20.0, 10.0)}, "turn is .20.0, 10.0.; expected pan and tilt from 0 to 1.5"),
    ],
)
def test_configuration_errors(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LearnerConfig(**change)


def test_batch_errors_say_what_came() -> None:
    def check(**changes: Any) -> None:
        learner.check_batch(dataclasses.replace(DATA, **changes), P, ("front",), CROP)

    check()
    with pytest.raises(ValueError, match=r"proprio: expected shape \(22, 5\), got \(22, 4\)"):
        check(proprio=DATA.proprio[:, :4])
    with pytest.raises(ValueError, match=r"actions: expected shape \(22, 10\), got \(21, 10\)"):
        check(actions=DATA.actions[1:])
    with pytest.raises(ValueError, match=r"expected the views \['front'\], got \['wrist'\]"):
        check(images={"wrist": DATA.images["front"]})
    with pytest.raises(ValueError, match="expected uint8"):
        check(images={"front": DATA.images["front"].astype(np.float32)})
    with pytest.raises(ValueError, match="less than the crop of 36"):
        check(images={"front": DATA.images["front"][:, :, :35]})


# -------------------------------------------------------------------------------------- the order


def order(seed: int, steps: range, count: int, size: int) -> np.ndarray:
    key = jax.random.key(seed)
    return np.concatenate([loop.batch_indices(key, step, count, size) for step in steps])


@pytest.mark.parametrize(("count", "size"), [(22, 8), (5, 8), (8, 8), (1, 3)])
def test_every_sample_once_an_epoch(count: int, size: int) -> None:
    stream = order(0, range(2 * count), count, size)  # 2 size epochs
    epochs = stream.reshape(2 * size, count)
    np.testing.assert_array_equal(np.sort(epochs, axis=1), np.tile(np.arange(count), (2 * size, 1)))
    if count > 4:
        assert len({tuple(epoch) for epoch in epochs}) == len(epochs)  # shuffled anew each time


def test_the_order_is_a_function_of_seed_and_step() -> None:
    forward = order(0, range(10), 22, 8)
    backward = np.concatenate(
        [loop.batch_indices(jax.random.key(0), step, 22, 8) for step in reversed(range(10))]
    )
    np.testing.assert_array_equal(forward, backward.reshape(10, 8)[::-1].ravel())
    assert not np.array_equal(forward, order(1, range(10), 22, 8))
    with pytest.raises(ValueError, match="no samples"):
        loop.batch_indices(jax.random.key(0), 0, 0, 8)


# ---------------------------------------------------------------------------------- one bare step


def test_a_step_by_hand(bare: learner.Learner) -> None:
    """Loss, norms and Adam's first step, against what NumPy makes of the network's predictions."""
    state = start(bare)
    before = copy(state)
    after, metrics = bare.jitted_step(jax.random.key(0), state, batch())

    policy = bare.policy_state(before)
    prediction, _ = bare.jitted_predict(policy, batch().images, batch().proprio)
    low, high = DATA.actions.min(axis=0), DATA.actions.max(axis=0)
    target = 2 * (batch().actions - low) / (high - low) - 1
    expected = np.square(np.asarray(prediction, np.float64) - target).mean()
    np.testing.assert_allclose(metrics["loss"], expected, rtol=1e-4)

    moved = jax.tree.map(lambda a, b: np.asarray(a) - b, after.params, before.params)
    np.testing.assert_allclose(metrics["update_norm"], norm(moved), rtol=1e-3)
    np.testing.assert_allclose(metrics["param_norm"], norm(after.params), rtol=1e-5)
    np.testing.assert_allclose(metrics["learning_rate"], 5e-3)
    # Adam's first update is the rate times the gradient's sign.
    steps = np.abs(np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(moved)]))
    assert np.quantile(steps, 0.999) == pytest.approx(5e-3, rel=1e-2)
    assert (int(after.step), int(after.skipped)) == (1, 0)
    assert after.ema_params == {} and after.batch_stats == {}
    assert state.params["head"]["output"]["kernel"].is_deleted()  # consumed, as documented


def test_it_learns(bare: learner.Learner) -> None:
    """The first translation is in the image only: predicting it needs the encoder."""
    state = start(bare)
    for step in range(200):
        indices = loop.batch_indices(jax.random.key(1), step, SAMPLES, 8)
        state, _ = bare.jitted_step(jax.random.key(0), state, loop.take(DATA, indices))
    score = held_out.action_r2(bare, bare.policy_state(state), DATA, batch_size=8)
    untrained = held_out.action_r2(bare, bare.policy_state(start(bare)), DATA, batch_size=8)
    assert score.shape == (10,)
    assert score[6] > 0.7
    assert untrained[6] < 0.2


def test_r2_by_hand(bare: learner.Learner) -> None:
    policy = bare.policy_state(start(bare))
    rows = np.array([3, 1, 4, 15, 9, 2, 6, 5])
    constant = dataclasses.replace(DATA, actions=DATA.actions.copy())
    constant.actions[:, 2] = 0.5
    score = held_out.action_r2(bare, policy, constant, rows=rows, batch_size=8)
    part = loop.take(constant, rows)
    predicted = np.asarray(bare.jitted_predict(policy, part.images, part.proprio)[0], np.float64)
    low, high = DATA.actions.min(axis=0), DATA.actions.max(axis=0)
    labels = 2 * (part.actions.astype(np.float64) - low) / (high - low) - 1
    residual = np.square(labels - predicted).sum(axis=0)
    spread = np.square(labels - labels.mean(axis=0)).sum(axis=0)
    others = np.arange(10) != 2
    np.testing.assert_allclose(score[others], 1 - residual[others] / spread[others], rtol=1e-3)
    assert np.isnan(score[2])


# ------------------------------------------------------------------------------------------ acting


def test_actions_are_executable_and_noisy(full: learner.Learner) -> None:
    policy = full.policy_state(start(full))
    few = batch()
    actions = np.asarray(full.jitted_act(jax.random.key(0), policy, few.images, few.proprio))
    assert actions.shape == (8, 10)
    first, second = actions[:, :3], actions[:, 3:6]
    for dot, value in (((first * first), 1), ((second * second), 1), ((first * second), 0)):
        np.testing.assert_allclose(dot.sum(axis=1), value, atol=1e-5)
    assert set(actions[:, 9]) <= {0.0, 1.0}
    again = full.jitted_act(jax.random.key(0), policy, few.images, few.proprio)
    other = full.jitted_act(jax.random.key(1), policy, few.images, few.proprio)
    np.testing.assert_array_equal(actions, again)
    assert 0 < np.abs(actions - other).max()


def test_noise_by_rows_is_that_of_the_whole(full: learner.Learner) -> None:
    policy, few = full.policy_state(start(full)), batch()

    def act(images: Any, proprio: np.ndarray, *rows: np.ndarray) -> np.ndarray:
        return np.asarray(full.jitted_act(jax.random.key(0), policy, images, proprio, *rows))

    whole = act(few.images, few.proprio)
    np.testing.assert_allclose(act(few.images, few.proprio, np.arange(8)), whole, atol=1e-5)
    order = np.array([5, 2, 7, 0, 1, 6, 3, 4])
    images = {view: x[order] for view, x in few.images.items()}
    np.testing.assert_allclose(
        act(images, few.proprio[order], order), np.asarray(whole)[order], atol=1e-5
    )


def test_acting_without_noise_is_predicting(bare: learner.Learner) -> None:
    policy, some = bare.policy_state(start(bare)), batch()
    prediction, _ = bare.jitted_predict(policy, some.images, some.proprio)
    low, high = DATA.actions.min(axis=0), DATA.actions.max(axis=0)
    expected = low + (np.asarray(prediction) + 1) / 2 * (high - low)
    actions = bare.jitted_act(jax.random.key(0), policy, some.images, some.proprio)
    np.testing.assert_allclose(actions[:, 6:9], expected[:, 6:9], atol=1e-4)
    clear = np.abs(expected[:, 9] - 0.5) > 1e-4
    np.testing.assert_array_equal(actions[clear, 9], expected[clear, 9] > 0.5)


# ------------------------------------------------------------------------- whole runs, all features


def test_the_log_of_a_run(uninterrupted: tuple[TrainState, list[Any]]) -> None:
    state, log = uninterrupted
    assert [step for step, _ in log] == [1, 2, 3, 4, 5, 6]
    assert int(state.step) == 6
    names = {"loss", "grad_norm", "param_norm", "update_norm", "learning_rate", "skipped"}
    for _, values in log:
        assert set(values) == names
        assert np.isfinite(list(values.values())).all()
    # Linear over two steps, then half a cosine over four: 1 + cos(pi k / 4), over 2.
    rates = [values["learning_rate"] for _, values in log]
    cosine = [(1 + np.cos(np.pi * k / 4)) / 2 for k in range(4)]
    np.testing.assert_allclose(rates, 4e-3 * np.array([0.5, 1.0, *cosine]), rtol=1e-5)


def test_one_seed_one_result(
    full: learner.Learner, uninterrupted: tuple[TrainState, list[Any]]
) -> None:
    again: list[Any] = []
    state = train(full, on_log=lambda step, values: again.append((step, values)))
    assert bits(state) == bits(uninterrupted[0])
    assert again == uninterrupted[1]
    assert bits(train(full, seed=4).params) != bits(uninterrupted[0].params)


def test_resumed_equals_uninterrupted_bit_for_bit(
    full: learner.Learner, uninterrupted: tuple[TrainState, list[Any]], tmp_path: Path
) -> None:
    log: list[Any] = []
    train(
        full,
        steps=3,
        checkpoint_every=2,
        on_checkpoint=lambda step, state: checkpoint.save(tmp_path, step, state),
        on_log=lambda step, values: log.append((step, values)),
    )
    assert [step for step, _ in checkpoint.steps(tmp_path)] == [2, 3]
    for step in (2, 3):
        state = checkpoint.load(tmp_path / str(step), full.abstract_state())
        rest: list[Any] = []
        state = train(full, state=state, on_log=lambda s, v, to=rest: to.append((s, v)))
        assert bits(state) == bits(uninterrupted[0])
        assert log[:step] + rest == uninterrupted[1]


def test_a_checkpoint_of_another_network_is_refused(full: learner.Learner, tmp_path: Path) -> None:
    path = checkpoint.save(tmp_path, 0, start(full))
    for change, message in (
        ({"width": 16}, "params/encoders/front/.*expected float32"),
        ({"ema": 0.0}, "'ema_params/.*not expected"),
        ({"norm": "group"}, "leaf '"),
    ):
        other = learner.make_learner(dataclasses.replace(FULL, **change), P)
        with pytest.raises(checkpoint.CheckpointMismatch, match=message):
            checkpoint.load(path, other.abstract_state())


def test_encoder_rate_average_and_running_statistics(full: learner.Learner) -> None:
    state = dataclasses.replace(start(full), step=jnp.int32(0))
    before = copy(state)
    after, _ = full.jitted_step(jax.random.key(0), state, batch(), BANK)
    moved = jax.tree.map(lambda a, b: np.abs(np.asarray(a) - b).max(), after.params, before.params)
    # Adam's first step has the size of the rate, here half way through the warm-up.
    assert max(jax.tree.leaves(moved["head"])) == pytest.approx(2e-3, rel=1e-2)
    assert max(jax.tree.leaves(moved["encoders"])) == pytest.approx(0.25 * 2e-3, rel=1e-2)
    for old, new, average in zip(
        *map(jax.tree.leaves, (before.params, after.params, after.ema_params)), strict=True
    ):
        np.testing.assert_allclose(average, 0.9 * old + 0.1 * np.asarray(new), atol=1e-6)
    assert full.policy_state(after).params is after.ema_params
    assert bits(after.batch_stats) != bits(before.batch_stats)


def test_overlay_waits_for_its_warm_up_in_one_compilation(full: learner.Learner) -> None:
    def loss(step: int, bank: np.ndarray) -> float:
        state = dataclasses.replace(start(full), step=jnp.int32(step))
        _, metrics = full.jitted_step(jax.random.key(0), state, batch(), bank)
        return float(metrics["loss"])

    other = 255 - BANK
    assert loss(1, BANK) == loss(1, other)
    assert loss(2, BANK) != loss(2, other)
    assert len(TRACES) == 1  # for all tests so far


def test_a_turned_camera_turns_the_rotation_input_along() -> None:
    """Images and proprioception are those that `align` gives for the camera that is returned."""
    rng = np.random.default_rng(5)
    base = align.Camera.from_fovy(40.0, SIDE, SIDE, np.eye(4)).turned(0.3, 0.2, np.ones(3))
    count = 8
    cameras = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], count, 0), base)
    tcp = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
    tcp[:, :3, :3] = align.matrix_from_6d(rng.normal(size=(count, 6)).astype(np.float32))
    tcp[:, :3, 3] = [0.5, 0.4, 1.2] + 0.02 * rng.normal(size=(count, 3))

    def proprio(cameras: align.Camera) -> Any:
        return jax.vmap(lambda pose, c: align.proprio(pose, 1.0, c, layout="cam6d_z"))(tcp, cameras)

    data = Batch(
        {"front": make_data(count=count).images["front"]},
        np.asarray(proprio(cameras)),
        DATA.actions[:count],
        cameras={"front": cameras},
        tcp=tcp[:, :3, 3],
    )
    config = dataclasses.replace(BARE, turn=(0.4, 0.2), turn_probability=0.7)
    key = jax.random.key(1)
    out = learner._turned_views(key, data, "front", config)
    images, turned = align.random_turn(
        jax.random.fold_in(key, 0), data.images["front"], cameras, data.tcp,
        pan=0.4, tilt=0.2, probability=0.7,
    )  # fmt: skip
    np.testing.assert_array_equal(out.images["front"], images)
    np.testing.assert_allclose(out.proprio, proprio(turned), atol=1e-5)
    assert (np.abs(out.proprio - data.proprio).max(1) > 1e-3).sum() >= 3
    world = dataclasses.replace(config, turn_proprio=False)
    same = learner._turned_views(key, data, "front", world)
    np.testing.assert_array_equal(same.proprio, data.proprio)


def test_turning_needs_cameras() -> None:
    made = learner.make_learner(dataclasses.replace(BARE, turn=(0.1, 0.0)), P)
    with pytest.raises(ValueError, match=r"needs those of \['front'\].*turn=\(0, 0\)"):
        loop.run(made, DATA, seed=0, steps=1)


def test_randomness_is_of_key_and_step(full: learner.Learner) -> None:
    def loss(key: int, step: int) -> float:
        state = dataclasses.replace(start(full), step=jnp.int32(step))
        return float(full.jitted_step(jax.random.key(key), state, batch(), BANK)[1]["loss"])

    assert loss(0, 0) == loss(0, 0)
    assert len({loss(0, 0), loss(0, 1), loss(1, 0)}) == 3


# ------------------------------------------------------------------------- what goes wrong in a run


def test_a_bad_batch_changes_nothing_but_the_count(full: learner.Learner) -> None:
    state = start(full)
    before = copy(state)
    bad = dataclasses.replace(batch(), actions=np.full((8, 10), np.nan, np.float32))
    after, metrics = full.jitted_step(jax.random.key(0), state, bad, BANK)
    assert np.isnan(metrics["loss"])
    assert (int(after.step), int(after.skipped), int(metrics["skipped"])) == (1, 1, 1)
    for name in ("params", "opt_state", "batch_stats", "ema_params"):
        assert bits(getattr(after, name)) == bits(getattr(before, name)), name
    # And the next good batch is learnt from.
    after, metrics = full.jitted_step(jax.random.key(0), after, batch(), BANK)
    assert np.isfinite(metrics["loss"]) and int(after.skipped) == 1
    assert bits(after.params) != bits(before.params)


def test_too_many_bad_batches_stop_the_run(full: learner.Learner) -> None:
    state = start(full)
    broken = dataclasses.replace(
        state, params=jax.tree.map(lambda x: np.full_like(x, np.nan), state.params)
    )
    seen: list[int] = []
    with pytest.raises(loop.NonFiniteError, match="max_skipped_steps = 1") as caught:
        train(full, state=broken, on_log=lambda step, values: seen.append(step))
    assert "2 of 2 updates" in str(caught.value)
    assert seen == [1, 2]


def test_bad_data_are_refused_before_anything_is_compiled(full: learner.Learner) -> None:
    bad = dataclasses.replace(DATA, proprio=DATA.proprio.copy())
    bad.proprio[3, 1] = np.nan
    with pytest.raises(ValueError, match="proprio has non-finite values"):
        loop.run(full, bad, seed=0, bank=BANK)
    with pytest.raises(ValueError, match="no bank of backgrounds"):
        loop.run(full, DATA, seed=0)
    with pytest.raises(ValueError, match="different views"):
        learner.make_learner(FULL, P, ("front", "front"))


def test_callbacks_and_stopping(full: learner.Learner) -> None:
    logged: list[int] = []
    saved: list[int] = []
    answers = iter([False, False, False, True])
    state = train(
        full,
        log_every=2,
        on_log=lambda step, values: logged.append(step),
        checkpoint_every=2,
        on_checkpoint=lambda step, state: saved.append(step),
        should_stop=lambda: next(answers),
    )
    assert int(state.step) == 3
    assert logged == [2]
    assert saved == [2, 3]  # the state at which it stopped can be resumed


# -------------------------------------------------------------------------- shapes only: no compile


def shapes_of(made: learner.Learner) -> tuple[TrainState, Callable[..., Any]]:
    return made.abstract_state(), lambda *args: jax.eval_shape(made.step, *args)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_state_keeps_its_types_for_two_views(dtype: str) -> None:
    """A step maps a state to one of the same structure, shapes and dtypes, in any arithmetic."""
    config = dataclasses.replace(FULL, dtype=dtype)
    made = learner.make_learner(config, P, ("front", "wrist"))
    state, step = shapes_of(made)
    image = jax.ShapeDtypeStruct((8, SIDE, SIDE, 3), jnp.uint8)
    samples = Batch(
        {"front": image, "wrist": image},
        jax.ShapeDtypeStruct((8, P), jnp.float32),
        jax.ShapeDtypeStruct((8, 10), jnp.float32),
    )
    key = jax.eval_shape(lambda: jax.random.key(0))
    after, metrics = step(key, state, samples, jax.ShapeDtypeStruct(BANK.shape, jnp.uint8))
    assert jax.tree.structure(after) == jax.tree.structure(state)
    assert [(x.shape, x.dtype) for x in jax.tree.leaves(after)] == [
        (x.shape, x.dtype) for x in jax.tree.leaves(state)
    ]
    assert all(value.shape == () for value in metrics.values())


def test_seeds_are_a_vmap(full: learner.Learner) -> None:
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), 3))
    normalizer: Normalizer = full.abstract_state().normalizer
    states = jax.eval_shape(jax.vmap(full.init, in_axes=(0, None)), keys, normalizer)
    stepped, metrics = jax.eval_shape(
        jax.vmap(full.step, in_axes=(0, 0, None, None)), keys, states, batch(), BANK
    )
    assert metrics["loss"].shape == (3,)
    assert stepped.params["head"]["output"]["kernel"].shape == (3, 16, 10)
