"""The next readings: what separates hypotheses, aliased effects, scans that the arm could take."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from heater import ABOUT, SIMULATOR, TABLE, runs
from mixtures import fixed_mixture
from scipy.stats import multivariate_normal

from probewise.diagnosis import TO_SEPARATE, diagnose_system
from probewise.diagnosis.advice import (
    Alias,
    PredictiveNormal,
    Rival,
    choose_next_measurement,
    is_settled,
    measurement_separating_rivals,
    mutual_information_lower_bound,
    pairs_with_separating_scans,
)
from probewise.diagnosis.apparatus import ENOUGH_NATS, MOST_ADVISED_READINGS
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.evidence import Linearised
from probewise.diagnosis.fit import Model, fit
from probewise.diagnosis.light_sensor import (
    LightSensorApparatus,
    candidate_scans,
    rows_of_distinct_scans,
    target_swaps,
    varying_covariates,
)
from probewise.diagnosis.locate import Place
from probewise.diagnosis.noise import white_noise_of_recording
from probewise.diagnosis.sensors import default_sensor
from probewise.diagnosis.simulator_rows import SimulatorApparatus
from probewise.effects import VOCABULARY, Extent
from probewise.recordings import HalfPlane, Plan, Recording, paper_plan, read_plan, two_way_plan, write_plan
from probewise.scene import KnownScene
from probewise.sensor import Chain, FixedLevels
from probewise.systems import Noise, RunTable, Simulator

SPOT = fixed_mixture(np.array([1.0, 0.0, 0.0, 0.02, 0.02, 0.0]))  # a Gaussian of sd 5 mm


def predictives(seed: int, apart: float) -> list[PredictiveNormal]:
    rng = np.random.default_rng(seed)
    return [PredictiveNormal(apart * rng.standard_normal(4), 0.7 * rng.standard_normal((4, 2))) for _ in range(3)]


def by_sampling(of: list[PredictiveNormal], weights: np.ndarray, n: int = 40_000) -> float:
    """The mutual information itself: the mean log ratio of the true density to the mixture's."""
    rng = np.random.default_rng(3)
    laws = [multivariate_normal(o.mean, np.eye(4) + o.factor @ o.factor.T) for o in of]
    total = 0.0
    for law, weight in zip(laws, weights, strict=True):
        y = law.rvs(n, random_state=rng)
        densities = np.stack([w * other.pdf(y) for other, w in zip(laws, weights, strict=True)])
        total += weight * float(np.mean(law.logpdf(y) - np.log(densities.sum(axis=0))))
    return total


@pytest.mark.parametrize("apart", [0.0, 0.5, 1.5, 3.0, 8.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_bound_lies_below_the_information_and_near_it(seed, apart):
    weights = np.array([0.5, 0.3, 0.2])
    bound, true = (f(predictives(seed, apart), weights) for f in (mutual_information_lower_bound, by_sampling))
    entropy = float(-np.sum(weights * np.log(weights)))
    assert 0.4 * true - 0.02 < bound < true + 0.02
    assert bound <= entropy + 1e-12
    if apart == 8.0:
        assert bound == pytest.approx(entropy, abs=0.02)


def test_a_prediction_that_ran_away_tells_nothing_and_gives_no_warning():
    """A cubic term in a rate ran away at a candidate: NumPy's warning reached the terminal."""
    known = predictives(0, 1.0)[0]
    wild = known._replace(factor=np.full((4, 2), 1e200))
    assert np.isnan(mutual_information_lower_bound([known, wild], np.full(2, 0.5)))


def rival(name: str, probability: float, settings: list[float], plan: Plan) -> Rival:
    extent = Extent(10.0, 60.0, plan)
    sensor = default_sensor(extent, 1)
    effect = VOCABULARY[name].for_extent(extent)
    model = Model(sensor, (effect,), plan)
    z = np.concatenate([np.zeros(sensor.n_params), model.z_of_last_effect(np.array([settings]))[0]])
    return Rival(name.replace("_", " "), model, z, 0.01 * np.eye(len(z)), probability)


@pytest.mark.parametrize(
    "rivals",
    [
        {"edge_misplacement": [0.4], "sensor_tilt": [-0.4, 0.0]},
        {"edge_misplacement": [0.4], "sensor_tilt": [-0.4, 0.0], "backlash": [-0.8]},
        {"height_gradient": [0.01], "albedo_gradient": [-0.0014, 0.0]},
    ],
)
def test_what_the_same_sheet_cannot_tell_another_does(rivals, tmp_path):
    plan = paper_plan()
    asked = measurement_separating_rivals(
        [rival(name, 1 / len(rivals), own, plan) for name, own in rivals.items()], 0.4, plan, LightSensorApparatus()
    )
    assert asked is not None
    assert len(asked.plan) <= MOST_ADVISED_READINGS
    assert {asked.plan.pattern_names[k] for k in asked.plan.pattern} - plan.patterns.keys()
    assert asked.expected_log_bayes_factor > 3
    assert asked.between == tuple(name.replace("_", " ") for name in rivals)
    assert len(set(asked.plan.scan_names)) == len(asked.plan.scan_names)
    assert (np.diff(asked.plan.time_s) > 0).all()
    assert asked.plan.time_s[0] > plan.time_s[-1]
    # What is asked for can be written, read by whoever carries it out, and predicted.
    write_plan(asked.plan, tmp_path / "next_plan.csv")
    read = read_plan(tmp_path / "next_plan.csv")
    assert read.patterns == {name: asked.plan.patterns[name] for name in read.patterns}
    np.testing.assert_allclose(read.x_mm, asked.plan.x_mm, atol=1e-9)


def test_readings_separate_hypotheses_into_classes():
    """Of three, two predict the same: these are in one class, and what is promised is to tell it from the third."""
    plan = paper_plan()
    lag, play = rival("lag", 0.4, [0.5], plan), rival("backlash", 0.2, [0.84], plan)
    same = replace(play, model=replace(play.model, effects=(replace(play.model.effects[0]),)))
    object.__setattr__(same.model.effects[0], "name", "twin")
    asked = measurement_separating_rivals([lag, play, same], 0.4, plan, LightSensorApparatus())
    assert asked is not None
    assert asked.classes_among(asked.effects) == [[0], [1, 2]]
    assert asked.classes_among([("backlash",), ("twin",)]) == [[1, 2]]
    assert asked.classes_among([("lag",), ("twin",)]) == [[0], [2]]
    assert asked.classes_among([("lag",), ("glint",)]) == [[0]]
    apart = np.array([asked.nats[0, 1:].min(), asked.nats[1, 0], asked.nats[2, 0]])
    assert asked.expected_log_bayes_factor == pytest.approx(np.array([0.5, 0.25, 0.25]) @ apart)
    assert apart.min() > 3
    both = measurement_separating_rivals([play, same], 0.4, plan, LightSensorApparatus())
    assert both is None or both.expected_log_bayes_factor == pytest.approx(0.0, abs=1e-6)


def read_by(plan: Plan) -> np.ndarray:
    chain = Chain(SPOT, FixedLevels(0.0, 1.0), KnownScene(plan.patterns), ())
    return chain.predict(np.empty((1, 0)), plan)[0]


def laid(plan: Plan, scan: str) -> Plan:
    return next(command.plan for command in target_swaps(plan) if command.plan.scan_names == (scan,))


@pytest.mark.parametrize("edge", [HalfPlane(0.0, 7.0), HalfPlane(0.4, -3.0, inside=0.2, outside=0.9)])
def test_a_sheet_turned_by_a_quarter_reads_the_same_along_the_other_axis(edge):
    """A round spot cannot tell that both were turned."""
    plan = replace(paper_plan(), y_mm=paper_plan().y_mm + 4.0)
    plan = replace(plan, patterns={**plan.patterns, "boundary": edge})
    turned = laid(plan, "boundary_quarter_4")
    at = np.arange(0, 101, 4)
    assert np.ptp(turned.x_mm) == pytest.approx(0.0, abs=1e-12)
    (pattern,) = (turned.patterns[name] for name, _ in turned.rows_by_pattern())
    assert pattern.normal_rad == pytest.approx(edge.normal_rad + math.pi / 2)
    np.testing.assert_allclose(read_by(turned), read_by(plan)[at], atol=1e-12)


def searched(probabilities, plan, fits):
    """What a search has found: the probability of each combination on the mean, and refits of some of them."""
    apparatus = LightSensorApparatus()
    recording = Recording(plan, np.zeros(len(plan)))
    prepared = SimpleNamespace(recording=recording, everything=recording, apparatus=apparatus, effects={})
    return SimpleNamespace(
        prepared=prepared,
        certain=(),
        posterior=SimpleNamespace(marginal_over_noise=probabilities),
        best_refit_of=lambda names, certain: fits.get(names),
    )


def refit(name: str, settings: list[float], plan: Plan) -> SimpleNamespace:
    own = rival(name, 0.0, settings, plan)
    found = SimpleNamespace(model=own.model, z=own.z, slopes=np.eye(len(plan))[:, : len(own.z)])
    return SimpleNamespace(names=(name,), found=found, whitened_sd=0.4)


@pytest.mark.parametrize(
    ("lag", "play", "advised"), [(0.5, 0.5, True), (0.93, 0.07, True), (0.984, 0.016, False), (0.02, 0.98, False)]
)
def test_readings_are_advised_only_where_a_question_is_open(lag, play, advised):
    """They would tell a lag from backlash by many nats, whatever their probabilities."""
    plan = paper_plan()
    fits = {("lag",): refit("lag", [0.5], plan), ("backlash",): refit("backlash", [0.84], plan)}
    found = searched({("lag",): lag, ("backlash",): play}, plan, fits)
    asked = choose_next_measurement(found, refit("lag", [0.0], plan), unknown_shows_in=None, is_unknown=False)
    assert is_settled(found) is not advised
    assert (asked is not None) is advised
    assert asked is None or asked.expected_log_bayes_factor >= ENOUGH_NATS


def test_the_next_readings_of_an_unknown_effect_go_where_its_residuals_lie():
    plan = paper_plan()
    scan = plan.scan_names[1]
    x = plan.x_mm.copy()
    inside = plan.scan == 1
    shown = Place(
        "place",
        scan,
        float(x[inside].min()),
        float(x[inside].max()),
        1e-9,
        9.0,
        np.array([0.0, 999.0]),
        np.full(2, 0.8),
        values=np.where(inside, x, np.nan),
    )
    null = refit("lag", [0.0], plan)
    found = searched({("unknown",): 1.0}, plan, {})
    asked = choose_next_measurement(found, null, unknown_shows_in=shown, is_unknown=True)
    assert asked is not None
    assert f"scan {scan} " in asked.description + " "
    faint = replace(shown, curve_mean=np.full(2, 1e-3))
    assert choose_next_measurement(found, null, unknown_shows_in=faint, is_unknown=True) is None


APPARATUS = SimulatorApparatus(ABOUT)
NULL = Model(cast(Any, ABOUT.system), (), cast(Any, TABLE))


def rival_of_new_runs(model: Model, z: np.ndarray, root: float = 1e-9) -> Rival:
    return Rival("a", model, z, root * np.eye(len(z)), 0.5, APPARATUS.coordinates_of_new_run(model))


def test_the_gain_of_the_heater_tells_as_much_as_a_run_with_its_own_start_can():
    """By a second route: the start is fitted to the new run, by least squares with its prior."""
    other = ABOUT.z + np.array([0.3, 0.0, 0.4, -0.3, 0.2])
    rivals = [rival_of_new_runs(NULL, ABOUT.z), rival_of_new_runs(NULL, other)]
    asked = measurement_separating_rivals(rivals, 0.05, cast(Any, TABLE), APPARATUS)
    assert asked is not None
    table = cast(Any, asked.plan)
    apart = np.subtract(*(NULL.predict(z[None, :], asked.plan)[0] for z in (other, ABOUT.z))) / 0.05
    left = 0.0
    for rows in table.rows_by_scan():
        ones = np.append(np.full(len(rows), 5 / 0.05), 1.0)
        own = np.append(apart[rows], 0.0)
        left += float(np.sum((own - ones * (ones @ own) / (ones @ ones)) ** 2))
    assert asked.expected_log_bayes_factor == pytest.approx(left / 2, rel=0.02)


def simulate(p, data):
    return p["off"] + p["slope"] * data["x"]


SIMULATOR_OF_ALIASES = Simulator(
    reading="y_v",
    unit="V",
    run="day",
    parameters={"slope": (-10, 10), "off": ("normal", 0, 10)},
    per_run=("off",),
    noise=Noise(sd=0.1),
    simulate=simulate,
)


def table() -> RunTable:
    """Three days of twelve readings, which the temperature shifts: so does an offset that depends on it."""
    rng = np.random.default_rng(3)
    x, temp_c = rng.uniform(0, 3, 36), 20 + 2 * rng.standard_normal(36)
    y_v = np.repeat([1.0, 1.3, 0.7], 12) + 2 * x + 0.3 * (temp_c - 20) + 0.1 * rng.standard_normal(36)
    return RunTable({"day": np.repeat(["a", "b", "c"], 12), "x": x, "temp_c": temp_c, "y_v": y_v}, run="day")


def test_where_no_readings_separate_the_named_hypotheses_the_verdict_says_so():
    diagnosis = diagnose_system(SIMULATOR_OF_ALIASES, table(), rng=np.random.default_rng(1))
    nothing = diagnosis.apparatus.words.settles_nothing
    assert diagnosis.verdict == "cannot_tell"
    assert TO_SEPARATE not in diagnosis.reason
    for name in ("off that depends on temp_c", "readings that depend on temp_c"):
        assert f"{name} (0.48)" in diagnosis.reason
    assert diagnosis.reason.endswith(f"; {nothing}.")
    assert diagnosis.next_measurement is None


def test_a_value_per_run_separates_nothing_that_a_start_of_each_run_absorbs():
    """An offset of each run and a start of each run are the same in a new run too, which has one of each."""
    prepared = prepare_system(SIMULATOR, runs(rng=np.random.default_rng(3), n=20))
    system, recording = cast(Any, prepared.null), prepared.recording
    law = white_noise_of_recording(recording)
    found = fit(Model(system, (), recording.plan), recording, system.first, law)
    names = "offset_per_run", "depends:start_c:room_c"
    entries = {name: (prepared.effects[name], prepared.effects[name].entries[0]) for name in names}
    nothing = prepared.apparatus.words.settles_nothing
    alike = [Alias(names, 1.0, nothing, 0)]
    rows = np.arange(len(recording.readings))
    (alias,) = pairs_with_separating_scans(alike, Linearised.of(found, law), found, entries, rows, prepared.apparatus)
    assert (alias.settle_by, alias.readings) == (nothing, 0)


def without_controls():
    plan = two_way_plan()
    return replace(plan, instrumentation=replace(plan.instrumentation, controls=()))


def lying(plan):
    return plan.pattern_names[int(plan.pattern[np.argmax(plan.time_s)])]


def test_without_hands_all_scans_are_over_what_lies_there():
    plan = without_controls()
    offered = LightSensorApparatus(hands=False).candidate_measurements(plan)
    assert offered
    assert {scan.plan.pattern_names[int(k)] for scan in offered for k in scan.plan.pattern} == {lying(plan)}
    assert "lay" not in {scan.kind for scan in offered}
    assert len(offered) < len(LightSensorApparatus().candidate_measurements(plan))


def test_a_scan_that_returns_after_a_whole_turn_is_the_same_scan_at_the_same_orientation():
    """It is neither offered twice, nor a value of the covariate `orientation`."""
    plan = two_way_plan()
    turned = replace(plan, orientation_rad=plan.orientation_rad - 2 * np.pi * (plan.scan % 2))
    assert [scan.tolist() for scan in rows_of_distinct_scans(turned)] == [
        scan.tolist() for scan in rows_of_distinct_scans(plan)
    ]
    level, everything = np.linspace(0.0, 1.0, len(plan)), np.arange(len(plan))

    def orientations(of):
        found = varying_covariates(of, everything, level, level)
        return next(
            np.unique(covariate.values, return_inverse=True)[1]
            for covariate in found
            if covariate.name == "orientation"
        )

    kinds = orientations(plan)
    assert len(set(zip(kinds, orientations(turned), strict=True))) == kinds.max() + 1


def test_a_scan_is_raised_from_the_height_at_which_it_was_taken():
    plan = two_way_plan()
    plan = replace(plan, instrumentation=replace(plan.instrumentation, controls=("height_mm",), height_mm=16.0))
    second, third = rows_of_distinct_scans(plan)[1:3]
    heights = np.full(len(plan), np.nan)
    heights[second], heights[third[::2]] = 20.0, 20.0
    lifted = replace(plan, covariates={**plan.covariates, "height_mm": heights})
    raised = [scan for scan in candidate_scans(lifted) if scan.kind == "raise"]
    np.testing.assert_array_equal(raised[0].plan.covariates["height_mm"], 20.0)
    np.testing.assert_array_equal(raised[1].plan.covariates["height_mm"], 25.0)
    np.testing.assert_array_equal(np.unique(raised[2].plan.covariates["height_mm"]), [20.0, 25.0])
    endings = ("with the sensor at 20 mm", "with the sensor at 25 mm", "with the sensor at 1.25 times its height")
    assert all(scan.description.endswith(words) for scan, words in zip(raised[:3], endings, strict=True))
