"""The environment: `Env` and its `State`; what can shift is in `palm_jax.envs.params`.

An episode: objects are placed in a region, a global policy finds the target in a rendered mask and
the hand is put near it (`reset`), then a local policy moves the TCP by body-frame deltas (`step`).
All functions are pure, for one world; batch them with `jax.vmap`. Everything that can shift is a
leaf of `EnvParams`, so a sweep is a `vmap` over params.
"""

import copy
import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from palm_jax.align import (
    Aligned,
    AlignSpec,
    Camera,
    align_window,
    apply_delta,
    encode_delta,
    unproject_to_height,
    window_origin,
)
from palm_jax.envs import control, physics, tree
from palm_jax.envs.calibration import miscalibrated
from palm_jax.envs.distractors import Distractors
from palm_jax.envs.params import TEST_HIGH, TEST_LOW
from palm_jax.envs.params import EnvParams as EnvParams
from palm_jax.envs.robots import Robot
from palm_jax.envs.scene import SceneModel
from palm_jax.envs.tasks import TABLE_HEIGHT, WORKSPACE_CENTRE, Task
from palm_jax.envs.world import build_spec
from palm_jax.render import Frame, Window, render

PAPER_FRAME = 512
"""Side in pixels of the paper's raw image; other frames share its focal length."""

WIDE_FRAME = 1024
"""Side in pixels of the default virtual frame: wide enough that a TCP crop never clamps."""

CAMERA_FOVY = 40.0
"""Vertical field of view in degrees of the paper's image."""

_LOCATE_SIZE = 128  # the mask for the global policy: the wide frame at an eighth
_SUBSTEPS = 10
_AREA_MARGIN = 0.12  # other objects may stand this far outside the target's region, metres
_MAX_DRAWS = 16  # start poses drawn before an episode is declared impossible
_IN_REACH = 0.002  # metres and radians that a start pose may be off
_STILL_SEEN = 0.5  # share of a target's mask below which its earlier sighting is trusted more
# Folded into a scene's key, so that one more draw leaves those that were there before unchanged.
_RADIUS_DRAW, _DISTRACTOR_DRAW, _LAYOUT_DRAW, _LATER_DRAW = range(1, 5)
CONTROL_RATE = 20.0
"""Control steps a second."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """One world in mid-episode."""

    data: mjx.Data  # physics; poses agree with qpos
    camera_to_world: jax.Array  # [4, 4] this episode's camera
    camera_angle: jax.Array  # [] its turn from the nominal pose, radians
    object_start: jax.Array  # [3] the target object's position at the start
    object_yaw: jax.Array  # [] and its yaw
    key: jax.Array  # uint32 [2]: raw key of what is drawn after the start
    stage: jax.Array  # int32 []: the part of the task that is under way
    jump: jax.Array  # bool []: it has just begun, and the global policy is yet to be called
    targets: jax.Array  # [S, 2] xy of each stage's target as the global policy last found it
    pixels: jax.Array  # [S] size of its mask then, 0 where it was never seen
    located: jax.Array  # [2] the one of the present stage, when it began
    seen: jax.Array  # bool []: it has been in the global policy's mask
    draws: jax.Array  # int32 [] start poses drawn until one was in reach
    reachable: jax.Array  # bool []: one of them was; otherwise the arm waits at its home pose
    step: jax.Array  # int32 [] control steps taken
    success: jax.Array  # bool []: solved at some step so far
    nan: jax.Array  # bool []: physics diverged unsolved; the world stays at its last finite state


def _uniform(key: jax.Array, bounds: jax.Array) -> jax.Array:
    return jax.random.uniform(key, (), minval=bounds[0], maxval=bounds[1])


def _pose_keys(key: jax.Array) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
    """(xy, height), yaw."""
    xy_key, height_key, yaw_key = jax.random.split(key, 3)
    return (xy_key, height_key), yaw_key


def _centroid(mask: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean pixel (u, v) [2] of a bool mask [H, W], and how many pixels it has []."""
    weight = mask.astype(jnp.float32)
    count = weight.sum()
    centre = jnp.arange(_LOCATE_SIZE) + 0.5
    uv = jnp.stack([(weight.sum(0) * centre).sum(), (weight.sum(1) * centre).sum()])
    return uv / jnp.maximum(count, 1.0), count


def _own_device() -> jax.Device:
    """MJX's default is the first of all processes' devices, which another process may own."""
    return jax.local_devices()[0]


class Env:
    """A task on a robot.

    Actions are [10]: the body-frame delta of the TCP (6D rotation, then xyz in metres), then the
    gripper (1 open, 0 close); 20 actions a second. `step` executes `tcp @ delta` from the measured
    TCP pose.

    Attributes:
      task: what is to be done.
      robot: what does it.
      mj_model: the compiled C MuJoCo model (physics parameters, names).
      mjx_model: the same for MJX.
      xml: the same as one MJCF file.
    """

    action_size = 10

    def __init__(self, task: Task, robot: Robot) -> None:
        self.task = task
        self.robot = robot
        spec = build_spec(robot, task.asset, task.contacts(robot))
        self.mj_model: mujoco.MjModel = spec.compile()
        self.xml: str = spec.to_xml()
        self.mjx_model = mjx.put_model(self.mj_model, device=_own_device())
        self.scene_model = SceneModel(self.mj_model)
        self.chain = control.arm_chain(self.mj_model, robot)
        self._distractors = Distractors(self.mj_model)
        self._ids = task.bind(self.mj_model, robot)
        self._tcp_site = self.mj_model.site("tcp").id
        self._arm_qpos = self._addresses(robot.arm_joints)
        self._gripper_qpos = self._addresses(robot.gripper_joints)
        self._closed = np.asarray(robot.gripper_closed, np.float32)
        self._open = np.asarray(robot.gripper_open, np.float32)
        self._target_ids = [
            np.array([self.mj_model.geom(g).id for g in stage.target_geoms])
            for stage in task.stages
        ]
        self._target_heights = np.array([s.target_height for s in task.stages], np.float32)
        self._opens = np.array([stage.open_hand for stage in task.stages])
        self._movable_qpos = [self._free_qpos(name) for name in task.movable]

    def _addresses(self, joints: tuple[str, ...]) -> np.ndarray:
        return np.array([int(self.mj_model.joint(name).qposadr[0]) for name in joints])

    def _free_qpos(self, body: str) -> int:
        return int(self.mj_model.jnt_qposadr[self.mj_model.body(body).jntadr[0]])

    def with_model(self, mjx_model: mjx.Model) -> "Env":
        """This environment with other physics (masses, friction, gains, ...), for domain
        randomisation; `mjx_model` may be traced. What was read from the model by name, and the
        arm's kinematics, stay as they are."""
        other = copy.copy(self)
        other.mjx_model = mjx_model
        return other

    def default_params(self) -> EnvParams:
        """The training distribution: the paper's front camera, objects within 0.2 x 0.2 m."""
        centre = np.asarray(WORKSPACE_CENTRE[:2])
        lights, table = self.scene_model.lights, self.scene_model.table
        values = {
            "camera_to_world": front_camera(),
            "camera_fovy": CAMERA_FOVY,
            "camera_angle": (0.0, 0.0),
            "camera_radius": (1.0, 1.0),
            "calibration_pixels": np.zeros(2),
            "calibration_rotation": np.zeros(3),
            "calibration_translation": np.zeros(3),
            "object_low": centre - 0.1,
            "object_high": centre + 0.1,
            "object_yaw": (-0.5, 0.5),
            "area_low": np.maximum(centre - 0.1 - _AREA_MARGIN, TEST_LOW),
            "area_high": np.minimum(centre + 0.1 + _AREA_MARGIN, TEST_HIGH),
            "distractors": 0.0,
            "start_radius": 0.06,
            "start_height": [stage.start_height for stage in self.task.stages],
            "start_yaw": (-0.5, 0.5),
            "align_hand": 0.0,
            "light_ambient": lights.ambient,
            "light_diffuse": lights.diffuse,
            "light_direction": lights.direction,
            "geom_rgb": self.scene_model.rgb,
            "object_hue": 0.0,
            "table_rgb": table.rgb,
            "table_rgb2": table.rgb2,
            "table_scale": table.scale,
            "robot_visible": float(self.task.robot_visible),
        }
        return EnvParams(**{k: jnp.asarray(v, jnp.float32) for k, v in values.items()})

    # -- episode -----------------------------------------------------------------------------------

    def reset(self, key: jax.Array, params: EnvParams) -> State:
        """Starts an episode: place the objects, locate the target, put the hand near it."""
        place_key, hand_key = jax.random.split(key)
        state = self.place(place_key, params)
        return self.reposition(hand_key, self.locate(state, params), params)

    def place(self, key: jax.Array, params: EnvParams) -> State:
        """Objects and camera drawn from `params`; the arm at its raised home pose."""
        xy_key, yaw_key, camera_key = jax.random.split(key, 3)
        xy = jax.random.uniform(xy_key, (2,), minval=params.object_low, maxval=params.object_high)
        yaw = _uniform(yaw_key, params.object_yaw)
        angle = _uniform(camera_key, params.camera_angle)
        radius = _uniform(jax.random.fold_in(key, _RADIUS_DRAW), params.camera_radius)
        area = jnp.stack([params.area_low, params.area_high])
        placement = self.task.place(
            self._ids, jax.random.fold_in(key, _LAYOUT_DRAW), self._home_qpos(), xy, yaw, area
        )
        parked = self._distractors.parked()
        data = mjx.make_data(self.mjx_model, device=_own_device()).replace(
            qpos=placement.qpos,
            ctrl=self._servo_targets(jnp.asarray(self.chain.home), jnp.ones(())),
            mocap_pos=jnp.concatenate([parked.pos, placement.mocap_pos]),
            mocap_quat=jnp.concatenate([parked.quat, placement.mocap_quat]),
        )
        data = tree.kinematics(self.mjx_model, data)
        arranged = self._distractors.arrange(
            jax.random.fold_in(key, _DISTRACTOR_DRAW), params, data, xy
        )
        data = data.replace(
            mocap_pos=data.mocap_pos.at[: len(arranged.pos)].set(arranged.pos),
            mocap_quat=data.mocap_quat.at[: len(arranged.quat)].set(arranged.quat),
        )
        data = tree.kinematics(self.mjx_model, data)
        pose = _at_distance(params.camera_to_world, radius)
        camera = Camera.from_fovy(params.camera_fovy, PAPER_FRAME, PAPER_FRAME, pose)
        turned = camera.rotated_about(jnp.asarray(WORKSPACE_CENTRE), angle)
        return State(
            data=data,
            camera_to_world=jnp.asarray(turned.cam_to_world),
            camera_angle=angle,
            object_start=self.task.object_position(self._ids, data),
            object_yaw=yaw,
            key=jax.random.key_data(jax.random.fold_in(key, _LATER_DRAW)),
            stage=jnp.zeros((), jnp.int32),
            jump=jnp.zeros((), bool),
            targets=jnp.tile(jnp.asarray(WORKSPACE_CENTRE[:2]), (len(self.task.stages), 1)),
            pixels=jnp.zeros(len(self.task.stages)),
            located=xy,
            seen=jnp.ones((), bool),
            draws=jnp.zeros((), jnp.int32),
            reachable=jnp.ones((), bool),
            step=jnp.zeros((), jnp.int32),
            success=jnp.zeros((), bool),
            nan=jnp.zeros((), bool),
        )

    def restore(
        self,
        qpos: jax.Array,
        mocap_pos: jax.Array,
        mocap_quat: jax.Array,
        camera_to_world: jax.Array,
        params: EnvParams,
    ) -> State:
        """A state to look at, from a recorded one: poses agree with `qpos`, nothing moves.

        Args:
          qpos: [nq]. mocap_pos: [nmocap, 3]. mocap_quat: [nmocap, 4]. camera_to_world: [4, 4].
          params: where the rest comes from.
        """
        state = self.place(jax.random.key(0), params)
        data = state.data.replace(qpos=qpos, mocap_pos=mocap_pos, mocap_quat=mocap_quat)
        return dataclasses.replace(
            state,
            data=tree.kinematics(self.mjx_model, data),
            camera_to_world=camera_to_world,
        )

    def locate(self, state: State, params: EnvParams) -> State:
        """The analytic global policy, first half: the targets' xy from their rendered masks.

        The centroid of a mask is carried along its ray to the object's centre height (paper,
        section III-D). A target of which the hand now hides most stays where it was last seen well;
        one that has never been in view leaves the workspace centre and `seen = False`.
        """
        camera = self.camera(state, params, frame=WIDE_FRAME).scaled(_LOCATE_SIZE / WIDE_FRAME)
        believed = self.calibrated_camera(state, params).scaled(_LOCATE_SIZE / WIDE_FRAME)
        frame = render(self.scene(state, params), camera, outputs=("segmentation",))
        assert frame.segmentation is not None
        found = [
            _centroid(jnp.isin(frame.segmentation, jnp.asarray(ids))) for ids in self._target_ids
        ]
        uv, count = (jnp.stack(values) for values in zip(*found, strict=True))
        xy = jax.vmap(lambda uv, z: unproject_to_height(believed, uv, z)[:2])(
            uv, jnp.asarray(self._target_heights)
        )
        clear = (count > 0) & (count >= _STILL_SEEN * state.pixels)
        targets = jnp.where(clear[:, None], xy, state.targets)
        pixels = jnp.maximum(count, state.pixels)
        return dataclasses.replace(
            state,
            targets=targets,
            pixels=pixels,
            located=targets[state.stage],
            seen=pixels[state.stage] > 0,
        )

    def reposition(self, key: jax.Array, state: State, params: EnvParams) -> State:
        """The global policy, second half: the TCP goes to a random pose near the located target.

        A pose out of the arm's reach is drawn again, up to a bound; `State.draws` counts.
        """
        arm, draws, reachable = self._draw_arm(
            key, lambda key: self._start_pose(key, state, params), jnp.ones((), bool)
        )
        data = state.data.replace(
            qpos=state.data.qpos.at[self._arm_qpos].set(arm),
            ctrl=self._servo_targets(arm, jnp.ones(())),
        )
        data = tree.kinematics(self.mjx_model, data)
        return dataclasses.replace(state, data=data, draws=draws, reachable=reachable)

    def jump(self, state: State, params: EnvParams) -> State:
        """Where `state.jump`: the second half of the global policy at a change of stage.

        The hand goes, as it is turned, to a random xy near the target that `locate` found, and to
        the stage's start height. What it holds goes with it; to pick, it opens. An arm that cannot
        reach any of the drawn poses stays where it is.
        """
        key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.step)
        tcp = self.tcp(state)
        arm, draws, reachable = self._draw_arm(
            key, lambda key: self._next_pose(key, state, params), state.jump
        )
        moves = state.jump & reachable
        data = state.data
        arm = jnp.where(moves, arm, data.qpos[self._arm_qpos])
        qpos = data.qpos.at[self._arm_qpos].set(arm)
        motion = control.forward_kinematics(self.chain, arm).tcp @ control.inverse(tcp)
        held = self.task.held(self._ids, data)
        for address, body_held in zip(self._movable_qpos, held, strict=True):
            pose = qpos[address : address + 7]
            moved = jnp.where(moves & body_held, control.carried(motion, pose), pose)
            qpos = qpos.at[address : address + 7].set(moved)
        opens = moves & jnp.asarray(self._opens)[state.stage]
        qpos = qpos.at[self._gripper_qpos].set(
            jnp.where(opens, self._open, qpos[self._gripper_qpos])
        )
        opened = self._servo_targets(arm, jnp.ones(()))
        kept = jnp.concatenate([arm, data.ctrl[-len(self._open) :]])
        data = data.replace(
            qpos=qpos,
            qvel=jnp.where(moves, 0.0, data.qvel),
            qacc_warmstart=jnp.where(moves, 0.0, data.qacc_warmstart),
            ctrl=jnp.where(moves, jnp.where(opens, opened, kept), data.ctrl),
        )
        data = tree.kinematics(self.mjx_model, data)
        return dataclasses.replace(
            state, data=data, draws=state.draws + draws, jump=jnp.zeros((), bool)
        )

    def _draw_arm(
        self, key: jax.Array, draw_pose: Callable[[jax.Array], jax.Array], wanted: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Arm [J] at the first of the drawn TCP poses that is in reach (home where none is, or none
        is `wanted`), the number of draws, and whether one was."""

        def draw(
            carry: tuple[jax.Array, jax.Array, jax.Array],
        ) -> tuple[jax.Array, jax.Array, jax.Array]:
            count = carry[0]
            target = draw_pose(jax.random.fold_in(key, count))
            arm = control.reach(self.chain, home, target)
            tcp = control.forward_kinematics(self.chain, arm).tcp
            return count + 1, arm, jnp.all(jnp.abs(control.pose_error(tcp, target)) < _IN_REACH)

        home = jnp.asarray(self.chain.home)
        draws, arm, reachable = jax.lax.while_loop(
            lambda carry: ~carry[2] & (carry[0] < _MAX_DRAWS) & wanted,
            draw,
            (jnp.zeros((), jnp.int32), home, jnp.zeros((), bool)),
        )
        return jnp.where(reachable, arm, home), draws, reachable

    def _start_pose(self, key: jax.Array, state: State, params: EnvParams) -> jax.Array:
        """TCP pose [4, 4] near the located target, pointing down."""
        pose_key, yaw_key = _pose_keys(key)
        yaw = _uniform(yaw_key, params.start_yaw) + params.align_hand * state.camera_angle
        return control.pointing_down(self._near_target(pose_key, state, params), yaw)

    def _next_pose(self, key: jax.Array, state: State, params: EnvParams) -> jax.Array:
        """TCP pose [4, 4] near the located target, turned as it is."""
        pose_key, _ = _pose_keys(key)
        return self.tcp(state).at[:3, 3].set(self._near_target(pose_key, state, params))

    def _near_target(
        self, keys: tuple[jax.Array, jax.Array], state: State, params: EnvParams
    ) -> jax.Array:
        """[3] near the located target, at the height that the stage begins with."""
        xy_key, height_key = keys
        offset = jax.random.uniform(xy_key, (2,), minval=-1.0, maxval=1.0) * params.start_radius
        height = TABLE_HEIGHT + _uniform(height_key, params.start_height[state.stage])
        return jnp.append(state.located + offset, height)

    def step(self, state: State, action: jax.Array, params: EnvParams) -> State:
        """One control step (50 ms) of `action` [10]; see the class. Latches success and NaN.

        Where a stage of the task ends, the global policy puts the hand near the next target before
        the step returns. Batches do better with `Runner.step` or `rollout.step_worlds`: under
        `vmap` every world would pay for the global policy in every step.
        """
        state = self.act(state, action)
        if len(self.task.stages) == 1:
            return state
        return jax.lax.cond(
            state.jump, lambda s: self.jump(self.locate(s, params), params), lambda s: s, state
        )

    def act(self, state: State, action: jax.Array) -> State:
        """`step` without the global policy: `State.jump` says where it is yet to be called."""
        data = state.data.replace(ctrl=self.servo(state, action))
        return self.judge(state, physics.substeps(self.mjx_model, data, _SUBSTEPS))

    def servo(self, state: State, action: jax.Array) -> jax.Array:
        """Controls [nu] for an `action` [10]: joint and finger positions to hold for a step."""
        target = apply_delta(self.tcp(state), action[:9])
        now = state.data.qpos[self._arm_qpos]
        arm = now + self._slowed(control.solve_ik(self.chain, now, target) - now)
        gripper = (state.data.ctrl[-len(self._open) :] - self._closed) / (self._open - self._closed)
        goal = jnp.where(action[9] > 0.5, 1.0, 0.0)
        limit = self.robot.gripper_speed
        opening = jnp.mean(gripper) + jnp.clip(goal - jnp.mean(gripper), -limit, limit)
        return self._servo_targets(arm, opening)

    def judge(self, state: State, data: mjx.Data) -> State:
        """The state after the physics of a step gave `data`: divergence, success, stage.

        A world that is solved has its outcome: how long it is stepped on after that depends on the
        other worlds of its batch.
        """
        finite = jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
        nan = state.nan | (~finite & ~state.success)
        kept = nan | ~finite
        data = jax.tree.map(lambda new, old: jnp.where(kept, old, new), data, state.data)
        after = dataclasses.replace(state, data=data)
        opening = self.opening(after)
        solved = self.task.success(self._ids, data, state.object_start, opening) & ~nan
        success = state.success | solved
        stage = self.task.next_stage(self._ids, data, state.stage, opening)
        stage = jnp.where(nan | success, state.stage, stage)
        return dataclasses.replace(
            after,
            step=state.step + 1,
            success=success,
            nan=nan,
            stage=stage,
            jump=stage != state.stage,
        )

    def expert(self, state: State) -> jax.Array:
        """Action [10] of the scripted expert, which knows the true state."""
        tcp = self.tcp(state)
        command = self.task.expert(
            self._ids, state.data, tcp, self.opening(state), state.object_start, state.stage
        )
        delta = encode_delta(tcp, control.step_towards(tcp, command.target))
        return jnp.append(delta, command.gripper)

    # -- observation -------------------------------------------------------------------------------

    def tcp(self, state: State) -> jax.Array:
        """Pose [4, 4] of the TCP in the world."""
        rotation, position = (
            state.data.site_xmat[self._tcp_site],
            state.data.site_xpos[self._tcp_site],
        )
        return jnp.eye(4).at[:3, :3].set(rotation.reshape(3, 3)).at[:3, 3].set(position)

    def opening(self, state: State) -> jax.Array:
        """Opening of the gripper [], 0 closed .. 1 open."""
        fingers = state.data.qpos[self._gripper_qpos]
        return jnp.mean((fingers - self._closed) / (self._open - self._closed))

    def object_position(self, state: State) -> jax.Array:
        """Position [3] of the target object in the world."""
        return self.task.object_position(self._ids, state.data)

    def camera(self, state: State, params: EnvParams, *, frame: int = WIDE_FRAME) -> Camera:
        """This episode's camera: a square image of `frame` pixels, the paper's focal length."""
        paper = Camera.from_fovy(
            params.camera_fovy, PAPER_FRAME, PAPER_FRAME, state.camera_to_world
        )
        centre = jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
        shift = (frame - PAPER_FRAME) / 2
        return Camera(paper.K + shift * centre, state.camera_to_world, frame, frame)

    def calibrated_camera(
        self, state: State, params: EnvParams, *, frame: int = WIDE_FRAME
    ) -> Camera:
        """The camera that policies believe in: `camera` with the params' calibration error.

        Pixels are the true camera's. Which of them are the crop, where the overlay goes, what the
        proprioception says and where the target is located follow from this one.
        """
        return miscalibrated(
            self.camera(state, params, frame=frame),
            params.calibration_pixels,
            params.calibration_rotation,
            params.calibration_translation,
        )

    def scene(self, state: State, params: EnvParams) -> Any:
        """The world as the renderer's `Scene`."""
        xmat = state.data.geom_xmat.reshape(-1, 3, 3)
        return self.scene_model(state.data.geom_xpos, xmat, params)

    def observe(
        self, state: State, params: EnvParams, spec: AlignSpec, *, frame: int = WIDE_FRAME
    ) -> Aligned:
        """What a policy sees: the aligned image [size, size, 3] uint8 and proprioception.

        Only the pixels of the policy's window are rendered, at the policy's resolution. `frame` is
        the side of the virtual full image that a `border="shift"` window must stay inside. With
        `spec.isolate` the gripper and the task's objects are shown, as the simulator knows them.
        """
        view, origin = self._window(state, params, spec, frame)
        true_view = spec.view_camera(self.camera(state, params, frame=frame))
        window = Window(origin, spec.size, spec.size)
        outputs = ("rgb", "segmentation") if spec.isolate else ("rgb",)
        seen = render(self.scene(state, params), true_view, window, outputs=outputs)
        assert seen.rgb is not None
        mask = None
        if spec.isolate:
            assert seen.segmentation is not None
            mask = jnp.isin(seen.segmentation, jnp.asarray(self.scene_model.handled))
        tcp, opening = self.tcp(state), self.opening(state)
        return align_window(seen.rgb, view, origin, tcp, opening, spec, mask=mask)

    def window_camera(
        self, state: State, params: EnvParams, spec: AlignSpec, *, frame: int = WIDE_FRAME
    ) -> Camera:
        """The calibrated camera of the image that `observe` gives: K [3, 3] in pixels of the
        size x size window, cam_to_world [4, 4] in metres."""
        view, origin = self._window(state, params, spec, frame)
        return view.cropped(origin[::-1].astype(jnp.float32), spec.size, spec.size)

    def render(self, state: State, params: EnvParams, size: int, **options: Any) -> Frame:
        """The paper's full frame at `size` x `size` pixels; options as in `palm_jax.render`."""
        camera = self.camera(state, params, frame=PAPER_FRAME).scaled(size / PAPER_FRAME)
        return render(self.scene(state, params), camera, **options)

    # -- internals ---------------------------------------------------------------------------------

    def _window(
        self, state: State, params: EnvParams, spec: AlignSpec, frame: int
    ) -> tuple[Camera, jax.Array]:
        """The frame at the policy's resolution as the calibrated camera has it, and the origin
        int32 [2] (row, col) of the policy's window in it, pixels."""
        view = spec.view_camera(self.calibrated_camera(state, params, frame=frame))
        return view, window_origin(view, self.tcp(state), spec)[0]

    def _home_qpos(self) -> jax.Array:
        qpos = jnp.asarray(self.mj_model.qpos0, jnp.float32)
        qpos = qpos.at[self._arm_qpos].set(self.chain.home)
        return qpos.at[self._gripper_qpos].set(self._open)

    def _slowed(self, move: jax.Array) -> jax.Array:
        """`move` [J] (radians) of one control step, scaled down to the robot's speed limits."""
        allowed = jnp.asarray(self.robot.velocity_limits) / CONTROL_RATE
        return move * jnp.minimum(1.0, jnp.min(allowed / jnp.maximum(jnp.abs(move), 1e-9)))

    def _servo_targets(self, arm: jax.Array, opening: jax.Array) -> jax.Array:
        fingers = self._closed + opening * (self._open - self._closed)
        return jnp.concatenate([arm, fingers])


def _at_distance(pose: jax.Array, factor: jax.Array) -> jax.Array:
    """Camera pose [4, 4] at `factor` [] times its distance from the workspace centre."""
    # As a sum, so that a factor of one changes no bit.
    off = pose[:3, 3] - jnp.asarray(WORKSPACE_CENTRE)
    return pose.at[:3, 3].add((factor - 1.0) * off)


def front_camera() -> np.ndarray:
    """Pose [4, 4] of RLBench's front camera (OpenCV axes): facing the robot, 25 degrees down."""
    sin, cos = np.sin(np.radians(25.0)), np.cos(np.radians(25.0))
    right, down, forward = (0.0, 1.0, 0.0), (sin, 0.0, -cos), (-cos, 0.0, -sin)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, down, forward], -1)
    pose[:3, 3] = (1.35, 0.0, 1.58)
    return pose
