"""Direct predictions: a hypothesis is asked only where its shape can be seen, and few tell as thousands do."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.effects import EFFECTS
from probewise.inquiry import Designs, DirectForecast, Grid, InformationGain, Readout, UtilityInput, forecast_of
from probewise.inquiry.forecast import predict_where_visible
from probewise.recordings import Instrumentation
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


@pytest.mark.parametrize(
    "model",
    [chain(SHAPES[0], FreeLevels()), chain(SHAPES[0], effects=(EFFECTS["gain_drift"](),))],
    ids=["levels", "effects"],
)
def test_readings_that_depend_on_more_than_the_shape_are_asked_everywhere(model):
    theta = np.full((2, len(model.names)), 50.0)
    np.testing.assert_array_equal(predict_where_visible(model, theta, PLAN), model.predict(theta, PLAN))


def information_of(forecast, theta, designs):
    n, rows = len(theta), np.arange(len(designs))
    even, cost_s = np.full(n, 1.0 / n), np.ones(len(rows))
    plan = replace(designs.plan("field"), instrumentation=Instrumentation(height_mm=10.0))
    given = UtilityInput(forecast, Readout(1.0, 1.0), theta, even, theta[:50], designs, plan, rows, cost_s)
    return InformationGain()(given).reshape(-1, designs.grid.n_places)


@pytest.mark.parametrize("shape", SHAPES[1:4], ids=lambda shape: type(shape).__name__)
def test_the_best_place_of_two_hundred_hypotheses_is_nearly_the_best_of_all(shape):
    """By the exact information of 1,500 hypotheses, of a posterior a tenth as wide as the prior."""
    theta = hypotheses(shape, 1500)
    theta = theta[:1] + 0.1 * (theta - theta[:1])
    designs, model = Designs(Grid(n_x=33, n_y=17)), chain(shape)
    exact = information_of(DirectForecast(model, 1500), theta, designs)
    bits = information_of(forecast_of(model), theta, designs)
    assert exact.max() > 1.0
    assert exact[0, bits.argmax()] > exact.max() - 0.1
    assert np.sqrt(((bits - exact) ** 2).mean()) < 0.1


def test_heights_orientations_and_repeats_have_maps_of_their_own():
    theta = hypotheses(SHAPES[2], 150)
    theta = theta[:1] + 0.05 * (theta - theta[:1])
    designs = Designs(Grid(n_x=27, n_y=14), (0.0, 1.2), (1, 4), (("height_mm", (8.0, 12.0)),))
    bits = information_of(forecast_of(chain(SHAPES[2]), highest=1.2), theta, designs)
    assert len(np.unique(bits.max(axis=1).round(3))) == 8
    assert (bits[1::2] > bits[::2] - 0.02).all()  # four readings tell no less than one
