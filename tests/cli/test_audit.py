"""`probewise audit`: one screen, four files, and one line for what cannot be used."""

import json

import pytest
from command import run

from probewise.effects import VOCABULARY
from probewise.recordings import read_plan


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


HEATER = """import numpy as np
reading, unit, time = "temp_c", "degC", "t_s"
parameters = {"gain": (0, 10), "start_c": ("normal", 20, 5)}
noise = {"sd": 0.05}

def simulate(p, data):
    return p["start_c"] + p["gain"] * data["t_s"]
"""


def fill_in_cure(folder):
    """Write the files that an earlier audit left, with the reading that was asked for."""
    folder.mkdir()
    (folder / "cure_plan.csv").write_text("x_mm,y_mm,reading\n1,2,40\n")
    (folder / "cure_plan.json").write_text("{}")


def test_readings_filled_into_a_cure_plan_outlive_the_audit_of_a_simulator(tmp_path):
    (tmp_path / "heater.py").write_text(HEATER)
    (tmp_path / "rows.csv").write_text("t_s\n" + "\n".join(map(str, range(30))) + "\n")
    out = tmp_path / "out"
    fill_in_cure(out)
    assert run("audit", tmp_path / "rows.csv", "--simulator", tmp_path / "heater.py", "--out", out, "--quiet") == 0
    assert "1,2,40" in (out / "cure_plan.csv").read_text()
    assert (out / "cure_plan.json").exists()
    # One that nobody filled in is of another plan now.
    (out / "cure_plan.csv").write_text("x_mm,y_mm,reading\n1,2,\n")
    assert run("audit", tmp_path / "rows.csv", "--simulator", tmp_path / "heater.py", "--out", out, "--quiet") == 0
    assert not (out / "cure_plan.csv").exists()


@pytest.mark.slow
def test_readings_filled_into_a_cure_plan_are_not_replaced_by_the_next(recording_file, tmp_path, capsys):
    fill_in_cure(tmp_path / "out")
    assert run("audit", recording_file, "--out", tmp_path / "out") == 0
    assert (tmp_path / "out" / "cure_plan_kept.csv").read_text().endswith("1,2,40\n")
    assert (tmp_path / "out" / "cure_plan_kept.json").read_text() == "{}"
    assert "cure_plan_kept.csv" in capsys.readouterr().out
