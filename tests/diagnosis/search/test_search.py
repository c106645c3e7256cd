"""Stepwise selection of effects, pruning, and what counts under which name."""

import itertools
import math
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest
from refitted import state_with_nulls

from probewise.diagnosis import search as searching
from probewise.diagnosis.apparatus import PriorOdds
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.noise import white_noise
from probewise.diagnosis.search import UnknownEffects, prune_out_of_vocabulary, search
from probewise.diagnosis.search.hypotheses import Evidences, Searched, hypothesis_probabilities
from probewise.effects import Extent
from probewise.effects.noise import correlated_noise, random_walk
from probewise.priors import LogUniform, Uniform
from probewise.systems import Noise, RunTable, Simulator, table_for

N_ROWS = 160
SD = 0.01
LINE = Simulator(
    reading="y",
    unit="V",
    parameters={"offset": (-5, 10), "gain": (0, 1)},
    simulate=lambda p, u: p["offset"] + p["gain"] * u["x"],
    time="t_s",
    noise=Noise(sd=SD),
)


def _readings_and_columns(rng, *, slow, amplitude):
    """A heat flux: the reading grows with the difference of two temperatures, which rise and fall together."""
    common = np.cumsum(rng.normal(0, 0.2, N_ROWS))
    own = np.cumsum(rng.normal(0, 0.1, N_ROWS)) if slow else rng.normal(0, 0.1, N_ROWS)
    room, wall, x = 20 + common, 18 + common + own, rng.normal(size=N_ROWS)
    y = 3 + 0.2 * x + amplitude * (wall - room) + SD * rng.normal(size=N_ROWS)
    return {"t_s": np.arange(float(N_ROWS)), "x": x, "room_c": room, "wall_c": wall, "y": y}, own


def _probability_of_both_columns(columns):
    found = search(prepare_system(LINE, table_for(LINE, columns)))
    both = {"room_c", "wall_c"}
    return sum(
        p for names, p in found.posterior.marginal_over_noise.items() if both == {n.split(":")[-1] for n in names}
    )


def test_a_difference_of_two_columns_is_found_where_neither_column_explains_anything():
    columns, _ = _readings_and_columns(np.random.default_rng(1), slow=False, amplitude=0.1)
    assert _probability_of_both_columns(columns) > 0.9


N = 50
NAME, PUSH = ("sensor_tilt",), ("arm_knock",)


@dataclass(frozen=True, eq=False)
class Held:
    """As much of a candidate as is asked here: its names, its log evidence, what it leaves of every reading."""

    names: tuple[str, ...]
    log_z: float
    left: float = 0.0
    log_share: float = 0.0
    n_gaussians: int = 1
    weights: dict = field(default_factory=dict)
    law = white_noise(N)

    @property
    def evidence(self):
        return {(): SimpleNamespace(log_z=self.log_z)}

    @property
    def log_z_by_noise(self):
        return {(): self.log_z}

    whitened_sd = 1.0

    @property
    def found(self):
        return SimpleNamespace(residuals=np.full(N, self.left))

    def with_variant_factor_and_weights(self, log_share, _):
        return replace(self, log_z=self.log_z + log_share - self.log_share, log_share=log_share)


NOISES = SimpleNamespace(average_log_evidence=lambda log_z: log_z.get((), -np.inf))


def by_key(*candidates):
    return {(c.n_gaussians, c.names): c for c in candidates}


@pytest.mark.parametrize(("behind", "goes"), [(2.0, False), (4.0, True)])
def test_what_is_poorer_than_something_left_out_for_a_name_is_left_out_too(behind, goes):
    """A log that a curve follows is that curve; an exponential that follows neither must not lead in its place."""
    poorer = Held(("reflection",), -behind, left=1.0)
    fits = by_key(Held((), -50.0), Held(NAME, -9.0), Held(PUSH, 0.0, left=0.3), poorer)
    assert prune_out_of_vocabulary(fits, NOISES)[1] == ({PUSH, poorer.names} if goes else {PUSH})


@pytest.mark.parametrize(
    ("name", "beside", "speaks"),
    [(-1.0, 0.0, True), (-1.0, 2.5, False), (-4.0, -4.0, False)],
    ids=["as much, and nothing left", "something left", "far behind"],
)
def test_a_name_speaks_for_bases_that_explain_no_more_and_find_nothing_beside_it(name, beside, speaks):
    state = SimpleNamespace(refits=SimpleNamespace(noises=NOISES), effects_in_vocabulary=[NAME])
    unknown = UnknownEffects(state, None, (), {(1, (), ()): 0.0, (1, NAME, ()): beside})
    unknown.drop_superfluous([Held((), -50.0), Held(NAME, name)])
    assert ((1, (), ()) not in unknown.log_z) == speaks
    assert (1, NAME, ()) in unknown.log_z


PRIOR = PriorOdds(n_named=2, n_unnamed=0, n_noises=1)


class Fit(SimpleNamespace):
    """As much of a weighed fit as its evidence."""

    def with_log_evidence_shifted(self, by):
        return Fit(evidence={k: SimpleNamespace(log_z=e.log_z + by) for k, e in self.evidence.items()})


def fit(log_z):
    return Fit(evidence={(): SimpleNamespace(log_z=log_z)})


EVIDENCES = Evidences(
    fits={(1, ()): fit(0.0), (2, ()): fit(math.log(3.0)), (1, ("lag",)): fit(5.0)},
    screened={(("backlash",), ()): 2.0},
    unknown={(1, (), ()): 1.0},
)


def posterior(evidences=EVIDENCES):
    return hypothesis_probabilities(evidences, PRIOR, certain=())


def test_probabilities_are_prior_times_evidence_summed_over_orders():
    by_mean = posterior().marginal_over_noise
    assert sum(by_mean.values()) == pytest.approx(1.0)
    share = PRIOR.by_size[0] / 2
    assert by_mean["lag",] / by_mean[()] == pytest.approx(share * math.exp(5.0) / (PRIOR.clean_mean * 4.0))
    assert by_mean["lag",] / by_mean["backlash",] == pytest.approx(math.exp(3.0))
    assert by_mean["unknown",] / by_mean[()] == pytest.approx(PRIOR.unknown * math.e / (PRIOR.clean_mean * 4.0))


def test_an_evidence_that_is_no_number_leaves_all_others_as_they_are():
    spoilt = replace(EVIDENCES, fits={**EVIDENCES.fits, (1, ("drag",)): fit(math.nan)})
    by_mean = posterior(spoilt).marginal_over_noise
    assert by_mean.pop(("drag",)) == 0.0
    assert by_mean == posterior().marginal_over_noise


FORMULA = "formula:reading:temp_c:a while |(t / period + phase) mod 1| < share / 2"


def of(log_z):
    """Evidences of fits by their names, of which nothing has 0."""
    return Evidences({(0, names): SimpleNamespace(log_z=value) for names, value in {(): 0.0, **log_z}.items()})


@pytest.mark.parametrize(("named", "known"), [(51.0, ("offset_drift",)), (49.0, ("unknown",))])
def test_a_formula_beside_a_name_counts_as_the_name_if_that_explains_more(named, known):
    evidences = of({("offset_drift",): named, (FORMULA, "offset_drift"): 100.0})
    assert evidences.reported_as((FORMULA, "offset_drift")) == known


def test_the_formula_beside_names_is_that_of_largest_evidence_which_adds_formulas_alone():
    def fit(log_z, *names):
        evidence = {("outliers",): SimpleNamespace(log_z=log_z)}
        return SimpleNamespace(names=names, n_gaussians=0, evidence=evidence)

    square = "formula:reading:temp_c:t^2"
    alone, more, best = fit(5.0, "lag"), fit(7.0, square, "lag"), fit(8.0, FORMULA, "lag")
    others = fit(20.0, "lag", "settling"), fit(30.0, FORMULA), fit(40.0, FORMULA, "lag", "settling")
    evidences = Evidences({(0, tuple(sorted(each.names))): each for each in (alone, more, best, *others)})
    assert evidences.best_formula_beside(alone, ("outliers",)) is best
    assert evidences.best_formula_beside(others[2], ("outliers",)) is None


@pytest.mark.parametrize(
    ("named", "stays"), [(16.0, True), (14.0, False)], ids=["over half of all that is explained", "less than half"]
)
def test_a_name_stays_if_it_explains_more_than_all_that_has_no_name(named, stays):
    """A gradient of 14 nats, a reflection that adds 10 and an unknown effect that adds 6: 14 of 30 have a name."""
    white: tuple[str, ...] = ()
    of_names = {(): 0.0, ("albedo_gradient",): named, ("albedo_gradient", "reflection"): 24.0}
    fits = {(2, names): SimpleNamespace(evidence={white: SimpleNamespace(log_z=z)}) for names, z in of_names.items()}
    evidences = Evidences(fits, unknown={(2, ("albedo_gradient", "reflection"), white): 30.0})
    assert evidences.named_outweigh_unknown(2, ("albedo_gradient", "reflection"), white) is stays


def test_a_name_stands_beside_what_is_unknown_in_its_share_of_the_evidence():
    """Two hypotheses, nothing named and `lag`, whose evidence and prior odds make them as one to three."""
    prior = PriorOdds()
    more = math.log(3.0) + prior.log_prior_with_unknown(()) - prior.log_prior_with_unknown(("lag",))
    unknown = {(0, (), ()): 10.0, (0, ("lag",), ()): 10.0 + more}
    searched = SimpleNamespace(evidences=Evidences({}, unknown=unknown), prior=prior, certain=())
    assert Searched.effect_probabilities_given_unknown(searched) == pytest.approx({"lag": 0.75})


def test_what_is_unknown_has_a_noise_too():
    """Of the unknown half, four parts in five have outliers; those of the named half do not count."""
    probabilities = {
        (("unknown",), ("outliers",)): 0.3,
        (("unknown",), ()): 0.1,
        (("arm_knock",), ("correlated_noise", "outliers")): 0.1,
        (("lag",), ("correlated_noise",)): 0.5,
    }
    fits = {(0, ()): SimpleNamespace(log_z=0.0), (0, ("arm_knock",)): SimpleNamespace(log_z=9.0)}
    searched = SimpleNamespace(evidences=Evidences(fits), posterior=SimpleNamespace(probabilities=probabilities))
    beside = Searched.noise_probabilities_given_unknown(searched)
    assert beside == pytest.approx({"outliers": 0.8, "correlated_noise": 0.2})


_N = 120


@pytest.fixture(scope="module")
def prepared():
    """A straight line that leaves out the room's temperature, of lambda about 11."""
    rng = np.random.default_rng(7)
    force, room = 10 * rng.random(_N), 20 + np.cumsum(rng.normal(size=_N))
    y = 2.0 + 0.5 * force + 0.05 * (room - room.mean()) / room.std() + 0.05 * rng.normal(size=_N)
    table = RunTable({"t_s": np.arange(float(_N)), "force": force, "room": room, "y": y}, time="t_s", run=None)
    simulator = Simulator(
        "y", "V", {"zero": (-10, 10), "slope": (0, 2)}, simulate=lambda p, u: p["zero"] + p["slope"] * u["force"],
        time="t_s",
    )  # fmt: skip
    return prepare_system(simulator, table)


@pytest.fixture(scope="module")
def state(prepared):
    return _state(prepared)


def _state(prepared):
    extent = Extent.of(prepared.recording)
    return state_with_nulls(prepared, {kind.name: kind.for_extent(extent) for kind in (correlated_noise, random_walk)})


def test_a_slope_that_differs_from_run_to_run_is_fitted_as_well_as_one_straight_line_for_each():
    """Route two: least squares with a slope of its own for each of six runs."""
    rng = np.random.default_rng(3)
    force, run = 10 * rng.random(_N), np.repeat(np.arange(6.0), _N // 6)
    slope = 0.5 + np.array([0.006, -0.008, 0.003, -0.005, 0.008, -0.004])[run.astype(int)]
    y = 2.0 + slope * force + 0.05 * rng.normal(size=_N)
    table = RunTable({"force": force, "run": run, "y": y}, time=None, run="run")
    simulator = Simulator(
        "y", "V", {"zero": Uniform(-10, 10), "slope": LogUniform(0.01, 10)},
        simulate=lambda p, u: p["zero"] + p["slope"] * u["force"], run="run",
    )  # fmt: skip
    state = _state(prepare_system(simulator, table))
    found = state.refits.refit_with_effect(state.null, state.effects["differs:slope"])[0].found
    lines = np.column_stack([np.ones(_N), force[:, None] * (run[:, None] == np.arange(6.0))])
    best = y - lines @ np.linalg.lstsq(lines, y)[0]
    assert np.sum(found.residuals**2) == pytest.approx(np.sum(best**2), rel=0.02)
    assert np.abs(found.z).max() < 3.0


_N_RUNS, _N_SPARED = 3, 30


def _line(change, **more):
    """Three runs of a straight line with a change that it leaves out, and a start of its own in each run."""
    rng = np.random.default_rng(11)
    run = np.repeat(np.arange(float(_N_RUNS)), _N_SPARED)
    columns = {
        "t_s": np.tile(np.arange(float(_N_SPARED)), _N_RUNS),
        "run": run,
        "force": 10 * rng.random(len(run)),
        "room": 20 + rng.normal(size=len(run)),
    }
    y = 2.0 + 0.1 * run + 0.5 * columns["force"] + change(columns) + 0.05 * rng.normal(size=len(run))
    table = RunTable({**columns, "y": y}, time="t_s", run="run")
    simulator = Simulator(
        "y", "V", {"zero": ("normal", 0, 5), "slope": (0, 2)}, per_run=["zero"],
        simulate=lambda p, u: p["zero"] + p["slope"] * u["force"], time="t_s", run="run", **more,
    )  # fmt: skip
    return prepare_system(simulator, table)


@pytest.fixture(scope="module")
def prepared_line():
    return _line(lambda u: 0.3 * (u["room"] - u["room"].mean()))


def _refit_favoured(state):
    def posterior():
        own = Evidences(state.candidates, state.screened_log_evidences())
        return hypothesis_probabilities(own, state.prior, certain=())

    searching._refit_favoured_by_screening(state, posterior)


def test_a_pair_that_screening_about_the_null_favours_is_screened_about_its_part_first(prepared_line):
    """About the null the pair promises 500 nats; about the fit with one of the two it promises nothing."""
    searched = searching.search(prepared_line)
    state = searching.SearchState(
        {n: e for n, e in prepared_line.effects.items() if n not in prepared_line.noise_effect_names},
        searched.prior, searched.refits,
    )  # fmt: skip
    state.candidates |= {key: f for key, f in searched.evidences.fits.items() if key[1] in ((), ("sensitivity:room",))}
    pair = ("offset_drift", "sensitivity:room")
    state.about_null[pair, ()] = state.null.log_z + 500.0

    _refit_favoured(state)
    assert pair not in state.refitted_combinations | state.undetected
    (part,) = state.candidates_of_combination(("sensitivity:room",))
    assert state.screened_log_evidences()[pair, ()] < part.log_z + 3.0


def test_what_was_not_refitted_promises_no_more_than_the_refits_kept(prepared):
    """Eight pairs promise 500 nats by screening, of which six are refitted and keep nothing: the others fall, too."""
    state = _state(prepared)
    promised = state.null.log_z + 500.0
    pairs = list(itertools.combinations(sorted(state.effects), 2))[:8]
    state.about_null |= {(tuple(sorted(pair)), ()): promised for pair in pairs}

    _refit_favoured(state)
    left = {
        names: value for (names, _), value in state.screened_log_evidences().items() if names not in state.undetected
    }
    assert len(left) >= 2
    assert all(value < max(c.log_z for c in state.candidates.values()) + 3.0 for value in left.values())
    assert state.optimism > 400


def test_an_effect_that_a_refit_shows_to_be_insignificant_promises_nothing_under_any_noise(prepared):
    state = _state(prepared)
    single = state.refit_with_effect(state.null, "sensitivity:room")
    improbable = replace(single.evidence["random_walk",], log_z=single.log_z - 10.0)
    single = state.store_candidate(replace(single, evidence={**single.evidence, ("random_walk",): improbable}))
    pair = ("offset_drift", "sensitivity:room")
    state.about_parts |= {(pair, noise): single.log_z + 500.0 for noise in single.evidence}
    assert state.refit_with_effect(single, "offset_drift") is None
    assert pair in state.undetected
    assert max(value for (names, _), value in state.screened_log_evidences().items() if names == pair) < single.log_z
