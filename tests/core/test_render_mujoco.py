"""The renderer against C MuJoCo: ids, depth, normals, shadows, and its OpenGL segmentation."""

import functools
import os
import subprocess
import sys

import jax
import mujoco
import numpy as np
import pytest
from render_worlds import away_from_edges, camera_at, cast, pixel_rays, random_model, scene_of

from palm_jax.render import make_lights, render

OUTPUTS = ("rgb", "radiance", "depth", "segmentation")
SUN, LAMP = np.array([0.4, 0.25, -1.0]), np.array([0.9, -1.2, 2.4])
AMBIENT, SUNSHINE, LAMPLIGHT, ALBEDO = 0.3, 0.45, 0.2, 0.8


@functools.cache
def world():
    model, data = random_model(7)
    lights = make_lights(
        dir=SUN, pos=LAMP, diffuse=[[SUNSHINE] * 3, [LAMPLIGHT] * 3], specular=0.0, ambient=AMBIENT
    )
    return model, data, scene_of(model, data, rgb=np.full((model.ngeom, 3), ALBEDO), lights=lights)


@functools.cache
def drawn(backend="auto"):
    return jax.jit(
        lambda scene, camera: render(scene, camera, outputs=OUTPUTS, shadows=True, backend=backend)
    )


VIEWS = {
    "corner": camera_at([2.1, 1.7, 1.6], [0.0, 0.0, 0.5]),
    "low": camera_at([-2.4, 0.3, 0.5], [0.0, 0.0, 0.6], skew=3.0),
    "above": camera_at([0.1, -0.2, 3.2], [0.0, 0.05, 0.4], fovy=40.0),
    "between": camera_at([0.0, -1.5, 0.9], [0.1, 1.0, 0.6], fovy=70.0),
}


@pytest.mark.parametrize("view", VIEWS)
def test_ids_and_depth_are_those_of_mujoco(view):
    model, data, scene = world()
    ids, depth, _ = cast(model, data, VIEWS[view])
    frame = drawn()(scene, VIEWS[view])
    inside = away_from_edges(ids)
    assert inside.sum() > 1000 and len(np.unique(ids)) > 8
    same = np.asarray(frame.segmentation) == ids
    assert same[inside].mean() > 0.995
    assert same.mean() > 0.99
    near = same & (depth < 10)
    np.testing.assert_allclose(np.asarray(frame.depth)[near], depth[near], atol=1e-4)
    assert np.all(np.isinf(frame.depth) == (np.asarray(frame.segmentation) < 0))


def sunlit(model, data, points, ids, towards, limit):
    """bool [n]: a ray from each point to the light misses all but the point's own geom."""
    clear = np.zeros(len(points), bool)
    hit = np.zeros(1, np.int32)
    for i, (point, own, way, far) in enumerate(zip(points, ids, towards, limit, strict=True)):
        start, left = point.copy(), far
        while True:
            distance = mujoco.mj_ray(model, data, start, way, None, True, -1, hit)
            if hit[0] != own or distance < 0 or distance > left:
                break
            # Only another geom counts: step past the near side of the own one.
            start, left = start + (distance + 1e-5) * way, left - distance - 1e-5
        clear[i] = hit[0] < 0 or distance > left
    return clear


def test_light_and_shadow_follow_from_mujoco_rays():
    model, data, scene = world()
    camera = VIEWS["corner"]
    ids, depth, normals = cast(model, data, camera)
    frame = drawn()(scene, camera)
    # The own geom counts as clear here: convex, it hides only what faces away.
    chosen = np.argwhere(away_from_edges(ids) & (ids >= 0))[::5]
    row, column = chosen.T
    eye = np.asarray(camera.cam_to_world, float)[:3, 3]
    points = eye + (pixel_rays(camera) * np.where(depth < 1e9, depth, 0)[..., None])[row, column]
    normal, own = normals[row, column], ids[row, column]
    expected = ALBEDO * AMBIENT * (0.8 + 0.2 * normal[:, 2])
    shaded = 0
    for strength, offset in ((SUNSHINE, None), (LAMPLIGHT, LAMP)):
        way = np.broadcast_to(-SUN, points.shape) if offset is None else offset - points
        far = np.linalg.norm(way, axis=1)
        way = way / far[:, None]
        limit = np.full(len(points), np.inf) if offset is None else far
        clear = sunlit(model, data, points + 1e-5 * normal, own, way, limit)
        cosine = (normal * way).sum(1)
        shaded += int((~clear & (cosine > 0)).sum())
        expected += ALBEDO * strength * np.maximum(cosine, 0) * clear
    got = np.asarray(frame.radiance)[row, column, 0]
    assert shaded > 50
    assert (np.abs(got - expected) < 2e-3).mean() > 0.97


def test_rgb_is_radiance_rounded():
    _, _, scene = world()
    frame = drawn()(scene, VIEWS["corner"])
    assert frame.rgb.dtype == np.uint8
    rounded = np.floor(np.asarray(frame.radiance) * np.float32(255) + np.float32(0.5))
    np.testing.assert_array_equal(frame.rgb, rounded.astype(np.uint8))


def test_accelerator_form_agrees():
    _, _, scene = world()
    for view in ("corner", "low"):
        tiled, fused = drawn()(scene, VIEWS[view]), drawn("fused")(scene, VIEWS[view])
        assert (np.asarray(tiled.segmentation) == np.asarray(fused.segmentation)).mean() > 0.999
        off = np.abs(np.asarray(tiled.rgb, int) - np.asarray(fused.rgb, int)).max(-1)
        assert (off <= 1).mean() > 0.995


NO_OPENGL = 77  # exit code of the program below where the machine has no EGL to draw with
OPENGL = f"""
import sys, numpy as np
try:
    import mujoco
    mujoco.GLContext(8, 8).make_current()
except Exception as error:
    print(error, file=sys.stderr)
    sys.exit({NO_OPENGL})
model = mujoco.MjModel.from_binary_path(sys.argv[1])
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 240, 320) as renderer:
    renderer.enable_segmentation_rendering()
    renderer.update_scene(data, "view")
    found = renderer.render()
np.save(sys.argv[2], np.where(found[..., 1] == mujoco.mjtObj.mjOBJ_GEOM, found[..., 0], -1))
"""


def test_segmentation_is_that_of_mujocos_opengl(tmp_path):
    spec = mujoco.MjSpec()
    pose = np.asarray(VIEWS["corner"].cam_to_world, float)
    axes = np.stack([pose[:3, 0], -pose[:3, 1], -pose[:3, 2]], 1)
    turn = np.zeros(4)
    mujoco.mju_mat2Quat(turn, axes.reshape(-1))
    spec.worldbody.add_camera(name="view", pos=pose[:3, 3], quat=turn, fovy=50.0)
    for geom in scene_geoms():
        spec.worldbody.add_geom(**geom)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mujoco.mj_saveModel(model, str(tmp_path / "model.mjb"), None)
    done = subprocess.run(
        [sys.executable, "-c", OPENGL, str(tmp_path / "model.mjb"), str(tmp_path / "ids.npy")],
        env=os.environ | {"MUJOCO_GL": "egl"},
        capture_output=True,
        text=True,
    )
    if done.returncode == NO_OPENGL:
        pytest.skip(f"no EGL on this machine, which nothing else needs: {done.stderr[-200:]}")
    assert done.returncode == 0, done.stderr
    focal = 240 / 2 / np.tan(np.deg2rad(50.0) / 2)
    intrinsics = np.array([[focal, 0, 160], [0, focal, 120], [0, 0, 1]], np.float32)
    camera = type(VIEWS["corner"])(intrinsics, pose.astype(np.float32), 240, 320)
    frame = jax.jit(lambda s, c: render(s, c, outputs=("segmentation",)))(
        scene_of(model, data), camera
    )
    theirs = np.load(tmp_path / "ids.npy")
    inside = away_from_edges(theirs)
    assert set(range(model.ngeom)) <= set(np.unique(theirs))
    assert (np.asarray(frame.segmentation) == theirs)[inside].mean() > 0.995


def scene_geoms():
    """One of each; MuJoCo's OpenGL draws round things as polyhedra, so none is thin."""
    kinds = ("sphere", "capsule", "ellipsoid", "cylinder", "box")
    types = {name: getattr(mujoco.mjtGeom, f"mjGEOM_{name.upper()}") for name in kinds}
    yield {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [3, 3, 1]}
    for i, (name, kind) in enumerate(types.items()):
        angle = 2 * np.pi * i / len(types)
        place = [0.7 * np.cos(angle), 0.7 * np.sin(angle), 0.5]
        yield {
            "name": name,
            "type": kind,
            "size": [0.2, 0.28, 0.15],
            "pos": place,
            "quat": [0.8, 0.3, 0.5, 0.1],
        }
