"""Readings that share a view of a straight edge or corner, against each reading's own closed form."""

import math

import numpy as np
import pytest
from mixtures import mean_albedo_under_gaussians
from scipy.special import ndtr, owens_t

from probewise.recordings import paper_plan
from probewise.recordings import patterns as kinds
from probewise.recordings.plan import Plan
from probewise.scene import KnownScene, region_of
from probewise.sensor import Chain, FixedLevels, FreeMixture, footprint_of
from probewise.sensor.gaussian import moments_in_lab_frame, probabilities_beyond_corner_and_sides

EDGES = {
    "edge": kinds.HalfPlane(0.0, 0.0),
    "its other side": kinds.HalfPlane(math.pi, 0.0),
    "grey": kinds.HalfPlane(0.3, 2.0, inside=0.9, outside=0.2),
    "grey from behind": kinds.HalfPlane(0.3 + math.pi, -2.0, inside=0.1, outside=0.7),
}
CORNERS = {
    f"{dx:+d}{dy:+d}": kinds.Quadrant((1.0, 2.0), (dx, dy), inside=0.9, outside=0.2 + 0.1 * dx)
    for dx in (-1, 1)
    for dy in (-1, 1)
}


def thetas(n_samples=5, n_gaussians=2):
    rng = np.random.default_rng(3)
    one = np.array([1.0, 0.5, 1.5, 0.02, 0.01, 0.005])
    return np.tile(one, (n_samples, n_gaussians)) * rng.uniform(0.6, 1.4, (n_samples, 6 * n_gaussians))


def out_and_back(patterns):
    """Scan every pattern at four angles, out and back, then once more at places of no order."""
    rng, n = np.random.default_rng(4), 4 * 14 * len(patterns)
    x = np.concatenate([np.linspace(-9, 9, 7), np.linspace(9, -9, 7)])
    turn = np.repeat(np.radians([0, 90, 180, 270]), 14)
    kind = np.repeat(np.arange(len(patterns)), 4 * 14)
    return Plan(
        x_mm=np.concatenate([np.tile(x, n // 14), rng.uniform(-9, 9, n)]),
        y_mm=np.concatenate([np.zeros(n), rng.uniform(-9, 9, n)]),
        orientation_rad=np.tile(turn, 2 * len(patterns)),
        time_s=np.arange(2.0 * n),
        scan=np.zeros(2 * n, dtype=int),
        scan_names=("scan",),
        pattern=np.concatenate([kind, rng.permutation(kind)]),
        pattern_names=tuple(patterns),
        patterns=patterns,
    )


def by_itself(theta, plan, row):
    """What a reading sees, from the closed form of its own pattern."""
    foot = footprint_of(theta, theta.shape[1] // 6)
    dx, dy, *spread = moments_in_lab_frame(
        plan.orientation_rad[row], foot.u_mm, foot.v_mm, foot.var_u, foot.var_v, foot.cov_uv
    )
    region = region_of(plan.patterns[plan.pattern_names[plan.pattern[row]]])
    return (mean_albedo_under_gaussians(region, plan.x_mm[row] + dx, plan.y_mm[row] + dy, *spread) * foot.weight).sum(
        axis=2
    )[:, 0]


@pytest.mark.parametrize("patterns", [EDGES, CORNERS, EDGES | CORNERS], ids=["edges", "corners", "both"])
def test_readings_that_share_a_view_see_what_each_sees_by_itself(patterns):
    theta, plan = thetas(), out_and_back(patterns)
    found = Chain(FreeMixture(2), FixedLevels(0.0, 1.0), KnownScene(plan.patterns)).predict(theta, plan)
    for row in range(len(plan)):
        assert found[:, row] == pytest.approx(by_itself(theta, plan, row), abs=1e-9)


def test_the_papers_scans_from_both_sides_are_half_as_many_views():
    """Four scans of 101 readings at right angles: the third and the fourth see the first two's places from behind."""
    plan = paper_plan()
    chain = Chain(FreeMixture(1), FixedLevels(0.0, 1.0), KnownScene(plan.patterns))
    edges = chain._layout_under_poses(thetas(1, 1), plan).straight_batches[0]
    assert len(edges.rows) == 404
    assert len(edges.distance_mm) == 202


def test_what_lies_beyond_a_corner_is_owens_function():
    """Owen (1956), near and far; and the angle alone where the corner is the centre."""
    rng = np.random.default_rng(5)
    z1, z2 = rng.normal(size=(2, 4000)) * 10.0 ** rng.uniform(-6, 2, (2, 4000))
    z1[:500], z2[250:750] = 0.0, 0.0
    rho = rng.uniform(-0.98, 0.98, 4000) * (rng.random(4000) < 0.8)
    free = np.sqrt(1 - rho**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope_1, slope_2 = (z2 / z1 - rho) / free, (z1 / z2 - rho) / free
    apart = np.where(z1 * z2 < 0, 0.5, 0.0)
    wanted = 0.5 * (ndtr(-z1) + ndtr(-z2)) - owens_t(z1, slope_1) - owens_t(z2, slope_2) - apart
    both, beyond_1, beyond_2 = probabilities_beyond_corner_and_sides(z1, z2, rho)
    known = (z1 != 0) & (z2 != 0)
    np.testing.assert_allclose(both[known], wanted[known], atol=1e-12)
    at_origin = (z1 == 0) & (z2 == 0)
    np.testing.assert_allclose(both[at_origin], 0.25 + np.arcsin(rho[at_origin]) / (2 * np.pi), atol=1e-14)
    np.testing.assert_allclose(beyond_1, ndtr(-z1), atol=1e-15)
    np.testing.assert_allclose(beyond_2, ndtr(-z2), atol=1e-15)
