"""Rendering: frames a second of 84 x 84 windows, 64 worlds, 35 textured primitives, two lights.

Without arguments a synthetic arm over a wooden table is drawn, each world with its parts moved a
little. `run` takes any other scenes, camera and windows.
"""

import dataclasses
import functools
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common import measure
from palm_jax.align import Camera
from palm_jax.render import Scene, Window, make_lights, make_scene, render

WORLDS, SIDE = 64, 84


class _Part(NamedTuple):
    kind: str
    pos: tuple[float, float, float]
    size: tuple[float, ...]
    rgb: tuple[float, float, float]
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)  # where its z axis points


_WHITE, _DARK, _STEEL = (0.93, 0.93, 0.95), (0.22, 0.23, 0.26), (0.6, 0.62, 0.65)
_ACROSS, _UP, _REACH = (0.0, 1.0, 0.0), (0.46, 0.0, 0.89), (0.75, 0.0, -0.66)

_FURNITURE = (
    _Part("plane", (0, 0, 0), (0, 0), (0.45, 0.47, 0.5)),
    _Part("box", (0.35, 0, 0.727), (0.4, 0.6, 0.025), (0.72, 0.5, 0.3)),
    *(
        _Part("cylinder", (x, y, 0.35), (0.03, 0.35), _DARK)
        for x in (0.0, 0.7)
        for y in (-0.55, 0.55)
    ),
)
_ARM = (
    _Part("box", (-0.3, 0, 0.787), (0.095, 0.08, 0.035), _WHITE),
    _Part("capsule", (-0.27, 0, 0.84), (0.068, 0.04), _WHITE),
    _Part("cylinder", (-0.27, 0, 0.95), (0.066, 0.008), _DARK),
    _Part("cylinder", (-0.27, 0, 1.02), (0.062, 0.065), _WHITE),
    _Part("capsule", (-0.27, 0, 1.085), (0.064, 0.05), _WHITE, _ACROSS),
    _Part("capsule", (-0.21, 0, 1.23), (0.058, 0.15), _WHITE, _UP),
    _Part("cylinder", (-0.2, 0, 1.25), (0.062, 0.008), _DARK, _UP),
    _Part("capsule", (-0.15, 0, 1.37), (0.06, 0.05), _WHITE, _ACROSS),
    _Part("capsule", (-0.11, 0, 1.36), (0.054, 0.04), _WHITE, (1.0, 0.0, -0.2)),
    _Part("capsule", (-0.07, 0, 1.35), (0.057, 0.05), _DARK, _ACROSS),
    _Part("capsule", (0.04, 0, 1.26), (0.05, 0.12), _WHITE, _REACH),
    _Part("cylinder", (0.05, 0, 1.25), (0.054, 0.008), _DARK, _REACH),
    _Part("capsule", (0.15, 0, 1.17), (0.05, 0.04), _WHITE, _ACROSS),
    _Part("capsule", (0.19, 0, 1.16), (0.046, 0.04), _WHITE, (1.0, 0.0, -0.2)),
    _Part("capsule", (0.23, 0, 1.15), (0.05, 0.03), _WHITE, _ACROSS),
    _Part("capsule", (0.24, 0, 1.09), (0.045, 0.05), _WHITE),
    _Part("cylinder", (0.25, 0, 1.03), (0.05, 0.02), _DARK),
    _Part("ellipsoid", (0.25, 0, 1.01), (0.04, 0.1, 0.03), _WHITE),
    _Part("box", (0.25, 0, 0.97), (0.032, 0.1, 0.035), _WHITE),
    *(_Part("box", (0.25, y, 0.91), (0.011, 0.01, 0.03), _DARK) for y in (-0.045, 0.045)),
    *(_Part("box", (0.25, y, 0.87), (0.01, 0.008, 0.022), _STEEL) for y in (-0.04, 0.04)),
)
_OBJECTS = (
    _Part("cylinder", (0.25, 0.02, 0.802), (0.033, 0.05), (0.8, 0.12, 0.1)),
    _Part("cylinder", (0.25, 0.02, 0.855), (0.034, 0.003), (0.75, 0.75, 0.78)),
    _Part("sphere", (0.4, -0.25, 0.792), (0.04,), (0.2, 0.6, 0.25)),
    _Part("ellipsoid", (0.15, 0.25, 0.782), (0.05, 0.03, 0.03), (0.95, 0.6, 0.1)),
    _Part("box", (0.1, -0.2, 0.782), (0.03, 0.03, 0.03), (0.2, 0.3, 0.75)),
    _Part("capsule", (0.45, 0.2, 0.777), (0.025, 0.07), (0.9, 0.85, 0.2), (1.0, 0.3, 0.0)),
)


def _axes(z: tuple[float, float, float]) -> np.ndarray:
    """A rotation whose third column is along `z`."""
    third = np.asarray(z) / np.linalg.norm(z)
    second = np.cross(third, [1.0, 0.0, 0.0])
    second = np.array([0.0, 1.0, 0.0]) if np.linalg.norm(second) < 0.1 else second
    second /= np.linalg.norm(second)
    return np.stack([np.cross(second, third), second, third], 1)


def arm_over_table(parts: int | None = None, *, copies: int = 1) -> Scene:
    """35 primitives of all six types (or the first `parts`; or all but the furniture `copies`
    times), wood and checker, two directional lights."""
    chosen = (*_FURNITURE, *((*_ARM, *_OBJECTS) * copies))[:parts]
    textures = ["checker", "wood"] + ["none"] * (len(chosen) - 2)
    lights = make_lights(
        dir=[[0.4, 0.35, -1.0], [-0.6, -0.3, -0.5]],
        diffuse=[[0.65] * 3, [0.25] * 3],
        specular=[[0.5] * 3, [0.1] * 3],
        ambient=0.35,
    )
    return make_scene(
        [part.kind for part in chosen],
        np.array([part.pos for part in chosen]),
        np.stack([_axes(part.axis) for part in chosen]),
        np.array([(*part.size, 0.0, 0.0)[:3] for part in chosen]),
        np.array([part.rgb for part in chosen]),
        textures=textures,
        texture_scale=np.array([0.5 if kind == "checker" else 0.1 for kind in textures]),
        lights=lights,
    )


def view_of_table() -> Camera:
    """A camera in front of the table, scaled so that the hand fills an 84-pixel window."""
    eye, target = np.array([1.3, 0.5, 1.6]), np.array([0.2, 0.0, 0.85])
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = eye
    return Camera.from_fovy(45.0, 215, 215, pose.astype(np.float32))


def scattered(scene: Scene, worlds: int, *, furniture: int = len(_FURNITURE)) -> Scene:
    """The scene `worlds` times, all but the first `furniture` geoms moved by about 2 cm."""
    noise = 0.02 * np.random.default_rng(0).normal(size=(worlds, *scene.pos.shape))
    noise[:, :furniture] = 0.0
    scenes = jax.tree.map(lambda leaf: jnp.stack([leaf] * worlds), scene)
    return dataclasses.replace(scenes, pos=scenes.pos + jnp.asarray(noise, jnp.float32))


def run(
    scenes: Scene | None = None,
    camera: Camera | None = None,
    origins: jax.Array | None = None,
    *,
    side: int = SIDE,
    repeats: int = 20,
) -> dict[str, Any]:
    """`frames_per_second` of lit rgb without shadows, and of other outputs.

    Args:
      scenes: W worlds, every leaf with a leading axis; by default the synthetic arm.
      camera: one for all worlds.
      origins: int32 [W, 2] of the windows.
      side: of the windows, pixels.
      repeats: timed calls for each figure.
    """
    scenes = scattered(arm_over_table(), WORLDS) if scenes is None else scenes
    view = view_of_table() if camera is None else camera
    worlds = scenes.pos.shape[0]
    if origins is None:
        around = np.random.default_rng(1).integers(-15, 16, (worlds, 2))
        origins = jnp.asarray(np.array([55, 65]) + around, jnp.int32)
    found: dict[str, Any] = {"worlds": worlds, "pixels": side, "geoms": len(scenes.types)}
    for name, options in {
        "rgb": {"outputs": ("rgb",)},
        "rgb_with_shadows": {"outputs": ("rgb",), "shadows": True},
        "rgb_depth_segmentation": {"outputs": ("rgb", "depth", "segmentation")},
        "segmentation": {"outputs": ("segmentation",)},
    }.items():

        def draw(scene: Scene, origin: jax.Array, options: Any = options) -> Any:
            return render(scene, view, Window(origin, side, side), **options)

        start = time.perf_counter()
        compiled = jax.jit(jax.vmap(draw)).lower(scenes, origins).compile()
        seconds = time.perf_counter() - start
        found[name] = measure(
            functools.partial(compiled, scenes, origins), repeats=repeats, items=worlds
        )
        found[name]["compile_seconds"] = seconds
        memory = compiled.memory_analysis()
        if memory is not None:
            found[name]["temporary_mib"] = memory.temp_size_in_bytes / 2**20
    found["scaling"] = scaling(repeats=repeats)
    return {"frames_per_second": found["rgb"]["per_second_median"], **found}


def scaling(*, repeats: int = 10) -> dict[str, dict[str, float]]:
    """Median seconds of a batch by worlds (84 px), by pixels of a frame (16 worlds) and by
    primitives (16 worlds, 84 px): the furniture, half of the scene, all of it, most of it twice."""
    scene, view = arm_over_table(), view_of_table()

    def seconds(scenes: Scene, side: int) -> float:
        worlds = len(scenes.pos)
        camera = view.scaled(side / view.height)
        draw = jax.jit(jax.vmap(lambda scene: render(scene, camera).rgb))
        return (
            worlds
            / measure(lambda: draw(scenes), repeats=repeats, items=worlds)["per_second_median"]
        )

    sides, count = (32, 64, 128, 256), len(scene.types)
    twice = arm_over_table(copies=2)
    parts = {n: arm_over_table(parts=n) for n in (len(_FURNITURE), count // 2, count)}
    return {
        "worlds": {str(n): seconds(scattered(scene, n), SIDE) for n in (1, 4, 16, 64, 256)},
        "pixels": {str(side**2): seconds(scattered(scene, 16), side) for side in sides},
        "primitives": {
            str(len(each.types)): seconds(scattered(each, 16), SIDE)
            for each in (*parts.values(), twice)
        },
    }
