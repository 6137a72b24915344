"""Robot data that this package did not make: Lift and Can, recorded with robosuite.

Runs in an environment of its own, because robosuite wants older packages than palm_jax, and a
MuJoCo before version 4::

    python3.11 -m venv venv-robosuite
    venv-robosuite/bin/pip install robosuite==1.5.2 mujoco==3.3.7 h5py
    MUJOCO_GL=egl venv-robosuite/bin/python benchmarks/make_robosuite_sample.py --out lift.hdf5
    MUJOCO_GL=egl venv-robosuite/bin/python benchmarks/make_robosuite_sample.py --task can --out
    can.hdf5

The files are robomimic's: `data/demo_i/{states, actions, rewards, dones, obs/*}`, images upright
(as robomimic's own scripts write them; robosuite's observations are upside down, which
`--upside-down` keeps), `camera_info` and `model_file` in a demo's attributes. Of the model only
cameras and the bodies they hang on are kept: no mesh, no texture, no path of this machine.

One key is not robomimic's, and is what makes the file a measure: `obs/CAMERA_tcp_uv`, the pixel at
which robosuite's own renderer shows the grip site. Everything but that site is hidden, the frame is
rendered with four times the pixels a side, and the centre of what is left is taken. No camera
matrix is involved.
"""

import argparse
import copy
import json
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import mujoco
import numpy as np
import robosuite
from robosuite.utils import camera_utils

TASKS = {"lift": "Lift", "can": "PickPlaceCan"}
OBJECTS = {"lift": "cube_pos", "can": "Can_pos"}
NUMBERS = (
    "robot0_eef_pos", "robot0_eef_quat", "robot0_eef_quat_site", "robot0_gripper_qpos",
    "robot0_joint_pos",
)  # fmt: skip
FINER = 4
"""Pixels per pixel when the grip site is looked for."""

OPEN, CLOSED = -1.0, 1.0


class Stage(NamedTuple):
    """Where the hand goes next: metres above the object's first position, or `shift` from it."""

    height: float
    gripper: float
    steps: int  # control steps to stay at least, e.g. for the fingers to close
    shift: tuple[float, float] = (0.0, 0.0)


PLANS = {
    "lift": (
        Stage(0.10, OPEN, 1),
        Stage(0.00, OPEN, 1),
        Stage(0.00, CLOSED, 6),
        Stage(0.14, CLOSED, 1),
    ),
    "can": (
        Stage(0.16, OPEN, 1),
        Stage(0.01, OPEN, 1),
        Stage(0.01, CLOSED, 6),
        Stage(0.22, CLOSED, 1),
        Stage(0.22, CLOSED, 1, shift=(0.02, 0.30)),
    ),
}
GAIN, NEAR, LIMIT, LONGEST = 8.0, 0.015, 1.0, 120


def make(task: str, camera: str, size: int, seed: int) -> Any:
    """The environment, with images of one camera."""
    return robosuite.make(
        TASKS[task],
        robots="Panda",
        has_renderer=False,
        has_offscreen_renderer=True,
        use_camera_obs=True,
        camera_names=camera,
        camera_heights=size,
        camera_widths=size,
        control_freq=20,
        horizon=1000,
        seed=seed,
    )


def site_pixels(env: Any, states: np.ndarray, camera: str, size: int) -> np.ndarray:
    """[T, 2] (u, v) of the grip site in the picture of a camera, found by rendering it alone.

    In pixels of the frame, (0, 0) its top left corner; NaN where nothing is seen of it.
    """
    model = copy.copy(env.sim.model._model)
    data = mujoco.MjData(model)
    site = next(i for i in range(model.nsite) if model.site(i).name.endswith("grip_site"))
    model.vis.global_.offwidth = model.vis.global_.offheight = FINER * size
    model.vis.quality.offsamples = 0  # smoothed edges would mix the ids
    model.site_group[:] = 0
    model.site_group[site] = 1
    alone = mujoco.MjvOption()
    alone.geomgroup[:], alone.sitegroup[:] = 0, 0
    alone.sitegroup[1] = 1
    pixels = np.full((len(states), 2), np.nan)
    with mujoco.Renderer(model, FINER * size, FINER * size) as renderer:
        renderer.enable_segmentation_rendering()
        for pixel, state in zip(pixels, states, strict=True):
            data.qpos[:] = state[1 : 1 + model.nq]  # after the time
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera, scene_option=alone)
            seen = renderer.render()  # ids and types, row 0 at the top
            wanted = (seen[..., 0] == site) & (seen[..., 1] == mujoco.mjtObj.mjOBJ_SITE)
            rows, columns = np.nonzero(wanted)
            if len(rows):
                pixel[:] = (columns.mean() + 0.5) / FINER, (rows.mean() + 0.5) / FINER
    return pixels


def play(
    env: Any, task: str, observation: dict, rng: np.random.Generator, *, near: bool = False
) -> Iterator[tuple]:
    """Runs the plan; yields (observation before, action, reward, state before); with `near`, from
    where the hand is near the object on."""
    anchor = observation[OBJECTS[task]].copy()
    start = rng.uniform(-0.12, 0.12, 2)
    plan = [Stage(0.16, OPEN, 1, shift=(start[0], start[1])), *PLANS[task]]
    taken = 0
    for number, stage in enumerate(plan):
        goal = anchor + np.array([*stage.shift, stage.height])
        stayed = 0
        while taken < LONGEST:
            error = goal - observation["robot0_eef_pos"]
            there = float(np.linalg.norm(error)) < NEAR
            stayed += there
            if there and stayed >= stage.steps:
                break
            action = np.zeros(7)
            action[:3] = np.clip(GAIN * error / 0.4, -LIMIT, LIMIT)
            action[6] = stage.gripper
            state = env.sim.get_state().flatten()
            after, reward, _, _ = env.step(action)
            if number > 0 or not near:
                yield observation, action, reward, state
            observation, taken = after, taken + 1


def cameras_only(xml: str) -> str:
    """The model without geoms, joints, assets and all else that needs files or takes space: world,
    bodies on the way to a camera, cameras."""
    root = ElementTree.fromstring(xml)
    for part in list(root):
        if part.tag not in ("compiler", "worldbody"):
            root.remove(part)
        elif part.tag == "compiler":
            for name in ("meshdir", "texturedir", "assetdir"):
                part.attrib.pop(name, None)
    _prune(root.find("worldbody"))
    return ElementTree.tostring(root, encoding="unicode")


def _prune(body: ElementTree.Element) -> bool:
    """Drops all children but cameras and bodies with cameras; tells whether anything is left."""
    for child in list(body):
        keep = child.tag == "camera" or (child.tag == "body" and _prune(child))
        if not keep:
            body.remove(child)
    body.text = body.tail = None
    return len(body) > 0


def camera_info(env: Any, camera: str, size: int) -> str:
    """What robosuite's own functions say: K and the pose of the camera in the world."""
    intrinsics = camera_utils.get_camera_intrinsic_matrix(env.sim, camera, size, size)
    pose = camera_utils.get_camera_extrinsic_matrix(env.sim, camera)
    return json.dumps({camera: {"intrinsics": intrinsics.tolist(), "extrinsics": pose.tolist()}})


def record(args: argparse.Namespace) -> None:
    """Records the episodes into a new file."""
    np.random.seed(args.seed)
    with h5py.File(args.out, "x") as file:
        data = file.create_group("data")
        data.attrs["total"] = 0  # room for it, see below
        data.attrs["env_args"] = json.dumps(
            {
                "env_name": TASKS[args.task],
                "env_type": 1,
                "env_version": robosuite.__version__,
                "env_kwargs": {"robots": "Panda", "control_freq": 20 / args.every},
            }
        )
        for index in range(args.episodes):
            # MuJoCo's renderer leaves robosuite's own context unusable: then one an episode.
            if args.pixels or index == 0:
                env = make(args.task, args.camera, args.size, 1000 * args.seed + index)
            rng = np.random.default_rng([args.seed, index])
            rows = list(play(env, args.task, env.reset(), rng, near=args.near))[:: args.every]
            demo = data.create_group(f"demo_{index}")
            write(demo, env, rows, args)
            heights = demo[f"obs/{OBJECTS[args.task]}"][:, 2]
            print(
                f"demo_{index}: {len(rows)} frames, raised by {np.ptp(heights):.3f} m", flush=True
            )
            if args.pixels:
                env.close()
        data.attrs["total"] = sum(int(demo.attrs["num_samples"]) for demo in data.values())


def write(demo: h5py.Group, env: Any, rows: list, args: argparse.Namespace) -> None:
    """One episode, in robomimic's layout."""
    observations, actions, rewards, states = zip(*rows, strict=True)
    image = f"{args.camera}_image"
    frames = np.stack([observation[image] for observation in observations])
    if not args.upside_down:
        frames = frames[:, ::-1]
    options: dict[str, Any] = {}
    if args.compression:
        options = {"compression": args.compression, "chunks": (1, *frames.shape[1:])}
    demo.create_dataset(f"obs/{image}", data=frames, **options)
    for key in (*NUMBERS, OBJECTS[args.task]):
        demo[f"obs/{key}"] = np.stack([observation[key] for observation in observations])
    if args.pixels:
        pixels = site_pixels(env, np.stack(states), args.camera, args.size)
        if args.upside_down:
            pixels[:, 1] = args.size - pixels[:, 1]
        demo[f"obs/{args.camera}_tcp_uv"] = pixels
    demo["actions"], demo["states"] = np.stack(actions), np.stack(states)
    demo["rewards"] = np.asarray(rewards)
    demo["dones"] = np.arange(len(rows)) == len(rows) - 1
    demo.attrs["num_samples"] = len(rows)
    demo.attrs["model_file"] = cameras_only(env.sim.model.get_xml())
    demo.attrs["camera_info"] = camera_info(env, args.camera, args.size)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--task", choices=sorted(TASKS), default="lift")
    parser.add_argument("--camera", default="agentview")
    parser.add_argument("--episodes", type=int, default=2)
    parser.add_argument("--size", type=int, default=128, help="pixels per side")
    parser.add_argument("--every", type=int, default=1, help="keep every n-th control step")
    parser.add_argument(
        "--near", action="store_true", help="begin where the hand is near the object"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--no-pixels", dest="pixels", action="store_false", help="do not measure CAMERA_tcp_uv"
    )
    parser.add_argument("--upside-down", action="store_true", help="as robosuite renders them")
    parser.add_argument("--compression", choices=("gzip", "lzf"), default=None)
    parser.add_argument("--out", type=Path, required=True)
    record(parser.parse_args())
    return 0


if __name__ == "__main__":
    sys.exit(main())
