"""What baselines make of demonstrations, and what they see."""

import dataclasses

import jax
import numpy as np
import pytest
import worlds

from palm_jax.envs.base import PAPER_FRAME
from palm_jax.train import demos, methods, transforms
from palm_jax.train.evaluate import VIEW
from palm_jax.train.learner import Batch

SIZE = 84
FRAMES = 40


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> demos.Demos:
    """Some frames of two demonstrations."""
    path = tmp_path_factory.mktemp("demos") / "spam.hdf5"
    demos.collect(worlds.runner("lift_spam"), path, count=2, seed=1, noise=0.004)
    data = demos.load(path, task="lift_spam", robot="panda")
    rows = np.linspace(0, len(data.qpos) - 1, FRAMES).astype(int)
    frames = ("qpos", "tcp", "opening", "actions", "episode", "stages")
    return dataclasses.replace(data, **{name: getattr(data, name)[rows] for name in frames})


def training_set(recorded: demos.Demos, name: str) -> tuple[transforms.Source, Batch]:
    """The rendered batch of a method, before its transform."""
    method, runner = methods.find(name), worlds.runner("lift_spam")
    spec = method.spec(runner.env.task, SIZE)
    images, proprio, cameras = demos.render_observations(runner, recorded, spec, frame=method.frame)
    batch = Batch(
        {VIEW: images}, proprio, recorded.actions,
        cameras={VIEW: cameras}, tcp=recorded.tcp[:, :3, 3],
    )  # fmt: skip
    return transforms.Source(runner, recorded, spec, method.frame, VIEW), batch


def half(batch: Batch, second: bool) -> Batch:
    rows = slice(FRAMES, None) if second else slice(0, FRAMES)
    return jax.tree.map(lambda x: np.asarray(x)[rows], batch)


def pose_of(proprio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and position of world6d_xyz."""
    first, second = proprio[:, :3], proprio[:, 3:6]
    return np.stack([first, second, np.cross(first, second)], -1), proprio[:, 6:9]


def target_of(proprio: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where actions lead from world6d_xyz poses."""
    rotation, position = pose_of(proprio)
    turn, move = pose_of(actions)
    return rotation @ turn, position + (rotation @ move[..., None])[..., 0]


def test_a_mirrored_demonstration_is_one_of_the_mirrored_world(recorded: demos.Demos) -> None:
    """The camera stands at y = 0: the mirror takes y to -y, also of where actions lead."""
    source, batch = training_set(recorded, "mirrorduo")
    found = transforms.mirrored(jax.random.key(0), source, batch)
    first, other = half(found, False), half(found, True)
    jax.tree.map(np.testing.assert_array_equal, first, jax.tree.map(np.asarray, batch))
    np.testing.assert_array_equal(other.images[VIEW], batch.images[VIEW][:, :, ::-1])
    mirror, fingers = np.diag([1.0, -1.0, 1.0]), np.diag([1.0, -1.0, 1.0])
    for place in (
        lambda b: pose_of(np.asarray(b.proprio)),
        lambda b: target_of(np.asarray(b.proprio), np.asarray(b.actions)),
    ):
        (rotation, position), (turned, moved) = place(batch), place(other)
        np.testing.assert_allclose(turned, mirror @ rotation @ fingers, atol=1e-5)
        np.testing.assert_allclose(moved, position @ mirror, atol=1e-5)
    np.testing.assert_array_equal(other.proprio[:, 9], np.asarray(batch.proprio)[:, 9])
    np.testing.assert_array_equal(other.actions[:, 9], batch.actions[:, 9])


def test_a_mirror_of_palm_draws_the_axes_anew(recorded: demos.Demos) -> None:
    """Colours tell the axes apart, so a flipped picture of them would be of no hand."""
    source, batch = training_set(recorded, "palm+mirrorduo")
    found = half(transforms.mirrored(jax.random.key(0), source, batch), True)
    flipped = batch.images[VIEW][:, :, ::-1].astype(int)
    seen = found.images[VIEW].astype(int)
    # The same hand and table in most pixels, another arrow in some.
    same = (np.abs(seen - flipped).max(-1) <= 1).mean((1, 2))
    assert (same > 0.8).all() and (same < 1.0).all()
    # In the camera's frame x is negated, and the second axis of the hand with it.
    columns, mirrored = np.asarray(batch.proprio)[:, :6], found.proprio[:, :6]
    signs = np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0])
    np.testing.assert_allclose(mirrored, columns * signs, atol=1e-5)
    np.testing.assert_allclose(found.proprio[:, 6:], np.asarray(batch.proprio)[:, 6:], atol=1e-5)


@pytest.mark.parametrize(
    ("name", "metres", "radians"),
    [("roviaug", [0.1, 0.1, 0.1], 0.05), ("roviaug-ultra", [0.4, 0.1, 0.4], 0.1)],
)
def test_novel_views_are_near_the_camera_and_worse(
    recorded: demos.Demos, name: str, metres: list[float], radians: float
) -> None:
    source, batch = training_set(recorded, name)
    transform = methods.find(name).transform
    assert transform is not None
    found = transform(jax.random.key(5), source, batch)
    first, other = half(found, False), half(found, True)
    jax.tree.map(np.testing.assert_array_equal, first, jax.tree.map(np.asarray, batch))
    np.testing.assert_array_equal(other.proprio, batch.proprio)
    np.testing.assert_array_equal(other.actions, batch.actions)
    old, new = (np.asarray(b.cameras[VIEW].cam_to_world) for b in (batch, other))
    move = np.linalg.inv(old) @ new
    offset = np.abs(move[:, :3, 3]).max(axis=0) / metres
    assert (offset <= 1 + 1e-4).all() and (offset > 0.8).all()
    angle = np.arccos(np.clip((np.trace(move[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert angle.max() <= np.sqrt(3) * radians + 1e-3 and angle.max() > 0.8 * radians
    assert len(np.unique(new[:, 0, 3])) == FRAMES  # each frame has a camera of its own
    # Edges are softer; flat parts are noisier.
    steps = [np.abs(np.diff(b.images[VIEW].astype(float), axis=2)) for b in (batch, other)]
    assert np.quantile(steps[1], 0.995) < 0.8 * np.quantile(steps[0], 0.995)
    assert np.median(steps[1]) > np.median(steps[0])


def test_a_model_for_novel_views_can_be_plugged_in(recorded: demos.Demos) -> None:
    source, batch = training_set(recorded, "bc")
    asked: list[np.ndarray] = []

    def model(key: jax.Array, source: transforms.Source, poses: np.ndarray) -> np.ndarray:
        asked.append(poses)
        return np.full((FRAMES, SIZE, SIZE, 3), 7, np.uint8)

    found = transforms.novel_views(model)(jax.random.key(0), source, batch)
    assert asked[0].shape == (FRAMES, 4, 4)
    assert (half(found, True).images[VIEW] == 7).all()


def test_arro_sees_the_gripper_and_the_objects_alone(recorded: demos.Demos) -> None:
    """Against the renderer's own labels of the whole frame."""
    _, seen = training_set(recorded, "arro")
    _, plain = training_set(recorded, "bc")
    runner = worlds.runner("lift_spam")
    env = runner.env
    state, params = next(demos.states(runner, recorded))
    label = jax.jit(
        jax.vmap(lambda s, p: env.render(s, p, SIZE, outputs=("segmentation",)).segmentation)
    )
    model = env.mj_model
    bodies = [model.body(model.geom(g).bodyid[0]).name for g in range(model.ngeom)]
    ids = np.asarray(label(state, params))
    shown, owner = (
        np.array([*names, "nothing"])[ids]
        for names in ([model.geom(g).name for g in range(model.ngeom)], bodies)
    )
    image, whole = seen.images[VIEW][: worlds.WORLDS], plain.images[VIEW][: worlds.WORLDS]
    for area in (shown == "table_top", np.char.startswith(owner, "link")):
        assert area.any() and set(np.unique(image[area])) <= {0, 96}
    target = np.isin(shown, env.task.stages[0].target_geoms)
    assert target.any()
    np.testing.assert_array_equal(image[target], whole[target])


def test_methods_compose_by_name() -> None:
    both = methods.find("palm+mirrorduo+arro")
    assert both.name == "palm+mirrorduo+arro"
    assert both.layout == "cam6d_z" and both.crop and both.overlay and both.augment
    assert both.isolate and both.transform is transforms.mirrored
    assert methods.find("bc").frame == PAPER_FRAME
    with pytest.raises(ValueError, match="unknown method 'mirror'; known: palm, "):
        methods.find("palm+mirror")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("palm+mirrorduo+roviaug", "of mirrorduo, roviaug, roviaug-ultra a method can have one"),
        ("roviaug+mirrorduo", "can have one"),
        (
            "bc+palm",
            "palm adds nothing to bc; behind a [+] can stand mirrorduo, roviaug, r.*, arro",
        ),
        ("palm+arro+arro", "arro adds nothing to palm"),
    ],
)
def test_what_cannot_be_composed_is_refused(name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        methods.find(name)


def test_isolated_palm_keeps_its_overlay(recorded: demos.Demos) -> None:
    _, batch = training_set(recorded, "palm+arro")
    image = batch.images[VIEW]
    assert (image == 0).all(-1).mean() > 0.4  # the background is black
    assert ((image[..., 2].astype(int) - image[..., :2].max(-1)) > 150).any()  # the blue arrow
