"""`probewise diagnose` on the journal of a run: the shape is not known, the sensor may be wrong all the same."""

import dataclasses
import json
import re

import numpy as np
import pytest
from command import refused, run
from mixtures import fixed_mixture

from probewise.calibration import read_sensor, write_sensor
from probewise.cli._inputs import find_journal_sensor_file
from probewise.errors import FileError
from probewise.experiment import experiment_for, sensor_entry
from probewise.recordings import Disc, Plan
from probewise.scene import Circle, Field, KnownScene
from probewise.sensor import Chain, FixedLevels

CENTRE_MM, RADIUS_MM = (520.0, 240.0), 80.0


def poses(n=26):
    """Places about the edge of the circle, as a run visits them, some far inside and far out."""
    rng = np.random.default_rng(5)
    angle = rng.uniform(0, 2 * np.pi, n)
    from_centre = np.where(np.arange(n) % 4 == 0, rng.uniform(0, 200, n), RADIUS_MM + rng.normal(0, 6, n))
    return CENTRE_MM[0] + from_centre * np.cos(angle), CENTRE_MM[1] + from_centre * np.sin(angle)


@pytest.fixture
def journal_file(sensor_file, tmp_path):
    """A journal of 26 readings in whole units; the electronics give no more than 50 of 60."""
    sensor = read_sensor(sensor_file)
    experiment = experiment_for(sensor, Circle(Field()), Field())
    x_mm, y_mm = poses()
    n = len(x_mm)
    plan = Plan.from_arrays(
        x_mm=x_mm, y_mm=y_mm, time_s=5.0 * np.arange(n), patterns={"field": Disc(CENTRE_MM, RADIUS_MM)}, unit="LEGO"
    )
    ssf = fixed_mixture(sensor.samples.mean(axis=0)[:6])
    exact = Chain(ssf, FixedLevels(10.0, 60.0), KnownScene(plan.patterns)).predict(np.empty((1, 0)), plan)[0]
    noise = 0.5 * np.random.default_rng(6).standard_normal(n)
    readings = np.round(np.minimum(exact, 50.0) + noise)
    lines = [{"format": "journal/1", **experiment.settings(np.random.SeedSequence(1))}]
    lines += [
        {
            "index": k + 1,
            "pose": {"x_mm": float(x_mm[k]), "y_mm": float(y_mm[k]), "orientation_rad": 0.0},
            "time_s": 5.0 * k,
            "reading": float(readings[k]),
            "covariates": {},
        }
        for k in range(n)
    ]
    path = tmp_path / "journal.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


@pytest.mark.slow
def test_a_robot_says_in_mid_run_that_its_sensor_model_is_wrong(journal_file, sensor_file, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("diagnose", journal_file, "--sensor", sensor_file, "--out", out) == 0
    found = json.loads((out / "diagnosis.json").read_text())
    assert found["verdict"] == "named", capsys.readouterr().out
    assert found["combination"] == ["saturation"]
    (level,) = (p for p in found["effects"][0]["parameters"] if p["name"] == "level")
    assert level["interval95"][0] < 50.0 < level["interval95"][1]
    repaired = read_sensor(out / "sensor.json")
    assert not {"x_mm", "y_mm", "radius_mm"} & set(repaired.names)
    assert repaired.effects == ("saturation",)
    assert found["next_measurement"] is None  # nothing is open
    assert not (out / "next_plan.csv").exists()


@pytest.mark.parametrize("named", ["sensor.json", "../sensors/sensor.json"])
def test_a_journal_finds_its_sensor_where_results_took_its_place(named, journal_file, sensor_file):
    """As explore --sensor DIR/sensor.json --out DIR leaves it when an effect is found: renamed."""
    sensor = read_sensor(sensor_file)
    sensor_file.unlink()
    first, *rest = journal_file.read_text().splitlines()
    first = json.dumps({**json.loads(first), **sensor_entry(sensor, named)})
    journal_file.write_text("\n".join([first, *rest]) + "\n")
    place = journal_file.parent / named
    place.parent.mkdir(exist_ok=True)
    write_sensor(sensor, place)
    assert find_journal_sensor_file(journal_file) == place
    place.rename(place.with_name("sensor_kept_2.json"))
    for name in ("sensor.json", "sensor_kept.json"):
        write_sensor(dataclasses.replace(sensor, notes=(f"another, {name}",)), place.with_name(name))
    assert find_journal_sensor_file(journal_file) == place.with_name("sensor_kept_2.json")
    place.with_name("sensor_kept_2.json").unlink()
    with pytest.raises(FileError, match="is another by now"):
        find_journal_sensor_file(journal_file)


@pytest.mark.parametrize("harm", ["empty", "no reading", "other shape", "no field", "no options", "far away"])
def test_a_journal_that_cannot_be_used_is_refused_in_one_line(harm, journal_file, sensor_file, tmp_path, capsys):
    first, *rest = journal_file.read_text().splitlines()
    settings = json.loads(first)
    match harm:
        case "empty":
            journal_file.write_text("")
        case "no reading":
            rest = []
        case "other shape":
            settings["shape"] = "Spiral()"
        case "no field":
            del settings["field"]
        case "no options":
            del settings["options"]
        case "far away":
            rest[0] = re.sub(r'"time_s": [^,]+', '"time_s": 1e300', rest[0])
    if harm != "empty":
        journal_file.write_text("\n".join([json.dumps(settings), *rest]) + "\n")
    arguments = ("diagnose", journal_file, "--sensor", sensor_file, "--out", tmp_path / "out")
    assert "journal.jsonl" in refused(capsys, tmp_path, *arguments)
