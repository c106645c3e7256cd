"""Gain on held-out readings."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from probewise.diagnosis.evidence import mean_gain_over_parts, predictive_log_densities
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.diagnosis.noise import NoiseLaw
from probewise.recordings import Recording, paper_plan

PAPER = Recording(paper_plan(), np.zeros(len(paper_plan())))


def test_many_scans_side_by_side_are_kept_back_by_pattern_and_orientation():
    """Sixteen scans: eight lines over each of two orientations."""
    plan = PAPER.plan
    rows = np.flatnonzero(plan.scan < 2)
    scan = np.concatenate([8 * plan.scan[rows] + (np.arange(len(rows)) // 12) % 8])
    taken = plan.take(rows)
    many = type(taken)(
        **{
            **{name: getattr(taken, name) for name in taken.__dataclass_fields__},
            "scan": np.sort(scan),
            "scan_names": tuple(f"line_{k}" for k in range(16)),
        }
    )
    parts, names = LightSensorApparatus().held_out_parts(Recording(many, np.zeros(len(many))))
    assert len(names) == 2
    assert names[0].endswith("0 degrees")
    np.testing.assert_array_equal(parts, np.round(many.orientation_rad / (np.pi / 2)).astype(int) - int(parts[0] != 0))
    a_turn_more = replace(many, orientation_rad=many.orientation_rad + 2 * np.pi * (many.scan % 2))
    again, names_again = LightSensorApparatus().held_out_parts(Recording(a_turn_more, np.zeros(len(many))))
    np.testing.assert_array_equal(again, parts)
    assert names_again == names
    held = mean_gain_over_parts(parts, lambda out: np.where(parts[out] == 0, 1.0, -1.0), names)
    assert dict(held.by_scan) == {names[0]: 1.0, names[1]: -1.0}


def _covariance(kind, sd):
    """Return a noise law of 60 readings and its covariance, in units of sigma^2."""
    n, at, nothing = len(sd), np.arange(len(sd)), np.zeros(len(sd))
    if kind == "walk":
        return NoiseLaw(sd, nothing, nothing > 0, walk=np.full(n, 0.3)), 0.3 * (1 + np.minimum.outer(at, at)) + np.diag(
            sd**2
        )
    carry = np.where(at > 0, 0.9, 0.0)
    return NoiseLaw(sd, carry, nothing > 0), 0.9 ** np.abs(np.subtract.outer(at, at)) * np.outer(sd, sd)


@pytest.mark.parametrize("kind", ["walk", "ar"])
@pytest.mark.parametrize("block", [(0, 12), (24, 36), (48, 60)])
def test_a_part_held_out_of_noise_with_memory_has_its_density_given_the_rest(kind, block):
    """Route two: the multivariate normal of all readings over that of those kept, coordinates integrated out."""
    rng, n, sigma = np.random.default_rng(8), 60, 0.4
    law, covariance = _covariance(kind, rng.uniform(0.5, 1.5, n))
    slopes = np.stack([np.ones(n), np.linspace(-3, 3, n), np.sin(np.arange(n))], axis=1)
    every = slopes @ slopes.T + sigma**2 * covariance
    readings = rng.multivariate_normal(np.zeros(n), every)
    out = (np.arange(n) >= block[0]) & (np.arange(n) < block[1])
    rest = np.linalg.inv(sigma**2 * covariance[np.ix_(~out, ~out)])
    spread = np.linalg.inv(slopes[~out].T @ rest @ slopes[~out] + np.eye(3))
    mean = spread @ slopes[~out].T @ rest @ readings[~out]
    found = predictive_log_densities(law, out, readings, slopes, mean, spread, sigma**2)
    kept = multivariate_normal(np.zeros(n - 12), every[np.ix_(~out, ~out)])
    assert found.sum() == pytest.approx(
        multivariate_normal(np.zeros(n), every).logpdf(readings) - kept.logpdf(readings[~out])
    )
    told = every[np.ix_(out, ~out)] @ np.linalg.inv(every[np.ix_(~out, ~out)])
    left, variance = (
        readings[out] - told @ readings[~out],
        np.diag(every[np.ix_(out, out)] - told @ every[~out][:, out]),
    )
    alone = predictive_log_densities(law, out, readings, slopes, mean, spread, sigma**2, sequential=False)
    np.testing.assert_allclose(alone, -0.5 * (np.log(2 * np.pi * variance) + left**2 / variance), rtol=1e-6)
