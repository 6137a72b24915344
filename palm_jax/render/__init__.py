"""Ray casting of MuJoCo primitives inside jit: rgb, depth, segmentation, any window, under vmap.

`render(scene, camera, window)` draws one frame; `make_scene` and `make_lights` fill in defaults.
"""

from palm_jax.render.raycast import render
from palm_jax.render.scene import (
    OUTPUTS,
    PRIMITIVES,
    TEXTURES,
    Frame,
    Lights,
    Scene,
    Window,
    make_lights,
    make_scene,
)

__all__ = [
    "OUTPUTS",
    "PRIMITIVES",
    "TEXTURES",
    "Frame",
    "Lights",
    "Scene",
    "Window",
    "make_lights",
    "make_scene",
    "render",
]
