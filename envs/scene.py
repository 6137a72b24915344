"""From a compiled MuJoCo model to what the renderer draws."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from palm_jax.render import Scene, make_lights, make_scene

_TEXTURES = {"table_top": ("wood", 0.09), "floor": ("checker", 0.35)}
"""Geoms with a procedural texture: kind, and metres per plank or square."""

_MATTE, _GLOSSY = (0.06, 0.2), (0.35, 0.5)  # specular, shininess
_VISIBLE_GROUPS = (0, 1, 2)  # MuJoCo's own default; collision geoms live in group 3
_BACKGROUND = np.array([[0.80, 0.84, 0.88], [0.60, 0.68, 0.78]], np.float32)


class LightDefaults(NamedTuple):
    """The model's directional lights."""

    ambient: np.ndarray  # [3]
    diffuse: np.ndarray  # [L, 3]
    direction: np.ndarray  # [L, 3]


class SceneModel:
    """The rendered geoms of a model and their looks, read once.

    Attributes:
      geoms: ids of the R rendered geoms in the MuJoCo model.
      rgb: [R, 3] their colours.
      robot: bool [R], the geoms that belong to the robot.
      lights: the model's lights.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.geoms = np.flatnonzero(np.isin(model.geom_group, _VISIBLE_GROUPS))
        names = [model.geom(int(g)).name for g in self.geoms]
        self.rgb = model.geom_rgba[self.geoms, :3].astype(np.float32)
        self.robot = _below(model, model.body("robot_base").id)[model.geom_bodyid[self.geoms]]
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

    def __call__(
        self,
        geom_xpos: jax.Array,
        geom_xmat: jax.Array,
        *,
        rgb: jax.Array,
        robot_visible: jax.Array,
        ambient: jax.Array,
        diffuse: jax.Array,
        direction: jax.Array,
    ) -> Scene:
        """The scene of one world.

        Args:
          geom_xpos: [G, 3] positions of all of the model's geoms.
          geom_xmat: [G, 3, 3] their axes.
          rgb: [R, 3] colours of the rendered geoms.
          robot_visible: [] above 0.5 where the robot is drawn.
          ambient, diffuse, direction: [3], [L, 3], [L, 3] lights.
        """
        return make_scene(
            self._types,
            geom_xpos[self.geoms],
            geom_xmat[self.geoms],
            self._sizes,
            rgb,
            ids=[int(g) for g in self.geoms],
            textures=self._textures,
            rgb2=0.78 * rgb,
            texture_scale=self._scales,
            specular=self._specular,
            shininess=self._shininess,
            visible=~jnp.asarray(self.robot) | (robot_visible > 0.5),
            lights=make_lights(
                dir=direction, diffuse=diffuse, specular=self._light_specular, ambient=ambient
            ),
            background=_BACKGROUND,
        )


def _below(model: mujoco.MjModel, root: int) -> np.ndarray:
    """bool [nbody]: `root` and every body that hangs from it."""
    result = np.zeros(model.nbody, bool)
    result[root] = True
    for body in range(root + 1, model.nbody):
        result[body] = result[model.body_parentid[body]]
    return result
