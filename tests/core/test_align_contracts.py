"""The contract checker itself: it must fail on broken operations."""

import jax.numpy as jnp
import numpy as np
import pytest
from contracts import check_op

ROWS = [(np.float32([1, 2, 3]),), (np.float32([4, 5, 7]),)]


def double(x):
    return jnp.asarray(x) * 2


def test_a_right_operation_passes():
    check_op(double, lambda x: 2 * x, ROWS)


@pytest.mark.parametrize(
    "op",
    [
        lambda x: jnp.asarray(x) * 2 + 0.01,  # wrong values
        lambda x: np.asarray(x) * 2,  # does not trace
        lambda x: jnp.asarray(x) * (2 if x[0] > 0 else 3),  # branches on a value
        lambda x: (jnp.asarray(x) * 2)[:2],  # wrong shape
        lambda x: jnp.asarray(x) * jnp.full(3, 2, jnp.int32),  # promotes int32
    ],
    ids=["values", "numpy", "branch", "shape", "promotion"],
)
def test_a_broken_operation_fails(op):
    with pytest.raises(Exception):  # noqa: B017 - each breaks in its own way
        check_op(op, lambda x: 2 * x, ROWS)


def test_one_example_is_refused():
    with pytest.raises(AssertionError, match="two examples"):
        check_op(double, lambda x: 2 * x, ROWS[:1])
