"""The same scenes by MuJoCo's OpenGL renderer, MuJoCo Warp and MJX-Warp.

Every renderer gets the same model, camera, joint positions and lights, and draws the same number of
pixels; `segmentation` says what it saw, which is compared before the speed is.
"""

import copy
import functools
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from benchmarks.peers import imported

CAMERA = "bench"
GROUPS = (0, 1, 2)  # collision geoms are in group 3


class Job(NamedTuple):
    """What is drawn."""

    model: mujoco.MjModel  # with a camera of the name CAMERA
    qpos: np.ndarray  # [W, nq]
    mocap_pos: np.ndarray  # [W, m, 3]
    mocap_quat: np.ndarray  # [W, m, 4]
    side: int  # pixels
    shadows: bool


class Renderer(NamedTuple):
    """One package at one setting."""

    rgb: Callable[[], Any]  # draws all worlds
    segmentation: Callable[[], np.ndarray]  # int [W, side, side], geom ids, -1 for the background


def peers(job: Job) -> dict[str, Renderer]:
    """By name; what is not installed, or has no OpenGL here, is left out."""
    found = {}
    warp = imported("Warp", "warp")
    if warp:
        warp[0].config.quiet = True  # it tells of every kernel that it compiles
    for name, modules, build in (
        ("mujoco.Renderer", (), functools.partial(_opengl, plain=True)),
        ("mujoco.Renderer, its defaults", (), functools.partial(_opengl, plain=False)),
        ("mujoco_warp", ("warp", "mujoco_warp"), _mujoco_warp),
        ("mjx.render", ("warp", "mujoco.mjx"), _mjx_warp),
    ):
        ready = imported(name, *modules)
        made = None if ready is None else build(*ready, job)
        if made is not None:
            found[name] = made
    return found


# -- OpenGL, a world at a time ---------------------------------------------------------------------


def _opengl(job: Job, *, plain: bool) -> Renderer | None:
    """`plain`: without antialiasing, shadows only if asked for, and then with a small map."""
    if not plain and not job.shadows:
        return None  # its defaults have shadows
    model = copy.copy(job.model)
    if plain:
        model.vis.quality.offsamples = 0
        model.vis.quality.shadowsize = 512
    else:
        model.vis.quality.offsamples, model.vis.quality.shadowsize = 4, 4096
    try:
        renderer = mujoco.Renderer(model, job.side, job.side)
    except Exception as error:  # EGL says it in many ways
        print(f"  without mujoco.Renderer: {error}", file=sys.stderr)
        return None
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = job.shadows
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
    data, option = mujoco.MjData(model), mujoco.MjvOption()
    option.geomgroup[:] = [group in GROUPS for group in range(len(option.geomgroup))]

    def draw() -> np.ndarray:
        frames = []
        for world in range(len(job.qpos)):
            data.qpos[:] = job.qpos[world]
            data.mocap_pos[:], data.mocap_quat[:] = job.mocap_pos[world], job.mocap_quat[world]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, CAMERA, option)
            frames.append(renderer.render())
        return np.stack(frames)

    def segmentation() -> np.ndarray:
        renderer.enable_segmentation_rendering()
        found = draw()
        renderer.disable_segmentation_rendering()
        return np.where(found[..., 1] == mujoco.mjtObj.mjOBJ_GEOM, found[..., 0], -1)

    return Renderer(draw, segmentation)


# -- Warp ------------------------------------------------------------------------------------------


def _options(job: Job, **options: Any) -> dict[str, Any]:
    return {
        "cam_res": (job.side, job.side),
        "use_textures": False,
        "use_shadows": job.shadows,
        "enabled_geom_groups": list(GROUPS),
        **options,
    }


def _mujoco_warp(warp: Any, mujoco_warp: Any, job: Job) -> Renderer:
    worlds, data = len(job.qpos), mujoco.MjData(job.model)
    mujoco.mj_forward(job.model, data)
    model = mujoco_warp.put_model(job.model)
    state = mujoco_warp.put_data(job.model, data, nworld=worlds)
    state.qpos.assign(job.qpos.astype(np.float32))
    state.mocap_pos.assign(job.mocap_pos.astype(np.float32))
    state.mocap_quat.assign(job.mocap_quat.astype(np.float32))

    def drawn(context: Any) -> None:
        mujoco_warp.kinematics(model, state)
        mujoco_warp.camlight(model, state)
        mujoco_warp.refit_bvh(model, state, context)
        mujoco_warp.render(model, state, context)
        warp.synchronize()

    colour = mujoco_warp.create_render_context(
        job.model, nworld=worlds, **_options(job, render_rgb=True)
    )
    labels = mujoco_warp.create_render_context(
        job.model, nworld=worlds, **_options(job, render_rgb=False, render_seg=True)
    )

    def segmentation() -> np.ndarray:
        drawn(labels)
        return _labels(labels.seg_data.numpy(), job)

    def draw() -> Any:
        drawn(colour)
        return colour.rgb_data.numpy()

    return Renderer(draw, segmentation)


def _mjx_warp(warp: Any, mjx: Any, job: Job) -> Renderer:
    del warp
    worlds = len(job.qpos)
    model = mjx.put_model(job.model, impl="warp")
    data = jax.vmap(lambda _: mjx.make_data(job.model, impl="warp"))(jnp.arange(worlds))
    data = data.replace(
        qpos=jnp.asarray(job.qpos, jnp.float32),
        mocap_pos=jnp.asarray(job.mocap_pos, jnp.float32),
        mocap_quat=jnp.asarray(job.mocap_quat, jnp.float32),
    )
    data = jax.jit(jax.vmap(mjx.forward, in_axes=(None, 0)))(model, data)
    context = mjx.create_render_context(
        job.model, nworld=worlds, **_options(job, render_rgb=True, render_seg=True)
    )
    handle = context.pytree()

    @jax.jit
    def render(data: Any) -> Any:
        return mjx.render(model, mjx.refit_bvh(model, data, handle), handle)[0]

    @jax.jit
    def labels(data: Any) -> Any:
        refitted = mjx.refit_bvh(model, data, handle)
        return mjx.render_with_segmentation(model, refitted, handle)[2]

    # The closure keeps the context alive: its buffers go with it.
    return Renderer(
        lambda context=context: render(data),
        lambda context=context: _labels(np.asarray(labels(data)), job),
    )


def _labels(packed: np.ndarray, job: Job) -> np.ndarray:
    """Geom ids of a buffer of segmentation, whose pixels are (id, kind) pairs or ids alone."""
    ids = packed[..., 0] if packed.ndim == 3 and packed.shape[-1] == 2 else packed
    return ids.reshape(len(job.qpos), -1)[:, -(job.side**2) :].reshape(-1, job.side, job.side)
