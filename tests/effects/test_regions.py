"""Graded and patched regions and the distance to an edge, each against a second route."""

from __future__ import annotations

import numpy as np
import pytest

from probewise.effects import Origin
from probewise.effects.optics import RegionWithGradient, RegionWithPatch
from probewise.scene import edge_distance
from probewise.scene.regions import (
    EllipseRegion,
    HalfPlaneRegion,
    PolygonRegion,
    QuadrantRegion,
    RampRegion,
    RegionsOfMixedKinds,
    StripesRegion,
    UniformRegion,
    disc_region,
)
from probewise.sensor import FixedMixture, Poses, mean_albedo_by_pixels, mean_albedo_under_gaussians, mean_ssf_field

EDGE = HalfPlaneRegion([0.5], [1.0], 0.9, 0.1)
CHANGED = {
    "graded": (
        RegionWithGradient(EDGE, np.array([[0.004, -0.006], [0.0, 0.01]])),
        lambda x, y: np.stack([1 + 0.004 * x - 0.006 * y, 1 + 0.01 * y]),
        lambda s, change: s * change,
    ),
    "graded from a place of its own": (
        RegionWithGradient(EDGE, np.array([[0.004, -0.006], [0.0, 0.01]]), Origin(x_mm=30.0, y_mm=-20.0)),
        lambda x, y: np.stack([1 + 0.004 * (x - 30) - 0.006 * (y + 20), 1 + 0.01 * (y + 20)]),
        lambda s, change: s * change,
    ),
    "patched": (
        RegionWithPatch(EDGE, np.array([[0.3, 2.0, -1.0, 4.0], [-0.2, 0.0, 0.0, 9.0]])),
        lambda x, y: np.stack([0.3 * np.exp(-((x - 2) ** 2 + (y + 1) ** 2) / 32), -0.2 * np.exp(-(x**2 + y**2) / 162)]),
        lambda s, change: s + change,
    ),
}


@pytest.mark.parametrize("kind", CHANGED)
def test_a_changed_surface_is_the_pattern_and_its_change(kind):
    region, change, joined = CHANGED[kind]
    points = np.random.default_rng(0).uniform(-9, 9, (50, 2))
    assert region.n_regions == 2
    wanted = joined(EDGE.albedo(points), change(*points.T))
    np.testing.assert_allclose(region.albedo(points), wanted)
    np.testing.assert_allclose(region.coverage(points, 1e-9, np.zeros(50)), wanted, atol=1e-6)


@pytest.mark.parametrize("kind", CHANGED)
def test_a_changed_surface_is_seen_alike_by_closed_form_and_by_the_papers_sum(kind):
    """The paper's sum over a discrete SSF of 0.5 mm pixels knows nothing of the closed form."""
    region = CHANGED[kind][0]
    cov = np.array([[16.0, 3.0], [3.0, 9.0]])
    ssf = FixedMixture([1.0], [[0.0, 0.0]], [cov])
    grid = np.arange(-25.0, 25.25, 0.5)
    field = mean_ssf_field(ssf.footprint(np.empty((1, 0))), u_mm=grid, v_mm=grid)
    x, y = np.array([[-6.0, 0.0, 2.0, 7.0]]), np.array([[3.0, -2.0, 1.0, 0.0]])
    discrete = mean_albedo_by_pixels(region, field, Poses(x, y, np.zeros((1, 4))))
    closed = mean_albedo_under_gaussians(
        region, x[..., None], y[..., None], *(np.full((1, 1, 1), c) for c in (16.0, 9.0, 3.0))
    )
    np.testing.assert_allclose(closed[:, :, 0], discrete, atol=2e-4)


OUTLINED = {
    "half_plane": HalfPlaneRegion([0.5], [1.0]),
    "quadrant": QuadrantRegion([[1.0, -2.0]], [[-1.0, 1.0]]),
    "stripes": StripesRegion([0.3], [7.0], [0.35], [1.0]),
    "disc": disc_region([[3.0, 1.0]], [6.0]),
    "polygon": PolygonRegion.from_vertices(np.array([[[0.0, 0.0], [8.0, 2.0], [3.0, 9.0]]])),
}


@pytest.mark.parametrize("name", OUTLINED)
def test_the_distance_is_that_to_where_the_albedo_changes(name):
    """Walk out in all directions until the albedo is another: the shortest walk, to within its steps."""
    region = OUTLINED[name]
    places = np.random.default_rng(1).uniform(-7, 7, (5, 2))
    found = edge_distance(region, places[None, :, 0], places[None, :, 1])[0]
    angles = np.linspace(0, 2 * np.pi, 361)
    radii = np.arange(0, 15, 0.02)
    for place, distance in zip(places, found, strict=True):
        rays = place + radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        albedo = region.albedo(rays.reshape(-1, 2)).reshape(len(radii), -1)
        changed = np.flatnonzero((albedo != albedo[0, 0]).any(axis=1))
        assert distance == pytest.approx(radii[changed[0]], abs=0.1)
    changed_surface = RegionWithGradient(RegionWithPatch(region, np.ones((1, 4))), np.zeros((1, 2)))
    np.testing.assert_array_equal(edge_distance(changed_surface, places[None, :, 0], places[None, :, 1])[0], found)


def test_near_an_ellipse_the_distance_is_right_to_first_order():
    ellipse = EllipseRegion([[1.0, 2.0]], [[9.0, 4.0]], [0.4])
    t = np.linspace(0, 2 * np.pi, 30)
    p, q = 9 * np.cos(t), 4 * np.sin(t)
    normal = np.stack([np.cos(t) / 9, np.sin(t) / 4]) / np.hypot(np.cos(t) / 9, np.sin(t) / 4)
    p, q = p + 0.05 * normal[0], q + 0.05 * normal[1]
    x, y = 1 + np.cos(0.4) * p - np.sin(0.4) * q, 2 + np.sin(0.4) * p + np.cos(0.4) * q
    np.testing.assert_allclose(edge_distance(ellipse, x[None], y[None]), 0.05, rtol=0.05)
    assert edge_distance(ellipse, np.array([[1.0]]), np.array([[2.0]]))[0, 0] == pytest.approx(4.0)


def test_where_there_is_no_edge_it_is_infinitely_far():
    place = np.zeros((1, 1))
    for region in (UniformRegion([0.5]), RampRegion([0.0], [0.1])):
        assert edge_distance(region, place, place)[0, 0] == np.inf


def test_each_hypothesis_of_a_mixture_has_its_own_edge():
    mixture = RegionsOfMixedKinds([1, 0, 1], (HalfPlaneRegion([0.0], [3.0]), disc_region([[0.0, 0.0]] * 2, [5.0, 7.0])))
    np.testing.assert_allclose(edge_distance(mixture, np.zeros((1, 1)), np.zeros((1, 1))), [[5.0], [3.0], [7.0]])
