"""The verbs with a simulator of a person's own: what they write, and that it fits together."""

import csv
import json

import jsonschema
import numpy as np
import pytest
from heater import FILE, runs

from probewise.cli import main
from probewise.diagnosis import diagnosis_schema
from probewise.recordings import parse_strict_json
from probewise.systems import run_table_csv


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("heater")
    (out / "heater.py").write_text(FILE)
    (out / "data.csv").write_text(run_table_csv(runs(rng=np.random.default_rng(2))))
    (out / "new.csv").write_text(run_table_csv(runs((20.0, 23.0), names="45", rng=np.random.default_rng(3))))
    return out


def run(folder, verb, *arguments):
    names = [str(folder / a) if (folder / a).exists() else a for a in arguments]
    assert main([verb, *names, "--simulator", str(folder / "heater.py"), "--quiet"]) == 0


@pytest.fixture(scope="module")
def fit(folder):
    run(folder, "fit", "data.csv", "--out", str(folder / "fit"))
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
    run(folder, "predict", str(fit / "fitted.json"), "new.csv", "--out", str(folder / "p.csv"))
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
    run(folder, "audit", "plan.csv", "--out", str(folder / "audit"))
    document = parse_strict_json((folder / "audit" / "audit.json").read_text())
    found = {effect["name"]: effect for effect in document["effects"]}
    assert found["sensitivity:room_c"]["sight"] == "invisible"
    assert found["offset_step"]["rows"] > 64
    assert any({"offset_step", "steps:start_c"} <= set(names) for names in document["alias_classes"])


@pytest.mark.slow
def test_a_diagnosis_writes_what_the_contract_promises(folder):
    out = folder / "diagnosis"
    run(folder, "diagnose", "data.csv", "new.csv", "--out", str(out))
    document = parse_strict_json((out / "diagnosis.json").read_text())
    jsonschema.validate(document, diagnosis_schema())
    assert document["verdict"] == "clean"
    for name in ("repaired.json", "calibrated.json"):
        text = (out / name).read_text()
        assert json.loads(text)["format"] == "system/1"
        run(folder, "predict", str(out / name), "new.csv", "--out", str(folder / f"{name}.csv"))
    page = (out / "report.html").read_text().lower()
    for word in (" scan ", "lamp", " arm ", "black and white", "sensor.json", "next_plan"):
        assert word not in page
    if document["next_measurement"] is not None:
        assert document["next_measurement"]["plan"] == "next.csv"
        asked = (out / "next.csv").read_text().splitlines()[1:]
        assert len(asked) == document["next_measurement"]["readings"]
        run(folder, "predict", str(out / "repaired.json"), str(out / "next.csv"), "--out", str(folder / "n.csv"))
