"""The environments behind other packages' interfaces; each needs that package (an extra).

* `palm_jax.envs.adapters.gym_env`: Gymnasium, `pip install 'palm-jax[gym]'`.
* `palm_jax.envs.adapters.playground_env`: MuJoCo Playground, `pip install 'palm-jax[playground]'`.

Nothing is imported here, so that one of them works without the other's package.
"""
