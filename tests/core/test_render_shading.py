"""Colours from first principles, shadows in windows, odd worlds, derivatives, memory, bad input."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from render_worlds import away_from_edges, camera_at, cast, random_model, scene_of

from palm_jax.render import (
    OUTPUTS,
    PRIMITIVES,
    TEXTURES,
    Window,
    make_lights,
    make_scene,
    render,
)

CAMERA = camera_at([1.6, 0.9, 1.2], [0.0, 0.0, 0.1], 40, 50)
SKY = np.array([[0.9, 0.6, 0.3], [0.1, 0.3, 0.8]], np.float32)


def lamps(**options):
    """A sun and a lamp; the same static fields everywhere, so that programs are shared."""
    options = {"dir": [0.5, 0.2, -1.0], "pos": [-0.5, 0.4, 1.5], "ambient": 0.3} | options
    return make_lights(**options)


def still_life(**options):
    """A ball and a block on the floor."""
    options = {"specular": 0.0, "background": SKY, "lights": lamps()} | options
    return make_scene(
        ["box", "plane", "sphere"],
        pos=[[0.4, -0.3, 0.15], [0, 0, 0], [0, 0.1, 0.3]],
        mat=np.stack([np.eye(3)] * 3),
        size=[[0.2, 0.1, 0.15], [0, 0, 0], [0.3, 0, 0]],
        rgb=[[0.2, 0.3, 0.9], [0.5, 0.6, 0.7], [0.9, 0.2, 0.1]],
        ids=[30, 10, 20],
        **options,
    )


@functools.cache
def drawn(outputs=OUTPUTS, shadows=True):
    return jax.jit(lambda s, c: render(s, c, outputs=outputs, shadows=shadows))


@functools.cache
def windowed():
    return jax.jit(
        lambda s, c, o: render(s, c, Window(o, 17, 23), outputs=("rgb", "depth"), shadows=True)
    )


def unit(vector):
    return np.asarray(vector, float) / np.linalg.norm(vector)


def floor_points(camera, depth):
    """World xy of the floor under each pixel, from depth."""
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = np.stack([column, row, np.ones_like(row)], -1)
    rays = pixels @ np.linalg.inv(np.asarray(camera.K, float)).T
    pose = np.asarray(camera.cam_to_world, float)
    return (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]


def test_floor_has_diffuse_specular_and_shadow():
    sun = np.array([0.5, 0.2, -1.0])
    on, off = [1.0] * 3, [0.0] * 3
    lights = lamps(
        dir=sun,
        diffuse=0.6 * np.array([on, off]),
        specular=0.5 * np.array([on, off]),
        ambient=[0.2, 0.3, 0.4],
    )
    scene = still_life(lights=lights)
    scene = dataclasses.replace(
        scene, specular=jnp.float32([0, 0.8, 0]), shininess=jnp.float32([0.1] * 3)
    )
    frame = jax.tree.map(np.asarray, drawn()(scene, CAMERA))
    floor = frame.segmentation == 10
    points = floor_points(CAMERA, np.where(floor, frame.depth, 0.0))
    assert np.abs(points[floor][:, 2]).max() < 1e-5
    to_light, to_eye = -unit(sun), CAMERA.cam_to_world[:3, 3] - points
    to_eye = to_eye / np.maximum(np.linalg.norm(to_eye, axis=-1, keepdims=True), 1e-9)
    half = to_eye + to_light
    shine = half[..., 2] / np.linalg.norm(half, axis=-1)
    quotient = shine / (6.4 - 6.4 * shine + shine)
    colour = np.array([0.5, 0.6, 0.7])
    lit = colour * (np.array([0.2, 0.3, 0.4]) + 0.6 * to_light[2])
    lit = lit + (0.8 * 0.5 * quotient**2)[..., None]
    # A point is in the ball's shadow where the line to the sun passes the ball's centre closely.
    from_ball = points - [0, 0.1, 0.3]
    gap = np.linalg.norm(np.cross(from_ball, to_light), axis=-1) - 0.3
    dark = np.abs(frame.radiance - colour * np.array([0.2, 0.3, 0.4])).max(-1) < 1e-4
    bright = np.abs(frame.radiance - np.minimum(lit, 1)).max(-1) < 1e-4
    assert (dark | bright)[floor].all()
    assert dark[floor & (gap < -1e-3)].all() and (floor & (gap < -1e-3)).sum() > 20
    assert bright[floor].sum() > 200


def test_sky_runs_from_horizon_to_zenith():
    up = dataclasses.replace(CAMERA, cam_to_world=np.eye(4, dtype=np.float32))
    frame = drawn()(still_life(visible=False), up)
    assert (np.asarray(frame.segmentation) == -1).all() and np.isinf(frame.depth).all()
    centre = np.asarray(frame.radiance)[17, 26]
    np.testing.assert_allclose(centre, SKY[1], atol=2e-3)
    down = dataclasses.replace(up, cam_to_world=np.diag([1, -1, -1, 1]).astype(np.float32))
    below = np.asarray(drawn()(still_life(visible=False), down).radiance)
    np.testing.assert_allclose(below, np.broadcast_to(SKY[0], below.shape), atol=1e-6)


def test_shadows_have_the_same_bits_in_a_window():
    scene = still_life()
    full = drawn()(scene, CAMERA)
    for origin in ((0, 0), (3, 11), (23, 27), (14, 5)):
        part = windowed()(scene, CAMERA, jnp.array(origin))
        rows, columns = slice(origin[0], origin[0] + 17), slice(origin[1], origin[1] + 23)
        for name in ("rgb", "depth"):
            whole = np.asarray(getattr(full, name))[rows, columns]
            np.testing.assert_array_equal(np.asarray(getattr(part, name)), whole, err_msg=name)


def test_textures_mix_the_two_colours():
    lights = make_lights(diffuse=0.0, specular=0.0, ambient=1.0)
    rgb, rgb2 = np.array([1.0, 0.5, 0.0]), np.array([0.0, 0.5, 1.0])
    kinds = [name for name in TEXTURES if name != "none"]
    scene = make_scene(
        ["plane"] * 3,
        pos=[[0, 1.2 * i - 1.2, 0] for i in range(3)],
        mat=np.stack([np.eye(3)] * 3),
        size=[[0.6, 0.5, 1]] * 3,
        rgb=[rgb] * 3,
        rgb2=[rgb2] * 3,
        textures=kinds,
        texture_scale=0.25,
        lights=lights,
    )
    above = camera_at([0.01, 0.0, 4.0], [0, 0, 0], 150, 150, fovy=60)
    frame = jax.jit(lambda s, c: render(s, c, outputs=("radiance", "depth", "segmentation")))(
        scene, above
    )
    colour, ids = np.asarray(frame.radiance), np.asarray(frame.segmentation)
    weight = colour[..., 2]
    seen = ids >= 0
    np.testing.assert_allclose(colour[seen][:, 0], 1 - colour[seen][:, 2], atol=1e-5)
    for i, kind in enumerate(kinds):
        inside = weight[away_from_edges(ids) & (ids == i)]
        assert inside.std() > 0.05 and 0.1 < inside.mean() < 0.9, kind
    board = seen & (ids == kinds.index("checker"))
    points = floor_points(above, np.where(board, np.asarray(frame.depth), 0.0))
    squares = (points - [0, -1.2, 0])[..., :2] / 0.25
    even = np.floor(squares).sum(-1) % 2 == 1
    clear = board & (np.abs(squares - np.round(squares)).min(-1) > 0.05)
    assert ((weight > 0.5) == even)[clear].all()


def test_worlds_gone_wrong_are_not_seen():
    scene = still_life()
    draw = drawn()
    sound = draw(scene, CAMERA)
    for change in (
        {"pos": scene.pos.at[2, 1].set(jnp.nan)},
        {"mat": scene.mat.at[2, 0, 0].set(jnp.inf)},
        {"size": scene.size.at[2, 0].set(-1.0)},
        {"size": scene.size.at[2, 0].set(jnp.nan)},
        {"visible": jnp.array([True, True, False])},
        # The camera inside the ball, and the ball behind the camera: neither shows.
        {"pos": scene.pos.at[2].set(jnp.array([1.6, 0.9, 1.1]))},
        {"pos": scene.pos.at[2].set(jnp.array([2.6, 1.5, 1.9]))},
        # A ball of no size.
        {"size": scene.size.at[2, 0].set(0.0)},
    ):
        frame = draw(dataclasses.replace(scene, **change), CAMERA)
        ids = np.asarray(frame.segmentation)
        assert 20 not in ids and {10, 30} <= set(ids.flat), change
        assert np.isfinite(frame.radiance).all() and not np.isnan(frame.depth).any()
        block = (ids == 30) & (np.asarray(sound.segmentation) == 30)
        assert block.sum() > 50
        np.testing.assert_array_equal(
            np.asarray(frame.depth)[block], np.asarray(sound.depth)[block]
        )


def test_a_lost_camera_sees_nothing():
    for field in ("K", "cam_to_world"):
        lost = dataclasses.replace(CAMERA, **{field: getattr(CAMERA, field) * np.float32(np.nan)})
        frame = drawn()(still_life(), lost)
        assert (np.asarray(frame.segmentation) == -1).all() and np.isinf(frame.depth).all()
        assert np.isfinite(frame.radiance).all()


def test_derivatives_of_depth_are_those_of_mujoco_rays():
    model, data = random_model(11, per_type=2)
    camera = camera_at([2.1, 1.7, 1.6], [0.0, 0.0, 0.5], 40, 50)
    scene = scene_of(model, data)
    way = np.random.default_rng(0).normal(size=data.geom_xpos.shape)

    def depth(pos):
        return render(dataclasses.replace(scene, pos=pos), camera, outputs=("depth",)).depth

    direction = jnp.asarray(way, jnp.float32)
    _, slope = jax.jit(lambda pos: jax.jvp(depth, (pos,), (direction,)))(scene.pos)
    step, start, around = 1e-5, data.geom_xpos.copy(), []
    for sign in (1, -1):
        data.geom_xpos[:] = start + sign * step * way
        around.append(cast(model, data, camera))
    same = (around[0][0] == around[1][0]) & away_from_edges(around[0][0]) & (around[0][0] >= 0)
    expected = (around[0][1] - around[1][1])[same] / (2 * step)
    assert same.sum() > 500
    # Where a ray grazes or the finite difference crosses an edge of a box, the two differ.
    error = np.abs(np.asarray(slope)[same] - expected) / (1 + np.abs(expected))
    assert np.quantile(error, 0.97) < 5e-3


def test_gradients_are_finite_and_batch():
    scene = still_life(lights=make_lights(pos=[0.5, 0.5, 2.0]))

    def loss(pos, size, rgb):
        moved = dataclasses.replace(scene, pos=pos, size=size, rgb=rgb)
        frame = render(moved, CAMERA, outputs=("depth", "radiance"))
        return jnp.where(jnp.isfinite(frame.depth), frame.depth, 0).mean() + frame.radiance.mean()

    lost = scene.pos.at[2, 0].set(jnp.nan)
    positions = jnp.stack([scene.pos, scene.pos + 0.01, lost])
    gradients = jax.jit(jax.vmap(jax.grad(loss, (0, 1, 2)), (0, None, None)))(
        positions, scene.size, scene.rgb
    )
    pos, size, rgb = (np.asarray(g) for g in gradients)
    assert all(np.isfinite(g).all() for g in (pos, size, rgb))
    assert (rgb[:2, 0] > 0).all() and (pos[2, 2] == 0).all()
    # A bigger ball is nearer.
    assert (size[:2, 2, 0] < 0).all() and (size[:, 2, 1:] == 0).all()


@pytest.mark.parametrize(
    "backend, output, bytes_per_pixel", [("tiled", "rgb", 24), ("fused", "segmentation", 72)]
)
def test_nothing_of_size_rays_by_geoms_is_stored(backend, output, bytes_per_pixel):
    worlds, side = 32, 84
    model, data = random_model(5, per_type=7)
    scene = scene_of(model, data)
    camera = camera_at([2.1, 1.7, 1.6], [0, 0, 0.5], side, side)

    def draw(pos):
        moved = dataclasses.replace(scene, pos=pos)
        return render(moved, camera, outputs=(output,), backend=backend)

    compiled = jax.jit(jax.vmap(draw)).lower(jnp.stack([scene.pos] * worlds)).compile()
    pixels = worlds * side * side
    # A float32 for every ray and geom would be twice what the accelerators' form may use.
    assert 4 * model.ngeom > 2 * bytes_per_pixel
    assert compiled.memory_analysis().temp_size_in_bytes < bytes_per_pixel * pixels
    assert "rsqrt" not in compiled.as_text(), "an approximate instruction: not the same everywhere"


def test_form_is_chosen_by_platform(monkeypatch):
    # As on a machine with an accelerator, where the choice is left to the compiled program.
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    window = Window(jnp.array([12, 14]), 13, 11)

    def ids(backend):
        return render(
            still_life(), CAMERA, window, outputs=("segmentation",), backend=backend
        ).segmentation

    auto = ids("auto")
    assert len(np.unique(auto)) > 1
    np.testing.assert_array_equal(auto, ids("tiled"))


def test_bad_input_is_named():
    scene = still_life()
    for names, known in (
        (["cone", "box", "box"], PRIMITIVES),
        (["sphere"] * 2 + ["mesh"], PRIMITIVES),
    ):
        with pytest.raises(ValueError, match=", ".join(known)):
            make_scene(names, scene.pos, scene.mat, scene.size, scene.rgb)
    with pytest.raises(ValueError, match=r"Scene.mat: expected shape \[3, 3, 3\], got \[3, 9\]"):
        make_scene(scene.types, scene.pos, scene.mat.reshape(3, 9), scene.size, scene.rgb)
    with pytest.raises(ValueError, match=r"rgb2: .*broadcasts to \[3, 3\], got \[2\]"):
        make_scene(scene.types, scene.pos, scene.mat, scene.size, scene.rgb, rgb2=[0.1, 0.2])
    with pytest.raises(ValueError, match="unknown texture 'marble'; known: none, checker"):
        still_life(textures=["marble"] * 3)
    with pytest.raises(ValueError, match="expected 3 entries as in Scene.types, got 1"):
        render(dataclasses.replace(scene, ids=(1,)), CAMERA)
    with pytest.raises(ValueError, match="unknown output 'depths'; known: rgb, radiance, depth"):
        render(scene, CAMERA, outputs=("depths",))
    with pytest.raises(ValueError, match="unknown backend 'gpu'; known: auto, tiled, fused"):
        render(scene, CAMERA, backend="gpu")
    with pytest.raises(ValueError, match=r"Camera.K: expected shape \[3, 3\], got \[2, 3, 3\]"):
        batched = dataclasses.replace(CAMERA, K=np.stack([CAMERA.K] * 2))
        jax.eval_shape(lambda c: render(scene, c), batched)
    with pytest.raises(TypeError, match="Window.origin holds whole pixels"):
        render(scene, CAMERA, Window(jnp.array([0.5, 1.0]), 4, 4))
    with pytest.raises(ValueError, match="Window.height: expected a Python int of at least 1"):
        render(scene, CAMERA, Window(jnp.array([0, 1]), 0, 4))
    with pytest.raises(ValueError, match="empty"):
        make_scene([], np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 3)))
