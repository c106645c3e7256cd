"""Plain functions with priors in any usual form give the evidence that a problem in one gives."""

import math
from functools import partial

import numpy as np
import pytest
from nested_sampling.problems import Known
from runs import N_ERRORS, quiet
from scipy import stats
from scipy.special import i0e

from probewise.errors import NotConvergedError, ParameterError
from probewise.nested import Evaluator, SliceMove, diversify, make_problem, merge, refine, run, update
from probewise.nested.importance import repartitioned
from probewise.nested.problem import Bound
from probewise.priors import Joint, Product, Uniform

SD = 0.3
LOG_Z = 2 * math.log(1 / 4)  # a unit of likelihood in a square of side 4
SQUARE = Product({"x": Uniform(-2.0, 2.0), "y": Uniform(-2.0, 2.0)})
few = partial(quiet, n_live=60)


def many_points(x):
    return -0.5 * ((x / SD) ** 2).sum(axis=1) - 2 * math.log(SD * math.sqrt(2 * math.pi))


def one_point(x):
    assert x.shape == (2,)
    return float(many_points(x[None])[0])


def by_name(point):
    return many_points(np.column_stack([point["x"], point["y"]]))[0]


def many_by_name(points):
    return many_points(np.column_stack([points["x"], points["y"]]))


def to_square(u):
    u *= 4  # in place, as many do
    u -= 2
    return u


@pytest.mark.parametrize(
    ("function", "prior", "options"),
    [
        (one_point, SQUARE, {}),
        (many_points, SQUARE, {"vectorized": True}),
        (by_name, SQUARE, {"pass_dict": True}),
        (many_by_name, SQUARE, {"pass_dict": True, "vectorized": True}),
        (one_point, {"x": stats.uniform(-2, 4), "y": [-2.0, 2.0]}, {}),
        (many_points, [stats.uniform(-2, 4), (-2, 2)], {"names": ["x", "y"], "vectorized": True}),
        (one_point, to_square, {"names": ["x", "y"]}),
        (many_points, to_square, {"names": ["x", "y"], "vectorized": True}),
    ],
)
def test_every_form_of_function_and_prior_poses_the_same_problem(function, prior, options):
    result = few(function, prior, **options)
    assert result.names == ("x", "y")
    assert abs(result.log_z - LOG_Z) < N_ERRORS * result.log_z_error
    whole = few(many_points, SQUARE, vectorized=True)
    assert result.log_z == pytest.approx(whole.log_z, abs=1e-6)  # the same seed, the same points


def test_the_evidence_under_a_normal_prior_of_scipy_is_the_convolution():
    """Two zero-mean normals: Z is their convolution's density at 0."""
    result = few(one_point, [stats.norm(0, 1), stats.norm(0.5, 2)])
    truth = stats.norm(0, math.hypot(1, SD)).logpdf(0) + stats.norm(0.5, math.hypot(2, SD)).logpdf(0)
    assert result.names == ("p0", "p1")
    assert abs(result.log_z - truth) < N_ERRORS * result.log_z_error


@pytest.mark.parametrize("kappa", [4.0, 40.0])
def test_angles_that_peak_across_the_end_of_their_circle_have_bessels_evidence(kappa):
    prior = {f"angle_{i}_rad": Uniform(0.0, 2 * math.pi) for i in range(3)}
    options = {"vectorized": True, "periodic": list(prior), "n_live": 100}
    result = quiet(lambda x: kappa * (np.cos(x) - 1).sum(axis=1), prior, **options)
    assert abs(result.log_z - 3 * math.log(i0e(kappa))) < N_ERRORS * result.log_z_error
    assert ((result.theta >= 0) & (result.theta <= 2 * math.pi)).all()


def test_chains_step_over_the_end_of_a_circle_and_stay_even():
    """From one corner of a region across the end, the chains' ends are even over it; walls would keep them apart."""

    def function(x):
        return np.where(np.abs((x[:, 0] + 0.5) % 1.0 - 0.5) < 0.1, 0.0, -1.0)

    problem = make_problem(function, {"a": (0.0, 1.0), "b": (0.0, 1.0)}, vectorized=True, periodic=["a"])
    evaluate, rng = Evaluator(problem), np.random.default_rng(20261123)
    live = evaluate(np.column_stack([rng.uniform(0.9, 1.0, 400), rng.random(400)]), rng)
    ends, _ = SliceMove(steps_per_param=8.0).draw(live, Bound(-0.5, 0.0), live.u, evaluate, rng)
    place = (ends.u[:, 0] + 0.5) % 1.0  # 0.4 to 0.6
    assert stats.kstest((place - 0.4) / 0.2, "uniform").pvalue > 1e-4


@pytest.mark.parametrize(
    ("function", "prior", "options", "message"),
    [
        (one_point, None, {}, r"nested\.run\(log_likelihood, prior, rng=rng\)"),
        (one_point, 3.0, {}, "prior is 3.0; allowed: a prior such as"),
        (one_point, to_square, {}, r"names is None; allowed: .*names=\['x', 'y'\]"),
        (one_point, Joint((Product({"x": Uniform(0, 1)}), Product({"x": Uniform(0, 1)}))), {}, "each name once"),
        (one_point, lambda u: u[:1], {"names": ["x", "y"]}, "prior is 'a function that makes one point"),
        (one_point, SQUARE, {"names": ["y", "x"]}, "those of the prior"),
        (one_point, {"x": stats.poisson(3)}, {}, r"prior\['x'\] is .*continuous"),
        (one_point, {"x": (2, 0)}, {}, "low < high"),
        (one_point, SQUARE, {"periodic": ["z"]}, "periodic is .*names among"),
        (one_point, SQUARE, {"periodic": 3}, "periodic is 3; allowed: names among"),
        (one_point, to_square, {"names": 3}, "names is 3; allowed: names of the parameters, in a list"),
    ],
)
def test_what_does_not_fit_is_refused_in_words(function, prior, options, message):
    with pytest.raises(ParameterError, match=message):
        few(function, prior, **options)


@pytest.mark.parametrize(
    ("function", "options", "message"),
    [
        (lambda x: np.zeros(5), {}, "vectorized=True"),
        (
            lambda x: np.ma.masked_less(x[:, 0], 0.0),
            {"vectorized": True},
            r"masked array with \d+ of 60 values masked.*filled\(-np\.inf\)",
        ),
    ],
)
def test_an_answer_that_is_no_likelihood_is_told_the_way_out(function, options, message):
    with pytest.raises(NotConvergedError, match=message):
        few(function, SQUARE, **options)


# ------------------------------------------------------------------ what misbehaves is accepted where that is safe


def test_a_likelihood_that_writes_into_its_argument_changes_nothing():
    def writes(x):
        values = many_points(x)
        x[:] = 1e6
        return values

    clean, messy = (few(function, SQUARE, vectorized=True, max_cost=5.0) for function in (many_points, writes))
    assert np.array_equal(clean.theta, messy.theta)
    assert clean.log_z == messy.log_z


class OneWay:
    """A prior that maps the unit cube to parameters and can do nothing else."""

    names = ("x", "y")

    def from_unit_cube(self, u):
        return 4.0 * u - 2.0


def test_a_prior_without_its_inverse_runs_and_is_refused_where_the_inverse_is_needed():
    asked = []
    problem = Known(OneWay(), lambda x: asked.append(len(x)) or many_points(x), LOG_Z)
    result, rng = quiet(problem, n_live=30), np.random.default_rng(1)
    asked.clear()
    for call in (lambda: refine(result, problem, rng=rng), lambda: repartitioned(problem, result.theta)):
        with pytest.raises(ParameterError, match="a prior with to_unit_cube"):
            call()
    with pytest.raises(ParameterError, match="a prior with log_prob"):
        diversify(result.theta[:5], problem, rng=rng)
    assert not asked


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda result, problem, rng: refine(result, problem, rng=None), "rng is None"),
        (lambda result, problem, rng: merge([result, result], rng=5), "rng is 5"),
        (lambda result, problem, rng: update(result, problem, rng=rng, fall_back=result), "fall_back is"),
        (lambda result, problem, rng: diversify(result.theta[-5:], problem, rng=rng, n_steps=5.0), "n_steps is 5.0"),
    ],
)
def test_an_argument_of_the_wrong_kind_is_refused_in_words(call, said):
    problem = make_problem(many_points, SQUARE, vectorized=True)
    result = run(problem, rng=np.random.default_rng(1), n_live=20, max_cost=1.0)
    with pytest.raises(ParameterError, match=said):
        call(result, problem, np.random.default_rng(2))
