"""Ray casting of MuJoCo primitives inside jit: rgb, depth, segmentation, any window, under vmap.

`render(scene, camera, window)` draws one frame; `make_scene` and `make_lights` fill in defaults.
"""

from palm_jax.render.raycast import render as render
from palm_jax.render.scene import OUTPUTS as OUTPUTS
from palm_jax.render.scene import PRIMITIVES as PRIMITIVES
from palm_jax.render.scene import TEXTURES as TEXTURES
from palm_jax.render.scene import Frame as Frame
from palm_jax.render.scene import Lights as Lights
from palm_jax.render.scene import Scene as Scene
from palm_jax.render.scene import Window as Window
from palm_jax.render.scene import make_lights as make_lights
from palm_jax.render.scene import make_scene as make_scene
