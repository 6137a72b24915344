"""Intervals against SciPy, hand calculation and exact coverage."""

import math

import numpy as np
import pytest
from scipy import stats as scipy_stats

from palm_jax.train.reporting.stats import (
    degradation,
    degradation_interval,
    independent_episodes,
    mean_interval,
    success_rate,
    wilson_interval,
)


def test_wilson_by_hand() -> None:
    # 10 of 20: centre 1/2; half width 1.95996 / (1 + 3.84146/20) * sqrt(0.0125 + 3.84146/1600).
    lower, upper = wilson_interval(10, 20)
    assert float(lower) == pytest.approx(0.29930, abs=1e-5)
    assert float(upper) == pytest.approx(0.70070, abs=1e-5)
    # 0 of 10: the upper end is z^2 / (n + z^2).
    lower, upper = wilson_interval(0, 10)
    assert float(lower) == 0.0
    assert float(upper) == pytest.approx(3.841459 / 13.841459, abs=1e-6)


@pytest.mark.parametrize(
    ("good", "total"), [(0, 24), (1, 24), (17, 24), (24, 24), (49, 50), (1, 1)]
)
def test_wilson_equals_scipy(good: int, total: int) -> None:
    expected = scipy_stats.binomtest(good, total).proportion_ci(0.95, method="wilson")
    lower, upper = wilson_interval(good, total)
    np.testing.assert_allclose([lower, upper], [expected.low, expected.high], atol=1e-12)


def test_wilson_broadcasts_and_knows_nothing_without_episodes() -> None:
    lower, upper = wilson_interval([[0, 5], [10, 0]], [10, 10])
    assert lower.shape == upper.shape == (2, 2)
    lower, upper = wilson_interval(0, 0)
    assert (float(lower), float(upper)) == (0.0, 1.0)
    assert math.isnan(success_rate(0, 0))


@pytest.mark.parametrize(("good", "total"), [(5, 4), (-1, 4)])
def test_impossible_counts_raise(good: int, total: int) -> None:
    with pytest.raises(ValueError, match="swapped"):
        wilson_interval(good, total)


def test_degradation_by_hand() -> None:
    # BC on the paper's real drawer: in-domain .65, shifted .20: 1 - 4/13.
    assert float(degradation(0.20, 0.65)) == pytest.approx(9 / 13)
    assert float(degradation(0.6, 0.5)) == pytest.approx(-0.2)
    assert float(degradation(0.0, 0.5)) == 1.0
    assert math.isnan(degradation(0.5, 0.0))
    assert math.isnan(degradation(math.nan, 0.5))


def coverage(p_ood: float, p_id: float, n: int) -> float:
    """Probability, by enumeration, that the interval holds the true degradation."""
    counts = np.arange(n + 1)
    a, b = np.meshgrid(counts, counts, indexing="ij")
    pmf = scipy_stats.binom.pmf
    weight = np.outer(pmf(counts, n, p_ood), pmf(counts, n, p_id))
    lower, upper = degradation_interval(a, n, b, n)
    truth = 1 - p_ood / p_id
    return float(weight[(lower <= truth) & (truth <= upper)].sum())


@pytest.mark.parametrize(("p_ood", "p_id", "n"), [(0.4, 0.9, 24), (0.7, 0.72, 50), (0.1, 0.5, 50)])
def test_degradation_interval_covers_as_often_as_it_says(p_ood: float, p_id: float, n: int) -> None:
    assert 0.93 < coverage(p_ood, p_id, n) < 0.985


def test_degradation_interval_holds_the_estimate_and_has_limits() -> None:
    lower, upper = degradation_interval(6, 24, 22, 24)
    assert float(lower) < 1 - 6 / 22 < float(upper) < 1
    # No success out of domain: everything may be lost, not all has to be.
    lower, upper = degradation_interval(0, 24, 22, 24)
    assert 0.7 < float(lower) < 1.0 and float(upper) == 1.0
    assert all(math.isnan(end) for end in degradation_interval(3, 24, 0, 24))


def test_mean_of_tasks_weighs_them_equally() -> None:
    mean, lower, upper = mean_interval([5, 20], [10, 80])
    assert mean == pytest.approx((0.5 + 0.25) / 2)
    # By hand from the two Wilson intervals: distances add in squares, halved.
    first = scipy_stats.binomtest(5, 10).proportion_ci(method="wilson")
    second = scipy_stats.binomtest(20, 80).proportion_ci(method="wilson")
    below = math.hypot(0.5 - first.low, 0.25 - second.low) / 2
    above = math.hypot(first.high - 0.5, second.high - 0.25) / 2
    assert (lower, upper) == pytest.approx((mean - below, mean + above))


def test_what_policies_in_the_same_scenes_are_worth() -> None:
    """Against the spread of the mean when scenes are drawn anew: half of a scene's outcome is the
    scene's, so that policies agree more often than by chance."""
    generator = np.random.default_rng(0)
    policies, scenes = 3, 50
    means, worth = [], []
    for _ in range(2000):
        hard = generator.beta(0.5, 0.5, scenes)
        solved = generator.random((policies, scenes)) < hard
        means.append(solved.mean())
        worth.append(independent_episodes(solved))
    wanted = 0.25 / np.var(means)
    assert np.mean(worth) == pytest.approx(wanted, rel=0.1)
    assert wanted < 0.6 * policies * scenes


def test_copies_are_worth_nothing_and_strangers_all() -> None:
    one = np.arange(40) % 3 == 0
    assert independent_episodes(one[None]) == 40
    assert independent_episodes([one, one, one]) == pytest.approx(40)
    # Every scene is solved by one of the two: further apart than chance.
    assert independent_episodes([one, ~one]) == 80
    for same in (np.zeros((3, 40)), np.ones((3, 40))):
        assert independent_episodes(same) == 40  # nothing tells how alike they are
