"""`python -m benchmarks.first_step TASK ROBOT WORLDS`: seconds until the first reset and step are
done in this process, imports left out. Run by `bench_physics` in processes of their own."""

import json
import sys
import time

import jax

from palm_jax.envs import make
from palm_jax.envs.rollout import Runner, repeat_params


def main(task: str, robot: str, worlds: int) -> None:
    """Prints `{"seconds": ...}`."""
    start = time.perf_counter()
    env = make(task, robot)
    runner, params = Runner(env, worlds), repeat_params(env.default_params(), worlds)
    state = runner.reset(jax.random.split(jax.random.key(0), worlds), params)
    jax.block_until_ready(runner.step(state, runner.expert(state), params).data.qpos)
    print(json.dumps({"seconds": time.perf_counter() - start}))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
