"""The folder keeps plans and readings; what was cut goes on, what was begun otherwise is refused."""

from functools import partial

import numpy as np
import pytest

from probewise.errors import FileError
from probewise.investigation import RoundsFolder, SimulatedRecorder
from probewise.recordings import paper_plan
from probewise.world.shipped import true_world

TAKE = SimulatedRecorder(true_world("paper"), seed=3)


class Cut(Exception):
    pass


def few_rows():
    plan = paper_plan()
    return plan.take(plan.scan < 1)


def cut_after(n):
    def take(number, plan, asked, taken):
        for k, reading in enumerate(TAKE(number, plan, asked, taken)):
            if k == n:
                raise Cut
            yield reading

    return take


@pytest.mark.slow
def test_a_round_that_was_cut_is_the_round_that_was_not(tmp_path, monkeypatch):
    monkeypatch.setattr("probewise.investigation.folder._KEPT_AGAIN_S", 0.0)
    whole = RoundsFolder(tmp_path / "whole", {"seed": 1}, resume=False).record_round(1, few_rows(), "", take=TAKE)
    with pytest.raises(Cut):
        RoundsFolder(tmp_path / "cut", {"seed": 1}, resume=False).record_round(1, few_rows(), "", take=cut_after(5))
    folder = RoundsFolder(tmp_path / "cut", {"seed": 1}, resume=True)
    assert folder.n_readings == 5
    resumed = folder.record_round(1, few_rows(), "", take=TAKE)
    assert (tmp_path / "cut" / "1.csv").read_bytes() == (tmp_path / "whole" / "1.csv").read_bytes()
    np.testing.assert_array_equal(resumed.readings, whole.readings)


def test_an_instrument_that_fails_soon_loses_no_reading(tmp_path):
    folder = RoundsFolder(tmp_path / "rounds", {"seed": 1}, resume=False)
    with pytest.raises(Cut):
        folder.record_round(1, few_rows(), "", take=cut_after(5))
    assert folder.n_readings == 5


def test_a_plan_that_was_written_decides(tmp_path):
    folder = RoundsFolder(tmp_path / "rounds", {"seed": 1}, resume=False)
    first = folder.record_round(1, few_rows(), "", take=TAKE)
    other = few_rows().take(np.arange(3))
    np.testing.assert_array_equal(folder.record_round(1, other, "", take=TAKE).readings, first.readings)


def test_two_investigations_do_not_mix(tmp_path):
    begin = partial(RoundsFolder, tmp_path / "rounds")
    with pytest.raises(FileError, match="omit --resume to begin a new one"):
        begin({"seed": 1}, resume=True)
    begin({"seed": 1}, resume=False).record_round(1, few_rows(), "", take=TAKE)
    with pytest.raises(FileError, match="--resume to continue it"):
        begin({"seed": 1}, resume=False)
    with pytest.raises(FileError, match="seed 1"):
        begin({"seed": 2}, resume=True)
    (tmp_path / "rounds" / "settings.json").write_text("[1]")
    with pytest.raises(FileError, match="no JSON object"):
        begin({"seed": 1}, resume=True)
