from __future__ import annotations

import numpy as np
import pytest

from probewise.calibration import calibrate, default_prior
from probewise.calibration.order_problems import ProblemsByOrder
from probewise.calibration.peaks import _split_gaussian, find_highest_likelihood_peak_by_order
from probewise.recordings import Recording, paper_plan
from probewise.world import Blob, World, gaussian_spot


@pytest.fixture(scope="module")
def two_lobes() -> Recording:
    """A sensor of two spots of equal light, 8 mm apart."""
    spot = gaussian_spot([Blob(0.5, (3.5, 2.0), (2.5, 3.0)), Blob(0.5, (-3.5, -2.0), (2.5, 3.0))])
    return World(spot, noise_sd=0.4).simulate(paper_plan(), rng=np.random.default_rng(8))


def test_the_peak_of_one_gaussian_is_no_lower_than_the_truth(recording: Recording, truth: np.ndarray) -> None:
    problem = ProblemsByOrder(recording, default_prior).problem
    peak = find_highest_likelihood_peak_by_order(problem, 1, rng=np.random.default_rng(9))[1]
    assert peak.log_likelihood >= problem(1).log_likelihood(truth[None])[0]
    assert peak.log_likelihood == pytest.approx(problem(1).log_likelihood(peak.theta[None])[0])


def test_two_lobes_are_found(two_lobes: Recording) -> None:
    peaks = find_highest_likelihood_peak_by_order(
        ProblemsByOrder(two_lobes, default_prior).problem, 2, rng=np.random.default_rng(13)
    )
    assert peaks[2].log_likelihood > peaks[1].log_likelihood + 50
    centres = peaks[2].theta[[1, 2, 7, 8]].reshape(2, 2)
    np.testing.assert_allclose(np.abs(centres), [[3.5, 2.0], [3.5, 2.0]], atol=0.4)


def test_a_split_keeps_light_centre_and_covariance(recording: Recording) -> None:
    rng = np.random.default_rng(10)
    prior = default_prior(recording, 1)
    theta = prior.from_unit_cube(rng.uniform(0.05, 0.95, (30, 8)))
    apart = _split_gaussian(theta, rng)

    def moments(rows: np.ndarray) -> np.ndarray:
        g = rows[:, :-2].reshape(len(rows), -1, 6)
        det = g[..., 3] * g[..., 4] - g[..., 5] ** 2
        light = g[..., 0] / np.sqrt(det)
        u, v = g[..., 1], g[..., 2]
        second = [0.5 * g[..., 4] / det + u * u, 0.5 * g[..., 3] / det + v * v, -0.5 * g[..., 5] / det + u * v]
        return np.stack([(light * part).sum(axis=1) for part in (np.ones_like(u), u, v, *second)], axis=1)

    np.testing.assert_allclose(moments(apart), moments(theta), rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_a_sensor_of_two_lobes_is_calibrated_without_a_search(two_lobes: Recording) -> None:
    """The evidence of two Gaussians as by nested sampling, within four of both errors."""
    quick = calibrate(two_lobes, orders=(1, 2), quick=True, rng=np.random.default_rng(11))
    assert not any("searched in full" in note for fit in quick.fits for note in fit.sensor.notes)
    full = calibrate(two_lobes, orders=(2,), n_live=200, rng=np.random.default_rng(12))
    one, other = quick.orders[1], full.orders[0]
    assert abs(one.log_z - other.log_z) < 4 * np.hypot(one.log_z_error, other.log_z_error)
    assert quick.chosen.n_gaussians == 2
