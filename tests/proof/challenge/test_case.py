"""One case from beginning to end, and the campaign that it belongs to."""

import json

import pytest

from probewise.errors import FileError
from probewise.proof.challenge import Task, challenge, run_case
from probewise.proof.sensors import stratum_of
from probewise.proof.tables import score

from ..conftest import case, single


@pytest.fixture
def file_of(tmp_path):
    """Write a campaign's file of cases made by hand."""

    def write(results, seed=3, version=None):
        from probewise import __version__

        settings = {"challenge": version or __version__, "seed": seed}
        lines = [{"format": "campaign/1", "settings": settings}]
        lines += [{"key": Task(seed, k).key, "result": r} for k, r in enumerate(results)]
        path = tmp_path / "cases.jsonl"
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))
        return path

    return write


def test_what_a_file_holds_is_not_done_again(file_of):
    results = [case(), single()]
    assert list(challenge(range(2), seed=3).run(path=file_of(results)).values()) == results


def test_another_version_s_cases_are_not_mixed_in(file_of):
    with pytest.raises(FileError, match=r"a campaign with challenge '0\.0'"):
        challenge([0], seed=3).run(path=file_of([case()], version="0.0"))


def test_a_case_that_cannot_be_drawn_is_noted(monkeypatch):
    def fails(*_, **__):
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr("probewise.proof.sensors.draw_case", fails)
    found = run_case(Task(1, 0))
    assert (found["failed"], found["at"]) == ("ZeroDivisionError: by zero", "drawing")
    assert found["kind"] == stratum_of(0)[0].kind


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 9])
def test_a_case_goes_through_strict_json_into_every_row(number):
    """And one of them again: it depends on its seed and number alone."""
    found = run_case(Task(1, number))
    if number == 1:
        assert {**run_case(Task(1, number)), "cpu_s": None} == {**found, "cpu_s": None}
    found = json.loads(json.dumps(found, allow_nan=False))
    assert "failed" not in found
    assert found["kind"] == stratum_of(number)[0].kind
    assert (found["settled"] is not None) == (found["kind"] == "alias")
    assert sum(p for _, p in found["hypotheses"]) == pytest.approx(1.0, abs=0.05)
    for h in found["hidden"]:
        assert h["size_lambda"] == pytest.approx(found["size"], rel=0.1)
        assert h["cosines"][h["name"]] > 0.98
    assert score([found])
