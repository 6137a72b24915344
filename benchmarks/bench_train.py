"""Speed of behaviour cloning: the training step, beside PyTorch, and acting.

One step = random perspective, random overlay, crop, forward, backward and Adam, from uint8 images
in host memory: 84 px cropped to 76, batch 64, at the CPU presets' width and at the paper's. The
random camera turn of the CPU presets, which PyTorch's step does not have, is a row of its own.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks.common import headline, measure, side_by_side
from benchmarks.peers import train as others
from palm_jax import align
from palm_jax.train import learner, loop

SIDE = 84
PROPRIO_DIM = 8
SAMPLES = 1024
BACKGROUNDS = 64
WIDTHS = (16, 64)
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


class _Trainer(NamedTuple):
    """Our step, ready to be timed."""

    call: Callable[[], None]
    parameters: int
    compile_seconds: float
    act: Callable[[int], Any]


def run(*, repeats: int = 20) -> dict[str, Any]:
    """`samples_per_second` of the best step at width 16, `act` maps batch sizes to images/s."""
    key, data = jax.random.key(0), _data()
    bank = jax.jit(align.procedural_bank, static_argnums=(1, 2))(key, BACKGROUNDS, SIDE)
    steps: dict[str, Any] = {}
    for width in WIDTHS:
        config = learner.LearnerConfig(width=width, overlay_warmup_steps=0)
        ours = _trainer(config, data, bank)
        theirs = others.peers(_setting(config, data, bank))
        calls = {"palm_jax": ours.call} | {name: peer.call for name, peer in theirs.items()}
        row = side_by_side(calls, repeats=repeats, items=config.batch_size)
        row["palm_jax"]["compile_seconds"] = ours.compile_seconds
        row["palm_jax"]["parameters"] = ours.parameters
        for name, peer in theirs.items():
            row[name]["parameters"] = peer.parameters
        steps[str(width)] = row
    config = learner.LearnerConfig(overlay_warmup_steps=0, turn=(0.35, 0.17))
    turning = _trainer(config, data, bank)
    return {
        **headline(steps[str(WIDTHS[0])], "samples_per_second"),
        "steps": steps,
        "with_turn": measure(turning.call, repeats=repeats, items=config.batch_size),
        "act": {
            str(count): measure(lambda n=count: turning.act(n), repeats=repeats, items=count)
            for count in ACT_BATCHES
        },
        "pixels": config.crop,
        "batch_size": config.batch_size,
        "device": jax.devices()[0].device_kind,
    }


def _trainer(config: learner.LearnerConfig, data: learner.Batch, bank: jax.Array) -> _Trainer:
    made, key = learner.make_learner(config, PROPRIO_DIM), jax.random.key(0)
    state = made.jitted_init(key, learner.fit_normalizer(data.proprio, data.actions))
    done = 0

    def step() -> None:
        nonlocal state, done
        indices = loop.batch_indices(key, done, SAMPLES, config.batch_size)
        batch = loop.take(data, indices)
        state, _ = jax.block_until_ready(made.jitted_step(key, state, batch, bank))
        done += 1

    start = time.perf_counter()
    step()
    seconds = time.perf_counter() - start

    def act(count: int) -> Any:
        images, proprio = {"front": data.images["front"][:count]}, data.proprio[:count]
        return made.jitted_act(key, made.policy_state(state), images, proprio)

    parameters = sum(leaf.size for leaf in jax.tree.leaves(state.params))
    return _Trainer(step, parameters, seconds, act)


def _setting(config: learner.LearnerConfig, data: learner.Batch, bank: jax.Array) -> others.Setting:
    """The same for another package."""
    normalizer = learner.fit_normalizer(data.proprio, data.actions)
    return others.Setting(
        images=data.images["front"],
        proprio=np.asarray(normalizer.proprio.normalize(data.proprio)),
        actions=np.asarray(normalizer.action.normalize(data.actions)),
        bank=np.asarray(bank),
        width=config.width,
        crop=config.crop or SIDE,
        embed=config.embed,
        hidden=config.hidden,
        batch_size=config.batch_size,
        learning_rate=config.learning_rate,
        grad_clip=config.grad_clip,
        distortion=config.perspective_distortion,
        proprio_noise=config.proprio_noise,
    )
