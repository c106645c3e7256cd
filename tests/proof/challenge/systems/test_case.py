"""One case, from its seed to what was stated."""

import json

import pytest

from probewise.proof.challenge import Task, challenge, run_system_case
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


@pytest.mark.slow
def test_a_case_is_the_same_each_time():
    one, again = (run_system_case(Task(5, 0)) | {"cpu_s": 0.0} for _ in range(2))
    assert json.dumps(one) == json.dumps(again)
