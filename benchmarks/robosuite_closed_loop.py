"""A policy that was trained on a robosuite recording, back in robosuite: does it lift the cube?

Runs in robosuite's environment (see `make_robosuite_sample.py`), which has no JAX; the policy
answers behind its websocket, from palm_jax's own environment::

    venv-robosuite/bin/pip install websockets msgpack
    python -m palm_jax serve runs/lift/palm --image-size 128 128
    MUJOCO_GL=egl PYTHONPATH=. venv-robosuite/bin/python benchmarks/robosuite_closed_loop.py

Scenes are robosuite's own, drawn from seeds that no recording has. `--turn` moves the camera on a
circle about the table's middle, where no recording was made from.
"""

import argparse
import json
import statistics
import sys
from pathlib import Path
from typing import Any

import numpy as np
from make_robosuite_sample import make
from robosuite.utils import camera_utils

from palm_jax.policy_client import PolicyClient

FINGER = 0.04  # metres that each finger opens
STEP = 0.05  # metres that robosuite's controller takes for an action of 1
FIRST_SEED = 900_000
TABLE = np.array([0.0, 0.0, 0.8])


def turned(env: Any, camera: str, degrees: float) -> None:
    """Turns the camera about the vertical line through the table's middle."""
    model = env.sim.model._model
    index = model.camera(camera).id
    angle = np.radians(degrees)
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    model.cam_pos[index] = TABLE + turn @ (model.cam_pos[index] - TABLE)
    half = np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
    model.cam_quat[index] = product(half, model.cam_quat[index])
    env.sim.forward()


def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Of two quaternions, scalar first."""
    vector = p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.array([p[0] * q[0] - p[1:] @ q[1:], *vector])


def hand(observation: dict) -> np.ndarray:
    """[4, 4] pose of the hand, from its quaternion (scalar last)."""
    x, y, z, w = observation["robot0_eef_quat"]
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = observation["robot0_eef_pos"]
    return pose


def episode(env: Any, policy: PolicyClient, args: argparse.Namespace) -> int | None:
    """Control steps until the cube is lifted; None if it never was."""
    observation = env.reset()
    turned(env, args.camera, args.turn)
    if args.turn:  # the picture of the reset is from where the camera was
        observation = env._get_observations(force_update=True)
    size = (args.size, args.size)
    K = camera_utils.get_camera_intrinsic_matrix(env.sim, args.camera, *size)
    pose = camera_utils.get_camera_extrinsic_matrix(env.sim, args.camera)
    policy.reset()
    for step in range(args.steps):
        tcp = hand(observation)
        opening = float(np.clip(np.abs(observation["robot0_gripper_qpos"]).mean() / FINGER, 0, 1))
        image = np.ascontiguousarray(observation[f"{args.camera}_image"][::-1])
        target, gripper = policy.act(image, K, pose, tcp, opening)
        action = np.zeros(7)
        # The controller covers but a part of a motion within a step: labels are what was covered.
        action[:3] = np.clip(args.gain * (target[:3, 3] - tcp[:3, 3]) / STEP, -1, 1)
        action[6] = -1.0 if gripper > 0.5 else 1.0
        observation, _, _, _ = env.step(action)
        if env._check_success():
            return step + 1
    return None


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--task", default="lift")
    parser.add_argument("--camera", default="agentview")
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--steps", type=int, default=120, help="control steps of an episode")
    parser.add_argument("--turn", type=float, default=0.0, help="degrees of the camera")
    parser.add_argument("--gain", type=float, default=4.0, help="command over covered motion")
    parser.add_argument("--port", type=int, default=8000)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    taken: list[int | None] = []
    with PolicyClient(port=args.port) as policy:
        for index in range(args.episodes):
            env = make(args.task, args.camera, args.size, FIRST_SEED + index)
            taken.append(episode(env, policy, args))
            env.close()
            print(f"episode {index}: {taken[-1] or 'not'} lifted", flush=True)
        latency = statistics.median(policy.server_ms)
    solved = sum(steps is not None for steps in taken)
    print(f"{solved} of {args.episodes} lifted, camera turned by {args.turn:g} degrees")
    print(f"an action: median {latency:.1f} ms on the server")
    if args.json:
        found = {"turn": args.turn, "solved": solved, "episodes": args.episodes, "steps": taken}
        args.json.write_text(json.dumps(found | {"infer_ms": latency}, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
