"""Plain functions with priors in any usual form give the evidence that a problem in one gives."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.special import i0e

from probewise.errors import DoubtfulResultWarning, NotConvergedError, ParameterError
from probewise.nested import NestedResult, SliceMove, make_problem, run
from probewise.nested.problem import Bound, Evaluator
from probewise.priors import Joint, Product, Uniform

SD = 0.3
LOG_Z = 2 * math.log(1 / 4)  # a unit of likelihood in a square of side 4


def rng() -> np.random.Generator:
    return np.random.default_rng(20261123)


def one_point(x: np.ndarray) -> float:
    assert x.shape == (2,)
    return float(-0.5 * ((x / SD) ** 2).sum() - 2 * math.log(SD * math.sqrt(2 * math.pi)))


def many_points(x: np.ndarray) -> np.ndarray:
    return np.asarray(-0.5 * ((x / SD) ** 2).sum(axis=1) - 2 * math.log(SD * math.sqrt(2 * math.pi)))


def by_name(point: dict[str, Any]) -> Any:
    return many_points(np.column_stack([point["x"], point["y"]]))[0]


def many_by_name(points: dict[str, np.ndarray]) -> np.ndarray:
    return many_points(np.column_stack([points["x"], points["y"]]))


def to_square(u: np.ndarray) -> np.ndarray:
    u *= 4  # in place, as many do
    u -= 2
    return u


def quiet(function: Callable[..., Any], prior: Any, **options: Any) -> NestedResult:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)
        return run(function, prior, **{"rng": rng(), "n_live": 60, "max_cost": 1.0, **options})


SQUARE = Product({"x": Uniform(-2.0, 2.0), "y": Uniform(-2.0, 2.0)})


@pytest.mark.parametrize(
    ("function", "prior", "options"),
    [
        (one_point, SQUARE, {}),
        (many_points, SQUARE, {"vectorized": True}),
        (by_name, SQUARE, {"pass_dict": True}),
        (many_by_name, SQUARE, {"pass_dict": True, "vectorized": True}),
        (one_point, {"x": stats.uniform(-2, 4), "y": Uniform(-2.0, 2.0)}, {}),
        (many_points, [stats.uniform(-2, 4), stats.uniform(-2, 4)], {"names": ["x", "y"], "vectorized": True}),
        (one_point, to_square, {"names": ["x", "y"]}),
        (many_points, to_square, {"names": ["x", "y"], "vectorized": True}),
    ],
)
def test_every_form_of_function_and_prior_poses_the_same_problem(
    function: Callable[..., Any], prior: Any, options: dict[str, Any]
) -> None:
    result = quiet(function, prior, **options)
    assert result.names == ("x", "y")
    assert abs(result.log_z - LOG_Z) < 3.9 * result.log_z_error
    whole = quiet(many_points, SQUARE, vectorized=True)
    assert result.log_z == pytest.approx(whole.log_z, abs=1e-6)  # the same seed, the same points


def test_the_evidence_under_a_normal_prior_of_scipy_is_the_convolution() -> None:
    """Two zero-mean normals: Z is their convolution's density at 0."""
    result = quiet(one_point, [stats.norm(0, 1), stats.norm(0.5, 2)])
    truth = stats.norm(0, math.hypot(1, SD)).logpdf(0) + stats.norm(0.5, math.hypot(2, SD)).logpdf(0)
    assert result.names == ("p0", "p1")
    assert abs(result.log_z - truth) < 3.9 * result.log_z_error


@pytest.mark.parametrize("kappa", [4.0, 40.0])
def test_angles_that_peak_across_the_end_of_their_circle_have_bessels_evidence(kappa: float) -> None:
    def function(x: np.ndarray) -> np.ndarray:
        return np.asarray(kappa * (np.cos(x) - 1).sum(axis=1))

    prior = {f"angle_{i}_rad": Uniform(0.0, 2 * math.pi) for i in range(3)}
    result = quiet(function, prior, vectorized=True, periodic=list(prior), n_live=100)
    assert abs(result.log_z - 3 * math.log(i0e(kappa))) < 3.9 * result.log_z_error
    assert ((result.theta >= 0) & (result.theta <= 2 * math.pi)).all()


def test_chains_step_over_the_end_of_a_circle_and_stay_even() -> None:
    """From one corner of a region across the end, the chains' ends are even over it; walls would keep them apart."""

    def function(x: np.ndarray) -> np.ndarray:
        return np.where(np.abs((x[:, 0] + 0.5) % 1.0 - 0.5) < 0.1, 0.0, -1.0)

    evaluate = Evaluator(
        make_problem(function, {"a": Uniform(0.0, 1.0), "b": Uniform(0.0, 1.0)}, vectorized=True, periodic=["a"])
    )
    draw = rng()
    live = evaluate(np.column_stack([draw.uniform(0.9, 1.0, 400), draw.random(400)]), draw)
    move = SliceMove(steps_per_param=8.0)
    ends, _ = move.draw(live, Bound(-0.5, 0.0), live.u, evaluate, draw)
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
        (one_point, SQUARE, {"periodic": ["z"]}, "periodic is .*names among"),
        (one_point, SQUARE, {"periodic": 3}, "periodic is 3; allowed: names among"),
        (one_point, to_square, {"names": 3}, "names is 3; allowed: names of the parameters, in a list"),
    ],
)
def test_what_does_not_fit_is_refused_in_words(
    function: Any, prior: Any, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ParameterError, match=message):
        quiet(function, prior, **options)


def test_a_function_of_many_points_that_was_not_said_to_be_one_is_told_how() -> None:
    with pytest.raises(NotConvergedError, match="vectorized=True"):
        quiet(lambda x: np.zeros(5), SQUARE)


def test_a_pair_of_numbers_is_a_uniform_prior() -> None:
    posed = make_problem(lambda x: 0.0, {"x": (0, 2), "y": [-1.0, 1.0]})
    assert posed.prior == Product({"x": Uniform(0.0, 2.0), "y": Uniform(-1.0, 1.0)})
    with pytest.raises(ParameterError, match="low < high"):
        make_problem(lambda x: 0.0, {"x": (2, 0)})
