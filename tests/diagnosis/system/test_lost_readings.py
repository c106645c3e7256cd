"""Single readings that nothing continuous explains are noise, however far out they are and wherever they lie."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from probewise.diagnosis import diagnose_system, fit_simulator
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.fit_simulator import repaired_of
from probewise.systems import Simulator, predict_system, table_for

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


def test_one_sentinel_is_noise_and_neither_model_is_bent_by_it():
    diagnosis = diagnose_system(OVEN, oven(r17=999.0), rng=np.random.default_rng(1))
    assert (diagnosis.verdict, diagnosis.combination) == ("noise", ("dropouts",))
    assert diagnosis.p_value > 0.05
    assert "row 19 (999)" in diagnosis.recording.notes[0]
    (found,) = [effect for effect in diagnosis.effects if effect.name == "dropouts"]
    share, value = found.parameters
    assert share.interval95[0] < 1 / 40 < share.interval95[1]
    assert value.mean == 999.0
    for model in (diagnosis.null, diagnosis.repaired):
        np.testing.assert_allclose(model.theta[:, :3].mean(axis=0), list(TRUE.values()), rtol=0.01)
        assert np.median(model.noise_sd) == pytest.approx(0.1, rel=0.3)
    predicted = predict_system(repaired_of(diagnosis), oven(), rng=np.random.default_rng(1))
    assert predicted.sd.max() < 0.2


@pytest.mark.parametrize("row", ["r0", "m1"])
def test_a_moderate_outlier_at_an_end_of_a_run_is_no_jump_and_no_delay(row):
    true = {"r0": 20.0, "m1": 72.1}[row]
    diagnosis = diagnose_system(OVEN, oven(**{row: true + 2}), rng=np.random.default_rng(1))
    assert (diagnosis.verdict, diagnosis.combination) == ("noise", ("outliers",))


def test_a_fit_says_which_row_it_leaves_out_and_which_one_bends_it():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        lost, bent, clean = (
            fit_simulator(OVEN, oven(**rows), rng=np.random.default_rng(1))
            for rows in ({"r17": 999.0}, {"r17": 61.0}, {})
        )
    assert lost.rms < 0.15
    np.testing.assert_allclose(np.median(lost.fitted.samples, axis=0)[:3], list(TRUE.values()), rtol=0.01)
    assert "left out as lost: row 19 (999)" in " ".join(lost.recording.notes)
    assert "row 19 (61) carries" in " ".join(bent.recording.notes)
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
