"""The paper's claims, asked of tables whose answers are known."""

import numpy as np
import pytest

from palm_jax.envs.shifts import DOMAINS
from palm_jax.train.reporting import claims, paper

METHODS = (
    "palm", "bc", "palm-crop", "palm-overlay", "palm-aug", "palm-prop", "mirrorduo", "roviaug",
    "arro",
)  # fmt: skip


def as_in_the_paper(episodes: int, *, tasks: int = 2) -> dict[str, dict[str, dict[str, dict]]]:
    """Counts that Table I implies, the same on every task."""

    def counts(method: str) -> dict[str, dict[str, int]]:
        rates = {domain: paper.implied_success(method, domain) for domain in DOMAINS}
        return {
            domain: {"successes": round(rate * episodes), "episodes": episodes, "nan": 0}
            for domain, rate in rates.items()
            if rate is not None
        }

    return {f"task{i}": {method: counts(method) for method in METHODS} for i in range(tasks)}


def verdicts(rows: claims.Rows) -> dict[str, str]:
    return {claim.name: claim.verdict for claim in claims.judge(rows)}


def test_the_papers_own_numbers_bear_out_its_claims() -> None:
    found = verdicts(as_in_the_paper(100_000))
    assert found == {f"C{i}": "holds" for i in range(1, 10)}


def test_few_episodes_decide_nothing() -> None:
    found = verdicts(as_in_the_paper(4, tasks=1))
    assert "does not hold" not in found.values()
    assert found["C2"] == "undecided" and found["C8"] == "undecided"


def test_the_reverse_is_seen() -> None:
    rows = as_in_the_paper(20_000)
    for row in rows.values():
        row["palm"], row["bc"] = row["bc"], row["palm"]
    found = verdicts(rows)
    assert found["C1"] == found["C2"] == "does not hold"


def test_a_method_that_a_task_lacks_is_not_judged() -> None:
    rows = as_in_the_paper(100)
    del rows["task1"]["arro"]
    found = verdicts(rows)
    assert {name for name, verdict in found.items() if verdict == "not run"} == {"C1", "C7", "C9"}


@pytest.mark.parametrize(("good", "total"), [(4_000, 10_000), (9_000, 10_000)])
def test_intervals_of_many_episodes_are_those_of_the_normal_law(good: int, total: int) -> None:
    entry = {"successes": good, "episodes": total, "nan": 0}
    posterior = claims.Posterior({"t": {"palm": dict.fromkeys(DOMAINS, entry)}})
    found = claims.estimate(posterior.success("palm"))
    p = good / total
    half = 1.96 * np.sqrt(p * (1 - p) / total)
    np.testing.assert_allclose(found, [p, p - half, p + half], atol=6e-4)


def test_a_task_that_is_not_learned_is_left_out_of_the_losses_alone() -> None:
    rows = as_in_the_paper(100)
    for entry in rows["task1"]["bc"].values():
        entry["successes"] = 0
    posterior = claims.Posterior(rows)
    assert posterior.tasks("bc") == ["task0"] and len(posterior.tasks("palm")) == 2
    assert posterior.success("bc")[0] == pytest.approx(0.52 / 2)
    assert posterior.loss("bc", "W")[0] == pytest.approx(0.40, abs=0.02)


def test_two_methods_are_compared_on_tasks_that_both_can_do() -> None:
    rows = as_in_the_paper(100)
    for entry in rows["task1"]["bc"].values():
        entry["successes"] = 0
    for domain, entry in rows["task1"]["palm"].items():  # of which PALM's loss is a half
        entry["successes"] = 80 if domain == "in_domain" else 40
    posterior = claims.Posterior(rows)
    bc, palm, alone = (
        posterior.loss("bc", "W")[0],
        posterior.loss("palm", "W", tasks=["task0"])[0],
        posterior.loss("palm", "W", tasks=["task1"])[0],
    )
    assert alone == pytest.approx(0.5) and palm < 0.1
    value, draws = posterior.gap("bc", "palm", "W")
    assert value == pytest.approx(bc - palm) and np.median(draws) == pytest.approx(value, abs=0.02)
    assert posterior.gap("palm", "bc", "W")[0] == pytest.approx(-value)
    assert posterior.gap("palm", "palm-crop", "W")[0] == pytest.approx(
        posterior.loss("palm", "W")[0] - posterior.loss("palm-crop", "W")[0]
    )


def test_questions_say_on_which_tasks_they_were_asked() -> None:
    rows = as_in_the_paper(100)
    for entry in rows["task1"]["bc"].values():
        entry["successes"] = 0
    asked = {q.text for claim in claims.judge(rows) for q in claim.questions}
    label = paper.task_label("task0")
    assert f"mean loss, BC - PALM - 0.2 on {label}" in asked
    assert f"loss of BC in W - 0.3 on {label}" in asked
    assert "mean loss, ARRO - PALM - 0.2" in asked  # on both


def loses(row: dict[str, dict[str, dict[str, int]]], method: str, domain: str, loss: float) -> None:
    """Sets what a method loses in a domain."""
    base = row[method]["in_domain"]["successes"]
    row[method][domain]["successes"] = round((1 - loss) * base)


def test_a_little_less_is_not_far_less() -> None:
    rows = as_in_the_paper(20_000)
    for row in rows.values():
        for domain in DOMAINS[1:]:
            loses(row, "bc", domain, 0.2)
    assert verdicts(rows)["C1"] == "does not hold"


def test_the_proprioception_matters_most_only_if_more_than_the_crop() -> None:
    rows = as_in_the_paper(20_000)
    for row in rows.values():
        loses(row, "palm-prop", "workspace", 0.15)  # PALM -0.02, without the crop 0.23
    assert verdicts(rows)["C4"] == "does not hold"


def test_one_domain_is_enough_to_match_palm_somewhere() -> None:
    rows = as_in_the_paper(20_000)
    for row in rows.values():
        loses(row, "arro", "viewpoint", 0.02)
    found = next(claim for claim in claims.judge(rows) if claim.name == "C7")
    assert found.verdict == "does not hold"
    assert "loss in V, ARRO - PALM" in {q.text for q in found.questions}


def test_where_no_task_is_shared_nothing_is_decided() -> None:
    rows = as_in_the_paper(100, tasks=1)
    for entry in rows["task0"]["bc"].values():
        entry["successes"] = 0
    assert verdicts(rows)["C1"] == "undecided" == verdicts(rows)["C6"]


def test_seeds_are_summed() -> None:
    one = {"in_domain": {"successes": 3, "episodes": 10, "nan": 1}}
    two = {"in_domain": {"successes": 4, "episodes": 10, "nan": 0}}
    total = claims.summed({"0": one, "1": two})
    assert total == {"in_domain": {"successes": 7, "episodes": 20, "nan": 1}}
    assert one["in_domain"]["successes"] == 3


def test_an_interval_stays_when_another_method_is_added() -> None:
    rows = as_in_the_paper(50)
    few = {task: {method: row[method] for method in ("palm", "bc")} for task, row in rows.items()}
    # The order in which a page asks must not matter either.
    asked = claims.Posterior(rows)
    asked.mean_loss("arro")
    found, again = (claims.estimate(p.mean_loss("bc")) for p in (asked, claims.Posterior(few)))
    assert found == again
    # Yet no two cells share their draws: differences of equal rates have a spread.
    assert np.std(asked.gap("bc", "bc", "W")[1]) == 0 < np.std(asked.gap("palm", "bc", "W")[1])
