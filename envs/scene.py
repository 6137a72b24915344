"""From a compiled MuJoCo model to what the renderer draws."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from palm_jax.envs.distractors import task_geoms
from palm_jax.envs.params import EnvParams
from palm_jax.envs.world import DISTRACTORS
from palm_jax.render import Scene, make_lights, make_scene

_TEXTURES = {"table_top": ("wood", 0.09), "floor": ("checker", 0.35)}
"""Geoms with a procedural texture: kind, and metres per plank or square."""

_SECOND = np.float32(0.78)  # a texture's second colour: this share of the first
_MATTE, _GLOSSY = (0.06, 0.2), (0.35, 0.5)  # specular, shininess
_VISIBLE_GROUPS = (0, 1, 2)  # MuJoCo's own default; collision geoms live in group 3
_BACKGROUND = np.array([[0.80, 0.84, 0.88], [0.60, 0.68, 0.78]], np.float32)


class LightDefaults(NamedTuple):
    """The model's directional lights."""

    ambient: np.ndarray  # [3]
    diffuse: np.ndarray  # [L, 3]
    direction: np.ndarray  # [L, 3]


class TableDefaults(NamedTuple):
    """The table top's texture."""

    rgb: np.ndarray  # [3] first colour
    rgb2: np.ndarray  # [3] second colour
    scale: float  # metres per plank


class SceneModel:
    """The rendered geoms of a model and their looks, read once.

    Attributes:
      geoms: ids of the R rendered geoms in the MuJoCo model.
      rgb: [R, 3] their colours.
      robot: bool [R], the geoms that belong to the robot.
      hand: bool [R], those of its gripper.
      objects: bool [R], those of the task's objects.
      handled: ids of the gripper's geoms and of the task's objects.
      lights: the model's lights.
      table: the table top's texture.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.geoms = np.flatnonzero(np.isin(model.geom_group, _VISIBLE_GROUPS))
        names = [model.geom(int(g)).name for g in self.geoms]
        self.rgb = model.geom_rgba[self.geoms, :3].astype(np.float32)
        self.robot = _below(model, model.body("robot_base").id)[model.geom_bodyid[self.geoms]]
        self.objects = task_geoms(model)[self.geoms]
        self.hand = _below(model, int(model.site("tcp").bodyid[0]))[model.geom_bodyid[self.geoms]]
        self.handled = self.geoms[self.hand | self.objects]
        distractors = [model.body(name).id for name in DISTRACTORS]
        self._distractors = np.isin(model.geom_bodyid[self.geoms], distractors)
        self._table = names.index("table_top")
        self.table = TableDefaults(
            self.rgb[self._table], _SECOND * self.rgb[self._table], _TEXTURES["table_top"][1]
        )
        self.lights = LightDefaults(
            ambient=np.full(3, 0.38, np.float32),
            diffuse=model.light_diffuse.astype(np.float32),
            direction=model.light_dir.astype(np.float32),
        )
        self._light_specular = model.light_specular.astype(np.float32)
        self._types = tuple(
            mujoco.mjtGeom(int(t)).name.removeprefix("mjGEOM_").lower()
            for t in model.geom_type[self.geoms]
        )
        self._sizes = model.geom_size[self.geoms].astype(np.float32)
        self._textures = tuple(_TEXTURES.get(n, ("none", 0.1))[0] for n in names)
        self._scales = np.array([_TEXTURES.get(n, ("none", 0.1))[1] for n in names], np.float32)
        fixed = model.geom_bodyid[self.geoms] == 0
        gloss = np.where(fixed[:, None], _MATTE, _GLOSSY).astype(np.float32)
        self._specular, self._shininess = gloss[:, 0], gloss[:, 1]

    def __call__(self, geom_xpos: jax.Array, geom_xmat: jax.Array, params: EnvParams) -> Scene:
        """The scene of one world.

        Args:
          geom_xpos: [G, 3] positions of all of the model's geoms.
          geom_xmat: [G, 3, 3] their axes.
          params: lights, colours, the table's texture, and whether the robot is drawn.
        """
        pos = geom_xpos[self.geoms]
        # Parked distractors are below the floor, where drawing them would be wasted.
        parked = jnp.asarray(self._distractors) & (pos[:, 2] < 0.0)
        turned = turned_hue(params.geom_rgb, params.object_hue)
        rgb = jnp.where(self.objects[:, None], turned, params.geom_rgb)
        return make_scene(
            self._types,
            pos,
            geom_xmat[self.geoms],
            self._sizes,
            rgb.at[self._table].set(params.table_rgb),
            ids=[int(g) for g in self.geoms],
            textures=self._textures,
            rgb2=(_SECOND * rgb).at[self._table].set(params.table_rgb2),
            texture_scale=jnp.asarray(self._scales).at[self._table].set(params.table_scale),
            specular=self._specular,
            shininess=self._shininess,
            visible=~parked & (~jnp.asarray(self.robot) | (params.robot_visible > 0.5)),
            lights=make_lights(
                dir=params.light_direction,
                diffuse=params.light_diffuse,
                specular=self._light_specular,
                ambient=params.light_ambient,
            ),
            background=_BACKGROUND,
        )


# Rows: luma, and the two axes of the plane of equal luma in which hues are turned (NTSC's YIQ).
_YIQ = np.array([[0.30, 0.59, 0.11], [0.599, -0.2773, -0.3217], [0.213, -0.5251, 0.3121]])
_ROTATION = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_CHROMA = (np.linalg.inv(_YIQ) @ np.diag([0.0, 1.0, 1.0]) @ _YIQ).astype(np.float32)
_QUARTER = (np.linalg.inv(_YIQ) @ _ROTATION @ _YIQ).astype(np.float32)


def turned_hue(rgb: jax.Array, angle: jax.Array) -> jax.Array:
    """Colours [..., 3] (0..1) with the hue turned by `angle` [] radians and the luma kept.

    Positive angles go from red to yellow, green and blue. Greys stay; a colour that would leave
    0..1 is greyed until it does not. An angle of zero changes no bit.
    """
    # As sums, so that an angle of zero adds exact zeros.
    change = (jnp.cos(angle) - 1.0) * _CHROMA + jnp.sin(angle) * _QUARTER
    grey = (rgb * _YIQ[0].astype(np.float32)).sum(-1, keepdims=True)
    turned = rgb + (rgb[..., None, :] * change).sum(-1)
    off = turned - grey
    room = jnp.where(off > 0, 1.0 - grey, grey) / jnp.maximum(jnp.abs(off), 1e-6)
    return turned + (jnp.minimum(room.min(-1, keepdims=True), 1.0) - 1.0) * off


def _below(model: mujoco.MjModel, root: int) -> np.ndarray:
    """bool [nbody]: `root` and every body that hangs from it."""
    result = np.zeros(model.nbody, bool)
    result[root] = True
    for body in range(root + 1, model.nbody):
        result[body] = result[model.body_parentid[body]]
    return result
