"""What `import probewise` offers: one call for each verb, with the defaults and the results of the command line."""

import argparse
import importlib
import inspect
import json
import pickle
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import probewise
from probewise import verbs
from probewise.arm import SimulatedArm
from probewise.cli import VERBS, main
from probewise.diagnosis import audit_plan
from probewise.effects import VOCABULARY
from probewise.errors import ParameterError

FEW = dict(list(VOCABULARY.items())[:3])


@pytest.fixture
def sensor(sensor_file):
    return probewise.read_sensor(sensor_file)


@pytest.fixture
def recording(recording_file):
    return probewise.read_recording(recording_file)


def test_the_import_loads_no_numerical_library():
    code = (
        "import sys, probewise\ndir(probewise), probewise.calibrate\n"
        "sys.exit(' '.join(m for m in ('numpy', 'scipy', 'matplotlib', 'tqdm') if m in sys.modules) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_what_a_tab_offers_is_there_and_nothing_else_is_offered():
    offered = dir(probewise)
    assert {"calibrate", "predict", "explore", "audit", "diagnose", "nested", "Recording"} <= set(offered)
    assert [name for name in offered if name.startswith("_")] == ["__version__"]
    for name in offered:
        assert getattr(probewise, name) is not None
    assert probewise.nested.run.__module__ == "probewise.nested.sampler"
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        _ = probewise.calibrat


def test_every_package_that_is_documented_is_offered():
    """The API page lists the packages; each of the first level is an attribute."""
    page = (Path(__file__).parents[2] / "docs" / "reference" / "api.rst").read_text()
    listed = {line.strip().split(".")[1] for line in page.splitlines() if line.strip().startswith("probewise.")}
    assert {"nested", "calibration", "diagnosis"} <= listed
    assert all(hasattr(probewise, name) for name in listed)


def test_what_the_api_pages_lead_with_is_public():
    leads = tomllib.loads((Path(__file__).parents[2] / "docs" / "reference" / "leads.toml").read_text())
    assert "run" in leads["probewise.nested"]
    for package, names in leads.items():
        assert set(names) <= set(importlib.import_module(package).__all__), package


OPTIONS = [
    ("calibrate", "orders", "orders"),
    ("calibrate", "n_live", "live"),
    *(("explore", n, n) for n in ["shape", "truth", "model", "utility", "learn_sensor", "batch", "max_readings"]),
    *((verb, "sensor", "sensor") for verb in ("audit", "diagnose")),
    ("diagnose", "thorough", "thorough"),
]


@pytest.mark.parametrize(("verb", "parameter", "option"), OPTIONS)
def test_the_command_line_and_python_have_the_same_defaults(verb, parameter, option):
    parser = argparse.ArgumentParser()
    VERBS[verb][1](parser)
    theirs = parser.get_default(option)
    own = inspect.signature(getattr(verbs, verb)).parameters[parameter].default
    assert own == (tuple(theirs) if parameter == "orders" else theirs[0] if parameter == "shape" else theirs)


def test_the_command_line_offers_every_shape_that_has_a_name():
    from probewise import scene

    assert tuple(scene.SHAPES) == verbs.SHAPES


def test_a_verb_and_the_function_behind_it_have_the_same_defaults():
    from probewise import calibration, experiment

    for parameter in ("orders", "n_live"):
        own = inspect.signature(verbs.calibrate).parameters[parameter].default
        assert inspect.signature(calibration.calibrate).parameters[parameter].default == own
    for function in (experiment.explore,):
        assert inspect.signature(function).parameters["max_readings"].default == verbs.MAX_READINGS
    posing = inspect.signature(experiment.experiment_for).parameters
    for parameter in ("model", "learn_sensor", "batch", "orientations_rad", "heights_mm", "repeats"):
        assert posing[parameter].default == inspect.signature(verbs.explore).parameters[parameter].default


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::probewise.errors.DoubtfulResultWarning")
def test_a_seed_calibrates_the_same_sensor_in_python_and_on_the_command_line(
    recording_file, recording, tmp_path, monkeypatch
):
    monkeypatch.setattr("probewise.report.calibration.figure_drawers", lambda *_: {})
    monkeypatch.setattr("probewise.report.calibration.page_html", lambda *_, **__: "")
    options = ["--orders", "1", "--live", "16", "--seed", "5", "--quiet"]
    assert main(["calibrate", str(recording_file), "--out", str(tmp_path / "out"), *options]) == 0
    theirs = probewise.read_sensor(tmp_path / "out" / "sensor.json")
    own = probewise.calibrate(recording, orders=[1], n_live=16, rng=np.random.default_rng(5), progress=False)
    ours, read = json.loads(own.sensor.to_json()), json.loads(theirs.to_json())
    # A field that was read is normalised once more, which on some processors moves the last digit.
    np.testing.assert_allclose(ours.pop("field").pop("values"), read.pop("field").pop("values"), rtol=1e-12)
    assert ours == read


@pytest.mark.slow
@pytest.mark.usefixtures("quick_frames")
def test_a_seed_makes_the_same_run_in_python_and_on_the_command_line(sensor_file, sensor, tmp_path):
    """What is hidden, where the robot looks and what it reads, noise included."""
    out = tmp_path / "out"
    options = ["--max-readings", "2", "--seed", "5", "--quiet"]
    assert main(["explore", "--sensor", str(sensor_file), "--out", str(out), *options]) == 0
    journal = tmp_path / "own.jsonl"
    rng = np.random.default_rng(5)
    run = probewise.explore(sensor, max_readings=2, rng=rng, progress=False, journal=journal)
    theirs = [json.loads(line) for line in (out / "journal.jsonl").read_text().splitlines()]
    own = [json.loads(line) for line in journal.read_text().splitlines()]
    assert [(line["pose"], line["reading"]) for line in own[1:]] == [
        (line["pose"], line["reading"]) for line in theirs[1:]
    ]
    assert run.hidden.name == "circle"
    assert "hidden       circle: x_mm" in run.summary()


def test_an_arm_of_ones_own_is_entered_measured_with_and_left(sensor):
    said = []

    class Mine(SimulatedArm):
        def __enter__(self):
            said.append("in")
            return super().__enter__()

        def __exit__(self, *why):
            said.append("out")
            super().__exit__(*why)

    def light(pose, time_s, height_mm):
        return 60.0 if abs(pose.x_mm - 500.0) < 90 else 10.0

    run = probewise.explore(sensor, arm=Mine(light), max_readings=1, rng=np.random.default_rng(1), progress=False)
    assert said == ["in", "out"]
    assert run.hidden is None
    with pytest.raises(ParameterError, match="none with an arm of your own"):
        probewise.explore(sensor, arm=Mine(light), truth=(1, 2, 3), rng=np.random.default_rng(1))


@pytest.mark.parametrize(
    ("truth", "message"),
    [
        ((500, 250), "truth is .*; allowed: 3 numbers, x_mm, y_mm, radius_mm"),
        ((500, 250, 9000), "radius_mm of truth is 9000.0; allowed: 20 to 150, as the circle's prior has it"),
        ({"heart": (1, 2, 3)}, "truth is {'heart': .*; allowed: one shape of circle, ellipse"),
        ("500,250,90", "truth is '500,250,90'; allowed: numbers"),
    ],
)
def test_a_truth_that_cannot_be_is_named(sensor, truth, message):
    with pytest.raises(ParameterError, match=message):
        probewise.explore(sensor, truth=truth, rng=np.random.default_rng(0))


def test_an_audit_takes_the_noise_of_the_sensor_that_it_is_given(sensor, recording):
    plan = recording.plan.take(np.arange(20))
    assert "noise 0.6" in audit_plan(plan, sensor=sensor, effects=FEW).assumed


def test_the_verbs_take_a_table_and_a_simulator_too(tmp_path, sensor):
    """A file or a Simulator, one table or several; the same as the functions of `diagnosis` and `systems` give."""
    file, rng = tmp_path / "line.py", np.random.default_rng(1)
    file.write_text(
        "reading, unit = 'y', 'V'\nparameters = {'slope': (-5, 5), 'offset': (-5, 5)}\nvectorized = True\n"
        "def simulate(p, data):\n    return p['slope'] * data['x'] + p['offset']\n"
    )
    x = np.linspace(0.0, 1.0, 40)
    table = {"x": x, "y": 2.0 * x + 1.0 + 0.1 * rng.standard_normal(40)}
    fitted = probewise.fit(table, simulator=file, rng=np.random.default_rng(3), progress=False)
    again = probewise.diagnosis.fit_simulator(probewise.read_simulator(file), table, rng=np.random.default_rng(3))
    np.testing.assert_array_equal(fitted.fitted.samples, again.fitted.samples)
    predicted = probewise.predict(fitted, table, rng=np.random.default_rng(4), progress=False)
    assert abs(predicted.mean - table["y"]).max() < 0.5
    halves = [{name: values[half] for name, values in table.items()} for half in (slice(0, 20), slice(20, 40))]
    found = probewise.diagnose(halves, simulator=probewise.read_simulator(file), rng=rng, progress=False)
    assert found.verdict == "clean"
    assert len(probewise.predict(found, table, rng=rng, progress=False).mean) == 40
    assert pickle.loads(pickle.dumps(found)).summary() == found.summary()
    assert probewise.audit(table, simulator=file, progress=False).cure_plan is None
    with pytest.raises(ParameterError, match="None with a simulator"):
        probewise.diagnose(table, simulator=file, sensor=sensor, rng=rng)
    with pytest.raises(ParameterError, match="rng"):
        probewise.predict(fitted, table)
