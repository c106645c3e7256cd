"""Forms of the vocabulary: each does what its name says, by a route of its own."""

import pickle
import re
from dataclasses import replace

import numpy as np
import pytest

from probewise.effects import is_out_of_vocabulary
from probewise.effects.effect import sentence_from_samples
from probewise.systems import Extra, Law, Noise, RunTable, Simulator, System
from probewise.systems.forms import ReferenceFit, bind_forms
from probewise.systems.forms.formulas import formula_forms
from probewise.systems.forms.reference import clipping_between, switch_points
from probewise.systems.law import LawWithEffects

SD = 0.01
N_ROWS = 60
_T = np.tile(np.linspace(0.0, 6.0, N_ROWS // 2), 2)
TABLE = RunTable(
    {
        "t_s": _T,
        "run": np.repeat([1.0, 2.0], N_ROWS // 2),
        "drive": np.sin(_T) + 0.3 * np.sin(3.1 * _T),
        "room_c": np.random.default_rng(1).normal(20, 2, N_ROWS),
        "y": np.zeros(N_ROWS),
    },
    time="t_s",
    run="run",
)


def _simulator(**more):
    how = {
        "parameters": {"offset": (-5, 5), "gain": (0, 4)},
        "simulate": lambda p, u: p["offset"] + p["gain"] * u["drive"],
        "noise": Noise(sd=SD),
    }
    return Simulator(**{"reading": "y", "unit": "V", "time": "t_s", "run": "run", **how, **more})


def _about(simulator, table=TABLE):
    system = System.of(simulator, table)
    return ReferenceFit(system, table, np.zeros(system.n_params), SD)


def _about_law(rates, *, observe=None, max_step_s=0.02, parameters=(("rate", (0.0, 2.0)),), table=TABLE, **starts):
    """The reference fit of a law of one parameter, 1 in the middle of its prior."""
    law = Law(starts or {"x": 0.0}, rates, observe, max_step_s=max_step_s)
    return _about(_simulator(parameters=dict(parameters), simulate=None, law=law), table)


def _rising(s, p, u):
    return {"x": p["rate"] + 0 * s["x"]}


ABOUT = _about(_simulator())
FORMS = bind_forms(ABOUT)
NOTHING = ABOUT.predicted


def _read(name, *setting, about=ABOUT, forms=FORMS):
    theta = np.concatenate([about.theta[0], setting])[None, :]
    return about.system.chain(TABLE, [forms[name]]).predict(theta, TABLE)[0]


def test_a_curve_is_a_polynomial_in_the_scaled_column_of_an_order_of_two_to_five():
    form, column = FORMS["curve:room_c"], TABLE.columns["room_c"]
    z = 2 * (column - column.min()) / np.ptp(column) - 1
    found = _read("curve:room_c", 0.1, -0.2, 0.3, 0.4, -0.5) - NOTHING
    np.testing.assert_allclose(found, 0.1 * z - 0.2 * z**2 + 0.3 * z**3 + 0.4 * z**4 - 0.5 * z**5, atol=1e-12)
    assert [len(variant.fixed) for variant in form.variants()] == [3, 2, 1, 0]
    assert form.sentence(np.array([0.1, 0.2, 0, 0, 0]), np.array([0.01, 0.01, 1e-12, 1e-12, 1e-12])).count("z^") == 1


def test_a_column_that_moves_both_ways_may_have_dry_friction_sharp_or_smooth():
    sharp, smooth = FORMS["friction:drive"].variants()
    drive = TABLE.columns["drive"]
    width = sharp.entries[0, 0, 1]
    np.testing.assert_allclose(_read("friction:drive", 0.2, width) - NOTHING, 0.2 * np.sign(drive), atol=1e-12)
    np.testing.assert_allclose(_read("friction:drive", 0.2, 0.5) - NOTHING, 0.2 * np.tanh(drive / 0.5), atol=1e-12)
    assert (sharp.fixed, smooth.fixed) == (("width",), ())
    assert "friction:room_c" not in FORMS


def test_a_switch_has_five_rows_and_three_values_on_either_side():
    assert switch_points(np.arange(9.0)).size == 0
    np.testing.assert_array_equal(switch_points(np.arange(12.0)), [4.0, 5.0, 6.0, 7.0])
    np.testing.assert_array_equal(switch_points(np.repeat([0.0, 1.0, 2.0, 3.0, 4.0, 5.0], 4)), [2.0, 3.0])


@pytest.mark.parametrize("name", sorted(name for name, form in FORMS.items() if form.nothing))
def test_a_form_at_nothing_changes_nothing(name):
    form = FORMS[name]
    setting = form.entries[0, 0].copy()
    for k, value in form.nothing.items():
        setting[k] = value
    np.testing.assert_allclose(_read(name, *setting), NOTHING, atol=1e-9)


@pytest.mark.parametrize("name", sorted(FORMS))
def test_settings_of_a_bank_lie_within_the_prior_and_some_can_be_seen(name):
    form = FORMS[name]
    bank = form.entries.reshape(-1, form.entries.shape[-1])
    assert np.isfinite(form.prior.log_prob(bank)).any()
    change = max(
        np.sqrt(np.mean((_read(name, *setting) - NOTHING) ** 2)) for setting in bank[:: max(len(bank) // 8, 1)]
    )
    assert change > 0.01 * SD


@pytest.mark.parametrize("wild", [-99.0, 99.0])
def test_one_wild_reading_hides_no_ceiling(wild):
    readings = np.minimum(NOTHING, 1.2) + SD * np.random.default_rng(0).standard_normal(N_ROWS)
    table = TABLE.with_columns({"y": np.where(np.arange(N_ROWS) == 7, wild, readings)})
    form = bind_forms(ReferenceFit(ABOUT.system, table, np.zeros(2), SD))["saturation"]
    found = ABOUT.system.chain(table, [form]).predict(np.append(ABOUT.theta[0], 1.2)[None, :], table)[0]
    np.testing.assert_allclose(found, np.minimum(NOTHING, 1.2))
    low, high = form.prior.from_unit_cube(np.array([[0.0], [1.0]])).ravel()
    assert NOTHING.min() - 1 < low < high < NOTHING.max() + 1


def test_the_code_of_an_error_beyond_the_declared_range_is_no_end_of_the_readings():
    simulator, levels = _simulator(noise=Noise(sd=SD, range=(-10.0, 10.0))), []
    for codes in ([], [9999.0, -9999.0]):
        table = TABLE.with_columns({"y": np.append(np.linspace(-1, 2, N_ROWS - len(codes)), codes)})
        form = bind_forms(_about(simulator, table))["saturation"]
        levels.append((form.prior.from_unit_cube(np.array([[0.0], [1.0]])), form.entries))
    np.testing.assert_array_equal(levels[0][0], levels[1][0])
    np.testing.assert_array_equal(levels[0][1], levels[1][1])


def test_hysteresis_goes_by_the_way_in_which_the_reading_moves_with_all_that_is_added_to_it():
    """An offset that rises faster than the reading ever falls: it rises throughout, and hysteresis is one sign."""
    chain = ABOUT.system.chain(TABLE, [FORMS["hysteresis"], FORMS["offset_drift"]])
    amplitudes = {"hysteresis": 0.05, "offset_drift": 100.0}
    theta = np.concatenate([ABOUT.theta[0], [amplitudes[effect.name] for effect in chain.effects]])[None, :]
    found = chain.predict(theta, TABLE)[0]
    np.testing.assert_allclose(found - NOTHING - 100.0 * _T, 0.05, atol=1e-9)


def test_a_gain_counts_from_the_reading_of_nothing():
    how = {"parameters": {"gain": (0, 4)}, "simulate": lambda p, u: 1.0 + p["gain"] * u["drive"]}
    about = _about(_simulator(**how, noise=Noise(sd=SD, zero=1.0)))
    found = _read("gain_drift", 0.1, about=about, forms=bind_forms(about))
    np.testing.assert_allclose(found, 1.0 + (about.predicted - 1.0) * (1 + 0.1 * _T))


def test_an_extra_effect_of_a_file_is_bound_with_its_own_prior_and_sentence():
    about = _about(_simulator(
        parameters={"gain": (0, 4)}, simulate=lambda p, u: p["gain"] * u["drive"] * (1 + p["bend"] * u["drive"]),
        extra={"bend": Extra(_simulator().parameters["gain"], 0.0, "the amplifier bends by {value} per V")},
    ))  # fmt: skip
    form = bind_forms(about)["bend"]
    expected = about.theta[0, 0] * TABLE.columns["drive"] * (1 + 0.25 * TABLE.columns["drive"])
    np.testing.assert_allclose(_read("bend", 0.25, about=about, forms={"bend": form}), expected)
    np.testing.assert_allclose(_read("bend", 0.0, about=about, forms={"bend": form}), about.predicted)
    assert form.sentence(np.array([0.25]), np.array([0.01])) == "the amplifier bends by 0.250 ± 0.010 per V"


@pytest.mark.parametrize(
    ("a", "told"),
    [(0.7, "a damping term -a x, a = 0.700 ± 0.020 per s"), (-0.7, "a term +b x, b = -a = 0.700 ± 0.020 per s")],
)
def test_a_term_that_adds_to_a_rate_is_told_without_a_double_negative(a, told):
    damping = bind_forms(_about_law(_rising, max_step_s=0.2))["damping:x"]
    assert damping.sentence(np.array([a]), np.array([0.02])) == f"the rate of x lacks {told}"


def test_an_input_is_cut_off_below_as_well_as_above():
    """On u = drive and y = offset + gain u: what is cut off is the drive."""
    drive, form = TABLE.columns["drive"], FORMS["input_saturation:drive"]
    offset, gain = ABOUT.theta[0]
    for level, cut in ((0.7, np.minimum), (-0.6, np.maximum)):
        np.testing.assert_allclose(_read(form.name, level), offset + gain * cut(drive, level))
    np.testing.assert_allclose(_read(form.name, form.nothing[0]), ABOUT.predicted)
    said = [form.sentence(np.array([level]), np.array([0.01])) for level in (0.7, -0.6)]
    assert "rises no further" in said[0]
    assert "falls no further" in said[1]


def test_levels_of_a_clipping_are_between_the_values():
    found = clipping_between(np.array([0.0, 0.4, 1.0, np.nan, 3.0]))
    assert (found.prior.low, found.prior.high, found.nowhere) == (0.0, 3.0, 6.0)
    assert clipping_between(np.full(3, 2.0)) is None


def _names_in_units(of_law, time, column, reading):
    """Names of the forms and proposals of one system, whose table is in other units, without their numbers."""
    table = TABLE.with_columns({"t_s": time * _T, "room_c": column * TABLE.covariates["room_c"]}).take(
        np.arange(0, 60, 2)
    )
    if of_law:
        parameters = {"k": (0.5 * reading / time, 1.5 * reading / time), "r": (0.1 / time, 1 / time)}
        law = Law(
            {"y": 2 * reading}, lambda s, p, u: {"y": p["k"] * u["drive"] - p["r"] * s["y"]}, max_step_s=0.2 * time
        )
        how = {"law": law}
    else:
        parameters = {"offset": (-5 * reading, 5 * reading), "gain": (0, 4 * reading)}
        how = {"simulate": lambda p, u: p["offset"] + p["gain"] * u["drive"]}
    about = _about(_simulator(parameters=parameters, noise=Noise(sd=SD * reading), **{"simulate": None, **how}), table)
    about = replace(about, sd=SD * reading)
    names = [*bind_forms(about), *(form.name for form in formula_forms(about))]
    return {re.sub(r"-?\d[\d.e+-]*", "#", name) for name in names}


@pytest.mark.slow
@pytest.mark.parametrize("of_law", [False, True])
def test_what_may_be_missing_does_not_depend_on_the_units_of_the_columns(of_law):
    """Nanoseconds in seconds, picoamperes in amperes, and readings of a million million of their unit."""
    usual = _names_in_units(of_law, 1.0, 1.0, 1.0)
    for units in ((1e-9, 1.0, 1.0), (1.0, 1e-12, 1.0), (1.0, 1.0, 1e12)):
        assert _names_in_units(of_law, *units) == usual


def test_what_may_be_missing_does_not_depend_on_the_last_digits_of_the_columns():
    """Two runs over the same settings, whose numbers were computed in two ways; and a column of one number."""
    rng, half = np.random.default_rng(3), N_ROWS // 2
    columns = {
        "t_s": TABLE.time_s,
        "drive": np.tile(TABLE.covariates["drive"][:half], 2),
        "room_c": np.tile(rng.normal(20, 2, half), 2),
        "lamp": np.where(np.arange(N_ROWS) % 3 == 0, 0.3, 0.7),
        "load": np.full(N_ROWS, 0.7),
    }
    found = []
    for last_digits in (False, True):
        noisy = {name: np.append(v[:half], np.nextafter(v[half:], np.inf)) for name, v in columns.items()}
        table = TABLE.with_columns(noisy if last_digits else columns)
        about = _about(_simulator(), table)
        forms = [*bind_forms(about).values(), *formula_forms(about)]
        found.append(
            {re.sub(r"-?\d[\d.e+-]*", "#", form.name): (len(form.entries), len(form.variants())) for form in forms}
        )
    assert found[1] == found[0]
    assert not any("load" in name for name in found[0])


def test_no_form_has_the_name_of_an_effect_out_of_vocabulary():
    """Such a name would count as unknown however sure it is: `gain_step` did, as a light sensor's jump of the gain."""
    assert "gain_step" in FORMS
    assert not any(is_out_of_vocabulary(name) for name in FORMS)


def test_an_overflow_goes_to_waste_or_into_a_state_that_it_drives():
    """Of two tanks in a row the upper one may overflow into the lower one, the lower one to waste only."""

    def rates(s, p, u):
        return {"upper": p["rate"] - 0.5 * s["upper"], "lower": 0.5 * s["upper"] - 0.3 * s["lower"]}

    about = _about_law(rates, lower=0.0, upper=0.0)
    forms, law = bind_forms(about), about.system.simulator.law
    wasted, taken = forms["limit:upper"].variants()
    assert (wasted.fixed, taken.fixed) == (("share[lower]",), ())
    assert [variant.fixed for variant in forms["limit:lower"].variants()] == [("share[upper]",)]
    level = forms["limit:upper"].entries[3, 0, 0]
    theta = np.array([[level, 0.0], [level, 0.5], [level, 1.0]])
    motions = [wasted.apply(LawWithEffects(law), theta[k : k + 1], TABLE) for k in range(3)]
    full = np.array([[[level if state == "upper" else 0.1]] for state in law.states])
    given = {"rate": np.full((1, 1), 2.0)}
    lower = [*law.states].index("lower")
    into_lower = [float(motion.rates(full, (given, {}))[lower, 0, 0]) for motion in motions]
    over = 2.0 - 0.5 * level
    np.testing.assert_allclose(np.diff(into_lower), 0.5 * over)
    assert "lower takes up 0.50" in taken.sentence(np.array([level, 0.5]), np.array([0.01, 0.01]))
    assert "takes up" not in wasted.sentence(np.array([level, 5e-10]), np.array([0.01, 3e-10]))


def test_a_loop_that_holds_its_input_is_told_from_a_formula_of_the_row():
    """Of x' = (u - x) / tau by hand, u held from row to row, the next reading is the first to depend on u."""

    def simulate(p, u):
        out = np.zeros(N_ROWS)
        for k in range(1, N_ROWS):
            stays = np.exp(-max(_T[k] - _T[k - 1], 0.0) / p["tau_s"])
            out[k] = stays * out[k - 1] + (1 - stays) * u["drive"][k - 1]
        return out

    loop = _about(_simulator(parameters={"tau_s": (0.5, 2.0)}, simulate=simulate))
    assert loop.is_held_between_rows("drive")
    assert not loop.is_held_between_rows("room_c")
    assert not ABOUT.is_held_between_rows("drive")


def _proposed(ending, about=ABOUT):
    (form,) = [form for form in formula_forms(about) if form.name.endswith(ending)]
    return form


def test_a_wave_whose_frequency_changes_is_begun_from_its_two_columns():
    """Route two: the phase is the integral of the frequency, 2 pi hz (1 + sweep u / 3) over u = t - 3 s, by steps."""
    form = _proposed("u = t_s - 3")
    entry = form.entries[40]
    setting = form.start(entry, np.array([0.6, 0.8]))
    assert setting[0] == pytest.approx(entry[0, 0])
    assert setting[3] == pytest.approx(np.arctan2(0.8, 0.6))
    a, hz, sweep, phase = setting
    fine = np.linspace(-3, 3, 60_001)
    turned = np.concatenate([[0.0], np.cumsum(2 * np.pi * hz * (1 + sweep * fine / 3) * np.diff(fine)[0])[:-1]])
    expected = a * np.sin(np.interp(_T - 3, fine, turned - np.interp(0.0, fine, turned)) + phase)
    found = form.apply(np.zeros((1, N_ROWS)), setting[None, :], TABLE)[0]
    np.testing.assert_allclose(found, expected, atol=0.01 * a)


def test_a_dose_is_the_integral_since_the_start_of_the_run_and_saturates():
    """Route two: the trapezoid rule by its own sum over each run."""
    centre = float(f"{TABLE.columns['room_c'].mean():.6g}")
    form = _proposed(f"|room_c - {centre:.4g}| since the start of the run")
    found = form.apply(np.zeros((1, N_ROWS)), np.array([[0.5, 3.0]]), TABLE)[0]
    away = np.abs(TABLE.columns["room_c"] - centre)
    for rows in (slice(0, N_ROWS // 2), slice(N_ROWS // 2, N_ROWS)):
        dose = [np.trapezoid(away[rows][: k + 1], _T[rows][: k + 1]) for k in range(N_ROWS // 2)]
        np.testing.assert_allclose(found[rows], 0.5 * (1 - np.exp(-np.array(dose) / 3.0)), atol=1e-7)


def test_the_influence_of_a_column_is_a_quadratic_function_of_the_reading():
    (form,) = [form for form in formula_forms(ABOUT) if "(a + b z + c z^2) (room_c" in form.name]
    column, level = TABLE.columns["room_c"], np.linspace(NOTHING.min(), NOTHING.max(), N_ROWS)
    found = form.apply(level[None, :], np.array([[0.2, -0.1, 0.3]]), TABLE)[0] - level
    z = np.linspace(-1, 1, N_ROWS)
    np.testing.assert_allclose(found, (0.2 - 0.1 * z + 0.3 * z**2) * (column - column.mean()) / column.std())
    assert "a = 0.200 ± 0.010 V, b = -0.100" in form.sentence(np.array([0.2, -0.1, 0.3]), np.full(3, 0.01))


def test_a_wave_is_slow_enough_to_be_seen_as_a_whole_and_a_periodic_error_to_repeat():
    """Half a wave follows any smooth bend: of an S-shaped one x had "a period of 1365" in a range of 362."""

    def possible(name, waves_in_range, reach):
        period = reach / waves_in_range
        setting = {"a": 0.1, "period": period, "hz": 1 / period, "phase": 0.3}
        prior = FORMS[name].prior
        return np.isfinite(prior.log_prob(np.array([[setting[each] for each in prior.names]]))[0])

    assert possible("interference", 1.0, 6.0)
    assert not possible("interference", 0.85, 6.0)
    drive = np.ptp(TABLE.columns["drive"])
    assert possible("periodic_error:drive", 1.5, drive)
    assert not possible("periodic_error:drive", 1.3, drive)


def test_a_term_on_one_side_acts_beyond_its_threshold_alone():
    """Closed form: x' = 1 from 0, and x' = 1 - a (x - 2) above 2, goes as 2 + (1 - exp(-a (t - 2))) / a."""
    about = _about_law(_rising)
    form = _proposed("max(x - at, 0)", about)
    found = _read(form.name, -0.5, 2.0, about=about, forms={form.name: form})
    beyond = np.maximum(_T - 2.0, 0.0)
    np.testing.assert_allclose(found, np.minimum(_T, 2.0) + (1 - np.exp(-0.5 * beyond)) / 0.5, atol=1e-3)


def _of_drive(p, u):
    return p["offset"] + p["gain"] * u["drive"]


def test_a_pickled_form_finds_its_functions_again():
    forms = bind_forms(_about(_simulator(simulate=_of_drive)))
    for form in (forms[name] for name in ("lag", "curve:drive", "differs:gain", "interference~again", "offset_step")):
        again = pickle.loads(pickle.dumps(form))
        theta = np.concatenate([ABOUT.theta[0], form.entries[0, 0]])[None, :]
        one, other = (ABOUT.system.chain(TABLE, [each]).predict(theta, TABLE) for each in (form, again))
        np.testing.assert_array_equal(one, other)


def test_a_form_that_looks_back_to_earlier_times_says_so():
    """Route two: the time of one row is moved, and other rows change if and only if a form looks back."""
    moved = _T.copy()
    moved[10] += 0.05
    later, others = TABLE.with_columns({"t_s": moved}), np.arange(N_ROWS) != 10
    for form in (*FORMS.values(), *formula_forms(ABOUT)):
        theta = np.concatenate([ABOUT.theta[0], form.entries[len(form.entries) // 2, 0]])[None, :]
        chain = ABOUT.system.chain(TABLE, [form])
        change = (chain.predict(theta, later) - chain.predict(theta, TABLE))[0]
        assert form.needs_rising_time == bool(np.any(change[others] != 0)), form.name
    named = {name.partition(":")[0] for name, form in FORMS.items() if form.needs_rising_time}
    assert named == {"lag", "delay", "input_delay"}


def test_the_rates_of_a_law_lack_nothing_where_no_time_passes():
    law = Law(
        {"s": "offset"}, lambda s, p, u: {"s": p["gain"] * u["drive"] - s["s"]}, lambda s, p, u: s["s"] + u["drive"]
    )
    names = bind_forms(_about(_simulator(simulate=None, law=law), TABLE.with_columns({"t_s": np.zeros(N_ROWS)})))
    assert {"sensitivity:room_c", "offset_per_run"} <= names.keys()
    assert not any(name.endswith(":s") for name in names)


def test_a_cubic_term_is_minus_the_third_power():
    about = _about_law(_rising, max_step_s=0.2)
    values, law = np.random.default_rng(3).normal(size=(300, 1)), about.system.simulator.law
    ((_, term),) = bind_forms(about)["cubic:x:x"].apply(LawWithEffects(law), np.ones((300, 1)), None).terms
    np.testing.assert_allclose(term({"x": values}, {}, {}), -(values**3), rtol=1e-14)


def test_a_fast_wave_in_times_that_come_in_clusters_is_tried_where_the_residuals_have_their_peak():
    """Nights of three readings, years apart: their average spacing, 25 days, is no limit of what they tell apart."""
    rng = np.random.default_rng(5)
    nights = np.concatenate([np.sort(rng.choice(200, 30, replace=False)), 3650 + np.arange(0, 40, 2)])
    times = np.sort((nights[:, None] + np.sort(rng.uniform(0.0, 0.3, (len(nights), 3)), axis=1)).ravel())
    wave = 3 * SD * np.sin(2 * np.pi * times / 4.785) + SD * rng.standard_normal(times.size)
    simulator = Simulator("y", "V", {"offset": (-5, 5)}, simulate=lambda p, u: p["offset"] + 0 * u["t"], time="t")
    form = bind_forms(_about(simulator, RunTable({"t": times, "y": wave}, time="t")))["interference"]
    assert form.n_suggested
    assert np.abs(form.entries[:, 0, 1] - 1 / 4.785).min() < 0.25 / np.ptp(times)
    assert np.isfinite(form.prior.log_prob(np.array([[SD, 1 / 4.785, 0.0]])))[0]
    # What these readings suggest is nothing to test them by: the draws of a null would have suggested others.
    tested = form.with_fewer_variants()
    assert len(tested.entries) == len(form.entries) - form.n_suggested
    assert tested.entries[:, :, 1].max() < 0.1
    # Evenly spaced rows suggest no further frequencies.
    assert not FORMS["interference"].n_suggested


def test_what_a_parameter_jumps_by_has_its_unit():
    def decay(p, u):
        return p["gain"] * np.exp(-u["t_s"] / p["tau_s"])

    forms = bind_forms(_about(_simulator(parameters={"tau_s": (1, 5), "gain": (0, 4)}, simulate=decay)))
    said = forms["steps:tau_s"].sentence(np.array([-2.0, 3.0]), np.array([0.1, 0.2]))
    assert said == "tau_s jumps by -2.00 ± 0.10 s at 3.00 ± 0.20 s and stays there"
    said = forms["sensitivity:room_c"].sentence(np.array([0.5]), np.array([0.1]))
    assert said == "y changes by 0.50 ± 0.10 V per °C of room_c"


def test_a_jump_of_the_gain_may_go_back_as_a_block_of_rows_in_another_unit_does():
    form = FORMS["gain_step"]
    assert form.prior.names == ("a", "until_s", "at_s")
    found = _read("gain_step", 9.0, 4.0, 2.0)
    np.testing.assert_allclose(found, np.where((_T > 2) & (_T <= 4), 10 * NOTHING, NOTHING))
    never = form.entries[0, 0, 1]
    np.testing.assert_allclose(_read("gain_step", 9.0, never, 2.0), np.where(_T > 2, 10 * NOTHING, NOTHING))
    steps = [variant for variant in form.variants() if variant.fixed]
    blocks = [variant for variant in form.variants() if not variant.fixed]
    assert sum(v.relative_odds for v in blocks) == pytest.approx(0.1 * sum(v.relative_odds for v in steps))
    _, masks = form.variant_masks(TABLE)
    for variant, mask in list(zip(form.variants(), masks, strict=True))[:: len(blocks) // 40]:
        a, until, at = variant.entries[0, 0]
        changed = _read("gain_step", a, until, at) != NOTHING
        np.testing.assert_array_equal(changed, mask & (NOTHING != 0))
    theta = form.redraw_by_variant(
        np.tile([9.0, never, 2.0], (50, 1)), np.eye(len(masks))[-1], rng=np.random.default_rng(0)
    )
    assert np.isfinite(form.variants()[-1].prior.log_prob(theta)).all()
    assert (theta[:, 0] == 9.0).all()
    assert "goes back" in form.sentence(np.array([9.0, 4.0, 2.0]), np.full(3, 0.1))


def test_rows_are_predicted_alone_only_where_neither_the_simulator_nor_an_effect_looks_at_others():
    """Route two: the whole table. What comes late or adds up needs the other rows."""
    system, rows = System.of(_simulator(), TABLE), np.array([5, 6, 20, 37, 38, 59])
    forms = bind_forms(ReferenceFit(system, TABLE, np.zeros(2), SD))
    alone = set()
    for name, form in forms.items():
        part, at = system.part_that_predicts(rows, TABLE, (form,))
        settings = form.entries.reshape(-1, form.entries.shape[-1])
        theta, chain = np.insert(settings, 0, [[1.0], [2.0]], axis=1), system.chain(TABLE, (form,))
        np.testing.assert_allclose(chain.predict(theta, part)[:, at], chain.predict(theta, TABLE)[:, rows], rtol=1e-12)
        alone |= {name} if len(part) == len(rows) else set()
    assert {"offset_drift", "interference", "sensitivity:room_c", "gain_per_run"} <= alone
    assert not {"lag", "delay", "hysteresis", "backlash:drive", "input_delay:drive"} & alone
    adding_up = System.of(_simulator(simulate=lambda p, u: p["offset"] + p["gain"] * np.cumsum(u["drive"])), TABLE)
    assert adding_up.part_that_predicts(rows, TABLE, ())[0] is TABLE


def test_a_share_of_the_reading_fades_from_the_start_of_each_run():
    form = _proposed("s the t_s since the start of the run")
    y = np.linspace(1.0, 3.0, N_ROWS)[None, :]
    since = np.concatenate([_T[rows] - _T[rows][0] for rows in (slice(0, N_ROWS // 2), slice(N_ROWS // 2, N_ROWS))])
    found = form.apply(y, np.array([[0.2, 1.5]]), TABLE)[0]
    np.testing.assert_allclose(found, y[0] * (1 + 0.2 * np.exp(-since / 1.5)))


def test_what_differs_from_run_to_run_is_told_from_the_median_of_the_runs():
    """Of an offset that a parameter takes up, all runs together are known to 0.7 V, their difference to 0.01 V."""
    rng = np.random.default_rng(3)
    values = 0.7 * rng.standard_normal((2000, 1)) + [0.2, -0.2] + 0.01 * rng.standard_normal((2000, 2))
    assert "in run 1: by 0.2000 ± 0.007" in sentence_from_samples(FORMS["offset_per_run"], values)
