"""Input that cannot be used: exit status 2, one line that says what, where and what is allowed, nothing written."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from probewise.arm import shipped_geometry_path
from probewise.cli import VERBS, main
from probewise.cli._explore import parse_truth
from probewise.scene import Field


def refused(capsys, out, *arguments):
    """Run, and return the one line of the refusal."""
    before = sorted(out.parent.rglob("*"))
    assert main([str(a) for a in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("probewise")
    assert captured.err.count("\n") == 1, captured.err
    assert sorted(out.parent.rglob("*")) == before
    return captured.err


def spoil(path, column, text, row=3):
    """Write another text into one cell."""
    lines = path.read_text().splitlines()
    cells = lines[row - 1].split(",")
    cells[lines[0].split(",").index(column)] = text
    lines[row - 1] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("verb", ["calibrate", "diagnose"])
@pytest.mark.parametrize(
    ("column", "text"),
    [("x_mm", "ten"), ("y_mm", "nan"), ("x_mm", "inf"), ("pattern", "nobody"), ("reading", "bright"), ("x_mm", "")],
)
def test_a_cell_that_cannot_be_used_is_named_with_its_row_and_column(
    verb, column, text, recording_file, tmp_path, capsys
):
    spoil(recording_file, column, text)
    said = refused(capsys, tmp_path / "out", verb, recording_file, "--out", tmp_path / "out")
    assert recording_file.name in said
    assert "row 3" in said
    assert column in said


@pytest.mark.parametrize("verb", ["calibrate", "diagnose"])
@pytest.mark.parametrize("harm", ["no json", "torn json", "unknown kind", "no x_mm", "no rows", "empty", "binary"])
def test_a_damaged_recording_is_refused_in_one_line(verb, harm, recording_file, tmp_path, capsys):
    description = recording_file.with_suffix(".json")
    match harm:
        case "no json":
            description.unlink()
        case "torn json":
            description.write_text(description.read_text()[:40])
        case "unknown kind":
            content = json.loads(description.read_text())
            content["patterns"]["boundary"]["kind"] = "spiral"
            description.write_text(json.dumps(content))
        case "no x_mm":
            recording_file.write_text(recording_file.read_text().replace("x_mm", "where"))
        case "no rows":
            recording_file.write_text(recording_file.read_text().splitlines()[0] + "\n")
        case "empty":
            recording_file.write_bytes(b"")
        case "binary":
            recording_file.write_bytes(bytes(range(256)))
    refused(capsys, tmp_path / "out", verb, recording_file, "--out", tmp_path / "out")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("investigate", "--plan", "paper", "--origin-mm", "1,2"), "--origin-mm is '1,2'; allowed: none with"),
        (("investigate", "--plan", "paper", "--geometry", "arm.toml"), "--geometry is 'arm.toml'; allowed: none with"),
        (("investigate", "--plan", "paper", "--truth", "backlash:nan"), "'backlash:nan'; allowed: backlash:"),
        (("study", "--model", "naive", "--learn-sensor"), "learn_sensor is True; allowed: False with"),
        (("study", "--model", "naive", "--width", "1.3"), "width is 1.3; allowed: 1.0 with"),
        (("study", "--concealed", "--beside-paper"), "--beside-paper is 'given'; allowed: none with --concealed"),
        (("study", "--concealed", "--seed", "-1"), "'-1' is not a whole number of 0 or more"),
        (("study", "--batch", "3", "--utility", "entropy"), "batch is 3; allowed: 1, or more with"),
    ],
)
def test_options_that_contradict_each_other_are_refused_before_any_work(words, says, tmp_path, capsys):
    assert says in refused(capsys, tmp_path / "out", *words, "--out", tmp_path / "out")


@pytest.mark.parametrize("value", ["9" * 30, "1" * 5000, "1e400", "nan", "-1", "0"], ids=lambda value: value[:6])
@pytest.mark.parametrize(
    "words",
    [
        ("calibrate", "rec.csv", "--live"), ("arm", "scan", "450,260", "600,260", "--readings"),
        ("explore", "--sensor", "s.json", "--batch"),
        ("explore", "--sensor", "s.json", "--repeats"), ("explore", "--sensor", "s.json", "--max-readings"),
        ("study", "--circles"), ("study", "--concealed", "--clean"), ("study", "--batch"), ("study", "--workers"),
        ("challenge", "--cases"), ("investigate", "--plan", "paper", "--rounds"),
    ],
    ids=" ".join,
)  # fmt: skip
def test_a_count_out_of_range_is_refused_with_the_range(words, value, tmp_path, capsys):
    said = refused(capsys, tmp_path / "out", *words[:-1], f"{words[-1]}={value}")
    assert "is not a whole number from 1 to" in said
    assert len(said) < 500


@pytest.mark.filterwarnings("default")
def test_no_warning_of_arithmetic_stands_beside_an_error(tmp_path, capsys):
    arm = tmp_path / "arm.toml"
    arm.write_text(shipped_geometry_path().read_text().replace("upper_mm = 350", "upper_mm = 1e-320"))
    assert main(["arm", "check", "--geometry", str(arm)]) == 2
    assert capsys.readouterr().err.startswith("probewise arm: reach is 'nowhere on the field'")


@pytest.mark.parametrize("verb", ["calibrate", "diagnose"])
def test_a_recording_that_is_not_there_is_refused(verb, tmp_path, capsys):
    said = refused(capsys, tmp_path / "out", verb, tmp_path / "nowhere.csv", "--out", tmp_path / "out")
    assert "nowhere.csv" in said


def test_too_few_live_points_are_refused_before_any_work(recording_file, tmp_path, capsys):
    out = tmp_path / "out"
    assert "52 or more" in refused(capsys, out, "calibrate", recording_file, "--out", out, "--live", 51)


def test_too_many_gaussians_are_blamed_on_the_option_that_asked_for_them(recording_file, tmp_path, capsys):
    out = tmp_path / "out"
    said = refused(capsys, out, "calibrate", recording_file, "--out", out, "--orders", 1, 99)
    assert "--orders is 99; allowed: up to 24 with --live 300" in said
    assert "596 parameters, which take --live 1192" in said


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc")
@pytest.mark.parametrize("verb", ["calibrate", "diagnose", "audit"])
def test_a_directory_that_nobody_can_write_to_is_refused_before_any_work(verb, recording_file, tmp_path, capsys):
    """Root may write to /proc, by its permissions, and cannot."""
    said = refused(capsys, tmp_path / "out", verb, recording_file, "--out", "/proc/foo")
    assert said == f"probewise {verb}: /proc/foo: /proc cannot be written to; allowed: a directory you may write to\n"


@pytest.mark.parametrize("verb", ["predict", "audit", "calibrate"])
def test_a_journal_is_no_recording_and_it_is_said_what_to_do_with_it(verb, tmp_path, capsys):
    journal = tmp_path / "journal.jsonl"
    journal.write_text("{}\n")
    more = ["sensor.json"] if verb == "predict" else []
    said = refused(capsys, tmp_path / "out", verb, *more, journal, "--out", tmp_path / "out")
    assert f"probewise diagnose {journal} --sensor S.json --out DIR" in said


def test_a_recording_without_contrast_cannot_be_calibrated(recording_file, tmp_path, capsys):
    lines = recording_file.read_text().splitlines()
    at = lines[0].split(",").index("reading")
    rows = [",".join([*line.split(",")[:at], "30", *line.split(",")[at + 1 :]]) for line in lines[1:]]
    recording_file.write_text("\n".join([lines[0], *rows]) + "\n")
    refused(capsys, tmp_path / "out", "calibrate", recording_file, "--out", tmp_path / "out")


@pytest.mark.parametrize("content", ["", "{", "[]", '{"format": "sensor/2"}', '{"format": "sensor/1"}', "\0\1"])
@pytest.mark.parametrize("verb", ["predict", "explore", "diagnose"])
def test_a_damaged_sensor_model_is_refused(verb, content, recording_file, tmp_path, capsys):
    sensor, out = tmp_path / "damaged.json", tmp_path / "out"
    sensor.write_text(content)
    arguments = {
        "predict": ["predict", sensor, recording_file, "--out", out],
        "explore": ["explore", "--sensor", sensor, "--out", out],
        "diagnose": ["diagnose", recording_file, "--sensor", sensor, "--out", out],
    }[verb]
    assert "damaged.json" in refused(capsys, out, *arguments)


def test_a_sensor_model_with_a_field_missing_says_which(sensor_file, recording_file, tmp_path, capsys):
    content = json.loads(sensor_file.read_text())
    del content["noise"]
    sensor_file.write_text(json.dumps(content))
    said = refused(capsys, tmp_path / "o.csv", "predict", sensor_file, recording_file, "--out", tmp_path / "o.csv")
    assert "noise" in said


@pytest.mark.parametrize(
    "option",
    [
        ("--truth", "1,2"),
        ("--truth", "a,b,c"),
        ("--truth", "spiral:1,2,3"),
        ("--field", "10"),
        ("--field", "-5,20"),
        ("--shape", "spiral"),
        ("--max-readings", "0"),
        ("--seed", "-1"),
        ("--seed", "x"),
        ("--model", "perfect"),
        ("--arm", "third"),
        ("--utility", "spiral"),
        ("--batch", "0"),
        ("--batch", "2", "--utility", "entropy"),
        ("--learn-sensor", "--model", "naive"),
        ("--resume",),
        ("--unheard-of",),
    ],
)
def test_an_option_out_of_range_is_refused(option, sensor_file, tmp_path, capsys):
    out = tmp_path / "out"
    refused(capsys, out, "explore", "--sensor", sensor_file, "--out", out, *option)


@pytest.mark.parametrize(
    ("truth", "parameter", "value", "allowed"),
    [
        ("500,250,0", "radius_mm", "0.0", "20 to 150"),
        ("500,250,-90", "radius_mm", "-90.0", "20 to 150"),
        ("500,250,5000", "radius_mm", "5000.0", "20 to 150"),
        ("500,nan,90", "y_mm", "nan", "0 to 520"),
        ("inf,250,90", "x_mm", "inf", "0 to 1048"),
        ("500,250,-inf", "radius_mm", "-inf", "20 to 150"),
        ("1049,250,90", "x_mm", "1049.0", "0 to 1048"),
        ("500,-1,90", "y_mm", "-1.0", "0 to 520"),
        ("rectangle:500,250,100,0,0.3", "height_mm", "0.0", "40 to 300"),
        ("rectangle:500,250,100,60,2", "angle_rad", "2.0", "0 to 1.5708"),
        ("ellipse:500,250,90,120,0.3", "semi_minor_mm", "120.0", "20 to 90"),
        ("ellipse:500,250,inf,inf,0.3", "semi_major_mm", "inf", "20 to 150"),
    ],
)
def test_a_truth_that_cannot_lie_there_is_named_with_its_bounds_and_the_way_out(
    truth, parameter, value, allowed, sensor_file, tmp_path, capsys
):
    out = tmp_path / "out"
    said = refused(capsys, out, "explore", "--sensor", sensor_file, "--out", out, "--truth", truth)
    assert f"{parameter} of --truth {truth} is {value}; allowed: {allowed}," in said
    assert "without --truth the seed draws one" in said


@pytest.mark.parametrize("truth", ["0,0,20", "1048,520,150", "ellipse:500,250,90,90,0", "hexagon:500,250,30,0"])
def test_a_truth_on_its_bounds_is_taken(truth):
    hidden = parse_truth(truth, ["circle"], Field(), rng=np.random.default_rng(0))
    assert hidden.name == (truth.partition(":")[0] if ":" in truth else "circle")
    assert hidden.theta.tolist() == [float(cell) for cell in truth.rpartition(":")[2].split(",")]


@pytest.mark.parametrize("verb", VERBS)
def test_a_file_in_place_of_the_output_directory_is_refused(verb, sensor_file, recording_file, tmp_path, capsys):
    out = tmp_path / "taken"
    out.write_text("mine")
    arguments = {
        "demo": ["demo", "--out", out],
        "calibrate": ["calibrate", recording_file, "--out", out],
        "predict": ["predict", sensor_file, recording_file, "--out", out / "p.csv"],
        "explore": ["explore", "--sensor", sensor_file, "--out", out],
        "diagnose": ["diagnose", recording_file, "--out", out],
        "investigate": ["investigate", "--plan", recording_file, "--truth", "nothing", "--out", out],
        "study": ["study", "--out", out],
        "audit": ["audit", recording_file, "--out", out],
        "challenge": ["challenge", "--out", out],
        "fit": ["fit", recording_file, "--simulator", recording_file, "--out", out],
        "sheets": ["sheets", "field", "--out", out / "field.pdf"],
        "arm": ["arm", "check", "--out", out / "reach.png"],
        "emulate-nxt": ["emulate-nxt", "--log", out / "log.txt"],
    }[verb]
    refused(capsys, out, *arguments)
    assert out.read_text() == "mine"


def test_a_prediction_does_not_overwrite_its_plan(sensor_file, recording_file, tmp_path, capsys):
    for its in (recording_file, recording_file.with_suffix(".json")):
        before = its.read_bytes()
        refused(capsys, tmp_path / "x", "predict", sensor_file, recording_file, "--out", its)
        assert its.read_bytes() == before


def test_a_run_that_stands_there_is_not_overwritten_by_a_new_one(sensor_file, tmp_path, capsys):
    out = tmp_path / "run"
    out.mkdir()
    (out / "journal.jsonl").write_text('{"format": "journal/1"}\n')
    assert "--resume" in refused(capsys, out / "x", "explore", "--sensor", sensor_file, "--out", out)


@pytest.mark.parametrize("arguments", [[], ["unheard-of"], ["calibrate"], ["predict", "only-one"]])
def test_a_wrong_command_line_is_refused_in_one_line(arguments, tmp_path, capsys):
    refused(capsys, tmp_path / "out", *arguments)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["explor"], "did you mean explore?"),
        (["explore", "--sensr", "s.json", "--out", "o"], "no option --sensr; did you mean --sensor?"),
        (["explore", "--sensor", "s.json", "--out", "o", "--max-raedings=5"], "did you mean --max-readings?"),
        (["explore", "--sensor", "s.json", "--out", "o", "--shape", "circel"], "did you mean circle?"),
        (["arm", "raed"], "did you mean read?"),
        (["calibrate", "a.csv", "b.csv", "--out", "o"], "arguments: b.csv (see probewise calibrate --help)"),
        (["arm", "jog", "base", "-5", "--dryrun"], "did you mean --dry-run?"),
        (["arm", "read", "--zzz"], "no option --zzz (see"),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value),
)
def test_what_was_perhaps_meant_is_said(arguments, says, tmp_path, capsys):
    assert says in refused(capsys, tmp_path / "out", *arguments)


@pytest.mark.parametrize(
    ("option", "value", "meant"),
    [
        ("--arm", "emulatr", "emulator"),
        ("--arm", "ntx:/dev/rfcomm0", "nxt"),
        ("--utility", "entorpy", "entropy"),
        ("--truth", "cirle:600,260,90", "circle"),
    ],
)
def test_a_misspelt_value_is_told_with_what_was_perhaps_meant(option, value, meant, sensor_file, tmp_path, capsys):
    out = tmp_path / "out"
    said = refused(capsys, out, "explore", "--sensor", sensor_file, "--out", out, option, value, "--quiet")
    assert f"did you mean {meant}?" in said


def test_a_package_that_is_missing_is_named_and_not_the_address(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(["study", "--out", str(tmp_path / "out"), "--scheduler", "localhost:8786", "--quiet"]) == 1
    said = capsys.readouterr().err
    assert "--scheduler needs the package distributed, which is not installed" in said
    assert "pip install distributed" in said
    assert said.count("\n") == 1
