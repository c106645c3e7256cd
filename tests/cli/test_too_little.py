"""Readings that say nothing, and models that do not arrive: said so, never guessed."""

import json

import pytest

from probewise.cli import main
from probewise.errors import NotConvergedError


def run(*arguments):
    return main([str(a) for a in arguments])


def keep_rows(path, n):
    path.write_text("\n".join(path.read_text().splitlines()[: n + 1]) + "\n")


def set_all(path, reading):
    header, *rows = path.read_text().splitlines()
    at = header.split(",").index("reading")
    changed = [",".join([*row.split(",")[:at], reading, *row.split(",")[at + 1 :]]) for row in rows]
    path.write_text("\n".join([header, *changed]) + "\n")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("harm", "said"), [("one reading", "1 usable reading is too few"), ("few", "are too few"), ("equal", "are equal")]
)
def test_too_little_to_say_anything_is_a_verdict_of_its_own(harm, said, recording_file, tmp_path, capsys):
    match harm:
        case "one reading":
            keep_rows(recording_file, 1)
        case "few":
            keep_rows(recording_file, 20)
        case "equal":
            keep_rows(recording_file, 40)
            set_all(recording_file, "30")
    out = tmp_path / "out"
    assert run("diagnose", recording_file, "--out", out) == 0
    found = json.loads((out / "diagnosis.json").read_text())
    assert found["verdict"] == "cannot_tell"
    assert found["combination"] == []
    # What is believed of anything is what was believed before.
    assert found["hypotheses"][0]["effects"] == []
    assert 0.5 < found["clean_probability"] < 0.7
    assert 0.03 < found["unknown_probability"] < 0.1
    assert all(0.005 < effect["probability"] < 0.03 for effect in found["effects"])
    assert len(found["credible_set"]) > 10
    assert said in found["reason"]
    assert said in (out / "report.html").read_text()


@pytest.mark.slow
def test_a_fit_that_does_not_arrive_gives_no_verdict(recording_file, tmp_path, monkeypatch, capsys):
    def never(*_, **__):
        raise NotConvergedError("the fit of the model did not converge")

    monkeypatch.setattr("probewise.diagnosis.verdict.require_converged_fit", never)
    assert run("diagnose", recording_file, "--out", tmp_path / "out") == 1
    said = capsys.readouterr()
    assert said.err.splitlines()[-1] == "probewise diagnose: the fit of the model did not converge"
    assert said.out == ""
    assert not (tmp_path / "out").exists()
