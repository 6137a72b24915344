"""The disturbance of demonstrations has the size it says. What experts do: test_episodes.py."""

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.envs.expert import next_push

CHAINS, STEPS = 2000, 60


def test_a_push_has_its_deviation_and_lasts() -> None:
    def chain(key: jax.Array) -> jax.Array:
        def advance(push: jax.Array, t: jax.Array) -> tuple[jax.Array, jax.Array]:
            after = next_push(jax.random.fold_in(key, t), push, jnp.float32(0.004))
            return after, after

        return jax.lax.scan(advance, jnp.zeros(4), jnp.arange(STEPS))[1]

    keys = jax.random.split(jax.random.key(0), CHAINS)
    pushes = np.asarray(jax.jit(jax.vmap(chain, out_axes=1))(keys))[20:]  # [T, N, 4]
    np.testing.assert_allclose(pushes.std((0, 1)), 0.004, rtol=0.02)
    np.testing.assert_allclose(pushes.mean((0, 1)), 0.0, atol=1e-4)
    lagged = np.mean(pushes[1:] * pushes[:-1], (0, 1)) / pushes.var((0, 1))
    np.testing.assert_allclose(lagged, 0.8, atol=0.02)
