"""Builds the MuJoCo model of a task on a robot: table + robot + task objects + contact pairs.

Nothing collides by default (`contype = conaffinity = 0` everywhere); every contact that can matter
is an explicit pair. MJX evaluates every candidate on every step, so the list is what physics costs.
"""

import importlib.resources
import pathlib
from typing import NamedTuple

import mujoco
import numpy as np

from palm_jax.envs.robots import Robot

DISTRACTORS = ("distractor_mug", "distractor_block", "distractor_ball", "distractor_dumbbell")
"""Bodies of `assets/table.xml` that no task is about: drawn where an episode puts them, touched by
nothing. They are the first mocap bodies of every model, in this order."""

_SPIN_DAMPING = 25.0  # 1/s: the explicit integration gains less than this up to 100 rad/s


class Contact(NamedTuple):
    """Two geoms that may touch.

    Attributes:
      first, second: names of the geoms.
      friction: sliding friction coefficient.
      stiff: for what a gripper pushes on: twice as stiff as MuJoCo's default, the most that the
        time step allows.
    """

    first: str
    second: str
    friction: float
    stiff: bool = False


def asset_path(*parts: str) -> pathlib.Path:
    """Path of a packaged MJCF file."""
    return pathlib.Path(str(importlib.resources.files("palm_jax.envs") / "assets")).joinpath(*parts)


def build_spec(robot: Robot, task_asset: str, contacts: tuple[Contact, ...]) -> mujoco.MjSpec:
    """The world of one task on one robot, ready to `compile()` (then `to_xml()` has all).

    Args:
      robot: row of `ROBOTS`.
      task_asset: MJCF file name inside `assets/tasks/`.
      contacts: every pair of geoms that may touch.
    """
    files = ("table.xml", f"robots/{robot.asset}", f"tasks/{task_asset}")
    include = {name: asset_path(*name.split("/")).read_bytes() for name in files}
    spec = mujoco.MjSpec.from_string(_model_xml(files, contacts), include=include)
    _damp_free_bodies(spec)
    return spec


def _damp_free_bodies(spec: mujoco.MjSpec) -> None:
    """Damps every free joint: the gyroscopic forces of what tumbles freely are integrated
    explicitly, so that without damping a body flicked by a finger spins ever faster, to NaN.

    One number serves a joint's six directions. Scaled by the smallest inertia it slows a spin and
    leaves falling and sliding as they are (a 0.3 kg can: 2 % of its speed a second).
    """
    model = spec.compile()
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            inertia = model.body(joint.parent.name).inertia.min()
            joint.damping = np.array([_SPIN_DAMPING * inertia, 0.0, 0.0])  # linear term only


def _model_xml(files: tuple[str, ...], contacts: tuple[Contact, ...]) -> str:
    pairs = "".join(
        f'<pair geom1="{c.first}" geom2="{c.second}" condim="3" '
        f'solref="{0.01 if c.stiff else 0.02} 1" '
        f'friction="{c.friction} {c.friction} 0.005 0.0001 0.0001"/>'
        for c in contacts
    )
    parts = "".join(f'<include file="{name}"/>' for name in files)
    return f'<mujoco model="palm_jax">{parts}<contact>{pairs}</contact></mujoco>'
