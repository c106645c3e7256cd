"""Sampling coordinates: moments instead of A, B and C, Gaussians sorted by mass; or without labels."""

import math

import numpy as np
import pytest

from probewise.calibration import SSFPrior
from probewise.calibration.peaks import LightContrasts
from probewise.priors import LogUniform, Uniform


def prior(n_gaussians, *, by_mass):
    return SSFPrior(
        n_gaussians,
        offset_mm=Uniform(-10, 10),
        precision=LogUniform(0.003, 0.5) if by_mass else Uniform(0.003, 0.5),
        i_min=Uniform(0, 20),
        i_max=Uniform(40, 80),
        unit_mass_mm2=20.0 if by_mass else None,
    )


CASES = pytest.mark.parametrize(("n_gaussians", "by_mass"), [(1, False), (1, True), (2, False), (3, True)])


@CASES
def test_the_density_is_the_priors_times_the_volume_that_coordinates_stretch(n_gaussians, by_mass):
    """The Jacobian by central differences; N! for the labellings that became one."""
    belief = prior(n_gaussians, by_mass=by_mass)
    space = belief.coordinates
    for row in space.enter(belief.from_unit_cube(np.random.default_rng(3).random((5, len(belief.names))))):
        step = 1e-6 * np.maximum(1.0, np.abs(row))
        ahead, behind = (space.leave(row + sign * np.diag(step))[0] for sign in (1, -1))
        stretch = np.linalg.slogdet((ahead - behind) / (2 * step[:, None])).logabsdet
        theta, log_density = space.leave(row[None])
        expected = belief.log_prob(theta)[0] + stretch + math.lgamma(n_gaussians + 1)
        assert log_density[0] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_without_labels_parameters_come_back_but_for_the_light_of_all(n):
    """Readings depend on ratios of light alone, so that the sum of its logs may differ; labels change no density."""
    belief = prior(n, by_mass=True)
    space = LightContrasts(belief)
    theta = belief.from_unit_cube(np.random.default_rng(1).uniform(0.02, 0.98, (50, 6 * n + 2)))
    y = space.enter(theta)
    back, log_density = space.leave(y)
    assert np.isfinite(log_density).all()
    ratio = (back / theta)[:, :-2:6]
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio[:, :1], ratio.shape), rtol=1e-6)
    shapes = np.setdiff1d(np.arange(6 * n + 2), np.arange(0, 6 * n, 6))
    np.testing.assert_allclose(back[:, shapes], theta[:, shapes], rtol=1e-6)
    labelled = space.relabelled(y)
    assert len(labelled) == math.factorial(n)
    for each in labelled:
        other, log_other = space.leave(each)
        np.testing.assert_allclose(log_other, log_density, rtol=1e-9)
        np.testing.assert_allclose(np.sort(other[:, 1:-2:6]), np.sort(theta[:, 1:-2:6]), rtol=1e-9)
        np.testing.assert_allclose(np.sort(other[:, :-2:6]), np.sort(back[:, :-2:6]), rtol=1e-9)
