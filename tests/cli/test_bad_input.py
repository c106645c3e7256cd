"""Input that cannot be used: exit status 2, one line that says what, where and what is allowed, nothing written."""

import sys
from pathlib import Path

import numpy as np
import pytest

from probewise.arm import shipped_geometry_path
from probewise.cli import VERBS, main
from probewise.cli.explore import parse_truth
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


def test_a_table_without_places_is_perhaps_one_for_a_simulator(tmp_path, capsys):
    (tmp_path / "swings.csv").write_text("t_s,angle\n0,1\n1,2\n")
    said = refused(capsys, tmp_path / "out", "diagnose", tmp_path / "swings.csv", "--out", tmp_path / "out")
    assert "column x_mm: no such column" in said
    assert "a table of anything else needs --simulator FILE.py" in said


EXPLORE = ("explore", "--sensor", "sensor.json")
OWN = (*EXPLORE, "--arm", "own.py")
INVESTIGATE = ("investigate", "--plan", "paper")
TRUTHS = {
    "500,250,-90": ("radius_mm", "-90.0", "20 to 150"),
    "500,nan,90": ("y_mm", "nan", "0 to 520"),
    "rectangle:500,250,100,60,2": ("angle_rad", "2.0", "0 to 1.5708"),
    "ellipse:500,250,90,120,0.3": ("semi_minor_mm", "120.0", "20 to 90"),
}
# Words of a command, and what its refusal says.
CONTRADICTIONS = [
    ((*INVESTIGATE, "--origin-mm", "1,2"), "--origin-mm is '1,2'; allowed: none with"),
    ((*INVESTIGATE, "--geometry", "arm.toml"), "--geometry is 'arm.toml'; allowed: none with"),
    ((*INVESTIGATE, "--truth", "backlash:nan"), "'backlash:nan'; allowed: backlash:"),
    ((*INVESTIGATE, "--truth", "bcklash:1"), "did you mean backlash"),
    (("investigate", "--plan", "nowhere.csv"), "nowhere.csv"),
    ((*INVESTIGATE, "--arm", "own.py", "--no-hands"), "a plan over one pattern; paper has several"),
    ((*INVESTIGATE, "--arm", "own.py", "--truth", "lag:1"), "--truth is 'lag:1'"),
    (("study", "--model", "naive", "--learn-sensor"), "learn_sensor is True; allowed: False with"),
    (("study", "--concealed", "--beside-paper"), "--beside-paper is 'True'; allowed: none with --concealed"),
    (("study", "--concealed", "--seed", "-1"), "'-1' is not a whole number of 0 or more"),
    (("study", "--batch", "3", "--utility", "entropy"), "batch is 3; allowed: 1, or more with"),
    (("calibrate", "small.csv", "--live", "51"), "52 or more"),
    (("calibrate", "small.csv", "--orders", "1", "99"), "n_live is 300; allowed: a whole number, 1192 or more"),
    ((*EXPLORE, "--truth", "cirle:600,260,90"), "did you mean circle?"),
    *(
        ((*EXPLORE, "--truth", truth), f"{name} of --truth {truth} is {value}; allowed: {allowed},")
        for truth, (name, value, allowed) in TRUTHS.items()
    ),
    ((*EXPLORE, "--field=--"), "argument --field: -- is not a value"),
    ((*EXPLORE, "--field", "10"), "--field is '10'; allowed: WIDTH,HEIGHT in mm"),
    ((*EXPLORE, "--model", "perfect"), "'perfect' is not one of ssf, naive"),
    ((*EXPLORE, "--arm", "emulatr"), "did you mean emulator?"),
    ((*EXPLORE, "--resume"), "no such file; allowed: a journal to resume"),
    ((*EXPLORE, "--orientations", "0,45", "--arm", "nxt:/dev/null"), "no joint of which turns its sensor"),
    ((*EXPLORE, "--heights", "10,14", "--arm", "nxt:/dev/null"), "none with the LEGO arm but 14: it reads that many"),
    ((*EXPLORE, "--heights", "10", "--model", "naive"), "which knows no height"),
    ((*EXPLORE, "--heights", "10", "--both-models"), "the naive model has no height"),
    ((*EXPLORE, "--heights", "10"), "does not say at which height_mm it was calibrated"),
    ((*EXPLORE, "--orientations", "0,north"), "not a list of numbers"),
    ((*EXPLORE, "--reference", "120,100,80,60,1.5"), "albedo"),
    ((*EXPLORE, "--reference", "5,5,80,60,1"), "a card on the field of 1048 x 520 mm"),
    ((*EXPLORE, "--model", "naive", "--reference", "120,100,80,60,1"), "which knows two levels alone"),
    ((*EXPLORE, "--method", "paper", "--trust", "0.9"), "trust is 0.9; allowed: 1"),
    ((*EXPLORE, "--nested-stop", "change"), "nested_stop is 'change'; allowed: None, but with the paper's method"),
    ((*EXPLORE, "--method", "paper", "--levels", "x.csv"), "--levels is 'x.csv'; allowed: none with any but --method"),
    ((*EXPLORE, "--method", "paper", "--model", "naive", "--arm", "nxt:x"), "--levels is 'none'; allowed: a recording"),
    ((*EXPLORE, "--arm", "printer"), "--arm is 'printer'; allowed: simulated; emulator, "),
    ((*OWN, "--geometry", "a.toml"), "--geometry is 'a.toml'; allowed: none with FILE.py"),
    ((*OWN, "--truth", "600,260,90"), "--truth is '600,260,90'; allowed: none with a real arm"),
]


@pytest.mark.parametrize(("words", "says"), CONTRADICTIONS, ids=[" ".join(words) for words, _ in CONTRADICTIONS])
def test_options_that_contradict_each_other_are_refused_before_any_work(
    words, says, sensor_file, recording_file, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text("class Arm:\n    def measure(self, pose): 1 / 0\ndef connect(): return Arm()\n")
    assert says in refused(capsys, tmp_path / "out", *words, "--out", "out")


@pytest.mark.parametrize("value", ["9" * 30, "1" * 5000, "0"], ids=lambda value: value[:6])
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


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc")
@pytest.mark.parametrize("verb", ["calibrate", "diagnose", "audit"])
def test_a_directory_that_nobody_can_write_to_is_refused_before_any_work(verb, recording_file, tmp_path, capsys):
    """Root may write to /proc, by its permissions, and cannot."""
    said = refused(capsys, tmp_path / "out", verb, recording_file, "--out", "/proc/foo")
    assert said == f"probewise {verb}: /proc/foo: /proc cannot be written to; allowed: a directory you may write to\n"


@pytest.mark.parametrize("words", [("calibrate", "paper"), ("demo",), ("arm", "check"), ("study",)], ids=" ".join)
@pytest.mark.parametrize("name", ["x" * 300, f"new/{'x' * 300}/new", "/".join(["x" * 200] * 30)], ids=[1, 2, 3])
def test_a_name_that_no_folder_takes_is_refused_before_any_work(words, name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert "too long" in refused(capsys, tmp_path / "new", *words, "--out", name)


@pytest.mark.parametrize("verb", ["predict", "audit", "calibrate"])
def test_a_journal_is_no_recording_and_it_is_said_what_to_do_with_it(verb, tmp_path, capsys):
    journal = tmp_path / "journal.jsonl"
    journal.write_text("{}\n")
    more = ["sensor.json"] if verb == "predict" else []
    said = refused(capsys, tmp_path / "out", verb, *more, journal, "--out", tmp_path / "out")
    assert f"probewise diagnose {journal} --sensor S.json --out DIR" in said


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
        ([], "required"),
        (["unheard-of"], "is not one of"),
        (["predict", "only-one"], "required"),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value),
)
def test_what_was_perhaps_meant_is_said(arguments, says, tmp_path, capsys):
    assert says in refused(capsys, tmp_path / "out", *arguments)


def test_a_package_that_is_missing_is_named_and_not_the_address(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(["study", "--out", str(tmp_path / "out"), "--scheduler", "localhost:8786", "--quiet"]) == 1
    said = capsys.readouterr().err
    assert "--scheduler needs the package distributed, which is not installed" in said
    assert "pip install distributed" in said
    assert said.count("\n") == 1
