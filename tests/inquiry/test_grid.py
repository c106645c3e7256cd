"""The readings that may be taken: places of a grid, orientations, repeats, other settings, and what they cost."""

import numpy as np
import pytest

from probewise.errors import ParameterError
from probewise.inquiry import Designs, Grid

SMALL = Grid(2.0, 1.0, 3, 2)


def test_every_combination_stands_at_every_place():
    designs = Designs(SMALL, (0.0, 1.5), (1, 3), (("height_mm", (8.0, 14.0)),))
    plan = designs.plan("field", time_s=7.0)
    assert len(designs) == len(plan) == 6 * 8
    for row in range(len(designs)):
        design = designs[row]
        assert (design.x_mm, design.y_mm) == (plan.x_mm[row], plan.y_mm[row])
        assert design.orientation_rad == plan.orientation_rad[row]
        assert design.repeats == designs.n_repeats[row]
        assert dict(design.settings) == {"height_mm": plan.covariates["height_mm"][row]}
    assert len({designs[row] for row in range(len(designs))}) == len(designs)
    assert (plan.time_s == 7.0).all()
    assert (plan.direction_of_motion == 0).all()


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"orientations_rad": ()}, "orientations_rad"),
        ({"repeats": (0,)}, "repeats"),
        ({"settings": (("height_mm", ()),)}, "height_mm"),
        ({"orientations_rad": (np.nan,)}, "orientations_rad"),
    ],
)
def test_designs_that_are_none_are_refused(change, name):
    with pytest.raises(ParameterError, match=name):
        Designs(SMALL, **change)


def test_the_grid_is_the_papers_field_row_by_row():
    grid = Grid()
    assert grid.n_places == 131 * 65
    np.testing.assert_allclose(grid.x_mm, np.linspace(0, 1048, 131))
    np.testing.assert_allclose(grid.y_mm, np.linspace(0, 520, 65))
    assert grid.image(grid.places_mm[:, 0])[3, 7] == pytest.approx(grid.x_mm[7])
    assert grid.image(grid.places_mm[:, 1])[3, 7] == pytest.approx(grid.y_mm[3])


@pytest.mark.parametrize("change", [{"width_mm": 0.0}, {"n_x": 1}, {"height_mm": float("nan")}])
def test_a_grid_without_extent_is_refused(change):
    with pytest.raises(ParameterError):
        Grid(**change)
