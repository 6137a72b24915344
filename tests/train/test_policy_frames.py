"""A policy on whole images of the simulator sees what evaluations let it see."""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
import tiny
import worlds

from palm_jax.align import Camera
from palm_jax.envs.base import EnvParams, State
from palm_jax.policy import load
from palm_jax.render import render
from palm_jax.train import methods

COUNT = 3
K = np.array([[440.0, 0, 331], [0, 452, 229], [0, 0, 1]], np.float32)
"""A user's camera: wider than the training's, pixels not quite square, no middle."""


class Photos(NamedTuple):
    """What that camera takes of some worlds, leading axis [COUNT]; and the worlds' own states."""

    image: np.ndarray  # uint8 [N, 480, 640, 3]
    mask: np.ndarray  # bool [N, 480, 640]
    cam_to_world: np.ndarray
    tcp: np.ndarray
    opening: np.ndarray
    state: State  # of all worlds of the runner
    params: EnvParams


@functools.cache
def photos() -> Photos:
    runner = worlds.runner("lift_lid")
    env, params = runner.env, worlds.params(runner.env)
    state = runner.reset(worlds.keys(31), params)
    handled = np.asarray(env.scene_model.handled)

    @jax.jit
    @jax.vmap
    def shoot(state: State, params: EnvParams) -> tuple[Any, ...]:
        camera = Camera(K, state.camera_to_world, 480, 640)
        frame = render(env.scene(state, params), camera, outputs=("rgb", "segmentation"))
        assert frame.segmentation is not None
        mask = jax.numpy.isin(frame.segmentation, handled)
        return frame.rgb, mask, state.camera_to_world, env.tcp(state), env.opening(state)

    few = jax.tree.map(lambda leaf: leaf[:COUNT], (state, params))
    return Photos(*map(np.asarray, shoot(*few)), state=state, params=params)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "palm",
        "bc",
        pytest.param("palm-crop", marks=pytest.mark.long),
        pytest.param("arro", marks=pytest.mark.long),
    ],
)
def test_policies_see_and_do_what_they_do_in_evaluations(name: str) -> None:
    """The evaluation renders the window itself; the policy cuts it out of a user's image."""
    taken, method, runner = photos(), methods.find(name), worlds.runner("lift_lid")
    spec = method.spec(runner.env.task, tiny.CONFIG.image_size)
    expected = runner.observe(taken.state, taken.params, spec, frame=method.frame)
    policy, learner = load(tiny.run(name), image_size=None), tiny.learner(name)
    batch = {"front": expected.image[:COUNT]}, expected.proprio[:COUNT]
    theirs = np.asarray(learner.jitted_predict(policy.state, *batch)[0])
    ours = []
    for world in range(COUNT):
        observation = [
            taken.image[world], K, taken.cam_to_world[world], taken.tcp[world],
            taken.opening[world],
        ]  # fmt: skip
        mask = taken.mask[world] if method.isolate else None
        seen = policy.see(*observation, mask=mask)
        off = np.abs(np.asarray(seen.image, int) - np.asarray(expected.image[world], int)).max(-1)
        # The edges of things, the table's grain; where the user's image ends, its border.
        assert np.median(off) <= 6 and (off < 25).mean() > 0.85
        np.testing.assert_allclose(seen.proprio, expected.proprio[world], atol=1e-5)
        ours.append(learner.jitted_predict(policy.state, {"front": seen.image[None]},
                                           seen.proprio[None])[0][0])  # fmt: skip
        assert policy.decide(*observation, mask=mask).coverage > 0.8
    # However little an untrained network cares: less than for another scene.
    apart = np.abs(theirs - np.roll(theirs, 1, axis=0)).mean()
    assert np.abs(np.stack(ours) - theirs).mean() < 0.3 * apart
