"""The paper's own method: against sums over a lattice, its likelihoods, its draws, its journal."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from exploring import run
from hand_made import TRUTH, sensor_of

from probewise.arm import ReadingScale
from probewise.arm.instrument import Pose, Reading
from probewise.errors import FileError, NotConvergedError, ParameterError
from probewise.experiment import (
    NestedSampling,
    experiment_for,
    find_shape,
    naive_levels_from_recording,
    naive_levels_from_world,
)
from probewise.experiment.paper import OneScan, student_t_likelihood
from probewise.inference import Naive
from probewise.inquiry import Grid, InformationGain, ReadingEntropy
from probewise.inquiry.entropy import best_designs_mask
from probewise.nested import EvidenceChange, RemainingEvidence
from probewise.recordings import Disc, HalfPlane, Plan, Recording
from probewise.recordings import Uniform as UniformPattern
from probewise.scene import AnyOf, Circle, Field, KnownScene, region_of
from probewise.scene.shapes import Rectangle
from probewise.sensor import (
    Chain,
    FixedLevels,
    FreeMixture,
    Poses,
    footprint_of,
    mean_albedo_by_pixels,
    mean_ssf_field,
    merged_mean_mixture,
)
from probewise.world import Blob, World, gaussian_spot

STUDENT = OneScan(0.3, 50.0)
WIDE = OneScan(3.0, 50.0)  # a lattice of 5 mm sees every bend of its posterior
LEVELS = Naive(9.8, 0.8, 60.3, 1.1)
QUICK = NestedSampling(n_live=60, stop=RemainingEvidence(0.1), n_steps=100)
PLACES = [(60.0, 60.0), (200.0, 150.0), (260.0, 140.0), (310.0, 140.0), (250.0, 195.0), (190.0, 120.0)]


def rng(seed=2013):
    return np.random.default_rng(seed)


def readings_at(arm, places):
    return [arm.measure(Pose(x, y)) for x, y in places]


def lattice(experiment, readings, n=(80, 60, 52)):
    """Posterior by brute force: midpoints of a lattice over the uniform prior; log Z, mean and sd of each parameter."""
    low, high = experiment.prior.from_unit_cube(np.array([[0.0] * 3, [1.0] * 3]))
    sides = [a + (b - a) * (np.arange(k) + 0.5) / k for a, b, k in zip(low, high, n, strict=True)]
    theta = np.stack([side.ravel() for side in np.meshgrid(*sides, indexing="ij")], axis=1)
    log_likelihood = experiment.problem(readings).log_likelihood(theta)
    weight = np.exp(log_likelihood - log_likelihood.max())
    log_z = float(log_likelihood.max() + np.log(weight.mean()))
    weight /= weight.sum()
    mean = weight @ theta
    return log_z, mean, np.sqrt(weight @ (theta - mean) ** 2)


@pytest.mark.parametrize(
    "stop",
    [EvidenceChange(1e-8), pytest.param(RemainingEvidence(0.05), marks=pytest.mark.slow)],
    ids=["change", "remaining"],
)
@pytest.mark.parametrize(
    ("likelihood", "blur_mm", "n"), [(WIDE, 25.0, 6), (WIDE, 25.0, 2), (LEVELS, 0.0, 4)], ids=["ssf", "few", "naive"]
)
@pytest.mark.parametrize("n_live", [80, pytest.param(300, marks=pytest.mark.slow)])
def test_the_posterior_is_that_of_a_sum_over_a_lattice(small, likelihood, blur_mm, n, stop, n_live):
    """Evidence within five of its errors, means within five standard errors of as many samples as count."""
    method = NestedSampling(n_live=n_live, stop=stop)
    experiment = small.experiment(likelihood=likelihood, blur_mm=blur_mm, method=method)
    readings = readings_at(small.arm(sensor=small.sensor(blur_mm)), PLACES[:n])
    log_z, mean, sd = lattice(experiment, readings)
    found = infer(experiment, readings)
    weighted = found.joined(rng=rng())
    assert weighted.log_z == pytest.approx(log_z, abs=5 * weighted.log_z_error + 0.05)
    step = np.array([400.0, 300.0, 130.0]) / [80, 60, 52]
    error = 5 * sd * math.sqrt(weighted.run.memory / weighted.n_eff) + 0.3 * step
    assert (np.abs(weighted.mean() - mean) < error).all()
    assert (np.abs(weighted.sd() - sd) < error).all()


def infer(experiment, readings, previous=None, seed=1):
    from probewise.experiment.kinds import prior_posterior

    start = prior_posterior(experiment.kinds, 200, rng=rng()) if previous is None else previous
    return experiment.inference_method.updated(start, experiment.problem(readings).recording, rng=rng(seed))


def test_samples_that_repeat_are_walked_apart_and_stay_in_the_posterior(small):
    """Mean of 400 walked samples within five standard errors, those of twelve chains that share their steps' scale."""
    experiment = small.experiment(likelihood=STUDENT, method=NestedSampling(n_live=60, n_steps=300))
    readings = readings_at(small.arm(), PLACES)
    found = infer(experiment, readings)
    weighted, recording = found.joined(rng=rng()), experiment.problem(readings).recording
    drawn = experiment.inference_method.drawn(found, weighted, recording, 400, rng=rng(2))
    assert len(np.unique(weighted.samples(400, rng=rng(2)), axis=0)) < 400
    assert len(np.unique(drawn, axis=0)) == 400
    assert (np.abs(drawn.mean(axis=0) - weighted.mean()) < 5 * weighted.sd() / math.sqrt(60)).all()


def test_the_robot_asks_fifty_circles_and_goes_where_their_answers_differ_most(small):
    """Second route to the map: the entropy of the rounded answers, counted place by place."""
    experiment = small.experiment(likelihood=STUDENT, utility=ReadingEntropy(), n_samples=50, method=QUICK)
    steps = run(small.arm(), experiment, rng=rng(), max_readings=2).steps
    for step in steps:
        assert step.samples.shape == (50, 3)
        places = step.map.grid.places_mm
        plan = experiment.grid.plan("field")
        answers = np.rint(experiment.model.predict(step.samples, plan))
        for place in (0, 137, 300):
            counts = np.unique(answers[:, place], return_counts=True)[1] / 50
            assert step.map.values[place] == pytest.approx(-(counts * np.log2(counts)).sum())
    chosen = steps[0].next_pose
    assert [chosen.x_mm, chosen.y_mm] in places[best_designs_mask(steps[0].map.values, steps[0].map.reachable)].tolist()


def test_a_journal_of_one_method_is_not_gone_on_with_by_another(small, tmp_path):
    journal = tmp_path / "journal.jsonl"
    run(small.arm(), small.experiment(likelihood=STUDENT, method=QUICK), rng=rng(), max_readings=1, journal=journal)
    for other in (None, replace(QUICK, stop=EvidenceChange(1e-8))):
        with pytest.raises(FileError, match="method"):
            run(small.arm(), small.experiment(likelihood=STUDENT, method=other), rng=rng(), journal=journal)


@pytest.mark.slow
def test_of_two_shapes_each_has_a_run_of_its_own_and_the_right_one_wins():
    field = Field(400.0, 300.0)
    shape = AnyOf({"circle": Circle(field, (40.0, 80.0)), "rectangle": Rectangle(field)})
    experiment = experiment_for(sensor(), shape, field, method="paper", nested_stop="remaining")
    experiment = replace(experiment, method=QUICK)
    truth = shape.shapes["circle"].region(np.array([[200.0, 150.0, 60.0]]))
    angles = np.arange(12) * math.tau / 12
    places = [(200 + 60 * math.cos(a), 150 + 60 * math.sin(a)) for a in angles]
    values = 10 + 50 * np.full(12, 0.495)  # an edge through the middle of the footprint
    assert truth.n_regions == 1
    readings = [
        Reading(float(np.rint(v)), Pose(*p), 8.0 * k) for k, (p, v) in enumerate(zip(places, values, strict=True))
    ]
    found = infer(experiment, readings)
    probability = dict(zip(("circle", "rectangle"), found.probability, strict=True))
    assert probability["circle"] > 0.5
    drawn = experiment.inference_method.drawn(
        found, found.joined(rng=rng()), experiment.problem(readings).recording, 50, rng=rng()
    )
    assert drawn.shape == (50, len(shape.prior.names))


def test_readings_that_nothing_explains_end_the_inference(small):
    class Impossible:
        def log_prob(self, readings, predicted):
            return np.full(len(predicted), -np.inf)

    experiment = small.experiment(likelihood=Impossible(), method=QUICK)
    with pytest.raises(NotConvergedError, match="no hypothesis"):
        infer(experiment, readings_at(small.arm(), PLACES[:1]))


def sensor():
    return sensor_of(np.tile(TRUTH, (500, 1)))


def test_the_paper_experiment_is_posed_as_the_paper_says():
    posed = experiment_for(sensor(), Circle(), Field(), method="paper")
    assert posed.method == NestedSampling(n_live=300, stop=EvidenceChange(1e-8), n_steps=1000)
    assert posed.utility == ReadingEntropy(1.0)
    assert posed.likelihood == OneScan(1 / math.sqrt(12), 50.0)
    assert (posed.n_samples, posed.trust, posed.sensor_prior, posed.stop_sd_mm) == (50, 1.0, None, 4.0)
    assert (posed.grid.n_x, posed.grid.n_y) == (131, 65)
    inside = posed.prior.log_prob(np.array([[100.0, 100.0, 30.0], [900.0, 400.0, 140.0]]))
    assert inside[0] == inside[1]
    naive = experiment_for(
        sensor(), Circle(), Field(), method="paper", model="naive", naive=LEVELS, nested_stop="remaining"
    )
    assert naive.likelihood is LEVELS
    assert naive.method.stop == RemainingEvidence(0.05)
    assert naive.doubt_p == 0


def test_the_papers_robot_has_the_mean_of_the_sampled_fields():
    """Over an edge and a disc: the mean response of all samples, and the paper's sum over pixels of the mean field.

    The samples' sds differ by a third; one Gaussian of the same mean and covariance errs five times as much.
    """
    uncertain = sensor()
    samples = uncertain.samples.copy()
    samples[:, 1:5] *= np.exp(0.6 * rng(5).standard_normal((len(samples), 4)))
    axis = np.arange(-60.0, 60.5, 0.5)
    field = mean_ssf_field(footprint_of(samples[:, :6], 1), u_mm=axis, v_mm=axis)
    posed = experiment_for(replace(uncertain, samples=samples, field=field), Circle(), Field(), method="paper")
    x_mm = np.linspace(-12.0, 12.0, 49)
    for pattern in (HalfPlane(0.3, 0.0), Disc((0.0, 0.0), 9.0)):
        plan = Plan.from_arrays(x_mm=x_mm, y_mm=0.4 * x_mm, patterns={"only": pattern}, unit="LEGO")
        scene, none = KnownScene({"only": pattern}), np.empty((1, 0))
        levels = FixedLevels(0.0, 1.0)
        seen = Chain(posed.model.ssf, levels, scene).predict(none, plan)[0]
        each = Chain(FreeMixture(1), levels, scene).predict(samples[:, :6], plan)
        poses = Poses(plan.x_mm[None], plan.y_mm[None], plan.orientation_rad[None])
        pixels = mean_albedo_by_pixels(region_of(pattern), field, poses)[0]
        merged = Chain(merged_mean_mixture(footprint_of(samples[:, :6], 1)), levels, scene).predict(none, plan)[0]
        np.testing.assert_allclose(seen, each.mean(axis=0), atol=2.5e-3)
        np.testing.assert_allclose(seen, pixels, atol=2.5e-3)
        assert np.abs(merged - each.mean(axis=0)).max() > 5 * np.abs(seen - each.mean(axis=0)).max()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"utility": InformationGain()}, "utility"),
        ({"learn_sensor": True}, "learn_sensor"),
        ({"batch": 2}, "batch"),
        ({"trust": 0.9}, "trust"),
        ({"model": "naive"}, "naive"),
        ({"nested_stop": "never"}, "nested_stop"),
        ({"method": "particles", "nested_stop": "change"}, "nested_stop"),
        ({"method": "particles", "naive": LEVELS}, "naive"),
    ],
)
def test_what_does_not_go_with_the_method_is_refused_by_name(options, named):
    with pytest.raises(ParameterError) as caught:
        experiment_for(sensor(), Circle(), Field(), **{"method": "paper", **options})
    assert caught.value.name == named


def test_levels_and_sds_come_from_readings_over_black_and_white():
    """Second route: mean and sd by hand; readings near the edge and missing ones do not count."""
    n, noise = 41, rng()
    x_mm = np.concatenate([np.linspace(-50.0, 50.0, n), np.zeros(4)])
    readings = np.where(x_mm < 0, 10.0, 60.0) + noise.normal(0.0, 1.0, x_mm.size)
    readings[-4:] = 12.0, 8.0, math.nan, 11.0
    patterns = {"edge": HalfPlane(0.0, 0.0), "black": UniformPattern(0.0)}
    plan = Plan.from_arrays(x_mm=x_mm, y_mm=0.0, pattern=["edge"] * n + ["black"] * 4, patterns=patterns, unit="LEGO")
    found = naive_levels_from_recording(Recording(plan, readings), sensor())
    far = np.abs(x_mm[:n]) > 4 * 4.0  # sd along x' is 4 mm: a thousandth of it reaches as far as 3.1 sds
    black = np.concatenate([readings[:n][far & (x_mm[:n] < 0)], [12.0, 8.0, 11.0]])
    white = readings[:n][far & (x_mm[:n] > 0)]
    assert found.mu_black == pytest.approx(black.mean(), abs=0.15)
    assert found.sd_black == pytest.approx(black.std(ddof=1), rel=0.15)
    assert found.mu_white == pytest.approx(white.mean(), abs=0.15)
    assert found.sd_white == pytest.approx(white.std(ddof=1), rel=0.15)
    with pytest.raises(ParameterError, match="0 readings over black and 0 over white"):
        naive_levels_from_recording(Recording(plan.take(np.arange(19, 22)), readings[19:22]), sensor())


def test_a_simulated_sensor_reads_its_levels_on_its_own_scale():
    """Twenty readings of a known world: mean within five standard errors, no sd below that of rounding."""
    spot = gaussian_spot([Blob(1.0, (0.0, 1.5), (4.0, 2.5))])
    world = World(spot, black=10.3, white=60.0, noise_sd=1.0)
    found = naive_levels_from_world(world, ReadingScale(), rng=rng())
    assert found.mu_black == pytest.approx(10.3, abs=5 * 1.1 / math.sqrt(20))
    assert found.mu_white == pytest.approx(60.0, abs=5 * 1.1 / math.sqrt(20))
    assert 0.5 < found.sd_black < 2
    quiet = naive_levels_from_world(replace(world, noise_sd=0.0), ReadingScale(), rng=rng())
    assert (quiet.mu_black, quiet.sd_white) == (10.0, 1 / math.sqrt(12))


def test_the_student_ts_sd_lies_between_rounding_and_the_levels():
    assert student_t_likelihood(FixedLevels(60.0, 10.0), 1.0) == OneScan(1 / math.sqrt(12), 50.0)
    assert student_t_likelihood(FixedLevels(0.0, 5.0), None) == OneScan(0.005, 5.0)


def test_the_loop_of_the_paper_and_the_method_of_explore_infer_the_same(small):
    """Two routes from the same readings: evidence and means within five standard errors of as many samples as count."""
    grid = Grid(400.0, 300.0, 14, 10)
    experiment = small.experiment(likelihood=STUDENT, grid=grid, method=NestedSampling())
    steps = find_shape(small.arm(), experiment.shape, experiment.model, STUDENT, grid, bin_width=1.0, rng=rng())
    readings, posterior, shapes = next(itertools.islice(steps, 2, None))
    assert len(readings) == 3
    assert len(np.unique(shapes, axis=0)) == 50
    found = infer(experiment, readings).joined(rng=rng())
    error = 5 * math.hypot(posterior.log_z_error, found.log_z_error)
    assert posterior.log_z == pytest.approx(found.log_z, abs=error)
    spread = 5 * found.sd() * math.sqrt(found.run.memory / found.n_eff + posterior.memory / posterior.n_eff)
    assert (np.abs(posterior.mean() - found.mean()) < spread).all()
