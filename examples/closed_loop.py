"""A trained policy moves a robot in a closed loop; here the robot is the simulator.

    python examples/closed_loop.py RUN
    python examples/closed_loop.py RUN --server 127.0.0.1:8000      # of `python -m palm_jax serve`

For a robot of your own, write a class with the three methods of `Robot` below and give it to
`drive`: where the camera is, what it sees, and how the arm is moved. Nothing else here needs to be
kept; with `--server` not even JAX is needed on the robot's side.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np


class Robot(Protocol):
    """What a policy needs of a robot."""

    def calibration(self) -> tuple[np.ndarray, np.ndarray]:
        """K [3, 3] in pixels of the image, and the camera's pose [4, 4] in the robot's base frame
        (OpenCV axes: x right, y down, z forward)."""

    def sense(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Now: image uint8 [H, W, 3] RGB; TCP pose [4, 4] in the base frame (z the direction of
        approach, y the opening axis); opening of the gripper, 0 closed to 1 open."""

    def move(self, target: np.ndarray, gripper: float) -> bool:
        """Go towards a TCP pose [4, 4] for one period of the policy (20 a second) and open (1) or
        close (0) the gripper. Returns whether to stop: the task is done, or something is wrong."""


Act = Callable[..., tuple[np.ndarray, float]]
"""`Policy.act` or `PolicyClient.act`."""


def drive(act: Act, robot: Robot, steps: int, *, period: float = 0.0) -> int:
    """One episode; returns the number of steps taken.

    Args:
      act: of a policy.
      robot: see `Robot`.
      steps: at most.
      period: seconds of a step, where the robot does not wait by itself.

    An input that the policy refuses, and an answer that is not finite, end the loop with an error;
    the arm then stays at its last target.
    """
    K, cam_to_world = robot.calibration()
    for step in range(steps):
        start = time.monotonic()
        image, tcp, opening = robot.sense()
        target, gripper = act(image, K, cam_to_world, tcp, opening)
        if robot.move(target, gripper):
            return step + 1
        time.sleep(max(0.0, period - (time.monotonic() - start)))
    return steps


class SimulatedRobot:
    """A world of this package, seen by a camera of other resolution and lens than the training's.

    Scene i is that of the training command's own evaluation, so that successes can be compared.
    """

    def __init__(
        self,
        task: str,
        robot: str,
        domain: str,
        *,
        size: tuple[int, int],
        focal: float,
        seed: int,
        aligned: bool = True,
    ) -> None:
        import jax

        from palm_jax.align import Camera
        from palm_jax.envs import make, physics
        from palm_jax.envs.rollout import Runner
        from palm_jax.render import render

        self.env = make(task, robot)
        self.runner = Runner(self.env, worlds=1)
        self.seed, self.domain, self.solved = seed, domain, False
        self.aligned = aligned  # whether the hand's initial yaw turns with the camera
        height, width = size
        self.K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)

        def look(state: Any, params: Any) -> tuple[Any, Any, Any]:
            camera = Camera(self.K, state.camera_to_world, height, width)
            image = render(self.env.scene(state, params), camera).rgb
            return image, self.env.tcp(state), self.env.opening(state)

        self._look = jax.jit(jax.vmap(look))
        self._action = physics.jit_physics(self._to_action)

    @staticmethod
    def _to_action(tcp: Any, target: Any, gripper: Any) -> Any:
        import jax.numpy as jnp

        from palm_jax.align import encode_delta

        return jnp.append(encode_delta(tcp, target), gripper)[None]

    def begin(self, scene: int, scenes: int) -> None:
        """Set up scene number `scene` of an evaluation of so many scenes."""
        import jax

        from palm_jax.envs import shifts
        from palm_jax.envs.rollout import take_params
        from palm_jax.train.evaluate import scene_key

        key = scene_key(self.seed, self.domain)
        drawn = shifts.scenes(
            jax.random.fold_in(key, 2**32 - 1), self.env.default_params(), self.domain, scenes
        )
        drawn = shifts.aligned_hand(drawn) if self.aligned else drawn
        self.params = take_params(drawn, np.array([scene]))
        self.state = self.runner.reset(jax.random.fold_in(key, scene)[None], self.params)
        self.solved = False

    def calibration(self) -> tuple[np.ndarray, np.ndarray]:
        return self.K, np.asarray(self.state.camera_to_world[0])

    def sense(self) -> tuple[np.ndarray, np.ndarray, float]:
        image, tcp, opening = (np.asarray(x[0]) for x in self._look(self.state, self.params))
        return image, tcp, float(opening)

    def move(self, target: np.ndarray, gripper: float) -> bool:
        tcp = np.asarray(self.env.tcp(_first(self.state)))
        action = self._action(tcp, target, np.float32(gripper))
        self.state = self.runner.step(self.state, action, self.params)
        self.solved = bool(self.state.success[0])
        return self.solved or bool(self.state.nan[0])


def _first(tree: Any) -> Any:
    import jax

    return jax.tree.map(lambda leaf: leaf[0], tree)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("run", help="run folder of a policy (what the server loaded)")
    parser.add_argument("--server", help="HOST:PORT; by default the policy runs in this process")
    parser.add_argument("--episodes", type=int, default=24)
    parser.add_argument("--domain", default="in_domain", help="of the scenes")
    parser.add_argument("--robot", default="", help="by default that of the domain's evaluation")
    parser.add_argument("--image-size", type=int, nargs=2, default=(480, 640))
    parser.add_argument("--focal", type=float, default=440.0, help="pixels")
    parser.add_argument("--zoom", type=float, default=1.0, help="see palm_jax.policy.load")
    words = parser.parse_args()
    size = tuple(words.image_size)

    # The task and its scenes are the simulator's part: a robot has its own.
    from pathlib import Path

    from palm_jax.envs import shifts
    from palm_jax.train.workspace import quoted_variant, stored_config

    config = stored_config(Path(words.run))
    own = config.second_robot if shifts.other_robot(words.domain) else config.robot
    if words.server:
        from palm_jax.policy_client import PolicyClient

        host, _, port = words.server.rpartition(":")
        policy: Any = PolicyClient(host, int(port))
    else:
        from palm_jax.policy import load

        policy = load(words.run, image_size=size, zoom=words.zoom)
    robot = SimulatedRobot(
        config.task,
        words.robot or own,
        words.domain,
        size=size,
        focal=words.focal,
        seed=config.eval_seed,
        aligned=quoted_variant(Path(words.run)) == "aligned",
    )
    solved = 0
    for episode in range(words.episodes):
        robot.begin(episode, words.episodes)
        policy.reset()
        steps = drive(policy.act, robot, robot.env.task.horizon)
        solved += robot.solved
        outcome = "solved" if robot.solved else "not solved"
        print(f"episode {episode + 1:3d}: {outcome} after {steps} steps", flush=True)
    print(f"{solved} of {words.episodes} solved ({config.task}, {words.domain})")
    print(f"latency of act: {policy.latency}")


if __name__ == "__main__":
    main()
