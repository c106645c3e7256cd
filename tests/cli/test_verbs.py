"""Each verb writes what it promises, also with a simulator of a person's own, and nothing when it is stopped."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from command import run
from heater import FILE, runs

from probewise import __version__
from probewise.calibration import predict, read_sensor
from probewise.cli import VERBS, main
from probewise.diagnosis import diagnosis_schema
from probewise.effects import VOCABULARY
from probewise.errors import NotConvergedError
from probewise.recordings import (
    paper_plan,
    parse_strict_json,
    read_plan,
    read_plan_and_readings,
    read_prediction_columns,
    read_recording,
    write_plan,
)
from probewise.report import exploration
from probewise.systems import run_table_csv


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


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("heater")
    (out / "heater.py").write_text(FILE)
    (out / "data.csv").write_text(run_table_csv(runs(rng=np.random.default_rng(2))))
    (out / "new.csv").write_text(run_table_csv(runs((20.0, 23.0), names="45", rng=np.random.default_rng(3))))
    return out


def with_heater(folder, verb, *arguments):
    names = [folder / a if (folder / a).exists() else a for a in arguments]
    assert run(verb, *names, "--simulator", folder / "heater.py", "--quiet") == 0


@pytest.fixture(scope="module")
def fit(folder):
    with_heater(folder, "fit", "data.csv", "--out", folder / "fit")
    return folder / "fit"


@pytest.mark.slow
def test_a_fit_finds_what_the_readings_were_made_with(fit):
    document = parse_strict_json((fit / "fit.json").read_text())
    found = {p["name"]: p["interval95"] for p in document["parameters"]}
    assert found["tau_s"][0] < 15.0 < found["tau_s"][1]
    assert found["gain"][0] < 3.0 < found["gain"][1]
    assert (fit / "report.html").stat().st_size > 10_000
    with (fit / "samples.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) >= 500
    assert list(rows[0]) == ["tau_s", "gain", "start_c[1]", "start_c[2]", "start_c[3]", "noise_sd"]


def test_a_fit_predicts_runs_that_it_has_not_seen(folder, fit):
    with_heater(folder, "predict", fit / "fitted.json", "new.csv", "--out", folder / "p.csv")
    with (folder / "p.csv").open() as file:
        rows = list(csv.DictReader(file))
    z = [(float(r["temp_c"]) - float(r["mean"])) / float(r["sd"]) for r in rows]
    assert len(rows) == 24
    assert max(map(abs, z)) < 3
    assert all(np.isfinite(float(r["log_density"])) for r in rows)


@pytest.mark.slow
def test_an_audit_needs_no_readings(folder):
    lines = (folder / "data.csv").read_text().splitlines()
    (folder / "plan.csv").write_text("\n".join(line.rpartition(",")[0] for line in lines) + "\n")
    with_heater(folder, "audit", "plan.csv", "--out", folder / "audit")
    document = parse_strict_json((folder / "audit" / "audit.json").read_text())
    found = {effect["name"]: effect for effect in document["effects"]}
    assert found["sensitivity:room_c"]["sight"] == "invisible"
    assert found["offset_step"]["rows"] > 64
    assert any({"offset_step", "steps:start_c"} <= set(names) for names in document["alias_classes"])


@pytest.mark.slow
def test_a_diagnosis_writes_what_the_contract_promises(folder):
    out = folder / "diagnosis"
    with_heater(folder, "diagnose", "data.csv", "new.csv", "--out", out)
    document = parse_strict_json((out / "diagnosis.json").read_text())
    jsonschema.validate(document, diagnosis_schema())
    assert document["verdict"] == "clean"
    for name in ("repaired.json", "calibrated.json"):
        text = (out / name).read_text()
        assert json.loads(text)["format"] == "system/1"
        with_heater(folder, "predict", out / name, "new.csv", "--out", folder / f"{name}.csv")
    page = (out / "report.html").read_text().lower()
    for word in (" scan ", "lamp", " arm ", "black and white", "sensor.json", "next_plan"):
        assert word not in page
    if document["next_measurement"] is not None:
        assert document["next_measurement"]["plan"] == "next.csv"
        asked = (out / "next.csv").read_text().splitlines()[1:]
        assert len(asked) == document["next_measurement"]["readings"]
        with_heater(folder, "predict", out / "repaired.json", out / "next.csv", "--out", folder / "n.csv")


@pytest.fixture
def few(tmp_path):
    """Two scans across the edge: a diagnosis of them is quick."""
    plan = paper_plan()
    path = tmp_path / "few.csv"
    write_plan(plan.take(plan.scan < 2), path)
    return path


@pytest.mark.slow
def test_one_round_leaves_a_diagnosis_and_all_it_was_made_of(few, tmp_path, capsys):
    out = tmp_path / "out"
    options = ("--plan", few, "--truth", "nothing", "--rounds", 1, "--seed", 1)
    assert run("investigate", *options, "--out", out) == 0
    names = {path.name for path in out.iterdir()}
    assert {
        "diagnosis.json",
        "sensor.json",
        "calibrated.json",
        "recording.csv",
        "report.html",
        "rounds",
        "by_round.png",
    } <= names
    assert len(read_recording(out / "recording.csv")) == len(read_recording(out / "rounds" / "1.csv"))
    assert json.loads((out / "diagnosis.json").read_text())["verdict"]
    said = capsys.readouterr().out
    assert "round 1:" in said
    assert "concealed    nothing" in said
    page = (out / "report.html").read_text()
    assert "How it came to that" in page
    assert "http://" not in page


@pytest.mark.slow
def test_an_aliased_effect_is_settled_by_the_readings_that_are_asked_for(tmp_path):
    out = tmp_path / "out"
    options = ("--plan", "paper", "--truth", "backlash:0.5", "--seed", 4, "--quiet")
    assert run("investigate", *options, "--out", out) == 0
    found = json.loads((out / "diagnosis.json").read_text())
    assert found["hypotheses"][0]["effects"] == ["backlash"]
    assert found["hypotheses"][0]["probability"] > 0.95
    assert (out / "rounds" / "2.csv").exists()
    assert set(read_recording(out / "recording.csv").plan.sessions) >= {0, 1}


OWN = """
import math

def connect():
    return Edge()

class Edge:
    turns = True

    def measure(self, pose):
        across = pose.x_mm * math.cos(0.0) / 6.0
        return round(10.0 + 25.0 * (1.0 + math.tanh(across)) + 0.4 * math.sin(37.0 * pose.x_mm + 11.0 * pose.y_mm), 3)

    def close(self):
        with open(CLOSED, "w") as file:
            file.write("closed")
"""


@pytest.mark.slow
def test_an_instrument_of_ones_own_is_investigated_and_closed(few, tmp_path):
    file, closed, out = tmp_path / "edge.py", tmp_path / "closed.txt", tmp_path / "out"
    file.write_text(OWN.replace("CLOSED", repr(str(closed))))
    one = tmp_path / "one.csv"
    plan = paper_plan()
    write_plan(plan.take(plan.scan < 1), one)
    options = ("--arm", file, "--plan", one, "--rounds", 1, "--no-hands", "--quiet")
    assert run("investigate", *options, "--out", out) == 0
    assert closed.read_text() == "closed"
    assert len(read_recording(out / "recording.csv")) == len(read_recording(out / "rounds" / "1.csv"))
    assert "the world concealed" not in (out / "report.html").read_text()
