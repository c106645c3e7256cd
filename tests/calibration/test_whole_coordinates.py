"""Coordinates with mean and covariance of the whole in place of those of the heaviest Gaussian."""

from __future__ import annotations

import math

import numpy as np
import pytest

from probewise._arrays import FloatArray
from probewise.calibration import SSFPrior
from probewise.calibration.all_bright_density import AllGaussiansBrightDensity
from probewise.calibration.whole_coordinates import FAINT, WholeFootprintCoordinates, count_bright_gaussians
from probewise.priors import LogUniform, Uniform


def space(n_gaussians: int, *, n_bright: int | None = None) -> WholeFootprintCoordinates:
    prior = SSFPrior(
        n_gaussians,
        offset_mm=Uniform(-10, 10),
        precision=LogUniform(0.003, 0.5),
        i_min=Uniform(0, 20),
        i_max=Uniform(40, 80),
        unit_mass_mm2=20.0,
    )
    return WholeFootprintCoordinates(prior, (1.0, 0.5), 20.0, n_bright)


def drawn(asked: WholeFootprintCoordinates, n: int, seed: int) -> FloatArray:
    return asked.prior.from_unit_cube(np.random.default_rng(seed).random((n, len(asked.prior.names))))


@pytest.mark.parametrize("n_gaussians", [1, 2, 3])
def test_coordinates_of_the_whole_lead_back_to_the_sorted_gaussians(n_gaussians: int) -> None:
    asked = space(n_gaussians)
    theta = drawn(asked, 50, 2)
    x = asked.enter(theta)
    back, log_density = asked.leave(x)
    moments = asked.prior.coordinates
    assert np.isfinite(log_density).all()
    np.testing.assert_allclose(back, moments.leave(moments.enter(theta))[0], rtol=1e-9)
    np.testing.assert_allclose(asked.enter(back), x, atol=1e-9)


@pytest.mark.parametrize("n_gaussians", [1, 2, 3])
def test_the_density_is_the_priors_times_the_volume_that_the_whole_stretches(n_gaussians: int) -> None:
    """The Jacobian by central differences; N! for the labellings that became one."""
    asked = space(n_gaussians)
    for row in asked.enter(drawn(asked, 5, 3)):
        step = 1e-6 * np.maximum(1.0, np.abs(row))
        ahead, behind = (asked.leave(row + sign * np.diag(step))[0] for sign in (1, -1))
        stretch = np.linalg.slogdet((ahead - behind) / (2 * step[:, None])).logabsdet
        theta, log_density = asked.leave(row[None])
        expected = asked.prior.log_prob(theta)[0] + stretch + math.lgamma(n_gaussians + 1)
        assert log_density[0] == pytest.approx(expected, abs=1e-6)


def test_the_whole_of_gaussians_nearby_has_their_mean_and_covariance() -> None:
    """Far less is tapered there than a hundredth; the moments of a mixture by another route."""
    asked = space(2)
    theta = np.array([[0.05, 1.0, 0.5, 0.05, 0.06, 0.01, 0.01, 2.0, 0.0, 0.08, 0.05, 0.0, 10.0, 60.0]])
    g = theta[0, :-2].reshape(2, 6)
    light = g[:, 0] / np.sqrt(g[:, 3] * g[:, 4] - g[:, 5] ** 2)
    share = light / light.sum()
    mean = share @ g[:, 1:3]
    whole = np.zeros((2, 2))
    for s, (_, u, v, a, b, c) in zip(share, g, strict=True):
        off = np.array([u, v]) - mean
        whole += s * (0.5 * np.linalg.inv([[a, c], [c, b]]) + np.outer(off, off))
    x = asked.enter(theta)[0]
    np.testing.assert_allclose(x[1:3], mean, atol=0.01)
    np.testing.assert_allclose(x[3:5], np.log(np.diag(whole)), atol=0.01)
    assert x[5] == pytest.approx(np.arctanh(whole[0, 1] / np.sqrt(whole[0, 0] * whole[1, 1])), abs=0.01)


def test_the_prior_is_restricted_to_so_many_bright_gaussians() -> None:
    theta = drawn(space(3), 2000, 4)
    bright = count_bright_gaussians(theta)
    for n_bright in (1, 2, 3):
        asked = space(3, n_bright=n_bright)
        np.testing.assert_array_equal(np.isfinite(asked.leave(asked.enter(theta))[1]), bright == n_bright)
    assert count_bright_gaussians(np.array([[1.0, 0, 0, 1, 1, 0, FAINT, 0, 0, 1, 1, 0, 0, 1]])).tolist() == [1]


def test_what_is_not_sorted_by_mass_is_outside_the_prior() -> None:
    asked = space(3)
    x = asked.enter(drawn(asked, 20, 7))
    heavier, swapped = x.copy(), x.copy()
    heavier[:, 6] = 0.1
    swapped[:, [6, 12]] = swapped[:, [12, 6]]
    assert (asked.leave(heavier)[1] == -np.inf).all()
    assert (asked.leave(swapped)[1] == -np.inf).all()


def test_a_sharing_density_keeps_the_whole_of_the_gaussians_below() -> None:
    """All of its draws share the light; centre and levels scatter about those below, twice as wide or more."""
    asked, one = space(2, n_bright=2), space(1)
    rng = np.random.default_rng(5)
    below = one.enter(np.array([1.0, 0.5, 1.0, 0.05, 0.06, 0.01, 10.0, 60.0]) * (1 + 0.01 * rng.random((4000, 8))))
    density = AllGaussiansBrightDensity.from_samples_below(asked, below)
    theta = density.draw(np.empty((4000, 0)), rng=rng)
    possible = theta[np.isfinite(theta).all(axis=1)]
    assert len(possible) > 400
    assert (count_bright_gaussians(possible) == 2).all()
    assert np.isfinite(density.log_density_over_prior(possible)).all()
    x = asked.enter(possible)
    for own, other in ((1, 1), (2, 2), (-2, -2), (-1, -1)):
        sd = below[:, other].std()
        assert abs(x[:, own].mean() - below[:, other].mean()) < sd
        assert 1.5 < x[:, own].std() / sd < 3.0
    there, log_drawn = density.propose_moves(possible[:100], rng=rng)
    assert there.shape == (100, 14)
    assert np.isfinite(log_drawn).any()
