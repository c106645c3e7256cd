"""Readings of a table that are left out."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtri

from probewise.diagnosis import diagnose_system, fit_simulator
from probewise.diagnosis.diagnose_simulator import prepare_system, recording_from_table
from probewise.diagnosis.evidence import laplace_evidence
from probewise.diagnosis.fit import Model, fit
from probewise.diagnosis.fit_simulator import repaired_of
from probewise.diagnosis.noise import NoiseModel, white_noise_of_recording
from probewise.effects import Extent
from probewise.effects.noise import dropouts
from probewise.errors import ParameterError
from probewise.systems import RunTable, Simulator, System, predict_system, table_for

TRUE = {"tau_s": 40.0, "gain": 55.0, "start_c": 20.0}
OVEN = Simulator(
    "temp_c",
    "degC",
    {"tau_s": ("log", 1, 1000), "gain": (0, 200), "start_c": ("normal", 20, 5)},
    simulate=lambda p, data: p["start_c"] + p["gain"] * (1 - np.exp(-data["t_s"] / p["tau_s"])),
    time="t_s",
    noise={"sd": 0.1},
)


def oven(n: int = 40, **readings: float) -> dict[str, np.ndarray]:
    """Record an oven; readings replace those of rows, called r0, r1, ... from the first or m1, m2, ... from the end."""
    time = np.linspace(0, 117, n)
    y = np.round(75 - 55 * np.exp(-time / 40) + 0.1 * np.random.default_rng(1).standard_normal(n), 2)
    for row, value in readings.items():
        y[int(row[1:]) * (1 if row[0] == "r" else -1)] = value
    return {"t_s": time, "temp_c": y}


def left_out(table: dict[str, np.ndarray]) -> list[int]:
    return list(prepare_system(OVEN, table_for(OVEN, table), with_effects=False).recording.left_out)


@pytest.mark.parametrize(
    ("table", "rows"),
    [
        *((oven(r17=50 + size), [17]) for size in (1e2, 1e5, 1e11)),
        (oven(m1=1e3), [39]),
        (oven(r0=-1e9), [0]),
        (oven(r10=999, r30=-1000), [10, 30]),
        (oven(r10=-999, r11=-999, r12=-999), [10, 11, 12]),
        (oven(12, m1=999), [11]),
        (oven(), []),
        (oven(m1=90, m2=90.2, m3=89.9, m4=90.1), []),  # a jump
    ],
)
def test_readings_far_from_all_others_are_left_out_and_a_jump_is_not(table, rows):
    assert left_out(table) == rows


def test_first_readings_of_runs_that_are_all_far_off_are_an_effect_and_no_lost_readings():
    runs = [oven(20, r0=60 + k) for k in range(6)]
    table = {name: np.concatenate([run[name] for run in runs]) for name in runs[0]}
    table["run"] = np.repeat([f"run {k}" for k in range(6)], 20)
    simulator = Simulator(
        "temp_c", "degC", dict(OVEN.parameters), simulate=OVEN.simulate, time="t_s", run="run", noise={"sd": 0.1}
    )
    assert prepare_system(simulator, table_for(simulator, table), with_effects=False).recording.left_out == ()


@np.errstate(all="raise")  # which is the caller's, and ends no run
def test_one_sentinel_is_noise_and_neither_model_is_bent_by_it():
    diagnosis = diagnose_system(OVEN, oven(r17=999.0), rng=np.random.default_rng(1))
    assert (diagnosis.verdict, diagnosis.combination) == ("noise", ("dropouts",))
    assert diagnosis.p_value > 0.05
    assert "row 17 (999)" in diagnosis.recording.notes[0]
    (found,) = [effect for effect in diagnosis.effects if effect.name == "dropouts"]
    share, value = found.parameters
    assert share.interval95[0] < 1 / 40 < share.interval95[1]
    assert value.mean == 999.0
    for model in (diagnosis.null, diagnosis.repaired):
        np.testing.assert_allclose(model.theta[:, :3].mean(axis=0), list(TRUE.values()), rtol=0.01)
        assert np.median(model.noise_sd) == pytest.approx(0.1, rel=0.3)
    predicted = predict_system(repaired_of(diagnosis), oven(), rng=np.random.default_rng(1))
    assert predicted.sd.max() < 0.2


def test_a_fit_says_which_row_it_leaves_out_and_which_one_bends_it():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        lost, bent, clean = (
            fit_simulator(OVEN, oven(**rows), rng=np.random.default_rng(1))
            for rows in ({"r17": 999.0}, {"r17": 61.0}, {})
        )
    assert lost.rms < 0.15
    np.testing.assert_allclose(np.median(lost.fitted.samples, axis=0)[:3], list(TRUE.values()), rtol=0.01)
    assert "left out as lost: row 17 (999)" in " ".join(lost.recording.notes)
    assert "row 17 (61) carries" in " ".join(bent.recording.notes)
    assert clean.recording.notes == ()


def test_the_rms_of_readings_with_declared_sds_is_weighted_by_them():
    rng = np.random.default_rng(2)
    sd = np.tile([0.1, 10.0, 0.1], 20)
    table = {"x": np.linspace(-1, 1, 60), "y": 2.0 + sd * rng.standard_normal(60), "s": sd}
    simulator = Simulator(
        "y", "V", {"a": ("normal", 0, 3)}, simulate=lambda p, data: p["a"] + 0 * data["x"], noise={"sd": "s"}
    )
    fit = fit_simulator(simulator, table, rng=rng)
    assert fit.rms == pytest.approx(0.1, rel=0.4)
    assert "V (weighted by s)" in fit.summary()


FULL, BACK, EXPONENT, SD, HIGH = 1250.0, 12.0, 2.0, 6.0, 1000.0
TRUE_LIMITED = np.array([FULL, BACK, EXPONENT])
LAMP = Simulator(
    "lux",
    "lx",
    {"full": (0, 5000), "back": (0, 100), "expo": (1, 3)},
    simulate=lambda p, u: p["back"] + p["full"] / u["d_m"] ** p["expo"],
    noise={"sd": SD, "range": (0, HIGH)},
)


def _lamp(seed=1, n=150, most=HIGH):
    rng = np.random.default_rng(seed)
    d = rng.uniform(0.8, 4.0, n)
    return RunTable({"d_m": d, "lux": np.clip(BACK + FULL / d**EXPONENT + rng.normal(0, SD, n), 0, most)})


def _fitted(simulator, table):
    prepared = prepare_system(simulator, table, with_effects=False)
    about = prepared.apparatus.about
    law = white_noise_of_recording(prepared.recording)
    found = fit(Model(about.system, (), prepared.recording.plan), prepared.recording, about.z, law)
    return prepared, found, law


def _coordinates_of(system, theta):
    return ndtri(system.prior.to_unit_cube(theta[None, :]))[0]


def test_readings_at_an_end_are_no_lost_readings():
    """Once 7 % of such readings were dropouts of probability .99."""
    prepared, found, law = _fitted(LAMP, _lamp())
    effect = dropouts.for_extent(Extent.of(prepared.recording))
    white, lost = (laplace_evidence(found, NoiseModel(own, prepared.recording)) for own in ((), (effect,)))
    assert law.n_kept < len(found.residuals)
    assert not lost.nodes.laws or lost.log_z < white.log_z


def test_a_lost_reading_that_is_at_an_end_is_still_found_lost():
    table = _lamp()
    lux, far = np.array(table.columns["lux"]), np.flatnonzero(table.columns["d_m"] > 2)[:5]
    lux[far] = HIGH
    prepared, found, _ = _fitted(LAMP, table.with_columns({"lux": lux}))
    found = fit(found.model, prepared.recording, _coordinates_of(prepared.null, TRUE_LIMITED), _without(prepared, far))
    effect = dropouts.for_extent(Extent.of(prepared.recording))
    white, lost = (laplace_evidence(found, NoiseModel(own, prepared.recording)) for own in ((), (effect,)))
    assert lost.log_z > white.log_z + 10


def _without(prepared, rows):
    lost = np.isin(prepared.usable_rows, rows)
    return replace(white_noise_of_recording(prepared.recording), lost=lost)


@pytest.mark.parametrize(("reading", "expected"), [(np.nan, HIGH), (HIGH, HIGH), (1000.4, 1000.4), (700.0, 1262.0)])
def test_a_prediction_beyond_an_end_is_limited_unless_a_reading_within_was_recorded(reading, expected):
    """With a step of 1, the reading of 1000.4 is at the end, and the residual there is 0."""
    lamp = replace(LAMP, noise={"range": (0, HIGH), "step": 1.0})
    table = RunTable({"d_m": np.array([1.0, 2.0]), "lux": np.array([reading, 300.0])})
    predicted = System.of(lamp, table).chain(table, ()).predict(TRUE_LIMITED[None, :], table)
    np.testing.assert_allclose(predicted, [[expected, BACK + FULL / 4]])


def test_a_reading_half_a_step_beyond_an_end_is_at_it_and_a_farther_one_is_an_error_code():
    lamp = replace(LAMP, noise={"range": (0, HIGH), "step": 1.0})
    table = RunTable({"d_m": np.arange(1.0, 6.0), "lux": np.array([HIGH, 1000.4, 999.4, 1001.0, 9999.0])})
    recording = recording_from_table(lamp, table)
    assert recording.usable.tolist() == [True, True, True, False, False]
    assert recording.censored.tolist() == [True, True, False, False, False]


def test_a_walk_is_no_explanation_of_readings_at_an_end_that_the_simulator_does_not_predict_there():
    rng = np.random.default_rng(0)
    x, w = np.tile(np.linspace(0, 10, 60), 2), np.repeat([0.0, 1.0], 60)
    y = np.minimum(2 + x + 6 * w * (x > 6) + rng.normal(0, 0.3, 120), 12.5)
    simulator = Simulator(
        "y", "V", {"a": (-10, 10), "b": (0, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"],
        noise={"sd": 0.3, "range": (0, 12.5)},
    )  # fmt: skip
    prepared = prepare_system(simulator, table_for(simulator, {"x": x, "w": w, "y": y}))
    assert prepared.recording.censored.sum() > 10
    assert "random_walk" not in prepared.effects


def test_too_few_readings_within_the_range_are_refused_in_one_line():
    rng = np.random.default_rng(4)
    x = np.linspace(0, 10, 60)
    y = np.where(np.arange(60) < 5, 1 + rng.random(60), 0.0)
    simulator = Simulator(
        "y", "V", {"a": (-10, 10), "b": (0, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"],
        noise={"range": (0, None)},
    )  # fmt: skip
    with pytest.raises(ParameterError, match="readings within the declared range is 5; allowed: 12 or more"):
        prepare_system(simulator, table_for(simulator, {"x": x, "y": y}))
