"""Results are written whole or not at all, and nothing that was read is lost for them."""

import numpy as np
import pytest

from probewise.calibration import read_sensor, write_sensor
from probewise.cli import main
from probewise.cli._output import staged
from probewise.errors import FileError
from probewise.recordings import read_recording, write_recording


def test_what_an_earlier_run_left_behind_goes_and_what_is_not_ours_stays(tmp_path):
    for name in ("witness_time.svg", "witness_level.svg", "notes.txt"):
        (tmp_path / name).write_text("old")
    with staged(tmp_path, outdated=("witness_*.svg",)) as stage:
        (stage / "witness_level.svg").write_text("new")
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"witness_level.svg": "new", "notes.txt": "old"}


def test_an_input_that_would_be_replaced_is_set_aside_with_its_description(tmp_path):
    csv, json = tmp_path / "plan.csv", tmp_path / "plan.json"
    for round_ in ("first", "second"):
        csv.write_text(round_)
        json.write_text(round_)
        with staged(tmp_path, inputs=(csv, json), outdated=("plan.*",)) as stage:
            (stage / "plan.csv").write_text("new")
            (stage / "plan.json").write_text("new")
        assert csv.read_text() == json.read_text() == "new"
    kept = {p.name: p.read_text() for p in tmp_path.glob("plan_kept*")}
    assert kept == {
        "plan_kept.csv": "first",
        "plan_kept.json": "first",
        "plan_kept_2.csv": "second",
        "plan_kept_2.json": "second",
    }


def test_an_input_that_nothing_replaces_stays_where_it_is(tmp_path):
    csv = tmp_path / "next_plan.csv"
    csv.write_text("readings")
    with staged(tmp_path, inputs=(csv,), outdated=("next_plan.*",)):
        pass
    assert csv.read_text() == "readings"


def test_a_directory_in_the_way_leaves_everything_as_it_was(tmp_path):
    (tmp_path / "b").mkdir()

    def write():
        with staged(tmp_path) as stage:
            (stage / "a").write_text("new")
            (stage / "b").write_text("new")

    with pytest.raises(FileError, match="a directory of that name is in the way"):
        write()
    assert [p.name for p in tmp_path.iterdir()] == ["b"]


@pytest.mark.parametrize("verb", ["diagnose", "calibrate"])
def test_an_empty_name_is_not_the_directory_one_is_in(verb, recording_file, capsys):
    assert main([verb, str(recording_file), "--out", ""]) == 2
    assert "names no file or directory" in capsys.readouterr().err


def test_a_sensor_that_reads_in_another_unit_is_refused(sensor_file, recording_file, tmp_path, capsys):
    text = recording_file.with_suffix(".json").read_text()
    recording_file.with_suffix(".json").write_text(text.replace('"LEGO"', '"mW"'))
    out = tmp_path / "out"
    assert main(["diagnose", str(recording_file), "--sensor", str(sensor_file), "--out", str(out)]) == 2
    assert "'LEGO'" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
def test_readings_filled_in_where_the_plan_stood_are_not_lost(recording_file, tmp_path, capsys):
    """Whoever fills in next_plan.csv in place and diagnoses again, with it or without it, still has it."""
    out = tmp_path / "out"
    assert main(["diagnose", str(recording_file), "--out", str(out), "--quiet"]) == 0
    recording = read_recording(recording_file)
    few = type(recording)(recording.plan.take(np.arange(30)), recording.readings[:30] + 0.01)
    write_recording(few, out / "next_plan.csv")
    taken = (out / "next_plan.csv").read_bytes()
    assert main(["diagnose", str(recording_file), "--out", str(out)]) == 0
    kept = out / "next_plan_kept.csv"
    assert (kept if kept.exists() else out / "next_plan.csv").read_bytes() == taken
    sensor = read_sensor(out / "sensor.json")
    write_sensor(sensor, out / "sensor.json")
    before = (out / "sensor.json").read_bytes()
    assert main(["diagnose", str(recording_file), "--sensor", str(out / "sensor.json"), "--out", str(out)]) == 0
    assert (out / "sensor_kept.json").read_bytes() == before
    assert "sensor_kept.json" in capsys.readouterr().out
