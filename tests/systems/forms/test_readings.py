"""Readings that come late, rows in no order, a meter's end, and rates by definition: each by a second route."""

import math
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from probewise.diagnosis import PriorOdds, diagnose_system
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.fit import Model
from probewise.diagnosis.fit_simulator import repaired_of
from probewise.diagnosis.outlying import find_meter_stop
from probewise.diagnosis.templates import EffectTemplates
from probewise.diagnosis.words import FORMS_IN_WORDS, effect_has_words, effect_in_words
from probewise.effects import name_without_copy_suffix
from probewise.proof.refits import SystemRefit
from probewise.proof.systems.cases import draw_system
from probewise.proof.systems.forms import ADDED_FAMILIES, FAMILIES, SystemEffect, forms_of
from probewise.proof.systems.kinds import BATH, OSCILLATOR
from probewise.systems import Law, Noise, RunTable, Simulator, System, as_recording, predict_system, table_for
from probewise.systems.forms import ReferenceFit, bind_forms, names_in_definitions, sorting_column
from probewise.systems.forms.formulas import formula_forms
from probewise.systems.forms.readings import delayed_readings, lagged_readings
from probewise.systems.forms.reference import chance_of_sorted_readings, note_on_row_order

_RNG = np.random.default_rng(1)
_T = np.sort(_RNG.uniform(0, 10, 60))


def _reading(t):
    return np.sin(t) + 0.1 * t


def _rows(t=_T):
    return RunTable({"t": t, "y": _reading(t)}, time="t", run=None)


@pytest.mark.parametrize("tau", [0.01, 0.3, 2.0, 50.0])
def test_a_smooth_reading_lags_as_its_differential_equation_says(tau):
    exact = solve_ivp(
        lambda t, s: (_reading(t) - s) / tau, (_T[0], _T[-1]), [_reading(_T[0])],
        t_eval=_T, rtol=1e-9, atol=1e-11, method="Radau",
    ).y[0]  # fmt: skip
    smooth, held = lagged_readings(_reading(_T)[None], np.array([[tau, 1.0], [tau, 0.0]]), _rows())
    np.testing.assert_allclose(smooth, exact, atol=2e-3)
    assert np.abs(held - exact).max() > 3 * np.abs(smooth - exact).max()


@pytest.mark.parametrize("tau", [0.05, 0.7])
def test_a_smooth_reading_is_delayed_between_its_rows(tau):
    exact = _reading(np.maximum(_T - tau, _T[0]))
    smooth, straight = delayed_readings(_reading(_T)[None], np.array([[tau, 1.0], [tau, 0.0]]), _rows())
    np.testing.assert_allclose(smooth, exact, atol=3e-3)
    np.testing.assert_allclose(straight, np.interp(np.maximum(_T - tau, _T[0]), _T, _reading(_T)), atol=1e-12)


@pytest.mark.parametrize(("between", "holds"), [(0.0, slice(1, None)), (2.0, slice(None, -1))])
def test_a_reading_that_holds_before_or_after_its_row_lags_by_the_share_of_each_gap(between, holds):
    x, tau, expected = _reading(_T), 0.4, [_reading(_T[0])]
    for gap, value in zip(np.diff(_T), x[holds], strict=True):
        expected.append(expected[-1] + (1 - np.exp(-gap / tau)) * (value - expected[-1]))
    np.testing.assert_allclose(lagged_readings(x[None], np.array([[tau, between]]), _rows())[0], expected)


@pytest.mark.parametrize("between", [0.0, 1.0, 2.0])
def test_no_lag_changes_nothing_also_where_rows_share_a_time(between):
    t = np.repeat(np.arange(5.0), 2)
    table, x = RunTable({"t": t, "y": t}, time="t", run=None), _RNG.normal(size=(1, 10))
    np.testing.assert_array_equal(lagged_readings(x, np.array([[0.0, between]]), table), x)
    assert np.isfinite(lagged_readings(x, np.array([[0.3, between]]), table)).all()


@pytest.mark.parametrize("act", [lagged_readings, delayed_readings])
def test_a_sample_that_diverges_leaves_the_others_as_they_are(act):
    x = np.stack([_reading(_T), np.where(_T > 5, np.inf, _reading(_T))])
    with np.errstate(invalid="ignore"):
        found = act(x, np.full((2, 2), [0.3, 1.0]), _rows())
    np.testing.assert_array_equal(found[0], act(x[:1], np.array([[0.3, 1.0]]), _rows())[0])
    assert not np.isfinite(found[1]).all()


def _cups(every_min, tau_min, delay_min=0.0):
    """Two cups that are stirred in a bath that swings, read every so many minutes by a thermometer."""
    t = np.arange(0.0, 60.0, every_min)
    rng, rows = np.random.default_rng(4), []
    for start in (70.0, 30.0):

        def rates(at, s):
            bath = 40 + 10 * np.sin(2 * np.pi * at / 17)
            return [(bath - s[0]) / 8.0, (s[0] - s[1]) / max(tau_min, 1e-3)]

        dense = solve_ivp(rates, (0, 60), [start, start], dense_output=True, rtol=1e-8, atol=1e-8, method="Radau").sol
        seen = dense(np.maximum(t - delay_min, 0.0))[1 if tau_min else 0]
        rows.append(seen + 0.1 * rng.normal(size=len(t)))
    bath = np.tile(40 + 10 * np.sin(2 * np.pi * t / 17), 2)
    columns = {"t_min": np.tile(t, 2), "cup": np.repeat([1.0, 2.0], len(t)), "bath": bath, "y": np.concatenate(rows)}
    law = Law({"c": "start"}, lambda s, p, u: {"c": (u["bath"] - s["c"]) / p["tau"]}, hold="linear")
    simulator = Simulator(
        "y", "degC", {"start": ("normal", 50, 30), "tau": ("log", 1, 100)}, per_run=["start"], law=law,
        time="t_min", run="cup",
    )  # fmt: skip
    return simulator, RunTable(columns, time="t_min", run="cup")


@pytest.mark.slow
def test_a_lag_and_a_delay_have_a_smooth_variant_where_rows_are_not_dense_beside_the_noise():
    sparse = prepare_system(*_cups(0.8, 0.6)).effects
    assert all(len(sparse[name].variants()) == 2 for name in ("lag", "delay"))
    assert all("smooth" in sparse[name].fixed for name in ("lag", "delay"))
    dense = prepare_system(*_cups(0.06, 0.6)).effects
    assert len(dense["delay"].variants()) == 1


def test_the_variants_have_a_twentieth_and_a_half_of_the_prior_of_the_first():
    """So that a lag and a delay are no less probable where rows are held than what explains the same readings."""
    variants = prepare_system(*_cups(0.8, 0.6)).effects["lag"].variants()
    templates = EffectTemplates((), (), variants, np.array([0, 0, 1, 2]))
    found = templates.variant_probabilities(np.log([3.0, 1.0, 4.0, 2.0]))
    np.testing.assert_allclose(found, np.array([20, 1, 5]) / 26)


_T_OF_RATES = 0.2 * np.arange(60)


@cache
def _prepared(rates):
    law = Law({"angle": 1.0, "speed": 0.0}, rates, max_step_s=0.1)
    simulator = Simulator("y", "rad", {"stiff": (0.5, 2), "loss": (0.01, 0.5)}, law=law, time="t_s")
    y = np.exp(-0.05 * _T_OF_RATES) * np.cos(_T_OF_RATES) + 0.01 * np.random.default_rng(2).standard_normal(
        len(_T_OF_RATES)
    )
    return prepare_system(simulator, table_for(simulator, {"t_s": _T_OF_RATES, "y": y}))


def _pendulum(s, p, u):
    return {"angle": s["speed"], "speed": -p["stiff"] * s["angle"] - p["loss"] * s["speed"]}


def test_the_rate_of_an_angle_is_the_speed_by_definition():
    prepared = _prepared(_pendulum)
    about = prepared.apparatus.about
    assert about.states_with_rates_by_definition == {"angle"}
    within = names_in_definitions(about, {**prepared.effects, **prepared.apparatus.proposed_formulas()})
    assert {"quadratic:angle:speed", "forcing:angle", "coupling:angle:speed", "periodic_forcing:angle~again"} <= within
    assert not any("speed" in name.split(":")[1] for name in within if not name.startswith("formula"))
    assert not any(name.startswith(("limit", "formula:reading", "formula:rate:speed")) for name in within)
    assert any(name.startswith("formula:rate:angle:") for name in within)


@pytest.mark.parametrize("factor", ["stiff", "by parts"])
def test_a_rate_with_a_parameter_or_a_loss_is_no_definition(factor):
    def rates(s, p, u):
        own = p["stiff"] * s["speed"] if factor == "stiff" else s["speed"] - 1e-3 * s["angle"]
        return {**_pendulum(s, p, u), "angle": own}

    assert _prepared(rates).apparatus.about.states_with_rates_by_definition == frozenset()


def test_prior_odds_of_effects_in_a_definition():
    prepared = _prepared(_pendulum)
    odds = prepared.apparatus.prior_odds(prepared.effects)
    apart = odds.log_prior_on_mean(("quadratic:speed:angle",)) - odds.log_prior_on_mean(("quadratic:angle:speed",))
    assert apart == pytest.approx(math.log(10))


def test_combinations_of_unlikely_effects_sum_to_those_of_their_size():
    odds = PriorOdds(n_named=5, n_unnamed=0, unlikely=frozenset("ab"), unlikely_weight=0.1)
    single = sum(math.exp(odds.log_prior_on_mean((name,))) for name in "abcde")
    pairs = sum(math.exp(odds.log_prior_on_mean((a, b))) for a in "abcde" for b in "abcde" if a < b)
    assert (single, pairs) == pytest.approx(odds.by_size[:2])
    alone = odds.single_effect_priors("abcde", ())
    assert alone[("a",), ()] == pytest.approx(0.1 * alone[("c",), ()])


_SPEED = np.repeat(np.arange(4.0, 16.0), 4)


def _simulator(**more):
    return Simulator("way", "m", {"a": (0, 5)}, simulate=lambda p, u: p["a"] * u["speed"], **more)


def _sorted_within(speed, seed=0, scatter=3.0):
    way = 2 * speed + scatter * np.random.default_rng(seed).standard_normal(len(speed))
    return way[np.lexsort((way, speed))]


def _chance(way, speed=_SPEED, **more):
    simulator = _simulator(**{key: value for key, value in more.items() if key == "time"})
    columns = {key: value for key, value in more.items() if key != "time"}
    return chance_of_sorted_readings(simulator, table_for(simulator, {"speed": speed, "way": way, **columns}))


def test_the_chance_is_that_of_one_arrangement_of_each_group_or_its_reverse():
    way = _sorted_within(_SPEED)
    assert _chance(way) == pytest.approx(2 / math.factorial(4) ** 12)
    assert _chance(way[::-1], _SPEED[::-1]) == pytest.approx(2 / math.factorial(4) ** 12)
    tied = np.repeat([[1.0, 1.0, 2.0, 3.0]], 12, axis=0).ravel()
    assert _chance(tied) == pytest.approx(2 / (math.factorial(4) / 2) ** 12)


def test_rows_are_equal_whatever_the_last_digits_of_their_columns():
    last_digits = np.where(np.arange(48) % 3 == 0, np.nextafter(_SPEED, np.inf), _SPEED)
    assert _chance(_sorted_within(_SPEED), last_digits) == pytest.approx(2 / math.factorial(4) ** 12)
    part = np.repeat([1.0, np.nan], 24)  # a missing cell is equal to other missing ones
    way = np.tile(np.sort(np.random.default_rng(0).standard_normal(24)), 2)
    assert _chance(way, np.full(48, 3.0), part=part) == pytest.approx(2 / math.factorial(24) ** 2)


def test_rows_with_a_time_unsorted_ones_and_a_drift_keep_their_order():
    way = _sorted_within(_SPEED)
    assert _chance(way, t=np.arange(48.0), time="t") == 1.0
    swapped = way.copy()
    swapped[[5, 6]] = swapped[[6, 5]]
    assert _chance(swapped) == 1.0
    assert _chance(np.arange(48.0)) == 1.0
    assert _chance(way, number=np.arange(48.0)) == 1.0
    apart = np.tile(np.arange(4.0, 16.0), 4)  # equal rows whose readings rise as a jump or a drift makes them
    assert _chance(2 * apart + np.repeat(np.arange(4.0), 12), apart) == 1.0


def test_nothing_is_asked_that_needs_an_order():
    simulator = _simulator()
    prepared = prepare_system(simulator, table_for(simulator, {"speed": _SPEED, "way": _sorted_within(_SPEED)}))
    families = {name.split(":")[0] for name in prepared.effects}
    assert not families & {"offset_step", "steps", "hysteresis", "backlash", "correlated_noise", "random_walk"}
    assert {"nonlinearity", "sensitivity", "signal_dependent_noise"} <= families
    assert not any("sum over rows" in form.name for form in formula_forms(prepared.apparatus.about))
    (note,) = note_on_row_order(simulator, prepared.recording.plan)
    assert note in prepared.recording.notes


@pytest.mark.slow
def test_a_sorted_table_of_a_right_law_is_clean():
    """Before, "the change since the row before" was unknown beyond doubt."""
    simulator = _simulator()
    table = {"speed": _SPEED, "way": _sorted_within(_SPEED, seed=4)}
    assert diagnose_system(simulator, table, rng=np.random.default_rng(1)).verdict in ("clean", "noise")


_RNG_OF_ROWS = np.random.default_rng(3)
_X = np.sort(_RNG_OF_ROWS.uniform(0, 10, 50))


def _prepared_of_rows(x=_X, *, time=None, run=None, **more):
    prior = {"a": (-5, 5), "b": (-5, 5)}
    simulator = Simulator("y", "V", prior, simulate=lambda p, u: p["a"] + p["b"] * u["x"], time=time, run=run)
    y = 1 + 2 * x + 0.1 * np.random.default_rng(4).standard_normal(len(x))
    return prepare_system(simulator, table_for(simulator, {"x": x, **more, "y": y}))


def test_only_a_column_that_drives_the_simulator_sorts_a_table_without_a_time():
    number = np.arange(50.0)
    about = _prepared_of_rows().apparatus.about
    assert sorting_column(about) == "x"
    assert not any("sum over rows" in form.name for form in formula_forms(about))
    assert sorting_column(_prepared_of_rows(_X[::-1]).apparatus.about) == "x"
    assert sorting_column(_prepared_of_rows(_RNG_OF_ROWS.permutation(_X), number=number).apparatus.about) is None
    assert sorting_column(_prepared_of_rows(time="t", t=number).apparatus.about) is None


@pytest.mark.parametrize(
    ("levels", "adds_up"), [(np.arange(10.0), False), (_RNG_OF_ROWS.permutation(10.0 * np.arange(10)), True)]
)
def test_nothing_adds_up_in_runs_that_a_column_sorts(levels, adds_up):
    about = _prepared_of_rows(np.tile(levels, 5), run="tree", tree=np.repeat(list("abcde"), 10)).apparatus.about
    assert sorting_column(about) is None
    assert any("sum over rows" in form.name for form in formula_forms(about)) == adds_up


def test_a_jump_of_a_sorted_table_shows_in_the_column_and_says_so():
    prepared = _prepared_of_rows()
    step = prepared.effects["offset_step"]
    assert step.covariates == ("x", "row")
    assert (
        "rows are sorted by x: what jumps or wanders from row to row may change with x instead"
        in prepared.recording.notes
    )


_N, _SD = 240, 0.05


def _simulator_of_stop(**more):
    return Simulator(
        "y", "V", {"zero": (-10, 10), "slope": (0, 2)}, simulate=lambda p, u: p["zero"] + p["slope"] * u["x"], **more
    )


def _table(readings):
    x = 3 + 2 * np.sin(np.arange(_N) / 12)
    return {"x": x, "y": readings(1.0 + x + _SD * np.random.default_rng(3).standard_normal(_N))}


def _stop(table, **more):
    simulator = _simulator_of_stop(**more)
    return find_meter_stop(as_recording(simulator, RunTable(table, time=None, run=None)))


def test_a_meter_that_stops_after_its_noise_is_seen():
    found = _stop(_table(lambda y: np.minimum(y, 5.5)))
    assert (found.level, found.is_ceiling, found.rows.sum()) == (5.5, True, np.sum(_table(lambda y: y)["y"] >= 5.5))
    found = _stop(_table(lambda y: np.maximum(y, 2.5)))
    assert (found.level, found.is_ceiling) == (2.5, False)


_NOT_STOPPED = {
    "no stop": lambda y: y,
    "noise after the stop": lambda y: np.minimum(y, 5.5) + 0.01 * np.random.default_rng(1).standard_normal(_N),
    "coarse digits": lambda y: np.round(y, 1),
    "single lost readings": lambda y: np.where(np.arange(_N) % 30 == 0, 9.9, y),
    "constant": lambda y: np.full(_N, 3.0),
}


@pytest.mark.parametrize("case", _NOT_STOPPED)
def test_nothing_is_seen_where_no_meter_stops(case):
    assert _stop(_table(_NOT_STOPPED[case])) is None


def test_lost_readings_at_the_end_of_the_range_are_no_stop():
    lost = np.random.default_rng(6).random(_N) < 0.08
    prepared = prepare_system(
        _simulator_of_stop(), table_for(_simulator_of_stop(), _table(lambda y: np.where(lost, 9.0, y)))
    )
    (effect,) = prepared.apparatus.left_out
    assert (effect.name, effect.known[1]) == ("dropouts", 9.0)
    assert len(prepared.recording.left_out) == lost.sum()


@pytest.mark.slow
def test_a_stop_is_named_and_predicted():
    table = _table(lambda y: np.minimum(y, 5.5))
    found = diagnose_system(_simulator_of_stop(), table, rng=np.random.default_rng(0))
    assert (found.verdict, found.combination) == ("named", ("saturation",))
    effect = found.effects[0]
    assert effect.parameters[0].interval95 == pytest.approx((5.5, 5.5))
    # Some 60 readings are up to half a volt, ten sds, beyond.
    beyond = np.maximum(1.0 + table["x"] - 5.5, 0) / _SD
    assert effect.size_lambda == pytest.approx(np.linalg.norm(beyond), rel=0.1)
    predicted = predict_system(repaired_of(found), table, rng=np.random.default_rng(1))
    assert predicted.mean.max() == pytest.approx(5.5)


_T_OF_VOCABULARY = np.tile(np.arange(0.0, 6.0, 0.2), 2)
TABLE = RunTable(
    {
        "t_s": _T_OF_VOCABULARY,
        "run": np.repeat([1.0, 2.0], len(_T_OF_VOCABULARY) // 2),
        "push": np.sin(_T_OF_VOCABULARY) + 0.3 * np.sin(3.1 * _T_OF_VOCABULARY),
        "room_c": np.random.default_rng(1).normal(20, 2, len(_T_OF_VOCABULARY)),
        "y": np.zeros(len(_T_OF_VOCABULARY)),
    },
    time="t_s",
    run="run",
)


@pytest.fixture(scope="module", name="names")
def _names():
    """Every form of a mass on a spring that is pushed, in the file's own words."""
    law = Law(
        {"x": 0.5, "v": 0.0},
        lambda s, p, u: {"x": s["v"], "v": u["push"] - p["k"] * s["x"] - 0.3 * s["v"]},
        max_step_s=0.1,
    )
    simulator = Simulator("y", "m", {"k": (0.5, 2.0)}, law=law, time="t_s", run="run", noise=Noise(sd=0.01))
    system = System.of(simulator, TABLE)
    return {
        name_without_copy_suffix(name)
        for name in bind_forms(ReferenceFit(system, TABLE, np.zeros(system.n_params), 0.01))
    }


def test_every_form_has_a_counterpart_in_the_world_that_conceals(names):
    assert {name.split(":")[0] for name in names} == {family.split()[0] for family in (*FAMILIES, *ADDED_FAMILIES)}


def test_the_report_has_words_for_every_form(names):
    assert [name for name in names if not effect_has_words(name)] == []
    assert {effect_in_words(name).count("{") for name in names} == {0}


def test_the_report_has_words_for_nothing_else(names):
    of_the_noise = {"random_walk", "noise_per_run"}
    assert set(FORMS_IN_WORDS) <= {name.split(":")[0] for name in names} | of_the_noise


@pytest.mark.parametrize(
    ("kind", "share"), [(BATH, 1e-4), pytest.param(OSCILLATOR, 0.15, marks=pytest.mark.slow)], ids=["formula", "law"]
)
def test_the_library_and_the_world_that_conceals_have_the_same_formulas(kind, share):
    """Readings with each form, by the engine and by the world; of a law to how they integrate and delay a column."""
    rng = np.random.default_rng(3)
    drawn, refit = draw_system(kind, rng=rng), SystemRefit()
    bare = drawn.true_system
    forms = refit.forms(refit.refit(drawn, bare.readings))
    theta = refit.model.theta(refit.true_z[None, :])
    differ = {}
    for form in forms_of(bare):
        effect = SystemEffect(form, form.of_amplitude(form.first, form.draw(rng)))
        if effect.name not in forms:  # none that could be seen
            continue
        wanted = refit.recording(drawn.simulate_diagnosed_rows([effect])).readings
        found = []
        for variant in forms[effect.name].variants():
            values = [[effect.values.get(name, 0.0) for name in variant.prior.names]]
            chain = Model(refit.model.sensor, (variant,), refit.model.plan).chain
            found.append(chain.predict(np.append(theta, values, axis=1), refit.model.plan)[0])
        change = np.abs(wanted - refit.recording(bare.readings).readings).max()
        if (off := min(np.abs(readings - wanted).max() for readings in found)) > share * change:
            differ[form.name] = off, change
    assert not differ
