"""Shifts change what they say, and nothing else."""

import colorsys
import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from contracts import compilations
from oracles import GOLDEN, crop, project, rotation_6d

from palm_jax.align import AlignSpec
from palm_jax.envs import make, shifts
from palm_jax.envs.base import PAPER_FRAME, EnvParams, State
from palm_jax.envs.distractors import TARGET_DISTANCE
from palm_jax.envs.params import MAX_DISTRACTORS, repeat_params
from palm_jax.envs.scene import turned_hue
from palm_jax.envs.tasks import TABLE_HEIGHT, WORKSPACE_CENTRE
from palm_jax.envs.world import DISTRACTORS
from palm_jax.render import render

REGIONS = {"object_low", "object_high", "area_low", "area_high"}
LIGHTS = {"light_ambient", "light_diffuse", "light_direction"}
TABLE = {"table_rgb", "table_rgb2", "table_scale"}
EVERY = shifts.SHIFTS | shifts.AXES


@pytest.fixture(scope="module")
def default() -> EnvParams:
    return make("lift_spam").default_params()


def changed(before: EnvParams, after: EnvParams) -> set[str]:
    names = [field.name for field in dataclasses.fields(EnvParams)]
    return {n for n in names if not np.array_equal(getattr(before, n), getattr(after, n))}


@pytest.mark.parametrize(
    ("shift", "fields"),
    [
        (shifts.workspace, REGIONS),
        (shifts.viewpoint, {"camera_angle"}),
        (shifts.aligned_hand, {"align_hand"}),
        (lambda p: shifts.at_camera_angle(p, jnp.float32(0.2)), {"camera_angle"}),
        (lambda p: shifts.at_object(p, jnp.array([0.3, 0.1])), {"object_low", "object_high"}),
        (lambda p: shifts.shifted(p, "in_domain"), set()),
        (
            lambda p: shifts.shifted(p, "workspace+viewpoint"),
            REGIONS | {"camera_angle"},
        ),
        (lambda p: shifts.shifted(p, "embodiment"), set()),
        (shifts.viewpoint_cone, {"camera_angle", "camera_radius"}),
        (shifts.lighting, LIGHTS),
        (lambda p: shifts.lighting(p, strength=-0.5), LIGHTS),
        (shifts.table_texture, TABLE),
        (lambda p: shifts.table_texture(p, strength=-0.5), TABLE),
        (shifts.object_color, {"object_hue"}),
        (shifts.field_of_view, {"camera_fovy"}),
        (shifts.distractors, {"distractors"}),
        (shifts.calibration_pixels, {"calibration_pixels"}),
        (shifts.calibration_rotation, {"calibration_rotation"}),
        (shifts.calibration_translation, {"calibration_translation"}),
        (
            lambda p: shifts.shifted(p, "embodiment+lighting+viewpoint", strength=0.5),
            LIGHTS | {"camera_angle"},
        ),
    ],
)
def test_only_the_fields_of_a_shift_change(
    default: EnvParams, shift: Callable[[EnvParams], EnvParams], fields: set[str]
) -> None:
    after = jax.jit(shift)(default)
    assert changed(default, after) == fields
    before_types = [(x.shape, x.dtype) for x in jax.tree.leaves(default)]
    assert [(x.shape, x.dtype) for x in jax.tree.leaves(after)] == before_types


def test_regions_and_angles_are_the_papers(default: EnvParams) -> None:
    np.testing.assert_allclose(default.object_high - default.object_low, [0.2, 0.2], atol=1e-6)
    np.testing.assert_allclose(default.object_low + default.object_high, [0.5, 0], atol=1e-6)
    shifted = shifts.shifted(default, "workspace+viewpoint")
    np.testing.assert_allclose(shifted.object_low, [0.05, -0.35], atol=1e-6)
    np.testing.assert_allclose(shifted.object_high, [0.45, 0.35], atol=1e-6)
    np.testing.assert_allclose(np.degrees(shifted.camera_angle), [-30, 30], atol=1e-4)


@pytest.mark.parametrize("shift", list(shifts.SHIFTS.values()))
def test_strength_scales_a_shift(default: EnvParams, shift: Callable[..., EnvParams]) -> None:
    assert changed(default, shift(default, strength=0.0)) == set()
    half, full = shift(default, strength=0.5), shift(default)
    for name in changed(default, full):
        start, middle, end = (np.asarray(getattr(p, name)) for p in (default, half, full))
        np.testing.assert_allclose(middle, (start + end) / 2, atol=1e-6)


@pytest.mark.parametrize("name", EVERY)
def test_no_strength_is_no_shift(default: EnvParams, name: str) -> None:
    """Bit for bit, also of params that are not the default ones."""
    other = dataclasses.replace(
        default,
        camera_angle=jnp.array([-0.7, 0.1]),
        camera_radius=jnp.array([0.7, 0.9]),
        object_hue=jnp.float32(0.3),
        distractors=jnp.float32(1),
    )
    for params in (default, other):
        assert changed(params, jax.jit(lambda p: EVERY[name](p, strength=0.0))(params)) == set()


@pytest.mark.parametrize("name", EVERY)
def test_a_sweep_is_a_vmap_over_strengths(default: EnvParams, name: str) -> None:
    low, high = shifts.strength_range(name)
    strengths = np.linspace(low, high, 5).astype(np.float32)
    many = jax.vmap(lambda s: EVERY[name](default, strength=s))(jnp.asarray(strengths))
    ones = [EVERY[name](default, strength=float(strength)) for strength in strengths]
    for field in dataclasses.fields(EnvParams):
        expected = np.stack([getattr(one, field.name) for one in ones])
        found = np.broadcast_to(getattr(many, field.name), expected.shape)
        np.testing.assert_allclose(found, expected, atol=1e-6)
    numbers = {tuple(np.concatenate([np.ravel(x) for x in jax.tree.leaves(p)])) for p in ones}
    assert len(numbers) == 5


@pytest.mark.parametrize("name", EVERY)
def test_strengths_outside_the_range_are_refused(default: EnvParams, name: str) -> None:
    low, _ = shifts.strength_range(name)
    assert low == (-1 if name in shifts.AXES and name != "distractors" else 0)
    for strength in (low - 0.01, 1.01, np.nan, np.inf, np.zeros(3), jnp.float32(2)):
        with pytest.raises(ValueError, match=f"{name}: expected a strength from {low:g} to 1, got"):
            EVERY[name](default, strength=strength)
        with pytest.raises(ValueError, match=f"{name}: expected a strength"):
            shifts.shifted(default, name, strength=strength)


def test_axes_reach_what_they_say(default: EnvParams) -> None:
    """The numbers of the docstrings, written out."""
    dim, bright = (shifts.lighting(default, strength=s) for s in (-1, 1))
    np.testing.assert_allclose(dim.light_diffuse, 0.5 * default.light_diffuse, rtol=1e-6)
    np.testing.assert_allclose(bright.light_ambient, 1.5 * default.light_ambient, rtol=1e-6)
    for light, before in zip(bright.light_direction, default.light_direction, strict=True):
        angles = [np.degrees(np.arctan2(v[1], v[0])) for v in (light, before)]
        assert (angles[0] - angles[1]) % 360 == pytest.approx(60, abs=1e-3)
        assert light[2] == before[2]
        np.testing.assert_allclose(np.linalg.norm(light), np.linalg.norm(before), rtol=1e-6)
    fovy = [float(shifts.field_of_view(default, strength=s).camera_fovy) for s in (-1, 1)]
    np.testing.assert_allclose(fovy, [32, 48], rtol=1e-6)
    counts = [float(shifts.distractors(default, strength=s).distractors) for s in (0.25, 0.6, 1)]
    assert counts == [1, 2, 4] and MAX_DISTRACTORS == 4
    hue = [float(shifts.object_color(default, strength=s).object_hue) for s in (-1, 1)]
    np.testing.assert_allclose(np.degrees(hue), [-120, 120], rtol=1e-5)
    scale = [float(shifts.table_texture(default, strength=s).table_scale) for s in (-1, 1)]
    np.testing.assert_allclose(scale, [0.045, 0.18], rtol=1e-5)
    for sign in (-1, 1):
        pixels = shifts.calibration_pixels(default, strength=sign).calibration_pixels
        turn = shifts.calibration_rotation(default, strength=sign).calibration_rotation
        move = shifts.calibration_translation(default, strength=sign).calibration_translation
        np.testing.assert_allclose(pixels, sign * 20 / np.sqrt(2) * np.ones(2), rtol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(turn), np.radians(3), rtol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(move), 0.03, rtol=1e-5)
        assert (sign * turn > 0).all() and (sign * move > 0).all()
    cone = shifts.viewpoint_cone(default)
    np.testing.assert_allclose(cone.camera_radius, [0.8, 1.2], rtol=1e-6)
    np.testing.assert_allclose(cone.camera_angle, shifts.viewpoint(default).camera_angle)


# -- domains ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("domain", ["wokspace", "workspace+lights", "", "embodimant+viewpoint"])
def test_unknown_shifts_list_the_known_ones(default: EnvParams, domain: str) -> None:
    known = "known: in_domain, workspace, viewpoint, viewpoint_cone, embodiment, lighting"
    for function in (shifts.parts, shifts.other_robot, lambda d: shifts.shifted(default, d)):
        with pytest.raises(ValueError, match=known):
            function(domain)


def test_domains_that_repeat_or_contradict_themselves_are_refused() -> None:
    with pytest.raises(ValueError, match="names 'workspace' twice"):
        shifts.parts("workspace+viewpoint+workspace")
    with pytest.raises(ValueError, match="in_domain is no shift and stands alone"):
        shifts.parts("in_domain+viewpoint")


def test_the_eight_domains_of_the_paper_differ(default: EnvParams) -> None:
    seen = set()
    for domain in shifts.DOMAINS:
        leaves = jax.tree.leaves(shifts.shifted(default, domain))
        numbers = tuple(np.concatenate([np.ravel(x) for x in leaves]).tolist())
        seen.add((shifts.other_robot(domain), numbers))
    assert len(seen) == len(shifts.DOMAINS) == 8
    assert [shifts.parts(d) for d in shifts.DOMAINS[:3]] == [(), ("workspace",), ("viewpoint",)]
    assert sum(map(shifts.other_robot, shifts.DOMAINS)) == 4


# -- scenes ----------------------------------------------------------------------------------------


def test_every_scene_has_its_own_strength(default: EnvParams) -> None:
    many = shifts.scenes(jax.random.key(1), default, "workspace+field_of_view+distractors", 400)
    assert all(leaf.shape[0] == 400 for leaf in jax.tree.leaves(many))
    full = shifts.workspace(default)
    for name in REGIONS:
        np.testing.assert_array_equal(getattr(many, name), np.tile(getattr(full, name), (400, 1)))
    strengths = (np.asarray(many.camera_fovy) / 40 - 1) / 0.2
    assert -1 <= strengths.min() < -0.97 and 0.97 < strengths.max() <= 1
    np.testing.assert_allclose([strengths.mean(), strengths.std()], [0, 3**-0.5], atol=0.08)
    assert set(np.unique(many.distractors)) == {0, 1, 2, 3, 4}
    # Draws are the axis's own: the other one's are not the same numbers, and do not depend on it.
    assert abs(np.corrcoef(strengths, many.distractors)[0, 1]) < 0.15
    alone = shifts.scenes(jax.random.key(1), default, "field_of_view", 400)
    np.testing.assert_array_equal(alone.camera_fovy, many.camera_fovy)
    other = shifts.scenes(jax.random.key(2), default, "field_of_view", 400)
    assert not np.array_equal(other.camera_fovy, alone.camera_fovy)


def test_strength_scales_the_range_of_scenes(default: EnvParams) -> None:
    few = shifts.scenes(jax.random.key(1), default, "viewpoint+object_color", 300, strength=0.1)
    hue = np.degrees(few.object_hue)
    assert 11 < np.abs(hue).max() <= 12.0001 and hue.min() < -11
    np.testing.assert_allclose(np.degrees(few.camera_angle), np.tile([-3, 3], (300, 1)), atol=1e-4)
    same = shifts.scenes(jax.random.key(1), default, "in_domain", 3)
    assert changed(repeat_params(default, 3), same) == set()
    for options in ({"count": 0}, {"count": 2, "strength": -0.5}, {"count": 2, "strength": np.nan}):
        with pytest.raises(ValueError, match="scenes: expected a"):
            shifts.scenes(jax.random.key(1), default, "lighting", **options)


# -- what a shift does to the world ----------------------------------------------------------------


def test_viewpoint_turns_the_camera_about_the_workspace_centre() -> None:
    runner = worlds.runner("lift_spam")
    default = runner.env.default_params()
    angles = np.linspace(-0.5, 0.5, worlds.WORLDS).astype(np.float32)
    pinned = jax.vmap(shifts.at_camera_angle, in_axes=(None, 0))(default, jnp.asarray(angles))
    state = runner.reset(worlds.keys(3), pinned)
    np.testing.assert_allclose(state.camera_angle, angles, atol=1e-6)
    nominal, centre = np.asarray(default.camera_to_world, np.float64), np.array(WORKSPACE_CENTRE)
    for angle, pose in zip(angles, np.asarray(state.camera_to_world), strict=True):
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        np.testing.assert_allclose(pose[:3, :3], turn @ nominal[:3, :3], atol=1e-6)
        expected = centre + turn @ (nominal[:3, 3] - centre)
        np.testing.assert_allclose(pose[:3, 3], expected, atol=1e-6)
    cameras = jax.vmap(runner.env.camera)(state, repeat_params(default, worlds.WORLDS))
    for matrix, pose in zip(cameras.K, cameras.cam_to_world, strict=True):
        uv, _ = project(matrix, pose, centre)
        np.testing.assert_allclose(uv, project(cameras.K[0], nominal, centre)[0], atol=1e-2)


def test_the_camera_moves_along_its_ray() -> None:
    """Radius first, then the turn: the workspace centre stays at its pixel."""
    runner = worlds.runner("lift_spam")
    default = runner.env.default_params()
    factors = np.linspace(0.8, 1.2, worlds.WORLDS).astype(np.float32)
    pinned = jax.vmap(
        lambda r: dataclasses.replace(
            shifts.at_camera_angle(default, jnp.float32(0.4)), camera_radius=jnp.stack([r, r])
        )
    )(jnp.asarray(factors))
    state = runner.reset(worlds.keys(3), pinned)
    nominal, centre = np.asarray(default.camera_to_world, np.float64), np.array(WORKSPACE_CENTRE)
    far = np.linalg.norm(nominal[:3, 3] - centre)
    camera = runner.env.camera(jax.tree.map(lambda x: x[0], state), default)
    before = project(camera.K, nominal, centre)[0]
    for factor, pose in zip(factors, np.asarray(state.camera_to_world), strict=True):
        assert np.linalg.norm(pose[:3, 3] - centre) == pytest.approx(factor * far, abs=1e-5)
        np.testing.assert_allclose(project(camera.K, pose, centre)[0], before, atol=0.01)
    cone = shifts.viewpoint_cone(default)
    drawn = runner.reset(worlds.keys(4), repeat_params(cone, worlds.WORLDS)).camera_to_world
    ratio = np.linalg.norm(np.asarray(drawn)[:, :3, 3] - centre, axis=-1) / far
    assert 0.8 <= ratio.min() < 0.9 and 1.1 < ratio.max() <= 1.2


@pytest.fixture(scope="module")
def world() -> tuple[State, EnvParams]:
    """One started world with all distractors, no batch axis."""
    runner = worlds.runner("lift_spam")
    params = shifts.distractors(runner.env.default_params())
    state = runner.reset(worlds.keys(5), repeat_params(params, worlds.WORLDS))
    return jax.tree.map(lambda x: x[2], state), params


def picture(state: State, params: EnvParams) -> tuple[np.ndarray, np.ndarray]:
    """Picture [96, 96, 3] as int, and names of the geoms [96, 96]."""
    env = worlds.runner("lift_spam").env
    frame = _draw(state, params)
    names = np.array([*(env.mj_model.geom(i).name for i in range(env.mj_model.ngeom)), "sky"])
    return np.asarray(frame.rgb).astype(int), names[np.asarray(frame.segmentation)]


@jax.jit
def _draw(state: State, params: EnvParams) -> Any:
    return worlds.runner("lift_spam").env.render(state, params, 96, outputs=("rgb", "segmentation"))


def test_the_tables_texture_reaches_the_picture(world: tuple[State, EnvParams]) -> None:
    """The table top takes the colours and nothing else does; planks get the width."""
    state, params = world
    before, names = picture(state, params)
    table = names == "table_top"
    assert table.mean() > 0.2
    red = jnp.array([0.8, 0.1, 0.1])
    plain = dataclasses.replace(params, table_rgb=red, table_rgb2=red)
    after, _ = picture(state, plain)
    np.testing.assert_array_equal(after[~table], before[~table])
    share = after[table] / after[table].sum(-1, keepdims=True)
    np.testing.assert_allclose(share.mean(0), [0.8, 0.1, 0.1], atol=0.05)
    assert after[table].std(0)[0] < before[table].std(0)[0]  # one colour has no grain
    wider, _ = picture(state, dataclasses.replace(params, table_scale=2 * params.table_scale))
    np.testing.assert_array_equal(wider[~table], before[~table])
    assert (wider[table] != before[table]).any(-1).mean() > 0.3


def test_hue_turns_the_tasks_objects_alone(world: tuple[State, EnvParams]) -> None:
    state, params = world
    before, names = picture(state, params)
    after, _ = picture(state, dataclasses.replace(params, object_hue=jnp.float32(2.0)))
    coloured = np.isin(names, ["spam_can", "spam_label"])
    assert coloured.sum() > 20
    assert (np.abs(after - before)[coloured].max(-1) > 20).all()
    others = ~np.char.startswith(names, "spam")
    np.testing.assert_array_equal(after[others], before[others])


def test_hues_turn_as_in_yiq() -> None:
    """Against the standard library's conversion, where the result is a colour at all."""
    rng = np.random.default_rng(0)
    colours = rng.uniform(0.35, 0.65, (200, 3)).astype(np.float32)
    for angle in (-2.1, 0.4, 1.5):
        turned = np.asarray(turned_hue(jnp.asarray(colours), jnp.float32(angle)))
        for colour, result in zip(colours, turned, strict=True):
            y, i, q = colorsys.rgb_to_yiq(*map(float, colour))
            # Clockwise in the (I, Q) plane is the way of the colour circle, red to yellow.
            turn = complex(i, q) * np.exp(-1j * angle)
            expected = colorsys.yiq_to_rgb(y, turn.real, turn.imag)
            np.testing.assert_allclose(result, expected, atol=2e-3)


def test_hues_keep_luma_greys_and_the_unit_cube() -> None:
    rng = np.random.default_rng(1)
    colours = jnp.asarray(rng.uniform(0, 1, (500, 3)).astype(np.float32))
    luma = np.array([0.30, 0.59, 0.11])
    for angle in np.linspace(-3, 3, 7):
        turned = np.asarray(turned_hue(colours, jnp.float32(angle)))
        np.testing.assert_allclose(turned @ luma, colours @ luma, atol=1e-5)
        assert turned.min() >= -1e-6 and turned.max() <= 1 + 1e-6
        grey = turned_hue(jnp.full((1, 3), 0.6), jnp.float32(angle))
        np.testing.assert_allclose(grey, np.full((1, 3), 0.6), atol=1e-6)
    np.testing.assert_array_equal(turned_hue(colours, jnp.zeros(())), colours)
    # A third of a turn takes blue to red, two thirds to green, as the docstring says.
    blue = jnp.array([0.1, 0.1, 0.9])
    angles = np.radians([120, 240])
    assert [int(turned_hue(blue, jnp.float32(a)).argmax()) for a in angles] == [0, 1]


@pytest.mark.parametrize("task", worlds.TASKS)
def test_distractors_stand_clear_of_the_task(task: str) -> None:
    """0 to 4 of them in the area, away from the target and apart; the rest below the floor."""
    runner = worlds.runner(task)
    default = shifts.workspace(runner.env.default_params())
    counts = np.arange(worlds.WORLDS) % (MAX_DISTRACTORS + 1)
    params = dataclasses.replace(
        repeat_params(default, worlds.WORLDS), distractors=jnp.asarray(counts, jnp.float32)
    )
    bodies = [runner.env.mj_model.body(name).id for name in DISTRACTORS]
    for seed in range(8):
        state = runner._place(worlds.keys(seed), params)
        pos = np.asarray(state.data.xpos)[:, bodies]
        shown = np.arange(MAX_DISTRACTORS) < counts[:, None]
        assert (pos[~shown, 2] < -0.5).all()
        np.testing.assert_allclose(pos[shown, 2], TABLE_HEIGHT, atol=1e-6)
        assert (pos[shown, :2] >= shifts.TEST_LOW - 1e-6).all()
        assert (pos[shown, :2] <= shifts.TEST_HIGH + 1e-6).all()
        away = np.linalg.norm(pos[..., :2] - np.asarray(state.object_start)[:, None, :2], axis=-1)
        assert away[shown].min() >= TARGET_DISTANCE - 1e-6, away[shown].min()
        for world in np.flatnonzero(counts > 1):
            xy = pos[world, : counts[world], :2]
            gaps = np.linalg.norm(xy[:, None] - xy[None], axis=-1)[np.triu_indices(len(xy), 1)]
            assert gaps.min() > 0.06, (seed, world)
    # More of them leave the first ones, and everything else of the scene, where they were.
    full = runner._place(worlds.keys(7), worlds.params(runner.env, "workspace+distractors"))
    np.testing.assert_array_equal(np.asarray(full.data.xpos)[:, bodies][shown], pos[shown])
    np.testing.assert_array_equal(full.data.qpos, state.data.qpos)


def test_distractors_are_seen_and_hide_little(world: tuple[State, EnvParams]) -> None:
    state, params = world
    _, names = picture(state, params)
    for name in ("mug_cup", "block_cube", "ball_sphere", "dumbbell_left"):
        assert (names == name).sum() >= 5, name
    runner = worlds.runner("lift_spam")
    error = {}
    for domain in ("workspace", "workspace+distractors"):
        placed = runner.reset(worlds.keys(9), worlds.params(runner.env, domain))
        assert placed.seen.all()
        off = np.asarray(placed.located - placed.object_start[:, :2])
        error[domain] = np.linalg.norm(off, axis=-1)
    assert error["workspace+distractors"].max() < 0.02
    assert np.median(error["workspace+distractors"] - error["workspace"]) < 1e-3


def believed(camera: Any, params: EnvParams) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics and pose of the miscalibrated camera, in float64."""
    vector = np.asarray(params.calibration_rotation, np.float64)
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    error = np.eye(4)
    error[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    error[:3, 3] = params.calibration_translation
    matrix = np.asarray(camera.K, np.float64)
    matrix[:2, 2] += params.calibration_pixels
    return matrix, np.asarray(camera.cam_to_world, np.float64) @ error


OFF = {
    "calibration_pixels": jnp.array([8.0, -12.0]),
    "calibration_rotation": jnp.array([0.02, -0.03, 0.05]),
    "calibration_translation": jnp.array([0.02, -0.01, 0.03]),
}


def test_pixels_of_miscalibration_move_the_window_by_as_much(
    world: tuple[State, EnvParams],
) -> None:
    """The window of the true picture, (8, -12) pixels away; what the policy is told stays."""
    state, params = world
    env = worlds.runner("lift_spam").env
    spec = AlignSpec(crop=200, offset=(0, 40), size=50, overlay=False)  # a quarter of the frame
    off = dataclasses.replace(params, calibration_pixels=OFF["calibration_pixels"])
    camera = spec.view_camera(env.camera(state, params, frame=PAPER_FRAME))
    full = np.asarray(jax.jit(lambda s, p: render(env.scene(s, p), camera).rgb)(state, params))
    uv, _ = project(camera.K, camera.cam_to_world, np.asarray(env.tcp(state))[:3, 3])
    observe = jax.jit(lambda s, p: env.observe(s, p, spec, frame=PAPER_FRAME))
    seen, shifted = observe(state, params), observe(state, off)
    np.testing.assert_array_equal(seen.image, crop(full, uv, 50, (0, 10)))
    np.testing.assert_array_equal(shifted.image, crop(full, uv + (2, -3), 50, (0, 10)))
    np.testing.assert_array_equal(shifted.proprio, seen.proprio)


def test_a_policy_believes_in_the_miscalibrated_camera(world: tuple[State, EnvParams]) -> None:
    """Proprioception, the window and the overlay's camera; the picture is the true one's."""
    state, params = world
    env = worlds.runner("lift_spam").env
    off = dataclasses.replace(params, **OFF)
    matrix, pose = believed(env.camera(state, params), off)
    camera = env.calibrated_camera(state, off)
    np.testing.assert_allclose(camera.K, matrix, atol=1e-3)
    np.testing.assert_allclose(camera.cam_to_world, pose, atol=1e-6)
    true, same = env.camera(state, off), env.calibrated_camera(state, params)
    for got in (true, same):
        np.testing.assert_array_equal(got.K, env.camera(state, params).K)
        np.testing.assert_array_equal(got.cam_to_world, state.camera_to_world)
    # The frame is turned so far that a policy is told so.
    tcp = np.asarray(env.tcp(state), np.float64)
    seen = jax.jit(lambda s, p: env.observe(s, p, worlds.SPEC))(state, off)
    np.testing.assert_allclose(
        seen.proprio[:6], rotation_6d(pose[:3, :3].T @ tcp[:3, :3]), atol=1e-5
    )
    window = env.window_camera(state, off, worlds.SPEC)
    uv, _ = project(window.K, pose, tcp[:3, 3])
    np.testing.assert_allclose(uv, [42, 42 - 40 * 84 / 200], atol=1.0)  # whole pixels
    np.testing.assert_array_equal(picture(state, off)[0], picture(state, params)[0])


def test_the_global_policy_locates_with_the_miscalibrated_camera() -> None:
    """The target is found where its true pixel lies on the believed camera's ray."""
    runner = worlds.runner("lift_spam")
    env, default = runner.env, runner.env.default_params()
    off = dataclasses.replace(default, **OFF)
    good, bad = (
        runner.reset(worlds.keys(8), repeat_params(p, worlds.WORLDS)) for p in (default, off)
    )
    height = env.task.stages[0].target_height
    for world in range(worlds.WORLDS):
        camera = env.camera(jax.tree.map(lambda x, w=world: x[w], good), default)
        uv, _ = project(camera.K, camera.cam_to_world, np.append(good.located[world], height))
        matrix, pose = believed(camera, off)
        ray = pose[:3, :3] @ np.linalg.solve(matrix, np.append(uv, 1))
        point = pose[:3, 3] + ray * (height - pose[2, 3]) / ray[2]
        np.testing.assert_allclose(bad.located[world], point[:2], atol=2e-4)
    assert np.linalg.norm(bad.located - good.located, axis=-1).min() > 0.01
    np.testing.assert_array_equal(bad.object_start, good.object_start)


def test_axes_compile_nothing_new() -> None:
    """A shift is data: one reset and one observation of every axis, with the programs of old."""
    runner = worlds.runner("lift_spam")
    pieces = {"place", "locate", "reposition", "observe"}
    names: list[str] = []
    for name in ("in_domain", *EVERY):
        many = shifts.scenes(jax.random.key(0), runner.env.default_params(), name, worlds.WORLDS)
        with compilations() as compiled:
            seen = runner.observe(runner.reset(worlds.keys(0), many), many, worlds.SPEC)
        assert seen.image.shape == (worlds.WORLDS, 84, 84, 3)
        names += [n for n in compiled if n in pieces] if name != "in_domain" else []
    assert not names


@pytest.mark.parametrize("task", worlds.TASKS)
@pytest.mark.parametrize("domain", ["in_domain", "workspace+viewpoint"])
def test_scenes_of_a_key_are_those_of_earlier_versions(task: str, domain: str) -> None:
    """Recorded before there were distractors and axes: nothing that was drawn has changed."""
    with np.load(GOLDEN / "scenes.npz") as file:
        golden = {k.split("/")[2]: file[k] for k in file if k.startswith(f"{task}/{domain}/")}
    runner = worlds.runner(task)
    params = worlds.params(runner.env, domain)
    state = runner.reset(worlds.keys(21), params)
    np.testing.assert_allclose(state.object_start, golden["object_start"], atol=1e-6)
    np.testing.assert_allclose(state.located, golden["located"], atol=1e-5)
    np.testing.assert_allclose(state.camera_to_world, golden["camera"], atol=1e-6)
    np.testing.assert_allclose(worlds.tcp(runner.env, state), golden["tcp"], atol=1e-4)
    if "image" in golden:
        seen = np.asarray(runner.observe(state, params, worlds.SPEC).image)
        count = len(golden["image"])
        off = np.abs(seen[:count].astype(int) - golden["image"]).max(-1) > 1
        assert off.mean() <= 1e-3  # an edge may fall on either side
