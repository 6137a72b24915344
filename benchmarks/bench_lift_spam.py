"""Rendering of the real scene: the 84 x 84 windows of lift_spam that a policy sees, lit rgb."""

from typing import Any

import jax

from benchmarks.common import measure
from palm_jax.align import AlignSpec, window_origin
from palm_jax.envs import make, shifts
from palm_jax.envs.base import Env, EnvParams, State
from palm_jax.envs.rollout import Runner, repeat_params
from palm_jax.render import Window, render


def start(worlds: int) -> tuple[Env, State, EnvParams]:
    """Started episodes of the widest domain, [W]."""
    env = make("lift_spam")
    params = repeat_params(shifts.shifted(env.default_params(), "workspace+viewpoint"), worlds)
    return (
        env,
        Runner(env, worlds).reset(jax.random.split(jax.random.key(0), worlds), params),
        params,
    )


def run(*, worlds: int = 64, repeats: int = 20) -> dict[str, Any]:
    """Frames/s of the windows alone (`frames_per_second`), and of the whole observation."""
    env, state, params = start(worlds)
    spec = AlignSpec(crop=env.task.crop, offset=(0, 40), size=84)

    def window(state: State, params: EnvParams) -> jax.Array | None:
        view = spec.view_camera(env.camera(state, params))
        origin, _ = window_origin(view, env.tcp(state), spec)
        return render(env.scene(state, params), view, Window(origin, spec.size, spec.size)).rgb

    draw = jax.jit(jax.vmap(window))
    see = jax.jit(jax.vmap(lambda s, p: env.observe(s, p, spec)))
    frames = measure(lambda: draw(state, params), repeats=repeats, items=worlds)
    observed = measure(lambda: see(state, params), repeats=repeats, items=worlds)
    return {
        "frames_per_second": frames["per_second"],
        "windows": frames,
        "observations": observed,
        "worlds": worlds,
        "pixels": spec.size,
        "geoms": len(env.scene_model.geoms),
        "lights": len(env.scene_model.lights.direction),
    }
