"""Distance to an edge, against a search for the nearest place where the painted albedo changes."""

import math

import numpy as np
import pytest

from probewise.recordings import Disc, HalfPlane, Polygon, Quadrant, Stripes
from probewise.world import Oval, albedo_at
from probewise.world.surfaces import common_edge_normal, distance_to_nearest_edge

SURFACES = {
    "half plane": HalfPlane(0.7, 1.3),
    "quadrant": Quadrant((1.0, 2.0), (-1, 1)),
    "disc": Disc((3.0, -2.0), 6.3),
    "oval": Oval((0.0, 1.0), (7.0, 4.0), 0.4),
    "polygon": Polygon(((-6.0, -5.0), (7.0, -3.0), (2.0, 6.0))),
    "stripes": Stripes(0.2, 7.0, 0.4, 1.0),
}


@pytest.mark.parametrize("name", SURFACES)
def test_the_distance_is_that_to_the_nearest_change_of_albedo(name):
    surface, rng = SURFACES[name], np.random.default_rng(2)
    x, y = rng.uniform(-8, 8, (2, 8))
    distance = distance_to_nearest_edge(surface, x, y)
    # Along rays in all directions, how far the albedo stays what it is at the place.
    turn, radius = np.arange(600) * (2 * math.pi / 600), np.linspace(0, 16, 801)
    for k in range(len(x)):
        ray_x = x[k] + radius[:, None] * np.cos(turn)
        ray_y = y[k] + radius[:, None] * np.sin(turn)
        changed = albedo_at(surface, ray_x, ray_y) != albedo_at(surface, x[k : k + 1], y[k : k + 1])
        nearest = radius[np.flatnonzero(changed.any(axis=1))[0]]
        assert distance[k] == pytest.approx(nearest, abs=0.04)


def test_across_is_the_normal_of_straight_edges_and_x_elsewhere():
    assert common_edge_normal(HalfPlane(0.7, 1.3)) == pytest.approx((math.cos(0.7), math.sin(0.7)))
    assert common_edge_normal(Stripes(0.2, 7.0, 0.4, 1.0)) == pytest.approx((math.cos(0.2), math.sin(0.2)))
    assert common_edge_normal(Disc((0, 0), 1.0)) == (1.0, 0.0)
