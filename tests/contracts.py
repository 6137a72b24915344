"""Checks that an operation or an environment must pass, as functions."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Compare = Callable[[np.ndarray, np.ndarray], None]


def check_op(
    op: Callable[..., Any],
    oracle: Callable[..., Any],
    examples: Sequence[tuple],
    *,
    atol: float = 0.0,
    rtol: float = 0.0,
    compare: Compare | None = None,
) -> None:
    """Run `op` eagerly, under jit and under vmap, and compare each result with the oracle's.

    Args:
      op: takes one example, returns a pytree of arrays.
      oracle: the same by other means; its leaves are compared in order. Leaves of `op` beyond the
        oracle's are only compared between the three executions.
      examples: at least two argument tuples of equal shapes, arrays or pytrees of arrays.
      atol, rtol: tolerance, unless `compare` is given.
      compare: called with (got, expected) for each leaf; asserts.

    Implicit promotions of dtypes are errors: they turn float32 into float64 under x64.
    """
    assert len(examples) >= 2, "vmap needs at least two examples to tell axes apart"
    if compare is None:

        def compare(got: np.ndarray, expected: np.ndarray) -> None:
            np.testing.assert_allclose(got, expected, atol=atol, rtol=rtol)

    expected = [jax.tree.leaves(oracle(*example)) for example in examples]
    with jax.numpy_dtype_promotion("strict"):
        eager = [op(*example) for example in examples]
        jitted_op = jax.jit(op)
        jitted = [jitted_op(*example) for example in examples]
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *examples)
        batched = jax.vmap(op)(*stacked)
    rows = [jax.tree.map(lambda leaf, i=i: leaf[i], batched) for i in range(len(examples))]
    for results, how in ((eager, "eager"), (jitted, "jit"), (rows, "vmap")):
        for result, reference, wanted in zip(results, eager, expected, strict=True):
            leaves, firsts = jax.tree.leaves(result), jax.tree.leaves(reference)
            assert len(leaves) == len(firsts) >= len(wanted), how
            for leaf, first in zip(leaves, firsts, strict=True):
                assert leaf.dtype == first.dtype and leaf.shape == first.shape, how
            for leaf, value in zip(leaves, wanted, strict=False):
                assert np.shape(leaf) == np.shape(value), (how, np.shape(leaf), np.shape(value))
                compare(np.asarray(leaf), np.asarray(value))


@contextlib.contextmanager
def compilations() -> Iterator[list[str]]:
    """Names of the functions that JAX compiles inside the `with` block, in order."""
    names: list[str] = []

    def note(event: str, seconds: float, **details: Any) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(str(details.get("fun_name")).removeprefix("jit(").removesuffix(")"))

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        yield names
    finally:
        jax.monitoring.unregister_event_duration_listener(note)


def describe(tree: Any) -> Any:
    """Structure, shapes, dtypes and weak types: what a jit compiles anew for."""
    return jax.tree.map(lambda x: (jnp.shape(x), x.dtype, x.weak_type), tree)


def check_env(runner: Any, key: jax.Array, spec: Any, *, steps: int = 5) -> None:
    """An episode of random actions keeps an environment's promises.

    Args:
      runner: `envs.rollout.Runner`, or what has its `env`, `worlds`, `reset`, `step`, `observe`.
      key: of scenes and actions.
      spec: `AlignSpec` of the observation.
      steps: control steps.

    Every leaf of states and observations is finite; a step keeps a state's structure, shapes and
    dtypes; images are uint8 of the spec's size, and differ between worlds; the same key gives the
    same start; after the first step nothing is compiled.
    """
    worlds, env = runner.worlds, runner.env
    params = jax.tree.map(lambda x: jnp.broadcast_to(x, (worlds, *x.shape)), env.default_params())
    scene_key, action_key = jax.random.split(key)
    scenes = jax.random.split(scene_key, worlds)
    state = start = runner.reset(scenes, params)
    again = runner.reset(jax.random.clone(scenes), params)
    for one, other in zip(jax.tree.leaves(start), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other, "two resets with one key differ")
    for t in range(steps):
        rotation = jnp.tile(jnp.array([1.0, 0, 0, 0, 1.0, 0]), (worlds, 1))
        free = jax.random.uniform(
            jax.random.fold_in(action_key, t), (worlds, 4), minval=-1.0, maxval=1.0
        )
        action = jnp.concatenate([rotation, 0.015 * free[:, :3], free[:, 3:]], axis=-1)
        assert action.shape[-1] == env.action_size, "actions are not [10]"
        with compilations() as names:
            state = runner.step(state, action, params)
            seen = runner.observe(state, params, spec)
        assert t == 0 or not names, f"step {t} compiled {names}"
        assert jax.tree.structure(state) == jax.tree.structure(start), "the structure changes"
        assert describe(state) == describe(start), "shapes or dtypes change"
        for leaf in jax.tree.leaves((state, seen)):
            assert np.isfinite(leaf).all(), f"not finite after step {t}"
        assert seen.image.dtype == np.uint8, seen.image.dtype
        assert seen.image.shape == (worlds, spec.size, spec.size, 3), seen.image.shape
    images = np.asarray(seen.image).reshape(worlds, -1)
    assert len(np.unique(images, axis=0)) == worlds, "worlds look the same"
