"""What `probewise explore` says of the choices it offers."""

import csv
import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from probewise.calibration import read_sensor, write_sensor
from probewise.cli import main, parser
from probewise.cli.explore import Search, parse_truth
from probewise.recordings import Instrumentation
from probewise.report import exploration
from probewise.scene import Field


@pytest.fixture
def explore(sensor_file, tmp_path, quick_frames):
    def call(*options):
        out = tmp_path / "found"
        where = ("--sensor", sensor_file, "--truth", "500,250,90", "--out", out, "--seed", 3)
        status = main([str(word) for word in ("explore", *where, *options)])
        return status, [json.loads(line) for line in (out / "journal.jsonl").read_text().splitlines()]

    return call


def test_a_simulated_arm_that_lacks_the_effects_of_its_sensor_says_so(explore, sensor_file, capsys):
    sensor = read_sensor(sensor_file)
    more = np.tile([0.2, 30.0], (len(sensor.samples), 1))
    names = (*sensor.names, "gain_drift.frac", "gain_drift.tau_s")
    with_drift = replace(sensor, names=names, samples=np.hstack([sensor.samples, more]), effects=("gain_drift",))
    write_sensor(with_drift, sensor_file)
    assert explore("--trust", 1, "--max-readings", 1)[0] == 0
    said = capsys.readouterr().out
    assert "but not its effects: gain drift" in said
    assert "bits about the shape, " in said


def test_what_the_world_conceals_is_in_the_journal_and_the_summary(explore, capsys):
    assert explore("--conceal", "gain:-0.5", "--max-readings", 1)[1][0]["concealed"] == "gain:-0.5"
    said = capsys.readouterr().out
    assert "concealed    gain:-0.5" in said
    assert "bits about the shape and the sensor, " in said
    assert "sensor       The sensor model leaves nothing out that shows" in said
    assert explore("--max-readings", 1, "--resume")[0] == 2  # without what it conceals


@pytest.mark.slow
def test_the_sensor_may_be_learnt_along(explore, capsys):
    status, lines = explore("--learn-sensor", "--max-readings", 1)
    assert status == 0
    assert {"log_size_u", "log_size_v", "shift_u_mm", "shift_v_mm", "I_min", "I_max"} <= set(lines[1]["belief"]["mean"])
    said = capsys.readouterr().out
    assert "I_min" in said
    assert "(sensor)" in said


@pytest.mark.slow
def test_what_the_other_model_makes_of_the_readings_is_shown_beside(explore, monkeypatch, tmp_path):
    """The naive model left, as in the paper, whichever chooses; the run itself is the same as without."""
    drawn, quick = [], exploration.robot_views_by_model_png

    def remember(views, *_, **__):
        drawn.append(views)
        return quick()

    monkeypatch.setattr(exploration, "robot_views_by_model_png", remember)
    status, lines = explore("--both-models", "--max-readings", 2)
    assert status == 0
    assert [[title for title, *_ in views] for views in drawn] == [["naive model", "SSF model"]] * 2
    for views, line in zip(drawn, lines[1:], strict=True):
        assert [step.reading.value for _, step, _ in views] == [line["reading"]] * 2
        (_, naive, _), (_, ssf, _) = views
        assert ssf.mean.tolist() == [line["belief"]["mean"][name] for name in ssf.names] != naive.mean.tolist()
    assert "The SSF model chose the readings" in (tmp_path / "found" / "report.html").read_text()


@pytest.fixture
def at_14_mm(sensor_file):
    """The sensor's description says at which height it was calibrated."""
    write_sensor(replace(read_sensor(sensor_file), instrumentation=Instrumentation(height_mm=14.0)), sensor_file)


@pytest.mark.slow
@pytest.mark.usefixtures("at_14_mm")
def test_how_the_sensor_stands_and_how_often_it_reads_may_be_chosen_and_are_kept(explore, capsys):
    more = ("--orientations", "0,90", "--heights", "10,14", "--repeats", "2", "--utility", "per-second")
    status, lines = explore(*more, "--max-readings", 2)
    assert status == 0
    options = lines[0]["options"]
    assert options["orientations_rad"] == [0.0, math.pi / 2]
    assert (options["heights_mm"], options["calibrated_height_mm"], options["repeats"]) == ([10.0, 14.0], 14.0, [2])
    first, second = (line["pose"] for line in lines[1:])
    assert first == second
    assert first["height_mm"] in (10.0, 14.0)
    assert first["orientation_rad"] in (0.0, math.pi / 2)
    status, resumed = explore(*more, "--max-readings", 3, "--resume")
    assert status == 0
    assert resumed[:3] == lines
    capsys.readouterr()
    status, _ = explore("--max-readings", 4, "--resume")
    assert status == 2
    said = capsys.readouterr().err
    assert "options.heights_mm [10.0, 14.0] there, [] here" in said
    assert "options.batch" not in said


@pytest.mark.usefixtures("at_14_mm")
def test_the_lego_arms_own_height_may_be_named(sensor_file, tmp_path):
    words = ("explore", "--sensor", sensor_file, "--out", tmp_path, "--heights", "14", "--arm", "nxt:/dev/null")
    assert Search(parser().parse_args([str(word) for word in words])).experiment.heights_mm == (14.0,)


@pytest.mark.slow
def test_what_was_found_is_written_as_a_table_with_its_samples(explore, tmp_path):
    """Of a set of shapes the samples name theirs, and leave the parameters of the others empty."""
    status, lines = explore("--shape", "circle", "rectangle", "--max-readings", 2)
    assert status == 0
    found = json.loads((tmp_path / "found" / "result.json").read_text(), parse_constant=pytest.fail)
    assert (found["format"], found["readings"], found["known"]) == ("exploration/1", 2, False)
    assert found["seconds"] == lines[-1]["time_s"]
    assert found["shape"]["name"] in ("circle", "rectangle")
    own = {"circle": {"x_mm", "y_mm", "radius_mm"}, "rectangle": {"x_mm", "y_mm", "width_mm", "height_mm", "angle_rad"}}
    assert {p["name"] for p in found["shape"]["parameters"]} == own[found["shape"]["name"]]
    with (tmp_path / "found" / "samples.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert sum(float(row["weight"]) for row in rows) == pytest.approx(1.0, abs=1e-3)
    for row in rows:
        names = {name for name, cell in row.items() if cell and name not in ("weight", "shape")}
        assert {name.removeprefix(f"{row['shape']}.") for name in names} == own[row["shape"]]
    share = sum(float(row["weight"]) for row in rows if row["shape"] == found["shape"]["name"])
    assert found["shape"]["probability"] == pytest.approx(share, abs=1e-3)
    assert found["chance_off_12mm"] >= 1 - share - 1e-3


@pytest.mark.slow
def test_a_known_card_lies_on_the_field_of_the_robot_and_of_the_world(explore, tmp_path, capsys):
    """What it may leave out then holds a tilt; a run goes on only over the same cards."""
    status, lines = explore("--max-readings", 1, "--reference", "120,100,80,60,1")
    assert status == 0
    effects = [h["effects"] for h in json.loads((tmp_path / "found/result.json").read_text())["left_out"]["hypotheses"]]
    assert ["sensor_tilt"] in effects
    assert "No reading of the field can show" not in capsys.readouterr().out
    assert len(lines) == 2
    status, lines = explore("--max-readings", 2, "--reference", "120,100,80,60,0.5", "--resume")
    assert status == 2
    assert len(lines) == 2


PAPER = ("--method", "paper", "--nested-stop", "remaining")


@pytest.mark.slow
def test_the_papers_robot_leaves_what_the_other_leaves_and_its_journal_names_it(explore, tmp_path, capsys):
    status, lines = explore(*PAPER, "--max-readings", 1)
    assert status == 0
    assert lines[0]["method"].startswith("NestedSampling(n_live=300, stop=RemainingEvidence(dlogz=0.05), n_steps=1000")
    assert lines[0]["utility"] == "ReadingEntropy(bin_width=1.0)"
    assert lines[0]["options"]["trust"] == 1.0
    assert lines[0]["likelihood"].startswith("OneScan(")
    assert {"mean", "sd", "bits", "next"} == set(lines[1]["belief"])
    found = json.loads((tmp_path / "found" / "result.json").read_text())
    assert found["readings"] == 1
    assert "nested sampling anew after each reading" in (tmp_path / "found" / "report.html").read_text()
    assert "radius_mm" in capsys.readouterr().out


def test_a_resumed_run_takes_its_shipped_sensor_for_the_same_though_reading_normalises_the_field_again(
    sensor_file, tmp_path, monkeypatch, quick_frames
):
    sensor = read_sensor(sensor_file)
    fields = (replace(sensor.field, values=sensor.field.values * k) for k in range(1, 1000))
    made = replace(sensor, field=next(field for field in fields if field.values.sum() != 1.0))
    given = ["explore", "--out", str(tmp_path / "out"), "--trust", "1", "--quiet", "--max-readings"]
    monkeypatch.setattr("probewise.cli.explore.calibrate", lambda *_, **__: SimpleNamespace(sensor=made))
    assert main([*given, "1"]) == 0
    monkeypatch.setattr("probewise.cli.explore.calibrate", lambda *_, **__: pytest.fail("calibrated again"))
    assert main([*given, "2", "--resume"]) == 0


def test_without_a_sensor_a_simulated_run_takes_that_of_the_recording_that_ships(tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    given = ["explore", "--out", str(out), "--trust", "1", "--max-readings"]
    assert main([*given, "2", "--quiet"]) == 0
    assert json.loads((out / "journal.jsonl").read_text().splitlines()[0])["sensor_file"] == "shipped_sensor.json"
    monkeypatch.setattr("probewise.cli.explore.calibrate", lambda *_, **__: pytest.fail("calibrated again"))
    monkeypatch.setattr("probewise._progress._PATIENCE_S", 0.0)
    assert main([*given, "3", "--resume"]) == 0
    assert "going through the journal, 0 of 2" in capsys.readouterr().err.splitlines()[0]
    assert json.loads((out / "result.json").read_text())["readings"] == 3


@pytest.mark.parametrize("truth", ["0,0,20", "1048,520,150", "ellipse:500,250,90,90,0", "hexagon:500,250,30,0"])
def test_a_truth_on_its_bounds_is_taken(truth):
    hidden = parse_truth(truth, ["circle"], Field(), rng=np.random.default_rng(0))
    assert hidden.name == (truth.partition(":")[0] if ":" in truth else "circle")
    assert hidden.theta.tolist() == [float(cell) for cell in truth.rpartition(":")[2].split(",")]
