"""Each verb writes what it promises, and nothing when it is stopped."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from command import run

from probewise import __version__
from probewise.calibration import predict, read_sensor
from probewise.cli import VERBS, main
from probewise.diagnosis import diagnosis_schema
from probewise.effects import VOCABULARY
from probewise.errors import NotConvergedError
from probewise.recordings import read_plan, read_plan_and_readings, read_prediction_columns
from probewise.report import exploration


def test_predictions_come_back_from_the_file_as_they_were_computed(sensor_file, recording_file, tmp_path, capsys):
    out = tmp_path / "new" / "p.csv"
    assert run("predict", sensor_file, recording_file, "--out", out) == 0
    mean, sd, log_density = read_prediction_columns(out)
    plan, readings = read_plan_and_readings(recording_file)
    direct = predict(read_sensor(sensor_file), plan, readings)
    np.testing.assert_array_equal(mean, direct.mean)
    np.testing.assert_array_equal(sd, direct.sd)
    np.testing.assert_array_equal(log_density, direct.log_density)
    np.testing.assert_array_equal(read_plan(recording_file).x_mm, plan.x_mm)
    assert "chi-square" in capsys.readouterr().out


@pytest.mark.slow
def test_a_robot_at_work_can_be_watched(sensor_file, tmp_path, monkeypatch, quick_frames):
    """The page loads itself anew until the run is over; it is opened once."""
    pages, opened = [], []
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url))
    shown = exploration.live_page_html

    def remember(*arguments, **keywords):
        pages.append(shown(*arguments, **keywords))
        return pages[-1]

    monkeypatch.setattr(exploration, "live_page_html", remember)
    out = tmp_path / "out"
    assert run("explore", "--sensor", sensor_file, "--out", out, "--live", "--quiet", "--max-readings", 2) == 0
    assert ['http-equiv="refresh"' in page for page in pages] == [True, False]
    assert (out / "live.html").read_text() == pages[-1]
    assert "all 2 readings that it may take are taken" in pages[-1]
    assert all("possible faults after each reading" in page for page in pages)
    assert opened == [(out / "live.html").as_uri()]


@pytest.mark.parametrize(
    ("option", "quick"), [((), True), (("--method", "full"), False), (("--method", "quick"), True)]
)
def test_a_calibration_is_quick_unless_asked_otherwise(option, quick, recording_file, tmp_path, monkeypatch, capsys):
    asked = []

    def stop(*_, **options):
        asked.append(options["quick"])
        raise KeyboardInterrupt

    monkeypatch.setattr("probewise.calibration.calibrate", stop)
    assert run("calibrate", recording_file, "--out", tmp_path / "out", *option) == 130
    assert asked == [quick]
    assert "nothing was written" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_module_runs_as_the_command_does():
    done = subprocess.run(
        [sys.executable, "-m", "probewise", "--version"], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout == f"probewise {__version__}\n"


def test_help_does_not_load_the_numerical_libraries():
    code = (
        "import sys\nfrom probewise.cli import VERBS, main\n"
        "main(['diagnose', '--help'])\nassert not {'dataclasses', 'tempfile'} & {*sys.modules}\n"
        "for words in [], *([verb] for verb in VERBS):\n"
        "    main([*words, '--help'])\n"
        "sys.exit(any(m in sys.modules for m in ('numpy', 'scipy', 'matplotlib', 'tqdm')))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60, check=False).returncode == 0


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_itself(verb, capsys):
    assert run(verb, "--help") == 0
    said = capsys.readouterr().out
    assert said.startswith(f"usage: probewise {verb}")
    assert ("--out" in said) == (verb not in ("arm", "emulate-nxt"))  # these write nothing by themselves
    assert ("run only those that you trust" in " ".join(said.split())) == ("FILE.py" in said)


@pytest.mark.slow
def test_a_diagnosis_keeps_to_its_schema_and_names_its_figures(tmp_path):
    import jsonschema

    from probewise.diagnosis import diagnosis_schema
    from probewise.recordings import shipped

    out = tmp_path / "out"
    assert run("diagnose", shipped("concealed"), "--out", out, "--quiet") == 0
    document = json.loads((out / "diagnosis.json").read_text())
    jsonschema.validate(document, diagnosis_schema())
    for place in document["where"]:
        assert (out / place["witness"]).exists()
    if document["next_measurement"] is not None:
        assert len(read_plan(out / "next_plan.csv")) == document["next_measurement"]["readings"]
    for name in ("sensor.json", "calibrated.json"):
        assert len(read_sensor(out / name).samples) >= 500
    assert run("predict", out / "sensor.json", shipped("concealed"), "--out", out / "p.csv", "--quiet") == 0


@pytest.mark.slow
def test_the_demo_does_all_of_it(tmp_path, capsys):
    """Its answers are those that the README quotes, as far as another machine's arithmetic lets them be.

    PROBEWISE_DEMO names the --out of a demo that has run already, what it said in a file of that name with .txt.
    """
    if "PROBEWISE_DEMO" in os.environ:
        out = Path(os.environ["PROBEWISE_DEMO"])
        said = out.with_suffix(".txt").read_text(encoding="utf-8")
    else:
        out = tmp_path / "out"
        assert run("demo", "--out", out) == 0
        said = capsys.readouterr().out
    assert "naive" in said
    quoted = json.loads((Path(__file__).parents[2] / "docs" / "_static" / "pictures.json").read_text(encoding="utf-8"))
    answers = json.loads((out / "answers.json").read_text(encoding="utf-8"))
    assert answers.keys() == quoted.keys()
    for name in ("seed", "verdict", "combination", "concealed"):
        assert answers[name] == quoted[name]
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.index("The sensor") < page.index("The search") < page.index("A mismatch, found and repaired")
    assert '<img src="data:image/svg' not in page  # the diagnosis has its own page
    assert "://" not in page  # no address; "http" may stand in a picture by chance
    assert (out / "diagnosis" / "report.html").read_text(encoding="utf-8").startswith("<!doctype html>")
    assert "SSF" in said
    assert "concealed was" in said
    assert (out / "report.html").stat().st_size > 100_000


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


@pytest.mark.slow
def test_a_thorough_diagnosis_states_both_evidences(recording_file, sensor_file, tmp_path):
    out = tmp_path / "out"
    given = ["diagnose", recording_file, "--sensor", sensor_file, "--thorough", "--out", out, "--quiet"]
    assert main([str(word) for word in given]) == 0
    document = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    jsonschema.validate(document, diagnosis_schema())
    assert [] in [weighed["effects"] for weighed in document["thorough"]]
    assert all(weighed["agree"] for weighed in document["thorough"])
    assert document["reason"].endswith("nested sampling agrees to within a nat plus its standard error.")
    assert "ln Z, nested sampling" in (out / "report.html").read_text(encoding="utf-8")


def no_constant(name):
    raise ValueError(f"{name} is no JSON number")


@pytest.mark.slow
def test_an_audit_names_the_aliases_of_one_way_scans_and_the_scans_that_cure_them(recording_file, tmp_path, capsys):
    out = tmp_path / "new" / "audit"
    assert run("audit", recording_file, "--out", out) == 0
    said = capsys.readouterr().out
    assert len(said.splitlines()) <= 25
    found = json.loads((out / "audit.json").read_text(), parse_constant=no_constant)
    effects = {effect["name"]: effect for effect in found["effects"]}
    assert set(effects) == set(VOCABULARY)
    assert effects["hysteresis"]["sight"] == "invisible"
    assert "edge_misplacement" in {like["effect"] for like in effects["backlash"]["alike"]}
    cure = found["cure"]
    assert cure["readings"] == len(read_plan(out / cure["plan"])) == sum(s["readings"] for s in cure["scans"])
    cured = {name for scan in cure["scans"] for name in scan["cures"]}
    after = {effect["name"]: effect["sight"] for effect in found["after"]}
    assert "lag" in cured
    assert all(after[name] == "fine" for name in cured)
    assert (out / "audit.png").read_bytes().startswith(b"\x89PNG")
    assert "more fine" in (out / "report.html").read_text()


@pytest.mark.slow
def test_without_a_directory_nothing_is_written(recording_file, tmp_path, capsys):
    recording_file.write_text("\n".join(recording_file.read_text().splitlines()[:27]) + "\n")
    before = sorted(tmp_path.rglob("*"))
    assert run("audit", recording_file) == 0
    assert "backlash" in capsys.readouterr().out
    assert sorted(tmp_path.rglob("*")) == before
