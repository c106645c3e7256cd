from __future__ import annotations

from typing import cast

import numpy as np
import pytest

from probewise._arrays import FloatArray
from probewise.calibration import default_prior
from probewise.calibration.label_symmetric_coordinates import LabelSymmetricCoordinates
from probewise.calibration.peak_density import PeakDensity, StudentTDensity, share_missed_about_peak
from probewise.inference import SensorProblem
from probewise.recordings import Recording


class _Silent:
    """A recording that says nothing: the evidence is one."""

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        return np.zeros(len(theta))


@pytest.mark.parametrize("n", [1, 2, 3])
def test_parameters_come_back_but_for_the_light_of_all(recording: Recording, n: int) -> None:
    """Readings depend on ratios of light alone, so that the sum of its logs may differ."""
    prior = default_prior(recording, n)
    space = LabelSymmetricCoordinates(prior)
    theta = prior.from_unit_cube(np.random.default_rng(1).uniform(0.02, 0.98, (50, 6 * n + 2)))
    back, log_density = space.leave(space.enter(theta))
    assert np.isfinite(log_density).all()
    ratio = (back / theta)[:, :-2:6]
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio[:, :1], ratio.shape), rtol=1e-6)
    shapes = np.setdiff1d(np.arange(6 * n + 2), np.arange(0, 6 * n, 6))
    np.testing.assert_allclose(back[:, shapes], theta[:, shapes], rtol=1e-6)
    np.testing.assert_allclose(prior.to_unit_cube(back)[:, : 6 * n : 6].max(axis=1), 1.0, rtol=1e-9)


def test_a_change_of_labels_changes_neither_density_nor_readings(recording: Recording) -> None:
    prior = default_prior(recording, 3)
    space = LabelSymmetricCoordinates(prior)
    y = space.enter(prior.from_unit_cube(np.random.default_rng(2).uniform(0.02, 0.98, (20, 20))))
    theta, log_density = space.leave(y)
    assert len(space.label_permutations) == 6
    for change in space.label_permutations:
        other, log_other = space.leave(space.apply_label_permutation(y, change))
        np.testing.assert_allclose(log_other, log_density, rtol=1e-9)
        np.testing.assert_allclose(np.sort(other[:, 1:-2:6]), np.sort(theta[:, 1:-2:6]), rtol=1e-9)
        np.testing.assert_allclose(np.sort(other[:, :-2:6]), np.sort(theta[:, :-2:6]), rtol=1e-9)


@pytest.mark.parametrize("n", [1, 2])
def test_the_prior_integrates_to_one_in_these_coordinates(recording: Recording, n: int) -> None:
    """Draws of a Student-t that is fitted to the prior weigh one on average; five errors."""
    prior = default_prior(recording, n)
    space, rng = LabelSymmetricCoordinates(prior), np.random.default_rng(3)
    y = space.enter(prior.from_unit_cube(rng.random((4000, 6 * n + 2))))
    density = PeakDensity(space, StudentTDensity(y.mean(axis=0), np.linalg.cholesky(np.cov(y, rowvar=False))))
    _, _, log_density = density.draw_and_keep_within_prior(40_000, rng=rng)
    error = np.exp(-log_density).std() * np.sqrt(len(log_density)) / 40_000
    assert abs(np.exp(-log_density).sum() / 40_000 - 1.0) < 5 * error < 0.15


def test_a_peak_is_missed_where_its_part_of_the_evidence_has_no_samples(recording: Recording) -> None:
    """Of the prior's evidence of one, the samples of one half miss about a half."""
    prior, silent = default_prior(recording, 1), cast("SensorProblem", _Silent())
    space, rng = LabelSymmetricCoordinates(prior), np.random.default_rng(4)
    theta = prior.from_unit_cube(rng.random((4000, 8)))
    half = theta[theta[:, 1] < 0.0]
    y = space.enter(theta[theta[:, 1] > 0.0])
    density = PeakDensity(space, StudentTDensity(y.mean(axis=0), 0.8 * np.linalg.cholesky(np.cov(y, rowvar=False))))
    asked = {
        name: share_missed_about_peak(silent, density, some, np.log(z), n_draws=4000, rng=rng)
        for name, some, z in (("all", theta, 1.0), ("half", half, 0.5))
    }
    assert asked["all"] < 0.05
    assert 0.2 < asked["half"] <= 0.5
