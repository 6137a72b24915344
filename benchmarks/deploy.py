"""`python -m benchmarks.deploy RUN`: how fast a policy acts, and how its actions depend on the
camera. Prints JSON.

- latency of `Policy.act` for images of several sizes, and through `palm_jax serve` on loopback;
- the same states seen by several cameras, and what the actions differ from those of the evaluation,
  which renders the policy's window itself.
"""

import argparse
import contextlib
import dataclasses
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common
from palm_jax.align import Camera
from palm_jax.envs.base import State
from palm_jax.envs.rollout import Runner
from palm_jax.policy import Policy, load
from palm_jax.policy_client import PolicyClient
from palm_jax.render import render
from palm_jax.train import evaluate, methods, workspace
from palm_jax.train.evaluate import VIEW, Evaluator, Runners
from palm_jax.train.learner import to_action

SIZES = ((480, 640), (720, 1280), (1080, 1920))
CAMERAS = {  # focal length, rows, columns
    "1024 x 1024, f 703 (the training's frame)": (703.3542, 1024, 1024),
    "480 x 640, f 440": (440.0, 480, 640),
    "720 x 1280, f 700": (700.0, 720, 1280),
    "512 x 512, f 703 (the paper's frame)": (703.3542, 512, 512),
}
EVERY = 6
"""Of the states of an episode one in so many is looked at."""


def latency(run: Path, calls: int) -> dict[str, Any]:
    """Milliseconds of an action by image size; and through a server, there and back."""
    found = {}
    for height, width in SIZES:
        policy = load(run, image_size=(height, width))
        observation = _sample(policy, height, width)
        for _ in range(calls):
            policy.act(*observation)
        found[f"{height} x {width}"] = dataclasses.asdict(policy.latency)
        if (height, width) == SIZES[0]:
            found[f"{height} x {width}, through a server"] = _served(run, observation, calls)
    return found


def _sample(policy: Policy, height: int, width: int) -> list[Any]:
    """Random pixels; a TCP straight below the camera, at a height of the training's."""
    K = np.array([[0.7 * width, 0, width / 2], [0, 0.7 * width, height / 2], [0, 0, 1]])
    camera = np.diag([1.0, -1, -1, 1])
    tcp = camera.copy()
    tcp[2, 3] = np.mean(policy.contract.heights) if policy.contract.heights else 0.9
    camera[2, 3] = tcp[2, 3] + policy.contract.distance
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    return [image, K, camera, tcp, 1.0]


def _served(run: Path, observation: list[Any], calls: int) -> dict[str, float]:
    """There and back, the server in a process of its own."""
    with _server(run) as port, PolicyClient("127.0.0.1", port) as client:
        client.act(*observation)
        seconds = []
        for _ in range(calls):
            start = time.perf_counter()
            client.act(*observation)
            seconds.append(time.perf_counter() - start)
        times = 1e3 * np.asarray(seconds)
        return {
            "count": calls,
            "median_ms": float(np.median(times)),
            "p95_ms": float(np.percentile(times, 95)),
            "worst_ms": float(times.max()),
            "of_which_server_median_ms": float(np.median(client.server_ms[1:])),
        }


@contextlib.contextmanager
def _server(run: Path) -> Iterator[int]:
    """`python -m palm_jax serve`; its port."""
    words = [sys.executable, "-u", "-m", "palm_jax", "serve", str(run), "--port", "0"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if address := re.search(r"ws://[\d.]+:(\d+)", line):
                yield int(address[1])
                return
        raise RuntimeError(f"the server did not start: {' '.join(words)}")
    finally:
        process.terminate()
        process.communicate()


def cameras(run: Path, worlds: int) -> dict[str, Any]:
    """How far actions on whole images are from those on rendered windows, over the policy's own
    episodes: position of the target (mm), its rotation (degrees), the gripper's command."""
    config = workspace.stored_config(run)
    method = methods.find(config.method[0])
    if method.isolate:
        return {}
    runners = Runners.of(config.task, config.robot, config.second_robot, worlds)
    evaluator, state = workspace.load_policy(run, runners)
    episodes = _episodes(evaluator, state, config.eval_seed)
    policy = load(run, image_size=None)
    frames = dataclasses.replace(policy.contract, rendered=False)
    as_camera_images = Policy(evaluator.learner, policy.state, frames)
    found: dict[str, Any] = {"states": len(episodes) * worlds}
    for name, (focal, height, width) in CAMERAS.items():
        actors = {name: policy}
        if (height, width) == (1024, 1024):
            actors["the same, cut out before drawing and resizing (align)"] = as_camera_images
        for label, actor in actors.items():
            found[label] = _compared(evaluator, episodes, actor, focal, height, width)
    return found


def _episodes(evaluator: Evaluator, state: Any, seed: int) -> list[tuple[State, Any, np.ndarray]]:
    """(states, params, the evaluation's actions without noise) along a batch of episodes."""
    runner, method = evaluator.runner, evaluator.method
    spec = method.spec(evaluator.task, evaluator.image_size)
    params = evaluator.scenes("in_domain", seed=seed, count=runner.worlds, aligned=True)
    scenes = evaluate.scene_key(seed, "in_domain")
    keys = jax.vmap(lambda i: jax.random.fold_in(scenes, i))(np.arange(runner.worlds))
    kept: list[State] = []
    seen = iter(range(10**6))

    def watch(now: State) -> None:
        if next(seen) % EVERY == 0:
            kept.append(now)

    noise = jax.random.fold_in(scenes, 2**31)
    runner.run(noise, keys, params, evaluator.act(state), spec, frame=method.frame, watch=watch)
    learner = evaluator.learner

    @jax.jit
    def without_noise(image: jax.Array, proprio: jax.Array) -> jax.Array:
        prediction, _ = learner.predict(state, {VIEW: image}, proprio)
        return to_action(state.normalizer.action.denormalize(prediction))

    answers = []
    for now in kept:
        view = runner.observe(now, params, spec, frame=method.frame)
        answers.append((now, params, np.asarray(without_noise(view.image, view.proprio))))
    return answers


def _compared(
    evaluator: Evaluator,
    episodes: list[tuple[State, Any, np.ndarray]],
    policy: Policy,
    focal: float,
    height: int,
    width: int,
) -> dict[str, float]:
    env, runner = evaluator.runner.env, evaluator.runner
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
    look = _photographer(runner, K, height, width)
    moved, turned, gripper, coverage, size = [], [], [], [], []
    for state, params, expected in episodes:
        for world in range(runner.worlds):
            one = jax.tree.map(lambda leaf, world=world: leaf[world], (state, params))
            image = np.asarray(look(*one))
            tcp, opening = np.asarray(env.tcp(one[0])), float(env.opening(one[0]))
            got = policy.decide(image, K, one[0].camera_to_world, tcp, np.clip(opening, 0, 1))
            moved.append(np.linalg.norm(got.action[6:9] - expected[world, 6:9]))
            size.append(np.linalg.norm(expected[world, 6:9]))
            turned.append(_angle(got.action, expected[world]))
            gripper.append(got.gripper != expected[world, 9])
            coverage.append(got.coverage)
    millimetres = 1e3 * np.asarray(moved)
    return {
        "median_mm": float(np.median(millimetres)),
        "p95_mm": float(np.percentile(millimetres, 95)),
        "median_degrees": float(np.degrees(np.median(turned))),
        "p95_degrees": float(np.degrees(np.percentile(turned, 95))),
        "gripper_differs": float(np.mean(gripper)),
        "median_coverage": float(np.median(coverage)),
        "median_step_mm": float(1e3 * np.median(size)),
    }


def _photographer(runner: Runner, K: np.ndarray, height: int, width: int) -> Any:
    env = runner.env

    @jax.jit
    def look(state: State, params: Any) -> jax.Array:
        rgb = render(env.scene(state, params), Camera(K, state.camera_to_world, height, width)).rgb
        return jnp.asarray(rgb)

    return look


def _angle(one: np.ndarray, other: np.ndarray) -> float:
    """Radians between the rotations of two actions [10]."""

    def matrix(action: np.ndarray) -> np.ndarray:
        x, y = action[:3], action[3:6]
        return np.stack([x, y, np.cross(x, y)], -1)

    apart = np.linalg.norm(matrix(one) - matrix(other)) / 8**0.5
    return float(2 * np.arcsin(min(apart, 1.0)))


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--calls", type=int, default=300)
    parser.add_argument("--worlds", type=int, default=8)
    words = parser.parse_args()
    found: dict[str, Any] = {"load_before": [round(x, 2) for x in os.getloadavg()]}
    found["latency"] = latency(words.run, words.calls)
    found["load_between"] = [round(x, 2) for x in os.getloadavg()]
    found["cameras"] = cameras(words.run, words.worlds)
    print(json.dumps({"machine": common.conditions(), **found}, indent=1))


if __name__ == "__main__":
    main()
