"""What every kind of region keeps to: whoever adds one finds here what it lacks."""

import numpy as np
import pytest
from mixtures import mean_albedo_under_gaussians

from probewise.scene import edge_distance, outlines, regions
from probewise.scene.regions import (
    EllipseRegion,
    HalfPlaneRegion,
    ImageRegion,
    PolygonRegion,
    QuadrantRegion,
    RampRegion,
    RegionsOfMixedKinds,
    StripesRegion,
    UniformRegion,
)
from probewise.sensor import FixedMixture, Poses, mean_albedo_by_pixels, mean_ssf_field
from probewise.sensor.gaussian import mean_albedo_under_one_gaussian

ELLIPSE = EllipseRegion([[3.0, 1.0]], [[14.0, 9.0]], [0.4])
POLYGON = PolygonRegion.from_vertices(np.array([[[0.0, 0.0], [14.0, 2.0], [9.0, 15.0], [4.0, 6.0]]]))
KINDS = {
    "UniformRegion": UniformRegion([0.3]),
    "HalfPlaneRegion": HalfPlaneRegion([0.4], [2.0]),
    "QuadrantRegion": QuadrantRegion([[1.0, -2.0]], [[-1, 1]]),
    "EllipseRegion": ELLIPSE,
    "PolygonRegion": POLYGON,
    "StripesRegion": StripesRegion([0.3], [11.0], [0.35], [1.0]),
    "RampRegion": RampRegion([0.7], [0.02]),
    "ImageRegion": ImageRegion(np.random.default_rng(5).random((12, 16)), 2.0, (-15.0, -11.0)),
    "RegionsOfMixedKinds": RegionsOfMixedKinds([0, 1], (ELLIPSE, POLYGON)),
}
PLACES = np.random.default_rng(1).uniform(-18, 22, (200, 2))


def registered(function):
    return [kind for kind, one in KINDS.items() if function.dispatch(type(one)) is not function.dispatch(object)]


def test_every_kind_of_region_is_here():
    assert {name for name in vars(regions) if name.endswith("Region") or name.startswith("RegionsOf")} - {
        "Region"
    } == set(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_a_footprint_is_seen_alike_by_closed_form_and_by_the_papers_sum(kind):
    """And it has a closed form: without one the sensor warns, which fails here."""
    cov = np.array([[16.0, 3.0], [3.0, 9.0]])
    grid = np.arange(-25.0, 25.25, 0.5)
    ssf = FixedMixture([1.0], [[0.0, 0.0]], [cov])
    field = mean_ssf_field(ssf.footprint(np.empty((1, 0))), u_mm=grid, v_mm=grid)
    x, y = np.array([[-6.0, 0.0, 2.0, 12.0]]), np.array([[3.0, -2.0, 8.0, 4.0]])
    by_pixels = mean_albedo_by_pixels(KINDS[kind], field, Poses(x, y, np.zeros((1, 4))))
    closed = mean_albedo_under_gaussians(
        KINDS[kind], x[..., None], y[..., None], *(np.full((1, 1, 1), c) for c in (16.0, 9.0, 3.0))
    )
    np.testing.assert_allclose(closed[:, :, 0], by_pixels, atol=1.6e-3)
    assert kind in registered(mean_albedo_under_one_gaussian)


@pytest.mark.parametrize("kind", KINDS)
def test_no_edge_is_nearer_than_its_distance_says(kind):
    """Within nine tenths of the distance the albedo is that of the place itself, in whatever direction one goes."""
    if kind not in registered(edge_distance):
        assert np.isinf(edge_distance(KINDS[kind], PLACES[None, :, 0], PLACES[None, :, 1])).all()
        return
    region = KINDS[kind]
    distance = edge_distance(region, PLACES[None, :, 0], PLACES[None, :, 1])
    assert distance.shape == (region.n_regions, len(PLACES))
    for angle in np.linspace(0, 2 * np.pi, 24, endpoint=False):
        way = np.array([np.cos(angle), np.sin(angle)])
        for row in range(region.n_regions):
            # An ellipse's distance is of first order: far away it may be too large, hence no farther than 2 mm.
            there = PLACES + 0.9 * np.minimum(distance[row], 2.0)[:, None] * way
            np.testing.assert_array_equal(region.albedo(there)[row], region.albedo(PLACES)[row])


@pytest.mark.parametrize("kind", registered(outlines))
def test_a_closed_outline_lies_on_the_edge(kind):
    for row, trace in enumerate(outlines(KINDS[kind])):
        np.testing.assert_allclose(trace[0], trace[-1], atol=1e-12)
        along = edge_distance(KINDS[kind], trace[None, :, 0], trace[None, :, 1])[row]
        assert along.max() < 1e-6
