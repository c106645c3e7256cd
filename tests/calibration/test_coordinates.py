"""The SSF's own coordinates: moments instead of A, B and C, Gaussians sorted by mass."""

from __future__ import annotations

import math

import numpy as np
import pytest

from probewise.calibration import SSFPrior
from probewise.priors import LogUniform, Uniform


def prior(n_gaussians: int, *, by_mass: bool) -> SSFPrior:
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
def test_the_unit_cube_is_found_again(n_gaussians: int, by_mass: bool) -> None:
    belief = prior(n_gaussians, by_mass=by_mass)
    u = np.random.default_rng(1).random((50, len(belief.names)))
    assert belief.to_unit_cube(belief.from_unit_cube(u)) == pytest.approx(u, abs=1e-9)


@CASES
def test_coordinates_lead_back_to_the_gaussians_sorted_by_mass(n_gaussians: int, by_mass: bool) -> None:
    belief = prior(n_gaussians, by_mass=by_mass)
    theta = belief.from_unit_cube(np.random.default_rng(2).random((50, len(belief.names))))
    x = belief.coordinates.enter(theta)
    back, log_density = belief.coordinates.leave(x)
    assert np.isfinite(log_density).all()
    g = back[:, :-2].reshape(50, n_gaussians, 6)
    mass = g[..., 0] / np.sqrt(g[..., 3] * g[..., 4] - g[..., 5] ** 2)
    assert (np.diff(mass, axis=1) <= 0).all()
    # The same Gaussians in another order.
    ours, theirs = np.sort(g[..., 1], axis=1), np.sort(theta[:, :-2].reshape(50, n_gaussians, 6)[..., 1], axis=1)
    assert ours == pytest.approx(theirs, abs=1e-9)
    assert belief.coordinates.enter(back) == pytest.approx(x, abs=1e-9)


@CASES
def test_the_density_is_the_priors_times_the_volume_that_coordinates_stretch(n_gaussians: int, by_mass: bool) -> None:
    """The Jacobian by central differences; N! for the labellings that became one."""
    belief = prior(n_gaussians, by_mass=by_mass)
    n_params = len(belief.names)
    for row in belief.coordinates.enter(belief.from_unit_cube(np.random.default_rng(3).random((5, n_params)))):
        step = 1e-6 * np.maximum(1.0, np.abs(row))
        ahead, behind = (belief.coordinates.leave(row + sign * np.diag(step))[0] for sign in (1, -1))
        stretch = np.linalg.slogdet((ahead - behind) / (2 * step[:, None])).logabsdet
        theta, log_density = belief.coordinates.leave(row[None])
        expected = belief.log_prob(theta)[0] + stretch + math.lgamma(n_gaussians + 1)
        assert log_density[0] == pytest.approx(expected, abs=1e-6)


def test_nothing_is_dense_where_no_prior_is() -> None:
    belief = prior(2, by_mass=False)
    inside = belief.coordinates.enter(belief.from_unit_cube(np.full((1, 14), 0.4)))
    for column, value in ((0, 1.0), (1, 50.0), (3, 12.0), (3, 1e6), (5, 9.0), (6, 0.5), (13, 100.0)):
        outside = inside.copy()
        outside[0, column] = value
        theta, log_density = belief.coordinates.leave(outside)
        assert log_density[0] == -np.inf, (column, value)
        assert np.isfinite(theta).all() or not np.isfinite(log_density[0])
