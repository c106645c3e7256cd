"""Albedo and coverage of every kind of region."""

import numpy as np
import pytest

from probewise.errors import ParameterError, ShapeError
from probewise.recordings import patterns as kinds
from probewise.scene import (
    HalfPlaneRegion,
    ImageRegion,
    PolygonRegion,
    RegionsOfMixedKinds,
    StripesRegion,
    disc_region,
    edge_distance,
    outlines,
    region_of,
)


def test_the_inner_pentagon_of_a_star_is_outside_by_the_even_odd_rule():
    star = region_of(kinds.Polygon(((0.0, 20.0), (12.0, -16.0), (-19.0, 6.0), (19.0, 6.0), (-12.0, -16.0))))
    assert star.albedo(np.array([[0.0, 0.0], [0.0, 17.0]])).tolist() == [[0.0, 1.0]]
    assert star.edges_mm.shape == (1, 15, 2, 2)  # five triangles


def test_a_polygon_of_many_vertices_is_taken_apart_at_once():
    """A tenth of a second of arithmetic; edge by edge it was a minute. Its area is a regular polygon's."""
    n = 1500
    angle = 2 * np.pi * np.arange(n) / n
    (edges,) = PolygonRegion.from_even_odd_vertices(20 * np.stack([np.cos(angle), np.sin(angle)], axis=1)).edges_mm
    assert 0.5 * np.linalg.det(edges).sum() == pytest.approx(0.5 * n * 400 * np.sin(2 * np.pi / n))


def test_quadrant_and_half_plane_follow_the_format_at_the_edge():
    """Inside is strictly beyond the edge (recording format)."""
    half = region_of(kinds.HalfPlane(0.0, 1.0))
    quadrant = region_of(kinds.Quadrant((0.0, 0.0), (1, -1)))
    assert half.albedo(np.array([[1.0, 0.0], [1.0001, 0.0]])).tolist() == [[0.0, 1.0]]
    assert quadrant.albedo(np.array([[1.0, -1.0], [1.0, 1.0], [0.0, -1.0]])).tolist() == [[1.0, 0.0, 0.0]]


def test_stripes_that_fill_the_field_or_none_of_it_have_no_edge():
    flat = StripesRegion(normal_rad=0.0, period_mm=10.0, duty=np.array([0.0, 0.5, 1.0]), phase_mm=0.0)
    away = edge_distance(flat, np.array([2.0]), np.array([0.0]))
    np.testing.assert_array_equal(away[:, 0], [np.inf, 2.0, np.inf])


def test_an_image_has_its_first_row_on_top():
    region = ImageRegion(np.array([[1.0, 0.0], [0.25, 0.5]]), 10.0, (0.0, 0.0))
    points = np.array([[5.0, 15.0], [15.0, 15.0], [5.0, 5.0], [15.0, 5.0], [25.0, 5.0], [-1.0, 5.0]])
    assert region.albedo(points).tolist() == [[1.0, 0.0, 0.25, 0.5, 0.0, 0.0]]


def test_a_mixture_takes_each_hypothesis_from_its_own_kind():
    disc = disc_region(np.zeros((2, 2)), np.array([1.0, 5.0]))
    half = HalfPlaneRegion(np.zeros(1), np.zeros(1))
    mixed = RegionsOfMixedKinds(np.array([0, 1, 0]), (disc, half))
    assert mixed.albedo(np.array([[3.0, 0.0], [-0.5, 0.0]])).tolist() == [[0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: HalfPlaneRegion([np.nan], [0.0]), r"normal_rad\[0\] is nan"),
        (lambda: HalfPlaneRegion([0.0, 1.0, 2.0], [0.0, 1.0]), "offset_mm has 2 rows"),
        (lambda: PolygonRegion.from_vertices(np.zeros((1, 2, 2))), "3 or more"),
        (lambda: PolygonRegion.from_even_odd_vertices(np.zeros((4, 2))), "a polygon whose area is not 0"),
        (
            lambda: PolygonRegion.from_even_odd_vertices(np.array([[0.0, 0], [1, 0], [2, 0]])),
            "polygon whose area is not 0",
        ),
        (lambda: ImageRegion(np.zeros((0, 3)), 1.0, (0.0, 0.0)), "not empty"),
        (lambda: outlines(HalfPlaneRegion(np.zeros(1), np.zeros(1))), "HalfPlaneRegion"),
        (lambda: region_of("a square"), "a pattern of probewise.recordings.patterns"),
    ],
)
def test_numbers_that_make_no_region_are_named(build, message):
    with pytest.raises((ParameterError, ShapeError), match=message):
        build()
