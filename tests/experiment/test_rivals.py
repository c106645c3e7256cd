"""What a sensor model may leave out, weighed along with the shape."""

import json
import math
import pickle
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hand_made import sensor_of
from scipy.integrate import quad
from scipy.stats import norm

from probewise import scene
from probewise.arm import Pose, Reading
from probewise.calibration import posterior_mean_ssf_field, predict, read_sensor, write_sensor
from probewise.effects import Origin
from probewise.errors import ParameterError
from probewise.experiment import (
    CLEAN,
    Exploration,
    begin,
    experiment_for,
    left_out_after_step,
    repaired_sensor,
    result_json,
    step,
)
from probewise.experiment.inquire import (
    ENDS_RUN_LABEL,
    ENOUGH_BITS,
    INFORMATION_LABEL,
    LEFT_OUT_LABEL,
    ArmReachAndTravel,
    expected_bits_about_left_out,
    far_side,
    predict_readings_and_utilities,
    utilities_near_end,
)
from probewise.experiment.judgement import trend_of_residuals
from probewise.experiment.kinds import PosteriorByKind, prior_posterior
from probewise.experiment.noise_rivals import DeclaredNoise, noise_likelihoods
from probewise.experiment.rivals import rivals_of
from probewise.inference import Rounded
from probewise.inquiry import Readout
from probewise.proof.concealed_study import ConcealedTrial, _arm_in_concealed_world
from probewise.proof.study import REFERENCE, Trial, arm_of, experiment_of, timed_steps
from probewise.recordings import Plan, Recording, Uniform
from probewise.report.exploration import page_html, robot_view_png


@pytest.fixture(scope="module")
def doubting():
    return replace(experiment_of(REFERENCE), trust=0.9, n_particles=600, n_samples=20)


@pytest.fixture(scope="module")
def stepped(doubting):
    """Two steps of a run that doubts, both of the prior's first places."""
    rng = np.random.default_rng(3)
    with arm_of(Trial(REFERENCE, 0)) as arm:
        state = begin(doubting, arm, rng=rng)
        found = []
        for _ in range(2):
            reading = arm.measure(state.next_pose)
            state, info = step(state, reading, doubting, rng=rng, max_readings=2)
            found.append(info)
    return found


@pytest.fixture
def sensor():
    """A sensor as calibrated: one Gaussian, its posterior narrow about it."""
    truth = np.array([1.0, 0.5, 1.5, 0.03, 0.08, -0.005, 11.0, 58.0])
    sd = np.array([0.0, 0.03, 0.03, 0.001, 0.002, 0.0005, 0.05, 0.05])
    samples = truth + sd * np.random.default_rng(11).standard_normal((500, 8))
    return sensor_of(samples, noise_sd=np.full(500, 0.5), field=posterior_mean_ssf_field(samples, 1, pixel_mm=0.5))


def rivals():
    plain = experiment_of(REFERENCE)
    return rivals_of(plain.model, plain.likelihood, (1048.0, 520.0))


def test_the_rivals_share_what_trust_leaves(doubting):
    prior: dict[str, float] = {}
    for kind in doubting.kinds:
        prior[kind.left_out] = prior.get(kind.left_out, 0.0) + math.exp(kind.log_prior)
    assert prior.pop("") == pytest.approx(0.9)
    np.testing.assert_allclose(list(prior.values()), 0.1 / len(prior))
    assert {"backlash", "saturation", "dropouts", "outliers", "flicker", "edge_shadow", "quantisation"} <= set(prior)
    assert {"hysteresis", "lag"} <= set(prior)  # a run comes from every side


@pytest.mark.parametrize(
    ("row", "trust"),
    [
        (replace(REFERENCE, model="naive"), 0.9),
        (replace(REFERENCE, learn_sensor=True), 0.9),
        (REFERENCE, 0.0),
        (REFERENCE, 1.5),
    ],
)
def test_trust_is_a_probability_and_below_one_only_for_a_sensor_that_has_rivals(row, trust):
    assert [kind.left_out for kind in experiment_of(row).kinds] == [""]
    with pytest.raises(ParameterError, match="trust"):
        replace(experiment_of(row), trust=trust)


def test_every_rival_reaches_another_process():
    for rival in rivals():
        again = pickle.loads(pickle.dumps(rival))
        assert again.name == rival.name


def test_a_rival_is_of_a_size_and_at_a_time_that_a_run_can_show():
    found = {rival.name: rival.effect.prior.marginals for rival in rivals() if rival.effect is not None}
    width, at_s = found["backlash"]["width_mm"], found["ambient_step"]["at_s"]
    assert width.to_unit(np.array([0.5]))[0] < 0.3
    run_of_twelve = at_s.to_unit(np.array([4.0, 12 * 8.0]))
    assert run_of_twelve[0] == 0.0
    assert run_of_twelve[1] > 0.5
    assert at_s.to_unit(np.array([99 * 8.0]))[0] < 1.0  # nor is a run of a hundred readings safe from it


LEVELS = (10.0, 60.0)


def laws(*names):
    return [rival.likelihood for rival in rivals() if rival.name in names]


@pytest.mark.parametrize("law", laws("outliers", "correlated_noise", "flicker"))
def test_laws_of_the_residual_alone_are_densities(law):
    """As the level goes over all levels, so does the residual; its density is one."""
    level = np.linspace(-600.0, 670.0, 60_001)
    density = np.exp(law.log_prob(np.array([35.0]), level[:, None]))
    assert np.trapezoid(density, level) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("law", laws("dropouts", "signal_dependent_noise", "quantisation"))
def test_laws_of_the_noise_are_densities(law):
    """The density of one reading over all readings is one."""

    def density(reading):
        return math.exp(law.log_prob(np.array([reading]), np.array([[35.0]]))[0])

    breaks = [-0.001, 0.001, 9.99, 10.0, 10.01, 15.0, 30.0, 35.0, 40.0, 60.0, 64.999, 65.001]
    total = quad(density, -200.0, 270.0, points=breaks, limit=400)[0]
    assert total == pytest.approx(1.0, abs=0.01)


NOISE_ON_A_SCALE = DeclaredNoise.from_likelihood(Rounded(sd=2.0, step=1.0, low=4.0, high=36.0))


@pytest.mark.parametrize("name", ["outliers", "dropouts", "correlated_noise", "signal_dependent_noise", "flicker"])
def test_readings_at_an_end_of_the_scale_cover_everything_beyond(name):
    """The probabilities of all readings of a scale, both ends among them, add up to one."""
    law = noise_likelihoods(NOISE_ON_A_SCALE, (4.0, 36.0))[name]
    cells = np.arange(4.0, 37.0)
    total = sum(math.exp(law.log_prob(np.array([cell]), np.array([[35.3]]))[0]) for cell in cells)
    assert total == pytest.approx(1.0, abs=3e-3)


def test_the_result_holds_hypotheses_a_credible_set_and_a_sentence(doubting, stepped):
    document = json.loads(result_json(Exploration(doubting, tuple(stepped))))["left_out"]
    assert sum(h["probability"] for h in document["hypotheses"]) == pytest.approx(1.0)
    assert document["hypotheses"][0]["effects"] == []
    assert document["credible_set"][0] == CLEAN
    assert "leaves nothing out that shows" in document["sentence"]
    assert "tilt" in document["sentence"]


def weighed(info, change):
    """The step with `change(index, left_out)`, fields of the weighted samples, made to each kind's."""
    particles = tuple(
        replace(p, weighted=replace(p.weighted, **change(k, kind.left_out)))
        for k, (kind, p) in enumerate(zip(info.by_kind.kinds, info.by_kind.particles, strict=True))
    )
    return replace(info, by_kind=replace(info.by_kind, particles=particles))


def leading(info, name):
    """The step as if one rival led."""
    return weighed(info, lambda _, left_out: {"log_z": 0.0 if left_out == name else -40.0})


def test_what_leads_is_said_with_its_numbers(stepped):
    said = left_out_after_step(leading(stepped[-1], "backlash"), 0.9)
    assert said.leading == "backlash"
    assert said.credible_set == ("backlash",)
    two = left_out_after_step(leading(stepped[-1], "dark_level+gain"), 0.9)
    assert two.as_json()["hypotheses"][0]["effects"] == ["dark_level", "gain"]
    assert "other light; and since the calibration the signal" in two.sentence
    assert "gear play of" in said.sentence


def test_a_step_of_the_light_is_told_by_the_clock_of_the_readings(stepped):
    info = leading(stepped[-1], "ambient_step")
    early, late = (
        left_out_after_step(replace(info, pace=replace(info.pace, start_s=start_s)), 0.9).sentence
        for start_s in (0.0, 5000.0)
    )
    at_s = [float(re.search(r" at (\d+) ", said)[1]) for said in (early, late)]
    assert at_s[1] - at_s[0] == pytest.approx(5000.0, abs=1.0)


def test_a_name_that_the_warier_odds_leave_open_is_in_the_credible_set(stepped):
    """Two routes: the odds of a name by hand, fourteen times those of a run that expects a fault one time in ten."""
    last = leading(stepped[-1], "")
    for name, log_z in (("dropouts", 0.0), ("halo", -2.5)):
        last = weighed(last, lambda _, own, name=name, log_z=log_z: {"log_z": log_z} if own == name else {})
    share = 0.1 / (len({kind.left_out for kind in last.by_kind.kinds}) - 1)
    plain, wary = share / (0.9 + share), 14.0 * share / (0.9 + 14.0 * share)
    said = left_out_after_step(last, 0.9)
    assert said.probability["dropouts"] == pytest.approx(plain, rel=0.01)
    assert plain < 0.05 < wary
    assert said.credible_set == (CLEAN, "dropouts")


def test_a_reading_tells_names_by_what_they_predict():
    """Expected information about a name: none where names agree, its entropy where they do not, else by quadrature."""
    weight, names = np.full(400, 1 / 400), np.repeat(["", "halo"], 200)
    even = norm.ppf((np.arange(200) + 0.5) / 200)
    alike = np.tile(20.0 + 3.0 * even, 2)
    apart = np.concatenate([20.0 + 3.0 * even, 90.0 + 3.0 * even])
    near = np.concatenate([20.0 + 0.5 * even, 23.0 + 2.0 * even])
    bits = expected_bits_about_left_out(weight, np.stack([alike, apart, near], axis=1), names, Readout(1.0))
    at = np.linspace(-20.0, 60.0, 20_001)
    given = [norm.pdf(at, mean, math.hypot(sd, 1.0)) for mean, sd in ((20.0, 0.5), (23.0, 2.0))]
    both = 0.5 * (given[0] + given[1])
    exact = sum(0.5 * np.trapezoid(each * np.log2(np.maximum(each, 1e-300) / both), at) for each in given)
    assert bits[0] == pytest.approx(0.0, abs=1e-9)
    assert bits[1] == pytest.approx(1.0, abs=1e-6)
    assert bits[2] == pytest.approx(exact, abs=0.01)


@pytest.mark.parametrize(("name", "tested"), [("dropouts", False), ("", True)])
def test_the_fit_is_tested_where_the_declared_noise_leads(doubting, stepped, monkeypatch, name, tested):
    """Chi-square is of that noise alone."""
    index = [kind.left_out for kind in doubting.kinds].index(name)
    monkeypatch.setattr(PosteriorByKind, "most_probable_kind_index", index)
    rng = np.random.default_rng(4)
    with arm_of(Trial(REFERENCE, 0)) as arm:
        state = begin(doubting, arm, rng=rng)
        _, info = step(state, stepped[0].reading, doubting, rng=rng, max_readings=1)
    assert (info.p_value is not None) == tested
    found = Exploration(doubting, (info,))
    said = "not tested: the most probable noise is not the declared one"
    assert (f"fit          {said}" in found.summary().splitlines()) == (not tested)
    frame = robot_view_png(info, doubting, [], levels=(10.0, 60.0))
    page = page_html(found, frame, frame, seed=1, model="ssf")
    assert (said in page) == (not tested)
    assert not doubting.fit_is_doubtful(info.p_value)


def utilities_near_end_of_kind(experiment, left_out, sd_mm):
    """Return the utilities by the plain sensor, and by the kind, of a circle that is known so well."""
    rng = np.random.default_rng(1)
    posterior = prior_posterior([kind for kind in experiment.kinds if kind.left_out == left_out], 600, rng=rng)
    (particles,) = posterior.particles
    theta = np.array([500.0, 260.0, 90.0]) + np.array(sd_mm) * rng.standard_normal((600, 3))
    weighted = replace(particles.weighted, theta=theta)
    posterior = replace(posterior, particles=(replace(particles, weighted=weighted),))
    readings = (Reading(35.0, Pose(500.0, 170.0), 8.0), Reading(35.0, Pose(500.0, 350.0), 16.0))
    with arm_of(Trial(REFERENCE, 0)) as arm:
        reach = ArmReachAndTravel.from_instrument(arm, experiment.grid)
    of = predict_readings_and_utilities(experiment, weighted, theta[:20], reach, at=readings[-1], goal=experiment.goal)
    return of[1], utilities_near_end(experiment, posterior, *of, readings, mean=theta.mean(axis=0), rng=rng)


@pytest.mark.parametrize("left_out", ["", "noise_sd"])
def test_far_from_the_end_the_plain_sensor_chooses_until_it_is_surely_incomplete(doubting, left_out):
    plain, there = utilities_near_end_of_kind(doubting, left_out, (90.0, 90.0, 9.0))
    assert (there is plain) == (left_out == "")
    assert there.label == (INFORMATION_LABEL if left_out else plain.label)


@pytest.mark.parametrize(
    ("sd_mm", "what"),
    [((30.0, 30.0, 9.0), INFORMATION_LABEL), ((6.0, 1.0, 1.0), ENDS_RUN_LABEL)],
    ids=["far from the end", "near the end"],
)
def test_near_the_end_repeats_are_worth_more_than_one_reading(doubting, sd_mm, what):
    """At every place that is a candidate with one reading and with nine: the noise of their mean is a third."""
    _, there = utilities_near_end_of_kind(replace(doubting, repeats=(1, 9), noise_sd=6.0), "", sd_mm)
    assert there.label == what
    once, nine_times = there.values.reshape(2, -1)
    both = (once > 0) & (nine_times > 0)
    assert both.sum() > 5
    more = nine_times[both] - once[both]
    assert more.min() > -1e-3
    assert more.mean() > 0.03


@pytest.mark.parametrize(("angles_deg", "asked_deg"), [((0, 20, 40), 200), ((0, 120, 240), None), ((0, 180), None)])
def test_the_side_that_no_reading_has_seen_is_asked(doubting, angles_deg, asked_deg):
    """A circle's edge read from one side leaves its other side, from three sides or two opposite ones none."""
    x, y, radius = 500.0, 260.0, 90.0
    on_edge = [
        Reading(35.0, Pose(x + radius * math.cos(a), y + radius * math.sin(a)), 8.0) for a in np.radians(angles_deg)
    ]
    inside = Reading(60.0, Pose(x - 0.6 * radius, y), 0.0)
    joined = prior_posterior(doubting.kinds[:1], 600, rng=np.random.default_rng(1)).particles[0].weighted
    with arm_of(Trial(REFERENCE, 0)) as arm:
        reach = ArmReachAndTravel.from_instrument(arm, doubting.grid)
    inputs, _ = predict_readings_and_utilities(
        doubting, joined, joined.theta[:20], reach, at=inside, goal=doubting.goal
    )
    missing = [
        replace(r, value=math.nan, pose=Pose(2 * x - r.pose.x_mm, 2 * y - r.pose.y_mm)) for r in on_edge
    ]  # on the far side, without a value
    there, region = doubting.grid.places_mm[inputs.rows], doubting.shape.region(np.array([[x, y, radius]]))
    far, shows_it = far_side(there, doubting.grid, region, (inside, *on_edge, *missing))
    opposite = np.array([[x + radius * math.cos(a), y + radius * math.sin(a)] for a in np.radians([200.0, 60.0])])
    tried = np.concatenate([opposite, [[x, y]]])
    assert shows_it(tried).tolist() == ([True, False, False] if asked_deg else [True, True, True])
    if asked_deg is None:
        assert far is None
        return
    place = doubting.grid.places_mm[inputs.rows[far] % doubting.grid.n_places]
    asked = x + radius * math.cos(math.radians(asked_deg)), y + radius * math.sin(math.radians(asked_deg))
    assert np.hypot(*(place - asked)) < 12.0


def test_a_repaired_sensor_holds_the_effect_that_leads(sensor, stepped):
    rng = np.random.default_rng(1)
    assert repaired_sensor(sensor, stepped[-1], rng=rng) is sensor
    mended = repaired_sensor(sensor, leading(stepped[-1], "saturation"), rng=rng)
    assert mended.effects == ("saturation",)
    again = type(sensor).from_json(mended.to_json())
    assert again.mean()["saturation.level"] == pytest.approx(mended.mean()["saturation.level"])
    told = repaired_sensor(sensor, leading(stepped[-1], "dropouts"), rng=rng)
    assert told.effects == ()
    assert any("dropouts" in note for note in told.notes)


def test_an_effect_that_a_diagnosis_left_open_is_held_once_a_run_finds_it(sensor, stepped):
    """The run's model is the most probable combination of effects, which had the response bent but no saturation."""
    level, softness = np.full(500, 90.0), np.full(500, 1.0)
    few = np.arange(500) % 5 > 0
    open_ = replace(
        sensor,
        names=(*sensor.names, "nonlinearity.gamma", "saturation.level", "saturation.softness"),
        samples=np.column_stack([sensor.samples, np.full(500, 1.1), level, softness]),
        effects=("nonlinearity", "saturation"),
        absent={"saturation": few, "nonlinearity": ~few},
    )
    info = leading(stepped[-1], "saturation")
    mended = repaired_sensor(open_, info, rng=np.random.default_rng(1))
    assert mended.effects == ("nonlinearity", "saturation")
    assert not mended.absent
    found = info.by_kind.particles[[kind.left_out for kind in info.by_kind.kinds].index("saturation")].weighted
    assert mended.mean()["saturation.level"] == pytest.approx(found.mean()[-2], rel=0.1)
    assert type(sensor).from_json(mended.to_json()).effects == mended.effects


def test_an_effect_found_in_a_run_counts_from_0_beside_one_from_far_away(sensor, stepped):
    """A bright margin of the run's field: over black it adds its gradients times the run's own places."""
    far = replace(
        sensor,
        names=(*sensor.names, "position_scale.x", "position_scale.y"),
        samples=np.pad(sensor.samples, ((0, 0), (0, 2))),
        effects=("position_scale",),
        origins={"position_scale": Origin(x_mm=2000.0)},
    )
    mended = repaired_sensor(far, leading(stepped[-1], "ambient_gradient"), rng=np.random.default_rng(1))
    mended = type(sensor).from_json(mended.to_json())
    assert {e.name: e.binding.where.origin.x_mm for e in mended.effects_on_new_scans} == {
        "position_scale": 2000.0,
        "ambient_gradient": 0.0,
    }
    black, per_mm_x, per_mm_y = (mended.mean()[n] for n in ("I_min", *mended.names[-2:]))
    plan = Plan.from_arrays(x_mm=[0.0, 300.0, 0.0], y_mm=[0.0, 0.0, 200.0], patterns=Uniform(0.0), unit="LEGO")
    expected = black + np.array([0.0, 300 * per_mm_x, 200 * per_mm_y])
    np.testing.assert_allclose(predict(mended, plan).mean, expected, rtol=1e-9)


@pytest.mark.slow
def test_a_run_that_knows_the_shape_asks_what_the_sensor_leaves_out():
    """A step of the light, which would move the circle by 8 mm at a claimed 2.4 mm if it were not looked for."""
    trial = ConcealedTrial("ambient_step", 1, 0, 0.9, 40, 8101)
    experiment = replace(experiment_of(REFERENCE), trust=0.9)
    steps = [
        s for s, _ in timed_steps(_arm_in_concealed_world(trial), experiment, seed=8101, circle=0, max_readings=40)
    ]
    known = [step.number for step in steps if step.largest_sd_mm < 4.0 and step.chance_off < 0.01]
    assert [step.number for step in steps if step.checks_sensor] == known[:-1]
    assert steps[-1].map.label == LEFT_OUT_LABEL
    assert steps[-1].map.highest_utility < ENOUGH_BITS
    assert left_out_after_step(steps[-1], 0.9).credible_set == ("ambient_step",)
    assert np.abs(steps[-1].mean - trial.true_circle_in_arm_frame).max() < 2.0


BOTH = [10.0, 60.0] * 6
HEARD = {
    "correlated_noise": ([35.0] * 12, 1.5 * np.ones(12), 1.5 * np.tile([1.0, -1.0, -1.0, 1.0], 3), 3.0),
    "signal_dependent_noise": (BOTH, np.tile([0.5, 4.0, -0.5, -4.0], 3), np.tile([1.0, -0.5], 6), 5.0),
    "dropouts": ([60.0, 10.0, 10.0, 10.0, 60.0], [0.3, 0.0, 0.0, 0.0, -0.9], [0.3, 0.4, -0.8, 0.9, -0.9], 5.0),
}
"""By law: levels, errors that speak for it, errors of plain noise, and the least gain in nats from the first.

Errors that repeat each other; errors that grow with the light; three readings black to the last digit."""


@pytest.mark.parametrize("name", HEARD)
def test_a_law_of_the_noise_is_heard_in_its_errors_and_not_in_others(name):
    level, speaking, plain, least = HEARD[name]
    law, usual = noise_likelihoods(DeclaredNoise(1.0, 0.0), LEVELS)[name], experiment_of(REFERENCE).likelihood
    gained = [
        float((law.log_prob(read, np.array([level])) - usual.log_prob(read, np.array([level])))[0])
        for read in (np.array(level) + np.array(errors) for errors in (speaking, plain))
    ]
    assert gained[0] > least
    assert gained[1] < 0.5


@pytest.mark.parametrize("read", [[10.0, 10.0, 10.0, 10.0], [10.0, 5.0, 10.0, 10.0, 5.0]])
def test_one_or_two_values_that_recur_are_rounded_rather_than_lost(read):
    """Before a shape is seen all is black: readings of 10.0 and 5.0 are no lost ones, and places without a shape.

    So it is where a step is only the width of a cell, as `experiment_for` describes a sensor that declares none.
    """
    readings, level = np.array(read), np.full((1, len(read)), 9.0)
    cells = Rounded(1.0, 1.0 / 8.0, whole_steps=False)
    for noise in (DeclaredNoise(1.0, 0.0), DeclaredNoise.from_likelihood(cells)):
        of_noise = noise_likelihoods(noise, LEVELS)
        rounded, lost = (of_noise[name].log_prob(readings, level)[0] for name in ("quantisation", "dropouts"))
        assert rounded > lost + 2.0
    assert rounded > cells.log_prob(readings, level)[0] + (2.0 if len(read) == 5 else 1.0)
    rounded, lost = noise_likelihoods(DeclaredNoise(1.0, 0.0), LEVELS)["quantisation"], laws("dropouts")[0]
    shared = np.array([10.0, 9.31, 10.72, 8.4, 10.0])  # two were lost, the others were read
    level = np.full((1, 5), 9.6)
    assert lost.log_prob(shared, level)[0] > rounded.log_prob(shared, level)[0] + 2.0


@pytest.mark.parametrize(
    ("plain", "level", "read"),
    [
        (Rounded(sd=1.0, step=1.0, low=0.0, high=100.0), 101.0, [100.0] * 6),
        (Rounded(sd=0.6, step=1.0, low=1.0, high=100.0), 10.2, [10.0] * 6),
        (Rounded(sd=0.6, step=1.0, low=1.0, high=100.0), 10.2, [10.0, 11.0, 10.0, 10.0, 11.0, 10.0]),
    ],
)
def test_readings_at_an_end_or_rounded_as_declared_recur_by_nature(plain, level, read):
    law = noise_likelihoods(DeclaredNoise.from_likelihood(plain), LEVELS)["quantisation"]
    of = np.array(read), np.full((1, 6), level)
    assert law.log_prob(*of)[0] == pytest.approx(plain.log_prob(*of)[0], abs=1e-3)


PLAYED = [(846.5, 260.0), (854.5, 260.0), (846.5, 243.8), (854.5, 178.8), (967.4, 243.8), (886.8, 162.5)]
"""Places about a circle, taken from all sides."""


def test_play_of_each_axis_stays_on_the_side_that_the_axis_last_moved_to(doubting):
    """Place by place, by hand: an axis that rests keeps its side; whence the arm came to its first place is unknown."""
    kind = [kind for kind in doubting.kinds if kind.left_out == "backlash"][1]
    places = [(850.0, 240.0), (860.0, 240.0), (860.0, 250.0), (850.0, 250.0), (850.0, 255.0)]
    sides = [(0, 0), (1, 1), (1, 1), (-1, 1), (-1, 1)]
    taken = [Reading(10.0, Pose(x, y), 8.0 * k) for k, (x, y) in enumerate(places)]
    short = [
        Reading(10.0, Pose(x - 3.0 * a, y - 3.0 * b), 8.0 * k)
        for k, ((x, y), (a, b)) in enumerate(zip(places, sides, strict=True))
    ]
    circle = np.array([[922.0, 240.0, 77.0]])
    right = doubting.kinds[0].model.predict(circle, doubting.problem(short).recording.plan)
    found = kind.model.predict(np.append(circle, [[6.0]], axis=1), doubting.problem(taken).recording.plan)
    np.testing.assert_allclose(found, right, atol=1e-6)


def test_play_of_each_axis_is_so_after_the_file_of_the_repaired_sensor_too(doubting, sensor, stepped, tmp_path):
    """By hand: after a diagonal move each axis rests half the play short, not its share of the motion's direction."""
    of_axes = [kind.left_out for kind in doubting.kinds].index("backlash") + 1
    info = leading(stepped[-1], "backlash")
    info = weighed(info, lambda k, own: {"log_z": -40.0} if own == "backlash" and k != of_axes else {})
    write_sensor(repaired_sensor(sensor, info, rng=np.random.default_rng(1)), tmp_path / "sensor.json")
    read = read_sensor(tmp_path / "sensor.json")
    plan = Plan.from_arrays(x_mm=[0.0, 3.0], y_mm=[0.0, 4.0], patterns=Uniform(0.5), unit="LEGO")
    theta = read.samples_for_new_scans[:1]
    there = read.chain(scene.KnownScene(plan.patterns)).poses(theta, plan)
    short = theta[0, -1] / 2
    assert short > 0
    np.testing.assert_allclose([there.x_mm[0], there.y_mm[0]], [[-short, 3.0 - short], [-short, 4.0 - short]])
    assert json.loads((tmp_path / "sensor.json").read_text())["effects"] == ["backlash"]


def test_what_changed_since_the_calibration_is_in_the_levels_of_the_repaired_sensor(doubting, sensor, stepped):
    """Two routes: the rival's readings over black and white, and the levels of the sensor that it leaves."""
    plan = doubting.problem([Reading(10.0, Pose(x, 250.0), x) for x in (50.0, 500.0)]).recording.plan
    circle = [500.0, 250.0, 100.0]
    plain = doubting.kinds[0].model.predict(np.array([circle]), plan)
    changes = {"dark_level": [4.0], "gain": [-0.1], "dark_level+gain": [4.0, -0.1]}
    for name, dark, bright in (("dark_level", 4.0, 4.0), ("gain", 0.0, -4.7), ("dark_level+gain", 4.0, -0.7)):
        info = leading(stepped[-1], name)
        which = [kind.left_out for kind in info.by_kind.kinds].index(name)
        found = info.by_kind.particles[which].weighted
        theta = found.theta.copy()
        theta[:, 3:] = changes[name]
        changed = doubting.kinds[which].model.predict(np.array([[*circle, *changes[name]]]), plan)
        np.testing.assert_allclose(changed - plain, [[dark, bright]], atol=0.31)  # of a sensor with a span of 50
        info = weighed(info, lambda k, _, theta=theta, which=which: {"theta": theta} if k == which else {})
        before, after = sensor.mean(), repaired_sensor(sensor, info, rng=np.random.default_rng(1)).mean()
        assert after["I_min"] - before["I_min"] == pytest.approx(dark)
        assert after["I_max"] - before["I_max"] == pytest.approx(bright, rel=0.02)


def test_a_leader_whose_residuals_change_with_the_place_is_not_believed():
    """Two routes: no trend in noise, whatever its law, and one where readings on one side are lost."""
    rng, x = np.random.default_rng(3), np.linspace(0.0, 400.0, 30)
    plan = Plan.from_arrays(x_mm=x, y_mm=100.0 + 50.0 * (np.arange(30) % 2), patterns=Uniform(0.5), unit="LEGO")
    even = rng.permutation(rng.standard_t(2, 30))
    model = SimpleNamespace(predict=lambda theta, plan: np.zeros((1, len(plan))))
    best = SimpleNamespace(theta=np.zeros((1, 1)), log_likelihood=np.zeros(1))
    for readings, said in ((even, ""), (even - 20.0 * (x > 200.0), "changes with the place along X")):
        problem = SimpleNamespace(recording=Recording(plan, readings, ""), model=model)
        assert trend_of_residuals(best, problem) == said


def test_the_next_run_starts_with_the_doubt_that_the_last_one_left(sensor):
    """What a repaired sensor knows of its effect is inferred along with the shape; a run that trusts takes the mean."""
    width = np.random.default_rng(1).normal(6.0, 0.8, (len(sensor.samples), 1))
    again = replace(
        sensor,
        names=(*sensor.names, "backlash.width_mm"),
        samples=np.concatenate([sensor.samples, width], axis=1),
        effects=("backlash",),
    )
    field = scene.Field()
    circle = scene.Circle(field, (50.0, 150.0), inside=True)
    doubted, trusted = (experiment_for(again, circle, field, trust=trust) for trust in (0.9, 1.0))
    plain = doubted.kinds[0]
    assert (plain.left_out, plain.prior.names[3:]) == ("", ("backlash.width_mm",))
    assert "backlash" not in {kind.left_out for kind in doubted.kinds}
    drawn = prior_posterior([plain], 2000, rng=np.random.default_rng(2)).particles[0].weighted
    assert (drawn.mean()[3], drawn.sd()[3]) == pytest.approx((6.0, 0.8), abs=0.1)
    assert trusted.kinds[0].prior.names == circle.prior.names
    places = [Reading(10.0, Pose(x, y), 8.0 * k) for k, (x, y) in enumerate(PLAYED)]
    plan = doubted.problem(places).recording.plan
    theta = np.array([[922.0, 240.0, 77.0, again.mean()["backlash.width_mm"]]])
    found, told = plain.model.predict(theta, plan)[0], trusted.kinds[0].model.predict(theta[:, :3], plan)[0]
    np.testing.assert_allclose(found[1:], told[1:], atol=1e-9)
    assert abs(found[0] - told[0]) > 1.0  # nobody knows whence the arm came
