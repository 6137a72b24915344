"""The disturbance of demonstrations has the size it says. What experts do: test_episodes.py."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palm_jax.envs.expert import next_push

CHAINS, STEPS = 2000, 60


@pytest.fixture(scope="module")
def pushes() -> dict[bool, np.ndarray]:
    """[T, N, 4] by whether the hand is free, of 4 mm."""

    def chain(key: jax.Array, free: jax.Array) -> jax.Array:
        def advance(push: jax.Array, t: jax.Array) -> tuple[jax.Array, jax.Array]:
            after = next_push(jax.random.fold_in(key, t), push, jnp.float32(0.004), free)
            return after, after

        return jax.lax.scan(advance, jnp.zeros(4), jnp.arange(STEPS))[1]

    run = jax.jit(jax.vmap(chain, in_axes=(0, None), out_axes=1))
    made = {}
    for free in (False, True):
        keys = jax.random.split(jax.random.key(int(free)), CHAINS)
        made[free] = np.asarray(run(keys, jnp.asarray(free)))[20:]
    return made


def test_a_steady_push_has_its_deviation_and_lasts(pushes: dict[bool, np.ndarray]) -> None:
    held = pushes[False]
    np.testing.assert_allclose(held.std((0, 1)), 0.004, rtol=0.02)
    np.testing.assert_allclose(held.mean((0, 1)), 0.0, atol=1e-4)
    lagged = np.mean(held[1:] * held[:-1], (0, 1)) / held.var((0, 1))
    np.testing.assert_allclose(lagged, 0.8, atol=0.02)


def test_a_free_hand_is_knocked_now_and_then(pushes: dict[bool, np.ndarray]) -> None:
    free = pushes[True]
    fresh = free[1:] - 0.8 * free[:-1]
    # What comes anew is a mixture: one step in twenty the knock's variance on top.
    steady, knock = 0.004**2 * 0.36, 0.008**2
    np.testing.assert_allclose(fresh.var((0, 1)), steady + 0.05 * knock, rtol=0.05)
    # A knock hits all four components at once: their squares go together, those of noise do not.
    squares = (fresh**2).reshape(-1, 4)
    together = np.corrcoef(squares[:, 0], squares[:, 1])[0, 1]
    quiet = ((pushes[False][1:] - 0.8 * pushes[False][:-1]) ** 2).reshape(-1, 4)
    assert together > 0.2 > 0.05 > abs(np.corrcoef(quiet[:, 0], quiet[:, 1])[0, 1])
