"""The paper's numbers are consistent with each other, and names resolve."""

import pytest

from palm_jax.train.reporting import paper

TABLE = [
    "mirrorduo", "roviaug", "arro", "bc", "palm-crop", "palm-overlay", "palm-aug", "palm-prop",
    "palm",
]  # fmt: skip


@pytest.mark.parametrize("method", TABLE)
def test_printed_average_is_the_mean_of_the_seven_rows(method: str) -> None:
    values = [paper.degradation(method, domain) for domain in paper.OOD_DOMAINS]
    assert all(value is not None for value in values)
    mean = sum(value for value in values if value is not None) / 7
    assert mean == pytest.approx(paper.average_degradation(method), abs=0.0051)


def test_average_over_some_domains() -> None:
    # BC over W, V, W+V: (.40 + .61 + .65) / 3.
    found = paper.average_degradation("bc", ["in_domain", "workspace", "viewpoint", "W+V", "fog"])
    assert found == pytest.approx(1.66 / 3)
    assert paper.average_degradation("bc", ["ID"]) is None
    assert paper.average_degradation("mine") is None


def test_second_table_averages() -> None:
    # Printed below Table II: .15 and .04.
    assert sum(paper.TABLE_II["bc"][1:]) / 7 == pytest.approx(0.15, abs=0.0051)
    assert sum(paper.TABLE_II["palm"][1:]) / 7 == pytest.approx(0.04, abs=0.0051)


def test_real_robot_degradation_gives_the_quoted_numbers() -> None:
    # The abstract quotes 24 % (PALM) and 77 % (BC): the mean over 2 tasks x 3 shifts.
    for column, quoted in ((1, 0.24), (0, 0.77)):
        losses = [
            1 - paper.TABLE_IV[domain][column + task] / paper.TABLE_IV["ID"][column + task]
            for domain in ("W", "V", "E")
            for task in (0, 2)
        ]
        assert sum(losses) / 6 == pytest.approx(quoted, abs=0.0051)


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        ("palm", (0.73, 0.68, 0.65, 0.72, 0.68, 0.57, 0.59)),
        ("bc", (0.31, 0.20, 0.11, 0.18, 0.11, 0.06, 0.09)),
    ],
)
def test_implied_success(method: str, expected: tuple[float, ...]) -> None:
    for domain, value in zip(paper.OOD_DOMAINS, expected, strict=True):
        assert paper.implied_success(method, domain) == pytest.approx(value, abs=0.0051)
    assert paper.implied_success(method, "ID") == paper.in_domain_success(method)


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("ID", "ID"),
        ("in-domain", "ID"),
        ("in_domain", "ID"),
        ("w", "W"),
        ("workspace", "W"),
        ("W+V", "WV"),
        ("viewpoint_workspace", "WV"),
        ("VE", "VE"),
        ("embodiment+view", "VE"),
        ("all", "WVE"),
        ("workspace+viewpoint+embodiment", "WVE"),
        ("lights", "lights"),
        ("w_lights", "w_lights"),
        ("viewpoint_cone", "viewpoint_cone"),
        ("workspace+object_color", "workspace+object_color"),
        ("wide", "wide"),
        ("w2", "w2"),
        ("", ""),
    ],
)
def test_domain_names(name: str, key: str) -> None:
    assert paper.domain_key(name) == key


def test_order_and_labels() -> None:
    assert paper.ordered_domains(["all", "fog", "w", "id"]) == ["id", "w", "all", "fog"]
    assert paper.ordered_methods(["arro", "mine", "bc", "palm"]) == ["palm", "bc", "arro", "mine"]
    assert [paper.domain_label(d) for d in paper.DOMAINS] == [
        "ID", "W", "V", "E", "W+V", "W+E", "V+E", "All",
    ]  # fmt: skip
    assert paper.domain_label("object_color+workspace") == "object color + workspace"
    assert paper.domain_title("workspace+viewpoint+embodiment") == "all three"
    assert paper.task_label("my_task") == "my task"
    assert paper.method_label("mine") == "mine"
    assert paper.degradation("mine", "W") is None and paper.degradation("palm", "ID") is None
    assert paper.implied_success("palm", "fog") is None and paper.in_domain_success("mine") is None
