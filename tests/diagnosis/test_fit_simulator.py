"""Fit of a simulator without a diagnosis: its starts, its integration step, what it says of priors and noise."""

import contextlib
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from probewise.diagnosis import diagnose_system, fit_json, fit_simulator
from probewise.diagnosis.diagnose_simulator import (
    fit_system,
    notes_on_simulator,
    prepare_system,
    recording_from_table,
    with_step_for_likely_parameters,
)
from probewise.errors import NotConvergedError
from probewise.systems import Law, Noise, RunTable, Simulator, System, table_for
from probewise.systems.integrate import Integrations

X = np.linspace(-1.0, 1.0, 60)
RNG = np.random.default_rng(5)
Y = 1.0 + 2.0 * X + 0.1 * RNG.standard_normal(60)


def line(**options):
    given = {"simulate": lambda p, data: p["a"] + p["b"] * data["x"], "noise": {"sd": 0.1}, **options}
    return Simulator("y", "V", {"a": ("normal", 0, 3), "b": ("normal", 0, 3)}, **given)


@pytest.fixture(scope="module")
def fitted():
    return fit_simulator(line(), {"x": X, "y": Y}, rng=np.random.default_rng(1))


def test_the_posterior_of_a_line_is_that_of_least_squares(fitted):
    (b, a), covariance = np.polyfit(X, Y, 1, cov=True)
    median = dict(zip(fitted.fitted.names, np.median(fitted.fitted.samples, axis=0), strict=True))
    sd = fitted.fitted.samples.std(axis=0)
    np.testing.assert_allclose([median["a"], median["b"]], [a, b], atol=0.2 * np.sqrt(covariance[1, 1]))
    np.testing.assert_allclose(sd, np.sqrt(np.diag(covariance))[::-1], rtol=0.15)


def _one_by_one(p, data):
    return np.array([float(p["a"]) + float(p["b"]) * x for x in data["x"]])


def test_the_evidence_of_a_line_is_the_same_by_nested_sampling_and_for_one_sample_at_a_time(fitted):
    beside = fit_simulator(line(), {"x": X, "y": Y}, thorough=True, rng=np.random.default_rng(1))
    assert beside.evidence.log_z == fitted.evidence.log_z
    assert abs(beside.nested.log_z - fitted.evidence.log_z) < 4 * beside.nested.error
    assert fit_json(beside)["nested_sampling"]["method"] == beside.nested.method == "nested sampling"
    slow = fit_simulator(line(simulate=_one_by_one), {"x": X, "y": Y}, rng=np.random.default_rng(1)).evidence
    assert abs(slow.log_z - fitted.evidence.log_z) < 4 * (slow.error + fitted.evidence.error)


STRD = json.loads((Path(__file__).parents[1] / "data" / "strd.json").read_text())


def _strd(name):
    given = STRD[name]
    functions = {each: getattr(np, each) for each in ("exp", "cos", "sin", "arctan", "pi")}

    def simulate(p, data):
        return eval(given["law"], functions | dict(p) | {n: data[n] for n in data})

    return Simulator("y", "1", {n: tuple(prior) for n, prior in given["priors"].items()}, simulate=simulate)


# Medians, as distances from the certified values, and sds, both in certified sds: by differential evolution MCMC (ter
# Braak 2006) with 120 walkers, 12,000 moves each, of the same posterior.
_BY_MCMC = {
    "Misra1a": ([0.02, -0.02], [1.1, 1.1]),
    "Nelson": ([-0.04, -0.07, -0.07], [1.0, 1.7, 0.94]),
    "MGH10": ([0.0, -0.01, -0.01], [1.08, 1.08, 1.08]),
    "Roszman1": ([-0.03, 0.02, 0.04, -0.03], [0.96, 0.95, 0.99, 0.95]),
    "Hahn1": ([-0.11, 0.11, -0.1, 0.14, 0.02, -0.1, 0.14], [1.02, 1.03, 1.03, 1.03, 1.01, 1.03, 1.03]),
    "Thurber": ([0.55, -4.32, -4.36, -4.38, -4.2, -4.15, -3.79], [1.19, 2.92, 3.0, 3.02, 2.95, 3.0, 2.35]),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in {*_BY_MCMC, "BoxBOD"} else pytest.mark.slow) for n in STRD if n != "source"],
)
def test_the_mode_is_that_which_nist_certifies_and_the_posterior_that_of_a_long_chain(name):
    """To four digits, from priors that hold both of NIST's starts; of terms that can be exchanged, in NIST's order.

    Thurber's posterior is a ridge of which Laplace's approximation at the mode holds a third.
    """
    given = STRD[name]
    fit = fit_simulator(_strd(name), given["columns"], rng=np.random.default_rng(7))
    assert fit.fitted.mode() == pytest.approx(given["value"], rel=1e-4)
    n, p = len(given["columns"]["y"]), len(given["value"])
    if name != "Lanczos1":  # met to rounding: the last digits of the readings are its residuals
        least = given["residual_sd"] * np.sqrt((n - p) / n)
        assert 0.9 * least < fit.rms < 1.2 * least  # of mean predictions, which no one set of parameters makes
        assert 0.8 < np.median(fit.fitted.noise_sd) / given["residual_sd"] < 1.3
    hard = [note for note in fit.recording.notes if "hard to sample" in note]
    assert bool(hard) == (name == "Lanczos3")
    tie = [note for note in fit.recording.notes if "sets of parameters fit equally well" in note]
    assert bool(tie) == (name[:-1] in ("Gauss", "Lanczos"))
    if name in _BY_MCMC:
        (median, sd), found = _BY_MCMC[name], fit.fitted
        center, certified = (np.array([given[each][n] for n in found.names]) for each in ("value", "sd"))
        np.testing.assert_allclose((np.median(found.samples, axis=0) - center) / certified, median, atol=0.2 * max(sd))
        np.testing.assert_allclose(found.samples.std(axis=0) / certified, sd, rtol=0.15)  # some have heavy tails


@pytest.mark.parametrize("n", [2, 3, 6, 11])
def test_a_diagnosis_of_few_readings_says_that_they_cannot_tell(n):
    """Also where as many parameters meet them exactly; nothing is searched for."""
    stages = []
    table = {"x": X[:n], "y": Y[:n]}
    rng = np.random.default_rng(1)
    diagnosis = diagnose_system(line(), table, rng=rng, progress=lambda stage, *a, **k: stages.append(stage))
    assert diagnosis.verdict == "cannot_tell"
    assert diagnosis.reason == f"{n} usable readings are too few for a diagnosis; 12 or more are needed."
    assert not any("formulas" in stage or "pairs" in stage for stage in stages)


X_IN_CONFLICT = np.linspace(1, 20, 40)
SLOPE, SD = 1.8, 1.0


def _notes(prior, *, slope=SLOPE, seed=3):
    rng = np.random.default_rng(seed)
    simulator = Simulator(
        "strain_ue", "ue", {"per_n": prior}, simulate=lambda p, data: p["per_n"] * data["pull_n"], noise=Noise(sd=SD)
    )
    table = {"pull_n": X_IN_CONFLICT, "strain_ue": slope * X_IN_CONFLICT + rng.normal(0, SD, len(X_IN_CONFLICT))}
    prepared = prepare_system(simulator, table_for(simulator, table), with_effects=False)
    return [note for note in prepared.recording.notes if "prior" in note]


@pytest.mark.parametrize(
    ("prior", "words"),
    [
        ((0, 1), "per_n is at the upper end of its prior, uniform 0 to 1, but the readings ask for a larger value"),
        ((3, 9), "per_n is at the lower end of its prior, uniform 3 to 9, but the readings ask for a smaller value"),
        (("log", 0.1, 1), "upper end"),
        (("normal", 1.0, 0.1), "sds above the mean of its prior, normal 1 ± 0.1"),
    ],
)
def test_a_prior_that_excludes_what_the_readings_say_is_told(prior, words):
    (note,) = _notes(prior)
    assert words in note


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("prior", "slope"), [((0, 100), 0.1), ((0, 1.8), SLOPE), (("normal", 1.6, 0.1), SLOPE), ((0, 5), 0.0)]
)
def test_a_wide_prior_and_one_that_ends_at_the_truth_are_not(prior, slope, seed):
    """By chance a best value is four sds beyond an end at the truth in 3e-5 of recordings, by far the most of these."""
    assert not _notes(prior, slope=slope, seed=seed)


@pytest.mark.parametrize(("declared", "told"), [(0.5, True), (2.0, True), (SD, False), (None, False)])
def test_a_noise_that_is_not_as_it_was_declared_is_told(declared, told):
    """Of 400 readings the sd is known to a thirtieth."""
    rng, x = np.random.default_rng(8), np.linspace(1, 20, 400)
    simulator = Simulator(
        "strain_ue",
        "ue",
        {"per_n": (0, 5)},
        simulate=lambda p, data: p["per_n"] * data["pull_n"],
        noise={"sd": declared},
    )
    table = {"pull_n": x, "strain_ue": SLOPE * x + rng.normal(0, SD, len(x))}
    notes = fit_simulator(simulator, table, rng=rng).recording.notes
    assert sum("the noise sd of a reading is " in note and "was declared" in note for note in notes) == told


_DECAY = ({"a": (0, 10), "k": (-50, 50)}, lambda p, u: p["a"] * np.exp(p["k"] * u["t"]))
_TWO_DECAYS = (
    {**_DECAY[0], "b": (-10, 10), "c": (-40, 40)},
    lambda p, u: p["a"] * np.exp(p["k"] * u["t"]) + p["b"] * np.exp(p["c"] * u["t"]),
)
_SAME = ({"a": (-10, 10), "k": (-10, 10)}, lambda p, u: (p["a"] + p["k"]) * u["t"])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("noise", [0.1, 1e-12, 0.0])
@pytest.mark.parametrize("model", [_DECAY, _TWO_DECAYS, _SAME], ids=["decay", "two decays", "the same twice"])
def test_a_model_that_runs_away_or_fits_exactly_or_says_the_same_twice_is_fitted(model, noise):
    """Predictions reach e^500, or the residuals rounding, or only a sum is known: precisions that rounding spoils."""
    (parameters, simulate), t = model, np.linspace(0.5, 10, 8)
    y = simulate({"a": 2.0, "k": -0.3, "b": 0.0, "c": 0.0}, {"t": t})
    y = y + noise * np.random.default_rng(3).standard_normal(len(t))
    simulator = Simulator("y", "V", parameters, simulate=simulate, time="t")
    fit = fit_simulator(simulator, {"t": t, "y": y}, rng=np.random.default_rng(1))
    assert np.isfinite(fit.fitted.samples).all()
    np.testing.assert_allclose(simulate(fit.fitted.mode(), {"t": t}), y, atol=5 * noise + 1e-6)


@pytest.mark.parametrize("told", [np.nan, ValueError])
def test_where_the_best_fit_lies_beside_what_is_impossible_it_is_fitted_or_refused_in_words(told):
    """The sd of b is 0.02; readings are impossible within 0.1 of its mode: no step stays clear of them."""

    def simulate(p, data):
        b = float(p["b"])
        if abs(b - 2.0) < 0.1 and told is ValueError:
            raise ValueError(b)
        return p["a"] + (b if abs(b - 2.0) >= 0.1 else told) * data["x"]

    fit = fit_simulator(line(simulate=simulate), {"x": X, "y": Y}, rng=np.random.default_rng(1))
    assert abs(fit.fitted.mode()["b"] - 2.0) >= 0.1
    (said,) = (note for note in fit.recording.notes if "which count as impossible" in note)
    assert said.startswith(f"simulate {'raised' if told is ValueError else 'gave readings that are not finite for'} ")
    with contextlib.suppress(NotConvergedError):
        diagnose_system(line(simulate=simulate), {"x": X, "y": Y}, rng=np.random.default_rng(1))


def _warmed(p, tau_s, data):
    return p["start_c"] + p["gain"] * (1 - np.exp(-data["t_s"] / tau_s))


@pytest.mark.parametrize(
    "simulate",
    [
        lambda p, data: _warmed(p, np.round(p["tau_s"], 1), data),
        lambda p, data: _warmed(p, max(int(p["tau_s"]), 1), data),
    ],
    ids=["rounds", "counts"],
)
def test_a_parameter_that_simulate_rounds_or_counts_by_is_fitted_and_nothing_else_is_named(simulate):
    """Small steps of tau change nothing; it is 40.0, and its sd 0.1."""
    parameters = {"tau_s": ("log", 1, 1000), "gain": (0, 200), "start_c": ("normal", 20, 5)}
    oven, t = Simulator("temp_c", "degC", parameters, simulate=simulate, time="t_s"), 3.0 * np.arange(40)
    noise = 0.1 * np.random.default_rng(4).standard_normal(40)
    table = {"t_s": t, "temp_c": _warmed({"start_c": 20, "gain": 55}, 40.0, {"t_s": t}) + noise}
    fit = fit_simulator(oven, table, rng=np.random.default_rng(1))
    assert abs(fit.fitted.mode()["tau_s"] - 40.0) < 1.0
    assert fit.rms < 0.12
    assert diagnose_system(oven, table, rng=np.random.default_rng(1)).verdict == "clean"


SD_OF_SIMULATOR_FIT = 0.05
TIMES = np.arange(60.0)
HEATED = np.where(TIMES % 20 < 10, 1.0, 0.0)
PRIORS = {"tau_s": ("log", 0.01, 100), "gain": (0, 10)}
LAW = Law({"x": 0.0}, lambda s, p, u: {"x": (p["gain"] * u["power"] - s["x"]) / p["tau_s"]})


def _readings(tau, gain):
    """Return the state at every second by the closed form: the power is held from row to row."""
    x = [0.0]
    for power in HEATED[:-1]:
        x.append(gain * power + (x[-1] - gain * power) * np.exp(-1.0 / tau))
    return np.array(x)


def _table(tau, seed):
    y = _readings(tau, 3.0) + SD_OF_SIMULATOR_FIT * np.random.default_rng(seed).normal(size=len(TIMES))
    return RunTable({"t_s": TIMES, "power": HEATED, "y": y}, time="t_s", run=None)


def _simulator(law=LAW):
    return Simulator("y", "K", PRIORS, law=law, time="t_s")


@pytest.fixture(scope="module")
def stiff():
    table, simulator = _table(0.15, 3), _simulator()
    recording = recording_from_table(simulator, table)
    return table, recording, *fit_system(System.of(simulator, table), recording)


def test_the_step_serves_all_time_constants_that_the_readings_allow(stiff):
    table, _, system, _, _ = stiff
    assert system.stiff
    for tau in (0.011, 0.05, 0.2):  # with a tenth of a second they differ by less than the noise
        predicted = system.chain(table, ()).predict(np.array([[tau, 3.0]]), table)[0]
        np.testing.assert_allclose(predicted, _readings(tau, 3.0), atol=0.2 * SD_OF_SIMULATOR_FIT)
    assert not system.integrations.too_stiff


def test_a_law_that_needs_more_steps_than_are_taken_says_so(stiff, monkeypatch):
    table, _, _, found, sd = stiff
    monkeypatch.setattr("probewise.systems.system._MOST_STEPS", 20)
    first = System.of(_simulator(), table)
    assert not first.integrations.too_stiff
    assert with_step_for_likely_parameters(first, table, found, sd).integrations.too_stiff


@pytest.mark.parametrize("sets_step", [True, False])
def test_a_search_that_was_cut_short_advises_a_larger_step_only_where_one_was_set(sets_step):
    law = SimpleNamespace(max_step_s=0.1 if sets_step else None)
    simulator = SimpleNamespace(law=law, noise=SimpleNamespace(sd=None))
    system = SimpleNamespace(caller=None, integrations=Integrations(cut_short=True), simulator=simulator)
    (note,) = notes_on_simulator(SimpleNamespace(system=system, evaluations_of_a_search=1000), None)
    assert "after 1,000 evaluations" in note
    assert ("max_step_s" in note) is sets_step


TIMES_OF_REPAIR = np.linspace(0.0, 8.0, 41)  # about five rows a period
SD_OF_REPAIR = 1e-4


@pytest.fixture(scope="module")
def swings():
    """A spring of stiffness 36 that hardens with 20 x^3, by scipy's own integrator."""
    noise = np.random.default_rng(3)
    exact = solve_ivp(
        lambda t, s: [s[1], -36.0 * s[0] - 20.0 * s[0] ** 3 - 0.1 * s[1]],
        (0.0, TIMES_OF_REPAIR[-1]),
        [1.0, 0.0],
        t_eval=TIMES_OF_REPAIR,
        rtol=1e-10,
        atol=1e-12,
    )
    return exact.y[0] + noise.normal(0.0, SD_OF_REPAIR, len(TIMES_OF_REPAIR))


@pytest.mark.slow
def test_a_law_that_needs_finer_steps_once_it_is_repaired_gets_them(swings):
    spring = Simulator(
        "x_m",
        "m",
        {"k": ("log", 10, 100), "c": (0, 1)},
        law=Law({"x": 1.0, "v": 0.0}, lambda s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"]}),
        time="t_s",
    )
    stages = []

    def told(stage, *numbers, **note):
        stages.append(stage)

    found = diagnose_system(
        spring, {"t_s": TIMES_OF_REPAIR, "x_m": swings}, rng=np.random.default_rng(1), progress=told
    )
    assert any("once more" in stage for stage in stages)
    assert found.verdict == "named"
    assert found.combination == ("cubic:v:x",)
    cubic = next(effect for effect in found.effects if effect.name == "cubic:v:x")
    a = cubic.parameters[0]
    assert a.mean == pytest.approx(20.0, abs=4 * a.sd)
    assert found.improvement.rms_after < 2 * SD_OF_REPAIR
