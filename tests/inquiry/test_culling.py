"""A hypothesis is asked only where its shape can be seen; the answers are those of asking everywhere."""

import numpy as np
import pytest

from probewise.effects.reading import GainDrift
from probewise.inquiry import Grid
from probewise.inquiry.culling import CullingBounds
from probewise.inquiry.forecast import predict_where_visible
from probewise.scene import AnyOf, Circle, Ellipse, Field, HypothesisScene, Rectangle, RegularPolygon
from probewise.sensor import FAST_NODES, Chain, FixedLevels, FixedMixture, FreeLevels

FIELD = Field()
PLAN = Grid(n_x=33, n_y=17).plan("field")
MIXTURE = FixedMixture(
    np.array([0.8, 0.2]), np.array([[0.0, 1.5], [3.0, -4.0]]), np.array([np.diag([16.0, 6.0]), np.diag([4.0, 30.0])])
)
LEVELS = FixedLevels(10.0, 60.0)
SHAPES = (
    Circle(FIELD),
    Ellipse(FIELD),
    Rectangle(FIELD),
    RegularPolygon(3, FIELD),
    AnyOf({"circle": Circle(FIELD), "rectangle": Rectangle(FIELD)}),
)


def chain(shape, levels=LEVELS, effects=()):
    return Chain(MIXTURE, levels, HypothesisScene(shape), effects, n_nodes=FAST_NODES)


def hypotheses(shape, n=40):
    return shape.prior.from_unit_cube(np.random.default_rng(3).random((n, len(shape.prior.names))))


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_what_is_not_asked_is_what_would_be_answered(shape):
    model, theta = chain(shape), hypotheses(shape)
    assert predict_where_visible(model, theta, PLAN) == pytest.approx(model.predict(theta, PLAN), abs=1e-6)


def test_most_hypotheses_are_not_asked_about_most_places():
    shape = SHAPES[2]
    sight = CullingBounds.of(chain(shape), hypotheses(shape), PLAN)
    parts = list(sight.visible_hypotheses_by_tile(PLAN))
    assert np.sort(np.concatenate([rows for rows, _ in parts])).tolist() == list(range(len(PLAN)))
    assert sum(rows.size * shown.size for rows, shown in parts) < 0.6 * 40 * len(PLAN)


@pytest.mark.parametrize(
    "model", [chain(SHAPES[0], FreeLevels()), chain(SHAPES[0], effects=(GainDrift(),))], ids=["levels", "effects"]
)
def test_readings_that_depend_on_more_than_the_shape_are_asked_everywhere(model):
    theta = np.full((2, len(model.names)), 50.0)
    assert CullingBounds.of(model, theta, PLAN) is None
