"""Coordinates that chains step in and densities are fitted in: there and back, Jacobians, total probability."""

import math

import numpy as np
import pytest

from probewise.calibration import SSFPrior, default_prior
from probewise.nested.problem import unbounded_space_of
from probewise.priors import HeavyTailedPrior, Joint, LogHeavyTailedPrior, LogUniform, Normal, Product, Uniform
from probewise.recordings import Recording, paper_plan
from probewise.scene import AnyOf, Circle, Ellipse, Rectangle, RegularPolygon


def paper_prior(n_gaussians):
    return SSFPrior(n_gaussians, Uniform(-10, 10), Uniform(0.003, 0.5), Uniform(0, 20), Uniform(40, 80))


def derived_prior(n_gaussians):
    plan = paper_plan()
    return default_prior(Recording(plan, 10 + 50 / (1 + np.exp(-plan.x_mm / 4))), n_gaussians)


PRIORS = {
    "uniform": Product({"a": Uniform(-2.0, 5.0)}),
    "log-uniform": Product({"a": LogUniform(1e-3, 40.0)}),
    "normal": Product({"a": Normal(3.0, 0.5)}),
    "heavy-tailed": Product({"a": HeavyTailedPrior(2.0)}),
    "positive heavy-tailed": Product({"a": HeavyTailedPrior(0.1, positive=True)}),
    "log heavy-tailed": Product({"a": LogHeavyTailedPrior(0.2)}),
    "joint": Joint((Product({"a": Uniform(0, 1)}), Product({}), Product({"b": Normal(0, 1), "c": LogUniform(1, 2)}))),
    "circle": Circle().prior,
    "circle inside": Circle(inside=True).prior,
    "ellipse": Ellipse().prior,
    "ellipse inside": Ellipse(inside=True).prior,
    "rectangle": Rectangle().prior,
    "rectangle inside": Rectangle(inside=True).prior,
    "triangle": RegularPolygon(3).prior,
    "hexagon inside": RegularPolygon(6, inside=True).prior,
    "any of two": AnyOf({"circle": Circle(), "rectangle": Rectangle()}, (0.7, 0.3)).prior,
    "any of two inside": AnyOf({"circle": Circle(inside=True), "ellipse": Ellipse(inside=True)}).prior,
    "SSF of one Gaussian": paper_prior(1),
    "SSF of three Gaussians": paper_prior(3),
    "SSF by mass": derived_prior(2),
}


def cube(prior, n=200, seed=0):
    return np.random.default_rng(seed).random((n, len(prior.names)))


@pytest.mark.parametrize("prior", PRIORS.values(), ids=PRIORS)
def test_a_point_of_the_unit_cube_is_found_again_from_its_parameters(prior):
    """Rounding may push a sample over its prior's edge; chains must still find it in the cube."""
    u = cube(prior)
    theta = prior.from_unit_cube(u)
    np.testing.assert_allclose(prior.to_unit_cube(theta), u, atol=1e-7)
    for moved in (theta * (1 + 1e-12), theta * (1 - 1e-12)):
        u = prior.to_unit_cube(moved)
        assert ((u >= 0) & (u <= 1)).all()


@pytest.mark.parametrize("prior", PRIORS.values(), ids=PRIORS)
def test_parameters_are_found_again_from_coordinates_without_walls(prior):
    space = unbounded_space_of(prior)
    theta = prior.from_unit_cube(cube(prior))
    x = space.enter(theta)
    back, log_density = space.leave(x)
    assert np.isfinite(log_density).all()
    # Labels of exchangeable Gaussians may have been swapped; the density knows none.
    np.testing.assert_allclose(prior.log_prob(back), prior.log_prob(theta), atol=1e-6)
    np.testing.assert_allclose(space.enter(back), x, atol=1e-6)
    assert np.isinf(space.bounds).all()


def test_normal_scores_have_the_density_of_a_standard_normal_prior():
    space = unbounded_space_of(Circle().prior)
    x = space.draw(1000, rng=np.random.default_rng(3))
    _, log_density = space.leave(x)
    np.testing.assert_allclose(log_density, (-0.5 * x**2 - 0.5 * math.log(2 * math.pi)).sum(axis=1))
