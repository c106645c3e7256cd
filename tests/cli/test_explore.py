"""What `probewise explore` says of the choices it offers."""

import json

import pytest

from probewise.cli import main
from probewise.report import exploration


@pytest.fixture
def explore(sensor_file, tmp_path, quick_frames):
    def call(*options):
        out = tmp_path / "found"
        where = ("--sensor", sensor_file, "--truth", "500,250,90", "--out", out, "--seed", 3)
        status = main([str(word) for word in ("explore", *where, *options)])
        return status, [json.loads(line) for line in (out / "journal.jsonl").read_text().splitlines()]

    return call


def test_the_sensor_may_be_learnt_along(explore, capsys):
    status, lines = explore("--learn-sensor", "--max-readings", 1)
    assert status == 0
    assert {"log_size_u", "log_size_v", "shift_u_mm", "shift_v_mm", "I_min", "I_max"} <= set(lines[1]["belief"]["mean"])
    said = capsys.readouterr().out
    assert "I_min" in said
    assert "(sensor)" in said


@pytest.mark.parametrize(
    ("options", "utility"),
    [
        ((), "Finishing(of=InformationGain(), least=0.25)"),
        (("--utility", "entropy"), "ReadingEntropy(bin_width=1.0)"),
        (("--utility", "about:radius_mm"), "InformationAbout(of=ParameterValue(name='radius_mm', n_bins=16))"),
    ],
)
def test_the_journal_names_the_utility(explore, options, utility):
    status, lines = explore("--max-readings", 1, *options)
    assert status == 0
    assert lines[0]["utility"] == utility
    assert lines[0]["options"]["step"] == 1.0
    assert lines[0]["options"]["reading_range"] == [1.0, 100.0]


def test_readings_may_be_chosen_several_at_a_time(explore):
    status, lines = explore("--batch", 2, "--max-readings", 2)
    assert status == 0
    assert lines[0]["options"]["batch"] == 2
    first, second = (line["pose"] for line in lines[1:])
    assert lines[1]["belief"]["next"] == second != first


def test_what_the_other_model_makes_of_the_readings_is_shown_beside(explore, monkeypatch, tmp_path):
    """The naive model left, as in the paper, whichever chooses; the run itself is the same as without."""
    drawn, quick = [], exploration.frame_of_both

    def remember(views, *_, **__):
        drawn.append(views)
        return quick()

    monkeypatch.setattr(exploration, "frame_of_both", remember)
    status, lines = explore("--both-models", "--max-readings", 2)
    assert status == 0
    assert [[title for title, *_ in views] for views in drawn] == [["naive model", "SSF model"]] * 2
    for views, line in zip(drawn, lines[1:], strict=True):
        assert [step.reading.value for _, step, _ in views] == [line["reading"]] * 2
        (_, naive, _), (_, ssf, _) = views
        assert ssf.mean.tolist() == [line["belief"]["mean"][name] for name in ssf.names] != naive.mean.tolist()
    assert "naive model makes of the same readings" in (tmp_path / "found" / "report.html").read_text()
