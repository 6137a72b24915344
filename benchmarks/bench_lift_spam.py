"""Rendering of the real scene: `lift_spam` as a policy sees it, and beside other renderers.

`windows`: the 84 x 84 windows round the TCP, lit rgb, of the widest domain (`frames_per_second`).
`beside`: the whole frame of the paper's camera, the same model, poses and lights for every
renderer, with and without shadows; what they see is compared first (`same_geom`: the share of
pixels away from edges that show the same geom as ours).
"""

from collections.abc import Iterator
from typing import Any

import jax
import mujoco
import numpy as np

from benchmarks.common import headline, measure, side_by_side
from benchmarks.peers import render as others
from palm_jax.align import AlignSpec, tcp_crop, window_origin
from palm_jax.align.camera import project
from palm_jax.envs import make, shifts
from palm_jax.envs.base import Env, EnvParams, State
from palm_jax.envs.rollout import Runner, repeat_params
from palm_jax.envs.world import build_spec
from palm_jax.render import Window, render

SIDES, WORLDS = (64, 84, 128), (1, 8, 64, 256)
SIDE, MANY = 84, 64
_SLOW_FROM = 100  # frames at a time: OpenGL draws them one after the other


def start(worlds: int, domain: str = "workspace+viewpoint") -> tuple[Env, State, EnvParams]:
    """Started episodes, [W]; those of the first `MANY` again where there are more."""
    env, several = make("lift_spam"), min(worlds, MANY)
    params = repeat_params(shifts.shifted(env.default_params(), domain), several)
    state = Runner(env, several).reset(jax.random.split(jax.random.key(0), several), params)
    index = np.arange(worlds) % several
    state, params = jax.tree.map(lambda leaf: leaf[index], (state, params))
    return env, state, params


def run(*, repeats: int = 10) -> dict[str, Any]:
    """Frames/s of the windows alone (`frames_per_second`), of the whole observation, of whole
    frames beside other renderers (`peers`: the fastest setting of each, without shadows)."""
    env, state, params = start(MANY)
    spec = AlignSpec(crop=env.task.crop, offset=(0, 40), size=SIDE)
    figures = side_by_side(_windows(env, state, params, spec), repeats=2 * repeats, items=MANY)
    see = jax.jit(jax.vmap(lambda s, p: env.observe(s, p, spec)))
    settings = list(_settings())
    beside = {
        f"{w} worlds, {s} px{', shadows' * on}": _beside(w, s, on, repeats) for w, s, on in settings
    }
    return {
        **headline(beside[f"{MANY} worlds, {SIDE} px"], "frames_per_second"),
        "frames_per_second": figures["window"]["per_second_median"],
        "windows": figures,
        "observations": measure(lambda: see(state, params), repeats=repeats, items=MANY),
        "beside": beside,
        "geoms": len(env.scene_model.geoms),
        "lights": len(env.scene_model.lights.direction),
    }


def _windows(env: Env, state: State, params: EnvParams, spec: AlignSpec) -> dict[str, Any]:
    """The window of a policy: rendered alone, with shadows, and cut out of the whole frame."""

    def window(state: State, params: EnvParams, shadows: bool) -> jax.Array | None:
        view = spec.view_camera(env.camera(state, params))
        origin, _ = window_origin(view, env.tcp(state), spec)
        part = Window(origin, spec.size, spec.size)
        return render(env.scene(state, params), view, part, shadows=shadows).rgb

    def cut(state: State, params: EnvParams) -> jax.Array:
        view = spec.view_camera(env.camera(state, params))
        uv, _ = project(view, env.tcp(state)[:3, 3])
        offset = np.asarray(spec.offset) * spec.scale
        return tcp_crop(render(env.scene(state, params), view).rgb, uv, spec.size, offset=offset)

    def drawn(function: Any) -> Any:
        compiled = jax.jit(jax.vmap(function))
        return lambda: compiled(state, params)

    return {
        "window": drawn(lambda s, p: window(s, p, False)),
        "window, shadows": drawn(lambda s, p: window(s, p, True)),
        "whole frame, then cut": drawn(cut),
    }


# -- beside other renderers ------------------------------------------------------------------------


def _settings() -> Iterator[tuple[int, int, bool]]:
    """Worlds, pixels, shadows."""
    yield from ((worlds, SIDE, False) for worlds in WORLDS)
    yield from ((MANY, side, False) for side in SIDES if side != SIDE)
    yield MANY, SIDE, True


def _beside(worlds: int, side: int, shadows: bool, repeats: int) -> dict[str, Any]:
    env, state, params = start(worlds, "workspace")
    renderers = {
        "palm_jax": _ours(env, state, params, side, shadows),
        **others.peers(_job(env, state, side, shadows)),
    }
    if worlds > _SLOW_FROM:
        renderers = {n: r for n, r in renderers.items() if "mujoco.Renderer" not in n}
    seen = {name: renderer.segmentation() for name, renderer in renderers.items()}
    found = side_by_side(
        {name: renderer.rgb for name, renderer in renderers.items()}, repeats=repeats, items=worlds
    )
    inside = _away_from_edges(seen["palm_jax"])
    for name, ids in seen.items():
        found[name]["same_geom"] = float((ids == seen["palm_jax"])[inside].mean())
    return found


def _ours(env: Env, state: State, params: EnvParams, side: int, shadows: bool) -> others.Renderer:
    rgb = jax.jit(jax.vmap(lambda s, p: env.render(s, p, side, shadows=shadows).rgb))
    labels = jax.jit(
        jax.vmap(lambda s, p: env.render(s, p, side, outputs=("segmentation",)).segmentation)
    )
    return others.Renderer(lambda: rgb(state, params), lambda: np.asarray(labels(state, params)))


def _job(env: Env, state: State, side: int, shadows: bool) -> others.Job:
    """The same camera in MuJoCo's terms: it looks along -z, y up."""
    spec = build_spec(env.robot, env.task.asset, env.task.contacts(env.robot))
    pose = np.asarray(state.camera_to_world[0], float)
    turn = np.zeros(4)
    mujoco.mju_mat2Quat(turn, (pose[:3, :3] * [1.0, -1.0, -1.0]).reshape(-1))
    spec.worldbody.add_camera(name=others.CAMERA, pos=pose[:3, 3], quat=turn, fovy=40.0)
    worlds = len(state.data.qpos)
    return others.Job(
        model=spec.compile(),
        qpos=np.asarray(state.data.qpos),
        mocap_pos=np.asarray(state.data.mocap_pos).reshape(worlds, -1, 3),
        mocap_quat=np.asarray(state.data.mocap_quat).reshape(worlds, -1, 4),
        side=side,
        shadows=shadows,
    )


def _away_from_edges(ids: np.ndarray) -> np.ndarray:
    """bool [N, H, W], like `ids`: pixels whose eight neighbours show the same."""
    inside = np.ones(ids.shape, bool)
    for rows in (-1, 0, 1):
        for columns in (-1, 0, 1):
            inside &= np.roll(ids, (rows, columns), (1, 2)) == ids
    return inside
