"""Nested sampling against known evidences, and its behaviour where likelihoods misbehave."""

import math

import numpy as np
import pytest
from nested_sampling import problems
from runs import N_ERRORS
from scipy.stats import kstest

from probewise.errors import DoubtfulResultWarning, NotConvergedError, ParameterError
from probewise.nested import Bound, Evaluator, EvidenceChange, Points, PriorRejection, RemainingEvidence, SliceMove, run
from probewise.nested.clusters import find_clusters
from probewise.nested.evidence import insertion_p_value, insertion_ranks
from probewise.nested.sampler import replace_worst_live_points, run_once
from probewise.nested.save import LivePoints
from probewise.priors import Normal, Product


@pytest.fixture
def rng():
    return np.random.default_rng(20240229)


def test_a_posterior_narrower_than_floats_is_doubted_and_kept():
    with pytest.warns(DoubtfulResultWarning, match="within 0 steps between floating-point numbers"):
        found = run(lambda p: -0.5 * (p[0] - 0.2) ** 2 * 1e40, {"x": (0, 1)}, rng=np.random.default_rng(1), n_live=60)
    assert found.mean()[0] == pytest.approx(0.2, abs=1e-15)  # the weights sum to 1 but for rounding


def test_a_run_is_not_lost_to_a_check_that_raises(monkeypatch):
    def break_down(*_, **__):
        raise IndexError("out of bounds")

    monkeypatch.setattr("probewise.nested.check.find_missed_peaks", break_down)
    with pytest.warns(DoubtfulResultWarning, match="which checks the evidence, failed: IndexError: out of bounds"):
        found = run(lambda p: -0.5 * (p[0] / 0.1) ** 2, {"x": (-1, 1)}, rng=np.random.default_rng(1), n_live=60)
    assert found.complete


def test_no_setting_of_numpy_ends_a_run():
    with np.errstate(all="raise"):
        found = run(lambda p: -0.5e6 * (p**2).sum(), {"x": (-1, 1)}, rng=np.random.default_rng(1), n_live=60)
        assert "x " in found.summary()
        assert np.geterr()["under"] == "raise"


QUICK = {"shells 2-D", "Rosenbrock 2-D", "plateau", "naive steps"}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in problems.PROBLEMS]
)
def test_the_evidence_is_right_within_its_own_error(name, rng):
    problem = problems.PROBLEMS[name]()
    result = run(problem, rng=rng, n_live=100 if name in QUICK else 300)
    tolerance = 0.0 if name in QUICK else 1.0 if name.startswith("SSF") else 0.05  # the truth of an SSF: to half a nat
    assert abs(result.log_z - problem.log_z) < N_ERRORS * result.log_z_error + tolerance
    assert name not in QUICK or result.log_z_error < 0.5


def test_the_posterior_of_a_gaussian_has_its_moments(rng):
    problem = problems.gaussian(3, correlation=0.6)
    result = run(problem, rng=rng, n_live=150)
    k = 5 / math.sqrt(result.n_eff)
    assert result.mean() == pytest.approx(np.zeros(3), abs=k)
    assert result.sd() == pytest.approx(np.ones(3), abs=k)
    assert result.covariance()[0, 1] == pytest.approx(0.6, abs=k)
    low, high = result.interval(0.95)
    assert low == pytest.approx(-1.96 * np.ones(3), abs=3 * k)
    assert high == pytest.approx(1.96 * np.ones(3), abs=3 * k)
    # Information of a Gaussian against a box: ln of the box's volume less the Gaussian's entropy.
    entropy = 0.5 * math.log((2 * math.pi * math.e) ** 3 * np.linalg.det(result.covariance()))
    assert result.information == pytest.approx(3 * math.log(10) - entropy, abs=4 * result.log_z_error)
    assert result.mean(lambda t: t[:, 0] ** 2) == pytest.approx(1.0, abs=2 * k)


def test_one_step_by_hand_replaces_the_worst(rng):
    """Two of five die with five and four alive; their successors lie above the better of the two."""
    problem = problems.box(1, 0, 1)
    evaluate = Evaluator(problems.Known(problem, lambda t: t[:, 0], 0.0))
    u = np.array([[0.1], [0.5], [0.3], [0.9], [0.7]])
    live = LivePoints.drawn_from_prior(Points(u, u, np.zeros(5), u[:, 0], np.zeros(5)))
    after, dead, _ = replace_worst_live_points(live, PriorRejection(1.0), evaluate, n_replaced=2, rng=rng)
    assert dead.theta[:, 0].tolist() == [0.1, 0.3]
    assert (after.log_likelihood > 0.3).all()
    assert after.log_birth.tolist() == [-np.inf, -np.inf, -np.inf, 0.3, 0.3]


def test_ranks_of_new_points_count_the_worse_ones_alive_when_they_came():
    """Five points; two rounds of two: 0.1 and 0.3 die for 0.6 and 0.4, then 0.4 and 0.5 for 0.95 and 0.8."""
    place = np.array([0.1, 0.5, 0.3, 0.9, 0.7, 0.6, 0.4, 0.95, 0.8])  # in order of birth
    ident = np.array([0, 2, 6, 1, 5, 4, 8, 3, 7])  # in order of death
    assert (np.diff(place[ident]) > 0).all()
    rank, n_ranked = insertion_ranks(ident, 5, 2)
    assert rank.tolist() == [1, 0, 3, 2]
    assert n_ranked.tolist() == [3, 4, 3, 4]


@pytest.mark.parametrize("starts_live", [True, False])
@pytest.mark.parametrize("clustered", [False, True])
def test_slice_chains_leave_the_uniform_distribution_alone(clustered, starts_live, rng):
    """Starts drawn uniformly above the bound, live points or not, end uniformly above it: places and labels."""

    def function(theta):
        x = theta[:, 0]
        inside = (x < 0.15) | (x > 0.75) if clustered else x > 0.3
        return np.where(inside, 1.0, 0.0) + np.where(x > 0.9, 1.0, 0.0)

    evaluate = Evaluator(problems.Known(problems.box(2, 0, 1), function, 0.0))
    bound = Bound(1.0, 0.25)
    points = evaluate(rng.random((12_000, 2)), rng)
    points = points.take_rows(bound.mask_above(points.log_likelihood, points.label))
    ends = []
    for k in range(10):
        start = points.take_rows(slice(300 * k, 300 * k + 300))
        assert (len(find_clusters(start.u)) > 1) == clustered
        move = SliceMove(steps_per_param=1, differences=0.3)
        live = start if starts_live else points.take_rows(slice(3000 + 60 * k, 3060 + 60 * k))
        part, tally = move.draw(start, bound, live.u, evaluate, rng)
        assert tally.n_stuck < 15
        ends.append(part)
    end = Points.join(*ends)
    plain = end.log_likelihood == 1.0
    assert (end.label[plain] > 0.25).all()
    assert kstest(end.u[:, 1], "uniform").pvalue > 1e-4
    assert kstest((end.label[plain] - 0.25) / 0.75, "uniform").pvalue > 1e-4
    # Shares: a tenth of the prior above the plateau, the plateau thinned to three quarters by the label.
    flat = 0.75 * ((0.15 + 0.15) if clustered else 0.6)
    share = 0.1 / (0.1 + flat)
    assert (~plain).mean() == pytest.approx(share, abs=4 * math.sqrt(share / 3000))
    if clustered:
        share = 0.75 * 0.15 / (0.1 + flat)
        assert (end.u[:, 0] < 0.15).mean() == pytest.approx(share, abs=4 * math.sqrt(share / 3000))


def test_rare_possible_hypotheses_are_doubtful_but_used(rng):
    def function(theta):
        return np.where(theta[:, 0] < 0.002, 0.0, -np.inf)

    with pytest.warns(DoubtfulResultWarning, match="hypotheses drawn from the prior are possible"):
        result = run(problems.Known(problems.box(2, 0, 1), function, 0.0), rng=rng, n_live=100, max_cost=1.0)
    assert abs(result.log_z - math.log(0.002)) < N_ERRORS * result.log_z_error
    assert "doubtful" in result.summary()


@pytest.mark.filterwarnings("ignore::probewise.errors.DoubtfulResultWarning")
@pytest.mark.parametrize(
    ("share", "max_calls"),
    [(0.5, 100), (0.5, 3000), (0.1, 230), (0.03, 100), (0.03, 1000), (0.003, 3000), (0.001, 21_000)],
)
def test_the_call_limit_holds_where_a_part_of_the_prior_is_impossible(share, max_calls):
    asked = list[int]()

    def function(theta):
        asked.append(len(theta))
        within = theta[:, 0] / share
        return np.where(within < 1, -0.5 * ((within - 0.5) ** 2 + (theta[:, 1] - 0.5) ** 2) / 0.01, -np.inf)

    slab = problems.Known(problems.box(2, 0, 1), function, 0.0)
    result = run(slab, rng=np.random.default_rng(2), n_live=50, max_calls=max_calls)
    assert sum(asked) == result.n_calls <= max_calls
    if not result.complete:
        assert f"stopped at {result.n_calls} of max_calls = {max_calls}" in result.warnings[0]
    assert result.samples(10, rng=np.random.default_rng(3))[:, 0].max() < share


def test_a_hypothesis_space_that_excludes_the_readings_is_an_error(rng):
    nothing = problems.Known(problems.box(2, 0, 1), lambda t: np.full(len(t), -np.inf), 0.0)
    with pytest.raises(NotConvergedError, match="excludes what was measured"):
        run(nothing, rng=rng, n_live=50)


@pytest.mark.parametrize(("at", "sd", "warned"), [(-9, 0.05, False), (7, 0.05, False), (8, 0.05, True), (9, 0.3, True)])
def test_a_posterior_so_far_out_that_numbers_are_too_coarse_is_doubtful(at, sd, warned):
    """A measurement `at` prior sds, of the given sd: below the mean ln Z is right, above it samples pile up."""

    def function(x):
        return -0.5 * ((x[:, 0] - at) / sd) ** 2 - math.log(sd * math.sqrt(2 * math.pi))

    problem = problems.Known(Product({"p0": Normal(0.0, 1.0)}), function, 0.0)
    result = run_once(problem, rng=np.random.default_rng(4), n_live=100)
    assert any("steps between floating-point numbers" in note for note in result.warnings) is warned
    if not warned:
        truth = -0.5 * (at**2 / (1 + sd**2) + math.log(2 * math.pi * (1 + sd**2)))
        assert abs(result.log_z - truth) < N_ERRORS * result.log_z_error


def test_a_problem_without_parameters_is_its_likelihood(rng):
    result = run(problems.Known(Product({}), lambda t: np.full(len(t), -3.5), -3.5), rng=rng)
    assert (result.log_z, result.log_z_error, result.theta.shape) == (-3.5, 0.0, (1, 0))
    assert "log Z" in result.summary()


@pytest.mark.parametrize(
    "options", [{"n_live": 5}, {"n_live": 10**9}, {"n_replaced": 30, "n_live": 50}, {"max_calls": 10, "n_live": 50}]
)
def test_options_out_of_range_are_named(options, rng):
    with pytest.raises(ParameterError, match="allowed"):
        run(problems.plateau(), rng=rng, **options)
    with pytest.raises(ParameterError, match="dlogz"):
        RemainingEvidence(0.0)


def test_insertion_ranks_of_a_wrong_sampler_are_found(rng):
    m = np.full(2000, 99)
    assert insertion_p_value(rng.integers(0, 100, 2000), m, rng=rng) > 1e-4
    assert insertion_p_value(rng.integers(0, 90, 2000), m, rng=rng) < 1e-6
    early = np.concatenate([rng.integers(0, 60, 200), rng.integers(0, 100, 1800)])
    assert insertion_p_value(early, m, rng=rng) < 1e-4


def test_clusters_are_found_where_they_are_and_not_where_they_are_not(rng):
    ball = rng.standard_normal((300, 5))
    ball *= rng.random((300, 1)) ** (1 / 5) / np.linalg.norm(ball, axis=1, keepdims=True)
    assert len(find_clusters(ball)) == 1
    assert len(find_clusters(rng.random((300, 5)))) == 1
    two = np.concatenate([0.1 * ball[:220], 0.05 * ball[220:] + 0.5])
    clusters = find_clusters(two)
    assert len(clusters) == 2
    home = clusters.assign(two)
    assert len(np.unique(home[:220])) == len(np.unique(home[220:])) == 1
    assert home[0] != home[-1]


def test_the_papers_rule_ends_a_run_on_a_plateau_before_its_points_are_copies():
    """Evidence of two steps by hand: 0.9 of the prior at 1, a tenth at e^5."""

    steps = problems.Known(problems.box(1, 0.0, 1.0), lambda theta: 5.0 * (theta[:, 0] > 0.9), 0.0)
    result = run(steps, rng=np.random.default_rng(4), n_live=100, stop=EvidenceChange(1e-8))
    assert "same likelihood" in result.stop_reason
    assert result.warnings == ()
    assert abs(result.log_z - np.log(0.9 + 0.1 * np.exp(5.0))) < 5 * result.log_z_error
    assert len(np.unique(result.theta, axis=0)) == len(result.theta)


def test_first_live_points_forget_the_few_possible_draws_at_which_they_began():
    """One of 5,040 draws is possible. Means of 50 points scatter between ten seeds as those of independent points.

    A ratio of variances above 4.4 has a probability of 1e-5 (chi-square of 9 degrees of freedom); of points that stayed
    with the three or four draws it would be above ten.
    """

    def function(theta):
        return np.where((np.diff(theta, axis=1) > 0).all(axis=1), 0.0, -np.inf)

    known = problems.Known(problems.box(7, 0, 1), function, 0.0)
    middle = []
    for seed in range(10):
        run = run_once(known, rng=np.random.default_rng([7, seed]), n_live=50, stop=lambda _: "at once")
        first = run.theta[run.log_birth == -np.inf]
        middle.append(first[:, 3].mean())
    # The fourth of seven ordered uniforms is Beta(4, 4), of variance 1/36.
    assert np.var(middle, ddof=1) * 36 * 50 < 4.4
