"""How much of what another robot costs a policy is how it looks, and how much is how it moves.

    python examples/borrowed.py RUN [RUN ...]
    python examples/borrowed.py RUN --domain workspace+embodiment --scenes 50

The scenes are those of the training command's own evaluation, and the other robot does the work.
Drawn is that robot; or the demonstrations' hand in the place of its hand; or all of the
demonstrations' robot, by inverse kinematics at the same TCP pose. Nothing but the picture changes:
what is still lost with the last one is motion, and what the first loses more is looks.

It is also an example of a picture of your own: `Env.scene_model` can be any function from poses
of geoms to a `Scene`.
"""

import argparse
import copy
import dataclasses
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from palm_jax.envs import control, registry
from palm_jax.envs.base import Env
from palm_jax.envs.params import EnvParams
from palm_jax.envs.rollout import Runner
from palm_jax.render import Scene

LOOKS = ("as it is", "with the hand", "all of it")


class Borrowed:
    """A `SceneModel` of `env` that draws `lender`'s robot where its own is: the hand alone, or
    `arm` and hand. Call it as that, with geoms [G, 3] metres and [G, 3, 3] of `env`, for a `Scene`
    of one world; attributes are those of `env`'s own."""

    def __init__(self, env: Env, lender: Env, *, arm: bool) -> None:
        self._own, self._env, self._lender = env.scene_model, env, lender
        self._rows = np.flatnonzero(lender.scene_model.robot if arm else lender.scene_model.hand)
        self._hides = self._own.robot if arm else self._own.hand
        # What is drawn keeps the meaning that it has in masks.
        own_hand = int(self._own.geoms[self._own.hand][0])
        own_arm = int(self._own.geoms[self._own.robot & ~self._own.hand][0])
        is_hand = lender.scene_model.hand[self._rows]
        self._ids = tuple(np.where(is_hand, own_hand, own_arm).tolist())
        self._anchor, self._to_tcp = _anchor(env.mj_model)
        self._pads_closed = _gap(env, env.robot.gripper_closed)

    def __getattr__(self, name: str) -> object:
        return getattr(self._own, name)

    def __call__(self, geom_xpos: jax.Array, geom_xmat: jax.Array, params: EnvParams) -> Scene:
        own = self._own(geom_xpos, geom_xmat, params)
        own = dataclasses.replace(own, visible=own.visible & ~jnp.asarray(self._hides))
        pads = geom_xpos[np.array([self._env.mj_model.geom(n).id for n in self._env.robot.pads])]
        xpos, xmat = self._poses(
            _pose(geom_xpos[self._anchor], geom_xmat[self._anchor]) @ self._to_tcp,
            jnp.linalg.norm(pads[0] - pads[1]) - self._pads_closed,
        )
        looks = dataclasses.replace(
            self._lender.default_params(),
            robot_visible=params.robot_visible,
            light_ambient=params.light_ambient,
            light_diffuse=params.light_diffuse,
            light_direction=params.light_direction,
        )
        lent = _rows_of(self._lender.scene_model(xpos, xmat, looks), self._rows)
        return _together(own, dataclasses.replace(lent, ids=self._ids))

    def _poses(self, tcp: jax.Array, width: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The lender's geoms, [G, 3] and [G, 3, 3], with its TCP at `tcp` [4, 4] and its pads
        `width` [] metres apart."""
        env, robot, model = self._lender, self._lender.robot, self._lender.mj_model
        share = jnp.clip(width / robot.max_width, 0.0, 1.0)
        closed, opened = np.asarray(robot.gripper_closed), np.asarray(robot.gripper_open)
        fingers = closed + share * (opened - closed)
        arm = control.reach(env.chain, jnp.asarray(env.chain.home), tcp)
        qpos = jnp.asarray(model.qpos0, jnp.float32)
        qpos = qpos.at[_addresses(env, robot.arm_joints)].set(arm)
        qpos = qpos.at[_addresses(env, robot.gripper_joints)].set(fingers)
        # Its objects and its camera are not looked at.
        elsewhere = jnp.zeros((model.nmocap, 3)), jnp.tile(jnp.eye(4)[0], (model.nmocap, 1))
        data = env.restore(qpos, *elsewhere, jnp.eye(4), env.default_params()).data
        return data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3)


def _addresses(env: Env, joints: tuple[str, ...]) -> np.ndarray:
    return np.array([int(env.mj_model.joint(name).qposadr[0]) for name in joints])


def _pose(position: jax.Array, rotation: jax.Array) -> jax.Array:
    return jnp.eye(4).at[:3, :3].set(rotation).at[:3, 3].set(position)


def _anchor(model: mujoco.MjModel) -> tuple[int, np.ndarray]:
    """A geom that the TCP is fixed to, and the pose [4, 4] of the TCP in its frame."""
    data, site = mujoco.MjData(model), model.site("tcp").id
    mujoco.mj_kinematics(model, data)
    geom = int(np.flatnonzero(model.geom_bodyid == model.site_bodyid[site])[0])
    rotation = data.geom_xmat[geom].reshape(3, 3)
    to_tcp = np.eye(4)
    to_tcp[:3, :3] = rotation.T @ data.site_xmat[site].reshape(3, 3)
    to_tcp[:3, 3] = rotation.T @ (data.site_xpos[site] - data.geom_xpos[geom])
    return geom, to_tcp


def _gap(env: Env, fingers: tuple[float, ...]) -> float:
    """Metres between the centres of the pads."""
    model, data = env.mj_model, mujoco.MjData(env.mj_model)
    data.qpos[_addresses(env, env.robot.gripper_joints)] = fingers
    mujoco.mj_kinematics(model, data)
    left, right = (data.geom_xpos[model.geom(name).id] for name in env.robot.pads)
    return float(np.linalg.norm(left - right))


def _rows_of(scene: Scene, rows: np.ndarray) -> Scene:
    """Some of a scene's geoms, with its lights and sky."""
    return dataclasses.replace(
        scene,
        **{name: getattr(scene, name)[rows] for name in _ARRAYS},
        **{name: tuple(np.array(getattr(scene, name))[rows].tolist()) for name in _NAMES},
    )


def _together(scene: Scene, other: Scene) -> Scene:
    """The geoms of both, under the lights of the first."""
    return dataclasses.replace(
        scene,
        **{n: jnp.concatenate([getattr(scene, n), getattr(other, n)]) for n in _ARRAYS},
        **{n: getattr(scene, n) + getattr(other, n) for n in _NAMES},
    )


_NAMES = ("types", "ids", "textures")  # of the geoms, static
_ARRAYS = (
    "pos", "mat", "size", "rgb", "rgb2", "texture_scale", "specular", "shininess", "visible",
)  # fmt: skip


def looking_like(env: Env, lender: Env, *, arm: bool) -> Env:
    """`env` with the same physics, drawn with `lender`'s hand, or with its `arm` and hand."""
    other = copy.copy(env)
    other.scene_model = Borrowed(env, lender, arm=arm)  # type: ignore[assignment]
    return other


def runner(task: str, robot: str, other: str, look: str, name: str, *, worlds: int) -> Runner:
    """The runner of the robot `name`, drawn as it is, or, if it is `other`, in one of `LOOKS`."""
    env = registry.make(task, name)
    if name == other and look != LOOKS[0]:
        env = looking_like(env, registry.make(task, robot), arm=look == LOOKS[2])
    return Runner(env, worlds)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "runs", type=Path, nargs="+", help="folders of training runs, one method each"
    )
    parser.add_argument("--domain", default="embodiment", help="one with another robot")
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--looks", nargs="+", choices=LOOKS, default=LOOKS)
    options = parser.parse_args()

    from palm_jax.train import workspace
    from palm_jax.train.evaluate import Runners

    made: dict[tuple[str, ...], Runners] = {}
    for run in options.runs:
        config = workspace.stored_config(run)
        for look in options.looks:
            about = (config.task, config.robot, config.second_robot, look)
            if about not in made:
                make = partial(runner, *about, worlds=options.scenes)
                made[about] = Runners(make, config.robot, config.second_robot)
            runners = made[about]
            robot = runners.plays(options.domain)
            if robot == config.robot:
                parser.error(f"{options.domain}: expected a domain with another robot than {robot}")
            evaluator, policy = workspace.load_policy(run, runners)
            found = evaluator.domain(
                policy,
                options.domain,
                seed=config.eval_seed,
                count=options.scenes,
                aligned=workspace.quoted_variant(run) == "aligned",
            )
            solved = f"{found.solved.sum()} of {len(found.solved)} solved"
            drawn = "as it is" if look == LOOKS[0] else f"{look} drawn as the {config.robot}'s"
            print(f"{run}: {solved}, the {robot} {drawn}", flush=True)


if __name__ == "__main__":
    main()
