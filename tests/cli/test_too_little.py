"""Readings that say nothing, and models that do not arrive: said so, never guessed."""

import pytest
from command import run

from probewise.errors import NotConvergedError


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
