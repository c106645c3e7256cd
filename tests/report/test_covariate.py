"""Names and units of covariates on the axes of a report."""

from types import SimpleNamespace

import numpy as np
import pytest

from probewise.diagnosis import Place
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.recordings import Recording, Uniform
from probewise.report.covariates import ResidualNoise, covariate_in_words_and_unit, views_of_place
from probewise.report.diagnosis import _place_caption
from probewise.systems import RunTable
from probewise.systems.table import RunRecording


def words_and_unit(name):
    plan = SimpleNamespace(instrumentation=SimpleNamespace(unit="counts"))
    recording = SimpleNamespace(plan=plan)
    return covariate_in_words_and_unit(SimpleNamespace(recording=recording, apparatus=LightSensorApparatus()), name)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("room_c", ("room", "°C")),
        ("battery_mv", ("battery", "mV")),
        ("time", ("time", "s")),
        ("level", ("predicted reading", "counts")),
        ("place", ("place along the scans", "mm")),
    ],
)
def test_the_last_part_of_a_columns_name_is_its_unit_and_the_rest_its_name(name, said):
    assert words_and_unit(name) == said


@pytest.mark.parametrize(
    ("covariate", "values", "names"),
    [
        ("direction", [1.0, 0.0, np.nan], ["at rest", "forwards"]),
        ("direction", [0.0, -1.0, 1.0], ["backwards", "at rest", "forwards"]),
        ("orientation", [90.0, 0.0, np.nan, 90.0], ["0°", "90°"]),
        ("scan", [1.0, 0.0, 1.0], ["one", "two"]),
    ],
)
def test_every_category_has_its_name_on_the_axis_and_in_the_caption(covariate, values, names):
    """Readings at rest, such as single ones between scans, are compared with those of motion."""
    at = np.array(values)
    start, end = (None, None) if covariate == "scan" else (np.nanmin(at), np.nanmax(at))
    scan = "one" if covariate == "scan" else None
    place = Place(covariate, scan, start, end, 0.001, 5.0, np.zeros(2), np.zeros(2), values=at)
    rows = np.arange(len(at))
    scans = ["one", *["two"] * (len(at) - 1)]
    taken = Recording.from_table(
        {"x_mm": rows, "y_mm": 0, "reading": rows, "scan": scans}, patterns=Uniform(0.5), unit="V"
    )
    diagnosis = SimpleNamespace(recording=taken, apparatus=LightSensorApparatus())
    view = views_of_place(diagnosis, place)[-1]
    assert view.names == names
    assert view.window == ((-0.5, 0.5) if scan else (-0.5, len(names) - 0.5))
    assert ("scan one" if scan else ", ".join(names)) in _place_caption(diagnosis, place)


def test_the_band_of_chance_is_as_wide_as_each_readings_own_noise():
    columns = {"y": np.zeros(4), "sd": np.array([1.0, 1.0, 1.0, 3.0]), "run": np.array(["a", "a", "b", "b"])}
    recording = RunRecording(RunTable(columns, None, "run"), np.zeros(4), sd_column="sd")
    chain = SimpleNamespace(predict=lambda theta, plan: np.zeros((len(theta), len(plan))))
    diagnosis = SimpleNamespace(
        recording=recording,
        noise=SimpleNamespace(parameters=[SimpleNamespace(name="values[b]", mean=2.0)]),
        repaired=SimpleNamespace(noise_sd=np.array([0.5])),
        null=SimpleNamespace(theta=np.zeros((3, 1)), chain=chain, noise_sd=np.array([0.5])),
    )
    np.testing.assert_allclose(ResidualNoise(diagnosis).sd, [0.5, 0.5, 1.0, 3.0])
    diagnosis.noise.parameters.append(SimpleNamespace(name="step", mean=12**0.5))
    np.testing.assert_allclose(ResidualNoise(diagnosis).sd, np.hypot([0.5, 0.5, 1.0, 3.0], 1.0))
