"""The fault campaign's short cases; `make faults` runs all of them, and writes the table."""

from pathlib import Path

import pytest
from faults import campaign
from faults.cases import Case, Skipped, identifier

SHORT = [case for case in campaign.CASES if not case.long]


# When the disk is full, Orbax closes its event loop with writes under way.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("case", SHORT, ids=identifier)
def test_nothing_is_lost_and_the_cause_is_named(case: Case, tmp_path: Path) -> None:
    try:
        outcome = case.run(tmp_path)
    except Skipped as reason:
        pytest.skip(str(reason))
    assert outcome.happened and outcome.lost


def test_the_page_tells_of_every_case() -> None:
    """It is written by `make faults`, which has to be called when a case is added."""
    assert len(campaign.CASES) >= 60 and len(SHORT) >= 60
    rows = campaign.rows_of(campaign.PAGE.read_text())
    assert [row[:2] for row in rows] == [(case.group, case.name) for case in campaign.ordered()]
    assert campaign.FAILED not in {row[2] for row in rows}
