"""Speed of behaviour cloning: the training step of the CPU presets, and acting.

One step = random camera turn, random perspective, random overlay, crop, forward, backward and
Adam, from uint8 images in host memory: width 16, 84 px cropped to 76, batch 64.
"""

import time
from typing import Any

import jax
import numpy as np

from benchmarks.common import measure
from palm_jax import align
from palm_jax.train import learner

SIDE = 84
PROPRIO_DIM = 8
SAMPLES = 1024
ACT_BATCHES = (1, 64, 256)


def _data() -> learner.Batch:
    rng = np.random.default_rng(0)
    camera = align.Camera.from_fovy(17.0, SIDE, SIDE, np.eye(4))
    return learner.Batch(
        {"front": rng.integers(0, 256, (SAMPLES, SIDE, SIDE, 3), dtype=np.uint8)},
        rng.normal(size=(SAMPLES, PROPRIO_DIM)).astype(np.float32),
        rng.normal(size=(SAMPLES, learner.ACTION_DIM)).astype(np.float32),
        cameras={
            "front": jax.tree.map(lambda x: np.repeat(np.asarray(x)[None], SAMPLES, 0), camera)
        },
        tcp=np.tile(np.array([0.0, 0.0, 1.2], np.float32), (SAMPLES, 1)),
    )


def run(*, steps: int = 20, repeats: int = 10) -> dict[str, Any]:
    """Measure; `samples_per_second` is the best step's, `act` maps batch sizes to images/s."""
    config = learner.LearnerConfig(overlay_warmup_steps=0, turn=(0.35, 0.17))
    made = learner.make_learner(config, PROPRIO_DIM)
    data, key = _data(), jax.random.key(0)
    bank = jax.jit(align.procedural_bank, static_argnums=(1, 2))(key, 64, SIDE)
    state = made.jitted_init(key, learner.fit_normalizer(data.proprio, data.actions))

    start = time.perf_counter()
    state, _ = jax.block_until_ready(
        made.jitted_step(key, state, learner.take(data, np.arange(64)), bank)
    )
    compile_seconds = time.perf_counter() - start
    done = 1

    def step() -> None:
        nonlocal state, done
        indices = learner.batch_indices(key, done, SAMPLES, config.batch_size)
        state, _ = jax.block_until_ready(
            made.jitted_step(key, state, learner.take(data, indices), bank)
        )
        done += 1

    training = measure(step, repeats=steps, items=config.batch_size)
    policy = made.policy_state(state)

    def act(count: int) -> dict[str, float]:
        images, proprio = {"front": data.images["front"][:count]}, data.proprio[:count]
        return measure(
            lambda: made.jitted_act(key, policy, images, proprio),
            repeats=repeats,
            items=count,
        )

    return {
        "samples_per_second": training["per_second"],
        "samples_per_second_median": training["per_second_median"],
        "cpu_ms_per_sample": training["cpu_ms_each"],
        "first_step_seconds": compile_seconds,
        "act": {str(count): act(count) for count in ACT_BATCHES},
        "width": config.width,
        "pixels": config.crop,
        "batch_size": config.batch_size,
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(state.params)),
        "device": jax.devices()[0].device_kind,
    }
