"""One case, from its seed to what was stated."""

import pytest

from probewise.proof.challenge import challenge, run_system_case
from probewise.proof.tables import score_systems


@pytest.mark.slow
def test_a_case_is_diagnosed_from_its_files_and_the_campaign_goes_on(tmp_path):
    path = tmp_path / "cases.jsonl"
    first, both = (
        list(challenge(range(n), seed=5, work=run_system_case, of="systems").run(path=path).values()) for n in (1, 2)
    )
    assert both[0] == first[0]
    assert "failed" not in both[0]
    assert set(both[0]["held_out"]) == {"inside", "beyond"}
    assert len(path.read_text().splitlines()) == 3
    assert any(row.found.n for row in score_systems(both))
