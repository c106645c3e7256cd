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
