"""Diagnosis of a simulator."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.special import ndtri
from scipy.stats import multivariate_normal

from probewise.diagnosis import diagnose_system, repaired_of
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.fit import Model, fit
from probewise.diagnosis.noise import white_noise
from probewise.diagnosis.templates import templates_of_effect
from probewise.systems import Noise, Simulator, predict_system, table_for

_N, _SD, _STEP, _WAVE = 150, 0.1, 0.05, 0.25


def _covariance(step, sd):
    at = np.arange(_N)
    return step**2 * (1 + np.minimum.outer(at, at)) + sd**2 * np.eye(_N)


def _recorded():
    rng, t = np.random.default_rng(3), np.arange(_N, dtype=float)
    walk = _STEP * np.cumsum(rng.standard_normal(_N))
    return t, 20 + 0.01 * t + _WAVE * np.sin(0.6 * t + 1) + walk + _SD * rng.standard_normal(_N)


@pytest.fixture(scope="module")
def diagnosis():
    t, y = _recorded()
    line = Simulator(
        "y", "degC", {"a": (0, 50), "b": (-1, 1)}, simulate=lambda p, u: p["a"] + p["b"] * u["t_s"], time="t_s",
        vectorized=True,
    )  # fmt: skip
    return diagnose_system(line, {"t_s": t, "y": y}, rng=np.random.default_rng(1))


def _log_density_given_the_rest(readings, columns):
    """Return the mean, over readings, of log densities of a fifth given the rest, of a linear model with wide priors.

    The step of its walk and the sd of its noise are the likeliest.
    """

    def log_density(log_noise, rows):
        every = 1e4 * columns @ columns.T + _covariance(*np.exp(log_noise))
        return multivariate_normal(np.zeros(len(rows)), every[np.ix_(rows, rows)]).logpdf(readings[rows])

    rows = np.arange(_N)
    noise = minimize(lambda x: -log_density(x, rows), np.log([_STEP, _SD]), method="Nelder-Mead").x
    parts = [np.setdiff1d(rows, part) for part in np.array_split(rows, 5)]
    return sum(log_density(noise, rows) - log_density(noise, kept) for kept in parts) / _N


def test_the_gain_on_held_out_parts_is_that_of_the_conditional_densities(diagnosis):
    """It was 0.54 instead of 0.37 where no reading beside them told of the walk, and below 0 for longer walks."""
    t, y = _recorded()
    assert diagnosis.combination == ("interference", "random_walk")
    line = np.stack([np.ones(_N), t / _N], axis=1)
    right = np.concatenate([line, np.sin(0.6 * t)[:, None], np.cos(0.6 * t)[:, None]], axis=1)
    expected = _log_density_given_the_rest(y, right) - _log_density_given_the_rest(y, line)
    gain = diagnosis.improvement
    assert gain.heldout_log_density_per_reading == pytest.approx(expected, rel=0.1)
    assert gain.heldout_log_density_per_reading > 4 * gain.heldout_sd


def test_residuals_count_from_the_walk_and_the_lines_contain_it(diagnosis):
    y = _recorded()[1]
    gain = diagnosis.improvement
    assert 0.7 * _SD < gain.rms_after < 1.1 * _SD < gain.rms_before
    for shown, rms in ((diagnosis.before, gain.rms_before), (diagnosis.after, gain.rms_after)):
        assert shown.has_walk
        np.testing.assert_allclose(shown.readings_with_walk + shown.residuals, y)
        assert np.sqrt(np.mean(shown.residuals**2)) == pytest.approx(rms)
        assert abs(shown.residuals.mean()) < _SD / 2
    assert "fitted under the noise found, where a fit alone has white noise" in diagnosis.summary()


N, SD_OF_IMPOSSIBLE = 50, 0.02
X = np.sort(np.random.default_rng(2).uniform(-0.4, 1.45, N))
Y = 2 * np.sqrt(1 - (X - 0.5) ** 2) + SD_OF_IMPOSSIBLE * np.random.default_rng(3).normal(size=N)
TABLE = {"x": X, "y": Y}
DOME = Simulator(  # a dome whose position was recorded 0.5 too large: beyond the radius there is no height
    "y",
    "V",
    {"height": (0, 5), "radius": ("log", 0.5, 5)},
    simulate=lambda p, u: p["height"] * np.sqrt(1 - (u["x"] / p["radius"]) ** 2),
    vectorized=True,
)


@pytest.fixture(scope="module")
def diagnosis_of_impossible():
    return diagnose_system(DOME, TABLE, rng=np.random.default_rng(1))


@pytest.mark.slow
def test_every_probability_and_size_is_a_number(diagnosis_of_impossible):
    assert sum(h.probability for h in diagnosis_of_impossible.hypotheses) == pytest.approx(1.0)
    # Not the size of readings a thousand noise sds off, which stands for an impossible one.
    assert diagnosis_of_impossible.effects
    assert all(effect.size_lambda < 200 for effect in diagnosis_of_impossible.effects)
    assert all(
        np.isfinite([place.start, place.end]).all()
        for place in diagnosis_of_impossible.where
        if place.start is not None
    )


@pytest.mark.parametrize("noise", [{}, {"share": 0.1, "times": 5.0}, {"flat": 0.05, "sigma": SD_OF_IMPOSSIBLE}])
def test_a_fit_whose_steps_leave_the_domain_warns_of_nothing(noise):
    """Of any noise, normal, heavy-tailed or rounded: a step that is not taken is no news to a person."""
    prepared = prepare_system(DOME, table_for(DOME, TABLE))
    model = Model(prepared.null, (prepared.effects["input_offset:x"],), prepared.recording.plan)
    height, offset = ndtri(0.2), model.z_of_last_effect(np.array([[-0.5]]))[0]
    for radius in (0.35, 0.5, 0.9):  # shares of the prior; the first is close to the domain's edge
        start = np.append([height, ndtri(radius)], offset)
        assert np.isfinite(fit(model, prepared.recording, start, replace(white_noise(N), **noise)).objective)


def test_a_late_reading_of_an_impossible_one_is_impossible_without_a_warning():
    """Between two infinite readings there is none: pytest makes an error of numpy's warning."""
    t = np.arange(30.0)
    simulator = Simulator(
        "y",
        "V",
        {"a": (0, 2)},
        simulate=lambda p, u: np.where(p["a"] > 1, np.inf, p["a"] * u["t"]),
        time="t",
        vectorized=True,
    )
    prepared = prepare_system(simulator, table_for(simulator, {"t": t, "y": 0.5 * t + 0.01 * np.sin(9 * t)}))
    model = Model(prepared.null, (prepared.effects["delay"],), prepared.recording.plan)
    at_a_half, beyond = model.predict(np.array([[-0.67, 0.5, 0.0], [1.0, 0.5, 0.0]]))
    assert np.isfinite(at_a_half).all()
    assert not np.isfinite(beyond).all()


_N_OF_NOISE = 240


def _line(**more):
    return Simulator("y", "V", {"a": (-5, 5), "b": (-5, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"], **more)


def _table(readings):
    x = np.tile(np.linspace(0.0, 1.0, _N_OF_NOISE // 6), 6)
    return {"x": x, "run": np.repeat(np.arange(6.0), _N_OF_NOISE // 6), "y": 1.0 + 2.0 * x + readings}


@pytest.mark.slow
def test_a_walk_is_named_and_predicted_beyond_its_end():
    rng = np.random.default_rng(4)
    walk = 0.3 * np.cumsum(rng.standard_normal(_N_OF_NOISE))
    table = _table(0.1 * (rng.standard_normal(_N_OF_NOISE) + walk))
    diagnosis = diagnose_system(_line(run="run"), table, rng=rng)
    assert diagnosis.combination == ("random_walk",)
    (found,) = [e for e in diagnosis.effects if e.name == "random_walk"]
    low, high = found.parameters[0].interval95
    assert low < 0.3 < high
    predicted = predict_system(repaired_of(diagnosis), table, rng=rng)
    assert predicted.sd[-1] > 1.2 * predicted.sd[0]


@pytest.mark.slow
def test_a_bath_that_holds_after_its_row_is_a_lag_without_a_delay():
    rng, time_s = np.random.default_rng(3), 10.0 * np.arange(60)
    bath = np.where((np.arange(60) // 15) % 2, 45.0, 20.0)
    true = [bath[0]]
    for held in bath[:-1]:
        true.append(held + (true[-1] - held) * np.exp(-10 / 25))
    read = 0.6 + 0.98 * np.array(true) + 0.15 * rng.standard_normal(60)
    thermometer = Simulator(
        "y", "degC", {"k": (0, 2), "zero": (-5, 5)}, lambda p, u: p["k"] * u["bath"] + p["zero"], time="t"
    )
    diagnosis = diagnose_system(thermometer, {"t": time_s, "bath": bath, "y": read}, rng=rng)
    assert diagnosis.combination == ("lag",)
    (low, high) = diagnosis.effects[0].parameters[0].interval95
    assert low < 25 < high


@pytest.mark.slow
def test_known_sds_are_noise_of_the_rows_and_no_outliers():
    """Without the column the loud readings are outliers; with it nothing is wrong."""
    rng = np.random.default_rng(6)
    sigma = np.where(rng.random(_N_OF_NOISE) < 0.15, 0.8, 0.1)
    table = _table(sigma * rng.standard_normal(_N_OF_NOISE))
    assert diagnose_system(_line(), table, rng=rng).combination == ("outliers",)
    known = diagnose_system(_line(noise=Noise(sd="sigma_v")), {**table, "sigma_v": sigma}, rng=rng)
    assert known.verdict == "clean"
    predicted = predict_system(repaired_of(known), {**table, "sigma_v": sigma}, rng=rng)
    np.testing.assert_allclose(predicted.sd, sigma, rtol=0.2)


EPOCH = 1.7e9
N_FAR_OFF = 60
X_FAR_OFF = np.sin(0.7 * np.arange(N_FAR_OFF))
Y_FAR_OFF = (
    1.0
    + 2.0 * X_FAR_OFF
    + 0.1 * np.random.default_rng(1).standard_normal(N_FAR_OFF)
    + 0.25 * (np.arange(N_FAR_OFF) > 35)
)


def clock(constant: float) -> Simulator:
    priors = {"a": (constant - 5, constant + 5), "b": (-5, 5)}
    return Simulator("y", "s", priors, simulate=lambda p, u: p["a"] + p["b"] * u["x"], time="t")


def table(constant: float) -> dict[str, np.ndarray]:
    return {"t": np.arange(float(N_FAR_OFF)), "x": X_FAR_OFF, "y": constant + Y_FAR_OFF}


@pytest.mark.parametrize("name", ["offset_step", "lag", "offset_drift"])
def test_a_template_is_the_same_about_a_large_constant(name):
    columns = []
    for constant in (0.0, EPOCH):
        prepared = prepare_system(clock(constant), table_for(clock(constant), table(constant)))
        model = Model(prepared.null, (), prepared.recording.plan)
        found = fit(model, prepared.recording, np.zeros(2), white_noise(N_FAR_OFF))
        templates = templates_of_effect(found, prepared.effects[name], prepared.usable_rows)
        columns.append(np.concatenate(templates.columns, axis=1))
    sizes = np.abs(columns[0]).max(axis=0)
    assert (sizes > 0.01).all()
    # A step of the last digit is 2e-7, and the amplitude is found by changes ten thousand times smaller.
    np.testing.assert_allclose(columns[1] / sizes, columns[0] / sizes, atol=0.1)


def test_rows_after_the_recording_go_on_from_its_last_ones_and_the_walk_widens_them(diagnosis):
    """By each further row as much as the walk takes a step; the law's part moves little."""
    t = np.arange(_N, _N + 30, dtype=float)
    later = predict_system(repaired_of(diagnosis), {"t_s": t}, rng=np.random.default_rng(2))
    samples = diagnosis.repaired
    step = samples.noise_sd * samples.effect_samples("random_walk")[:, 0]
    assert later.sd[-1] ** 2 - later.sd[0] ** 2 == pytest.approx(29 * np.mean(step**2), rel=0.25)
    assert later.sd[0] ** 2 < np.mean(samples.noise_sd**2) + np.mean(step**2) * _N / 4
