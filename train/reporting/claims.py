"""What the paper claims of its main table, asked of a table of ours.

Every question is a difference (or several) that the claim says is positive. Success rates have
Beta posteriors under Jeffreys' prior, independent over cells; a claim holds when the central 95 %
of every difference lies above zero, does not when that of any lies below, and is undecided
otherwise. Losses of two methods are compared on the tasks that both of them can do. Scenes are what
is resampled: the spread between training seeds is not in it, and policies that were tried in the
same scenes count as the scenes that they are worth (`stats.independent_episodes`).
"""

import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from palm_jax.train.reporting import paper, stats

Counts = Mapping[str, Mapping[str, int]]  # domain -> successes, episodes, nan
Summed = Mapping[str, Mapping[str, float]]  # the same of several seeds, with what they are worth
Rows = Mapping[str, Mapping[str, Summed]]  # task -> method -> seeds summed

LEAST_IN_DOMAIN = 0.1
"""A policy that solves less in-domain has nothing to lose: that task is left out of its losses."""

_DRAWS = 4000


class Estimate(NamedTuple):
    """A quantity with its central 95 % interval."""

    value: float
    low: float
    high: float


class Posterior:
    """Success and loss of the methods of a table, as draws.

    Args:
      rows: task -> method -> domain -> counts; every method on the same tasks.
      seed: of the draws.
    """

    def __init__(self, rows: Rows, *, seed: int = 0) -> None:
        self._rows = rows
        self._seed = seed
        self._draws: dict[tuple[str, str, str], np.ndarray] = {}

    @property
    def methods(self) -> list[str]:
        """Those that every task has."""
        shared = [set(row) for row in self._rows.values()]
        return paper.ordered_methods(sorted(set.intersection(*shared))) if shared else []

    def _rate(self, task: str, method: str, key: str) -> tuple[float, np.ndarray]:
        """Share solved in one cell, and draws [D] of its true value."""
        domain = next(d for d in self._rows[task][method] if paper.domain_key(d) == key)
        entry = self._rows[task][method][domain]
        rate, worth = entry["successes"] / entry["episodes"], entry["independent"]
        where = (task, method, key)
        if where not in self._draws:
            # A stream of its own: an interval must not move when another cell is added.
            generator = np.random.default_rng([self._seed, zlib.crc32("/".join(where).encode())])
            good = rate * worth
            self._draws[where] = generator.beta(good + 0.5, worth - good + 0.5, _DRAWS)
        return rate, self._draws[where]

    def tasks(self, method: str) -> list[str]:
        """Tasks that the method's losses are means over, see `LEAST_IN_DOMAIN`."""
        return [t for t in self._rows if self._rate(t, method, "ID")[0] >= LEAST_IN_DOMAIN]

    def success(self, method: str) -> tuple[float, np.ndarray]:
        """In-domain success, mean over all tasks: value, draws [D]."""
        return _mean([self._rate(task, method, "ID") for task in self._rows])

    def loss(
        self, method: str, *keys: str, tasks: Sequence[str] | None = None
    ) -> tuple[float, np.ndarray]:
        """1 - success / in-domain success, mean over domains (keys as in `paper`) and tasks: those
        of `tasks(method)` by default."""
        parts = []
        for task in self.tasks(method) if tasks is None else tasks:
            base, base_draws = self._rate(task, method, "ID")
            for key in keys:
                rate, draws = self._rate(task, method, key)
                parts.append((1 - rate / base, 1 - draws / base_draws))
        return _mean(parts)

    def gap(self, method: str, other: str, *keys: str) -> tuple[float, np.ndarray]:
        """By how much more `method` loses than `other`, both on the tasks of `tasks` of both: a
        task that one of them cannot do must not weigh on the other alone."""
        shared = self.shared(method, other)
        more, less = (self.loss(name, *keys, tasks=shared) for name in (method, other))
        return more[0] - less[0], more[1] - less[1]

    def shared(self, method: str, other: str) -> list[str]:
        """The tasks of `gap`."""
        return [task for task in self.tasks(method) if task in self.tasks(other)]

    def where(self, tasks: Sequence[str]) -> str:
        """ " on Lift Lid and Lift Spam"; nothing if these are all tasks of the paper's table."""
        names = " and ".join(map(paper.task_label, tasks)) or "no task"
        return "" if set(tasks) == set(paper.TABLE_TASKS) else f" on {names}"

    def mean_loss(self, method: str) -> tuple[float, np.ndarray]:
        """Over the seven shifted domains."""
        return self.loss(method, *paper.OOD_DOMAINS)


def _mean(parts: Sequence[tuple[float, np.ndarray]]) -> tuple[float, np.ndarray]:
    if not parts:
        return float("nan"), np.full(_DRAWS, np.nan)
    values, draws = zip(*parts, strict=True)
    return float(np.mean(values)), np.mean(draws, axis=0)


def estimate(found: tuple[float, np.ndarray]) -> Estimate:
    """Value and interval of what a `Posterior` returns."""
    value, draws = found
    low, high = np.percentile(draws, [2.5, 97.5])
    return Estimate(value, float(low), float(high))


class Question(NamedTuple):
    """One difference of a claim."""

    text: str
    difference: Estimate  # above zero: as claimed


class Claim(NamedTuple):
    """A claim of the paper and what our table says of it."""

    name: str
    text: str
    verdict: str  # "holds", "does not hold", "undecided" or "not run"
    questions: tuple[Question, ...]


Ask = Callable[[Posterior], list[Question]]


def _label(method: str) -> str:
    return paper.method_label(method)


_BASELINES = ("bc", "mirrorduo", "roviaug", "arro")
_FAR = 0.2  # "far less": by at least this
_BARELY = 0.15  # "barely affected": a loss larger than PALM's by less than this
_FAILS = 0.3  # "fails": a loss of at least this


def _gain(text: str, p: Posterior, more: str, less: str) -> Question:
    """In-domain."""
    (high, high_draws), (low, low_draws) = p.success(more), p.success(less)
    return Question(f"in-domain success, {text}", estimate((high - low, high_draws - low_draws)))


def _gap(text: str, p: Posterior, more: str, less: str, *keys: str, by: float = 0.0) -> Question:
    value, draws = p.gap(more, less, *keys)
    least = f" - {by}" if by else ""
    return Question(
        text + least + p.where(p.shared(more, less)), estimate((value - by, draws - by))
    )


def _c1(p: Posterior) -> list[Question]:
    return [
        _gap(f"mean loss, {_label(b)} - PALM", p, b, "palm", *paper.OOD_DOMAINS, by=_FAR)
        for b in _BASELINES
    ]


def _c2(p: Posterior) -> list[Question]:
    return [_gain("PALM - BC", p, "palm", "bc")]


def _c3(p: Posterior) -> list[Question]:
    return [
        _gap(f"mean loss, {_label(m)} - PALM", p, m, "palm", *paper.OOD_DOMAINS)
        for m in ("palm-crop", "palm-prop")
    ]


def _c4(p: Posterior) -> list[Question]:
    crop, prop = "palm-crop", "palm-prop"
    return [
        _gap("loss in E, w/o crop - w/o aligned proprio", p, crop, prop, "E"),
        _gap("loss in W, w/o aligned proprio - w/o crop", p, prop, crop, "W"),
        _gap("loss in V, w/o aligned proprio - w/o crop", p, prop, crop, "V"),
    ]


def _c5(p: Posterior) -> list[Question]:
    questions = []
    for method in ("palm-overlay", "palm-aug"):
        name = _label(method).removeprefix("PALM ")
        value, draws = p.gap(method, "palm", "W", "V")
        text = f"{_BARELY} - (loss in W and V, {name} - PALM){p.where(p.shared(method, 'palm'))}"
        questions.append(Question(text, estimate((_BARELY - value, _BARELY - draws))))
        questions.append(_gap(f"loss in E, {name} - PALM", p, method, "palm", "E"))
    return questions


def _c6(p: Posterior) -> list[Question]:
    lost = {key: p.loss("bc", key) for key in ("W", "V")}
    where = p.where(p.tasks("bc"))
    return [
        Question(
            f"loss of BC in {key} - {_FAILS}{where}", estimate((value - _FAILS, draws - _FAILS))
        )
        for key, (value, draws) in lost.items()
    ]


def _support(question: Question) -> tuple[bool, float]:
    """Sorts domains by how well they bear out an "everywhere": what refutes it comes first, then
    the lowest lower end."""
    return question.difference.high >= 0, question.difference.low


_OWN = (("mirrorduo", "W"), ("roviaug", "V"), ("arro", "E"))


def _c7(p: Posterior) -> list[Question]:
    questions = [_gap(f"loss in {key}, BC - {_label(m)}", p, "bc", m, key) for m, key in _OWN]
    for method, _ in _OWN:
        every = [
            _gap(
                f"loss in {paper.domain_label(key)}, {_label(method)} - PALM",
                p,
                method,
                "palm",
                key,
            )
            for key in paper.OOD_DOMAINS
        ]
        questions.append(min(every, key=_support))
    return questions


def _c8(p: Posterior) -> list[Question]:
    return [_gain("BC - RoVi-Aug", p, "bc", "roviaug")]


def _c9(p: Posterior) -> list[Question]:
    return [
        _gap("loss in E, ARRO - PALM", p, "arro", "palm", "E"),
        _gap("loss in E, w/o overlay - PALM", p, "palm-overlay", "palm", "E"),
    ]


_CLAIMS: dict[str, tuple[str, tuple[str, ...], Ask]] = {
    "C1": ("PALM loses far less out of distribution than any baseline", _BASELINES, _c1),
    "C2": ("PALM is better than BC in-domain, too", ("bc",), _c2),
    "C3": ("Both are needed: the crop and the aligned proprioception",
           ("palm-crop", "palm-prop"), _c3),
    "C4": ("The crop matters most for embodiment, the proprioception for workspace and viewpoint",
           ("palm-crop", "palm-prop"), _c4),
    "C5": ("Overlay and augmentation barely matter for workspace and viewpoint, but for embodiment",
           ("palm-overlay", "palm-aug"), _c5),
    "C6": ("BC fails outside of the training workspace and under turned cameras", ("bc",), _c6),
    "C7": ("Each baseline improves on BC on its own axis, none matches PALM anywhere",
           _BASELINES, _c7),
    "C8": ("RoVi-Aug's reconstructed views cost it success in-domain", ("bc", "roviaug"), _c8),
    "C9": ("The overlay tells more of the embodiment than masking can",
           ("arro", "palm-overlay"), _c9),
}  # fmt: skip


def judge(rows: Rows) -> list[Claim]:
    """The paper's claims C1 to C9 of its main table.

    Args:
      rows: see `summed`. A claim about a method that is not on every task is "not run".
    """
    posterior = Posterior(rows)
    claims = []
    for name, (text, needed, ask) in _CLAIMS.items():
        if not {"palm", *needed} <= set(posterior.methods):
            claims.append(Claim(name, text, "not run", ()))
            continue
        questions = tuple(ask(posterior))
        claims.append(Claim(name, text, _verdict(questions), questions))
    return claims


def _verdict(questions: Sequence[Question]) -> str:
    if all(question.difference.low > 0 for question in questions):
        return "holds"
    if any(question.difference.high < 0 for question in questions):
        return "does not hold"
    return "undecided"


def summed(
    seeds: Mapping[str, Counts], solved: Mapping[str, Sequence[ArrayLike]]
) -> dict[str, dict[str, float]]:
    """Counts of one method on one task, over its seeds.

    Args:
      seeds: seed -> domain -> counts.
      solved: domain -> for each seed whether it solved scene n [N]; the same scenes for all.

    Returns:
      domain -> counts, and "independent": the scenes that these episodes are worth.
    """
    total: dict[str, dict[str, float]] = {}
    for counts in seeds.values():
        for domain, entry in counts.items():
            so_far = total.setdefault(domain, dict.fromkeys(entry, 0))
            for name, value in entry.items():
                so_far[name] += value
    for domain, so_far in total.items():
        so_far["independent"] = stats.independent_episodes(np.array(solved[domain]))
    return total


def rate(counts: Counts, key: str) -> float:
    """Success of one policy in one domain."""
    entry = next(entry for domain, entry in counts.items() if paper.domain_key(domain) == key)
    return entry["successes"] / entry["episodes"]


def loss(counts: Counts, key: str) -> float:
    """1 - success / in-domain success of one policy in one domain, NaN without the latter."""
    return float(stats.degradation(rate(counts, key), rate(counts, "ID")))
