"""Success rates with intervals, and the paper's normalised degradation.

Everything works on NumPy arrays (or plain numbers) of any shape and broadcasts; rates are fractions
in [0, 1], intervals are (lower, upper) pairs of arrays.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# Two-sided 95 %.
Z95 = 1.959963984540054


def _counts(successes: ArrayLike, episodes: ArrayLike) -> tuple[Array, Array]:
    good, total = np.asarray(successes, float), np.asarray(episodes, float)
    good, total = np.broadcast_arrays(good, total)
    if np.any(good < 0) or np.any(good > total):
        raise ValueError(
            f"successes must lie between 0 and episodes, got {good.tolist()} of {total.tolist()}: "
            "are the two arguments swapped?"
        )
    return good, total


def success_rate(successes: ArrayLike, episodes: ArrayLike) -> Array:
    """successes / episodes, NaN where there were no episodes."""
    good, total = _counts(successes, episodes)
    return np.divide(good, total, out=np.full(good.shape, np.nan), where=total > 0)


def wilson_interval(
    successes: ArrayLike, episodes: ArrayLike, *, z: float = Z95
) -> tuple[Array, Array]:
    """Wilson's score interval of a success probability.

    Unlike the textbook interval it stays inside [0, 1] and keeps a width at 0 and at 100 %, which
    is where evaluations of a few dozen scenes end up.

    Args:
      successes, episodes: counts [...]; no episodes gives (0, 1), nothing is known.
      z: normal quantile, by default of a 95 % interval.

    Returns:
      lower [...], upper [...].
    """
    good, total = _counts(successes, episodes)
    n = np.maximum(total, 1.0)
    p = good / n
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    # The limits at p = 0 and p = 1 are exact in theory and off by one ulp in arithmetic.
    lower = np.where(good == 0, 0.0, np.maximum(centre - half, 0.0))
    upper = np.where(good == total, 1.0, np.minimum(centre + half, 1.0))
    return np.where(total > 0, lower, 0.0), np.where(total > 0, upper, 1.0)


def independent_episodes(solved: ArrayLike) -> float:
    """How many independent scenes several policies' episodes in the same scenes are worth.

    Scenes that are hard for one policy tend to be hard for the next, so that K policies in N scenes
    tell less than K N scenes would. Kish's design effect: the variance that the overall rate has
    over scenes, beside the binomial one. Where all succeed or all fail nothing is known of it, and
    the scenes count once.

    Args:
      solved: [K, N], policy k in scene n.

    Returns:
      between N (the policies agree everywhere) and K N (they agree by chance).
    """
    each = np.asarray(solved, float)
    policies, scenes = each.shape
    rate, over_scenes = each.mean(), each.mean(axis=0)
    if policies == 1 or scenes == 1 or rate in (0.0, 1.0):
        return float(scenes)
    spread = np.var(over_scenes, ddof=1)
    worth = rate * (1 - rate) * scenes / spread if spread > 0 else np.inf
    return float(np.clip(worth, scenes, policies * scenes))


def degradation(out_of_domain: ArrayLike, in_domain: ArrayLike) -> Array:
    """The paper's normalised degradation, 1 - ood / id; lower is better, negative is a gain.

    Args:
      out_of_domain, in_domain: success rates [...].

    Returns:
      [...]; NaN where the in-domain rate is zero or unknown: there is nothing to lose.
    """
    ood, base = np.broadcast_arrays(np.asarray(out_of_domain, float), np.asarray(in_domain, float))
    return 1.0 - np.divide(ood, base, out=np.full(ood.shape, np.nan), where=base > 0)


def degradation_interval(
    ood_successes: ArrayLike,
    ood_episodes: ArrayLike,
    id_successes: ArrayLike,
    id_episodes: ArrayLike,
    *,
    z: float = Z95,
) -> tuple[Array, Array]:
    """Interval of 1 - ood / id for two independent proportions.

    Recovers the variance of the ratio from the two Wilson intervals (the MOVER-R construction of
    Donner and Zou, 2012). The lower end is -inf where the in-domain interval reaches zero, and both
    are NaN where the in-domain rate is zero or unknown.
    """
    a, b = success_rate(ood_successes, ood_episodes), success_rate(id_successes, id_episodes)
    la, ua = wilson_interval(ood_successes, ood_episodes, z=z)
    lb, ub = wilson_interval(id_successes, id_episodes, z=z)
    a, b, la, ua, lb, ub = np.broadcast_arrays(a, b, la, ua, lb, ub)
    with np.errstate(divide="ignore", invalid="ignore"):
        # The limits of a / b solve two quadratics with these leading and constant terms.
        lead_low, lead_high = ub * (2 * b - ub), lb * (2 * b - lb)
        rest_low, rest_high = la * (2 * a - la), ua * (2 * a - ua)
        root_low = np.sqrt(np.maximum((a * b) ** 2 - rest_low * lead_low, 0))
        root_high = np.sqrt(np.maximum((a * b) ** 2 - rest_high * lead_high, 0))
        low_ratio = (a * b - root_low) / lead_low
        high_ratio = np.where(lb > 0, (a * b + root_high) / lead_high, np.inf)
    known = (b > 0) & np.isfinite(a)
    return np.where(known, 1 - high_ratio, np.nan), np.where(known, 1 - low_ratio, np.nan)


def mean_interval(
    successes: Sequence[float], episodes: Sequence[float], *, z: float = Z95
) -> tuple[float, float, float]:
    """Plain mean of several tasks' success rates, with an interval from their Wilson intervals.

    Tasks count equally, however many scenes each had. Distances of the limits from the rates add in
    squares, as for independent estimates.

    Returns:
      mean, lower, upper.
    """
    rates = success_rate(successes, episodes)
    lower, upper = wilson_interval(successes, episodes, z=z)
    mean, count = float(rates.mean()), rates.size
    below = float(np.sqrt(np.sum((rates - lower) ** 2))) / count
    above = float(np.sqrt(np.sum((upper - rates) ** 2))) / count
    return mean, max(mean - below, 0.0), min(mean + above, 1.0)
