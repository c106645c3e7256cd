"""Priors by name: quantile functions against their own densities."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from probewise.errors import ParameterError, ShapeError
from probewise.priors import Joint, LogNormal, LogUniform, Normal, Prior, Product, Uniform

MARGINALS = [Uniform(-2.0, 5.0), LogUniform(0.01, 30.0), LogNormal(3.0, 0.6), Normal(1.0, 2.5)]


@pytest.mark.parametrize("marginal", MARGINALS, ids=str)
def test_the_density_integrates_to_the_unit_coordinate(marginal):
    """Two routes to one number: quadrature of the density up to a quantile, and that quantile's coordinate."""
    low = marginal.from_unit(np.array(1e-12))
    for u in (0.1, 0.5, 0.93):
        x = float(marginal.from_unit(np.array(u)))
        mass, _ = quad(lambda t: float(np.exp(marginal.log_prob(np.array(t)))), float(low), x, limit=200)
        assert mass == pytest.approx(u, abs=1e-7)


@pytest.mark.parametrize("marginal", MARGINALS[:2], ids=str)
@given(u=st.floats(0, 1))
def test_quantiles_stay_in_the_support(marginal, u):
    value = marginal.from_unit(np.array(u))
    assert marginal.low - 1e-9 <= value <= marginal.high + 1e-9


def test_a_value_outside_the_support_is_impossible_and_never_nan():
    for marginal in MARGINALS[:2]:
        assert marginal.log_prob(np.array([-100.0, 0.0, 100.0]))[[0, 2]].tolist() == [-np.inf, -np.inf]


def test_joined_priors_keep_names_and_columns_in_order():
    joint = Joint((Product({"a": Uniform(0, 1)}), Product({}), Product({"b": Normal(0, 1), "c": LogUniform(1, 2)})))
    assert isinstance(joint, Prior)
    assert joint.names == ("a", "b", "c")
    u = np.random.default_rng(0).random((7, 3))
    theta = joint.from_unit_cube(u)
    np.testing.assert_array_equal(theta[:, 0], u[:, 0])
    expected = sum(p.log_prob(theta[:, i]) for i, p in enumerate([Uniform(0, 1), Normal(0, 1), LogUniform(1, 2)]))
    np.testing.assert_allclose(joint.log_prob(theta), expected)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Uniform(1, 1),
        lambda: Uniform(0, float("inf")),
        lambda: LogUniform(0, 1),
        lambda: LogNormal(0.0, 1.0),
        lambda: Normal(0, 0),
        lambda: Normal(float("nan"), 1),
    ],
    ids=["no width", "no end", "no decade", "no median", "no sd", "no mean"],
)
def test_improper_priors_are_refused(make):
    with pytest.raises(ParameterError, match="allowed"):
        make()


@pytest.mark.parametrize("prior", [Product({}), Joint(()), Joint((Product({}),))])
def test_a_prior_of_no_parameters_draws_none(prior):
    nothing = np.zeros((3, 0))
    assert prior.names == ()
    assert prior.from_unit_cube(nothing).shape == prior.to_unit_cube(nothing).shape == (3, 0)
    assert prior.log_prob(nothing).tolist() == [0.0, 0.0, 0.0]


def test_the_wrong_number_of_columns_is_refused():
    with pytest.raises(ShapeError, match="allowed"):
        Product({"a": Uniform(0, 1)}).from_unit_cube(np.zeros((3, 2)))
