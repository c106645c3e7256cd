"""Quick readings of ellipses and convex polygons, against the sensor's closed forms for every pair."""

import math
import time
from dataclasses import dataclass, replace

import numpy as np
import pytest

from probewise.effects.reading import GainDrift
from probewise.inquiry import (
    Designs,
    DirectForecast,
    Finishing,
    Goal,
    Grid,
    InformationGain,
    Readout,
    TabulatedForecast,
    UtilityInput,
    forecast_of,
    utility_map,
)
from probewise.priors import Product, Uniform
from probewise.recordings import Instrumentation
from probewise.scene import AnyOf, Circle, Ellipse, Field, HypothesisScene, PolygonRegion, Rectangle, RegularPolygon
from probewise.sensor import FAST_NODES, Chain, FixedLevels, FixedMixture

FIELD, DARK, SPAN = Field(), 10.0, 50.0
ONE = FixedMixture(np.ones(1), np.array([[0.0, 1.5]]), np.array([[[16.0, 2.0], [2.0, 6.25]]]))
TWO = FixedMixture(
    np.array([0.7, 0.3]),
    np.array([[0.5, 1.5], [-3.0, 1.0]]),
    np.array([[[16.0, 2.0], [2.0, 6.25]], np.diag([9.0, 20.0])]),
)
SHAPES = {
    "rectangle": Rectangle(FIELD),
    "narrow": Rectangle(FIELD, (15.0, 100.0)),
    "triangle": RegularPolygon(3, FIELD),
    "hexagon": RegularPolygon(6, FIELD),
    "ellipse": Ellipse(FIELD),
    "circle": Circle(FIELD),
    "any of two": AnyOf({"circle": Circle(FIELD), "rectangle": Rectangle(FIELD)}),
}
RMS = 0.005  # of the span: what `TabulatedForecast` promises


def chain(shape, mixture=ONE, effects=()):
    return Chain(mixture, FixedLevels(DARK, DARK + SPAN), HypothesisScene(shape), effects, n_nodes=FAST_NODES)


def hypotheses(shape, n, seed=3):
    return shape.prior.from_unit_cube(np.random.default_rng(seed).random((n, len(shape.prior.names))))


def prospect_of(forecast, theta, designs, *, instrumentation=None, noise_sd=1.0, goal=None, turn_rad=0.0):
    plan = designs.plan("field")
    plan = replace(
        plan,
        orientation_rad=plan.orientation_rad + turn_rad,
        instrumentation=instrumentation or Instrumentation(),
    )
    n, rows = len(theta), np.arange(len(designs))
    weight = np.full(n, 1.0 / n)
    cost = np.ones(len(rows))
    return UtilityInput(forecast, Readout(noise_sd, 1.0), theta, weight, theta[:50], designs, plan, rows, cost, goal)


@pytest.mark.parametrize("mixture", [ONE, pytest.param(TWO, marks=pytest.mark.slow)], ids=["one", "two"])
@pytest.mark.parametrize("name", SHAPES)
def test_predictions_near_the_edges_are_those_of_the_closed_form(name, mixture):
    """Places of a fine grid about one edge at a time: where nothing is seen nothing can be wrong."""
    shape = SHAPES[name]
    model, theta = chain(shape, mixture), hypotheses(shape, 60)
    forecast = TabulatedForecast.of(model)
    rng = np.random.default_rng(4)
    plan = Designs(Grid(), (0.0, 0.9)).plan("field").take(rng.integers(2 * 8515, size=900))
    exact, quick = model.predict(theta, plan), forecast.predict(theta, plan)
    near = (exact > DARK + 0.001 * SPAN) & (exact < DARK + 0.999 * SPAN)
    off = (quick - exact)[near] / SPAN
    assert near.sum() > 400
    assert np.sqrt((off**2).mean()) < RMS
    assert np.quantile(np.abs(off), 0.99) < 3 * RMS
    assert np.abs(quick - exact).max() < 0.04 * SPAN  # at the tip of a thin ellipse


def test_the_led_dims_what_the_tables_predict_as_what_the_model_does():
    shape, rng = SHAPES["rectangle"], np.random.default_rng(4)
    model, theta = chain(shape), hypotheses(shape, 60)
    plan = Designs(Grid(), (0.0, 0.9)).plan("field").take(rng.integers(2 * 8515, size=900))
    led = rng.uniform(size=len(plan))
    led[:300], led[300:350] = 0.0, np.nan
    dimmed = replace(plan, covariates={"led": led})
    off = TabulatedForecast.of(model).predict(theta, dimmed) - model.predict(theta, dimmed)
    assert np.abs(off).max() < 0.04 * SPAN


@pytest.mark.parametrize("name", ["rectangle", "triangle", "ellipse", "any of two"])
def test_the_weights_of_levels_are_those_of_asking_every_hypothesis(name):
    """Their distribution functions differ by no more than what lies within a level and an error of 1 % of the span."""
    shape = SHAPES[name]
    model, theta, grid = chain(shape), hypotheses(shape, 300), Grid()
    designs = Designs(grid, (0.4,))
    weight = np.random.default_rng(5).dirichlet(np.ones(300))
    weight[:40] = 0.0
    plan, rows = designs.plan("field"), np.random.default_rng(6).integers(grid.n_places, size=200)
    predictive = TabulatedForecast.of(model).predictive(theta, weight, designs, plan, np.arange(len(plan)), 1.0)
    ((_, mass),) = predictive.level_weights(weight)
    np.testing.assert_allclose(mass.sum(axis=1), weight.sum(), atol=1e-12)
    exact = model.predict(theta, plan.take(rows))
    width = predictive.levels[1] - predictive.levels[0]
    below = np.cumsum(mass[rows], axis=1)
    for away, side in ((0.5 * width + 0.01 * SPAN, -1), (0.5 * width + 0.01 * SPAN, 1)):
        bound = (weight[:, None, None] * (exact[:, :, None] <= predictive.levels + side * away)).sum(axis=0)
        assert (side * (bound - below) > -1e-9).all()


@pytest.mark.parametrize(
    "name", ["rectangle", *(pytest.param(n, marks=pytest.mark.slow) for n in ("triangle", "ellipse", "any of two"))]
)
def test_the_map_is_that_of_asking_within_what_the_tables_and_the_levels_hide(name):
    """An error of variance v (in noise variances), were it noise, could hide 1/2 log2(1 + v) bits; here the same 400.

    The levels stand half a noise sd apart, which makes 1/48; the tables are off by no more than `RMS` of the span.
    """
    shape = SHAPES[name]
    theta = hypotheses(shape, 400)
    centre = theta[:1]
    designs = Designs(Grid(n_x=27, n_y=14))
    tolerance = 0.5 * math.log2(1.0 + 1.0 / 48.0 + (RMS * SPAN) ** 2)
    for believed in (theta, centre + 0.04 * (theta - centre)):
        if name == "any of two":
            believed[:, 0] = theta[:, 0]
        quick = prospect_of(TabulatedForecast.of(chain(shape)), believed, designs)
        slow = replace(quick, forecast=DirectForecast(chain(shape)))
        bits, exact = InformationGain()(quick), InformationGain()(slow)
        assert exact.max() > 0.3
        assert np.abs(bits - exact).max() < tolerance
        assert exact[bits.argmax()] > exact.max() - tolerance


@pytest.mark.slow
def test_heights_orientations_and_repeats_have_maps_of_their_own():
    shape = SHAPES["rectangle"]
    theta = hypotheses(shape, 150)
    theta = theta[:1] + 0.05 * (theta - theta[:1])
    designs = Designs(Grid(n_x=27, n_y=14), (0.0, 1.2), (1, 4), (("height_mm", (8.0, 12.0)),))
    calibrated = Instrumentation(height_mm=10.0)
    forecast = TabulatedForecast.of(chain(shape), highest=1.2)
    quick = prospect_of(forecast, theta, designs, instrumentation=calibrated)
    bits = InformationGain()(quick).reshape(8, -1)
    exact = InformationGain()(replace(quick, forecast=DirectForecast(chain(shape)))).reshape(8, -1)
    assert np.abs(bits - exact).max() < 0.5 * math.log2(1.0 + 4 * (1 / 48 + (RMS * SPAN * 1.25**2) ** 2))
    assert np.ptp(bits.max(axis=1)) > 0.1


def test_near_the_end_the_tables_serve_too():
    shape = SHAPES["rectangle"]
    theta = hypotheses(shape, 300)
    theta = theta[:1] + np.array([4.0, 4.0, 12.0, 5.0, 0.02]) * np.random.default_rng(1).standard_normal((300, 5))
    goal = Goal((0, 1, 2, 3), 4.0)
    quick = prospect_of(TabulatedForecast.of(chain(shape)), theta, Designs(Grid(n_x=66, n_y=33)), goal=goal)
    slow = replace(quick, forecast=DirectForecast(chain(shape)))
    assert Finishing(least=1e-6)(quick).max() == pytest.approx(Finishing(least=1e-6)(slow).max(), abs=0.05)


@dataclass(frozen=True)
class Arrow:
    """A quadrilateral with a dent: no convex one."""

    @property
    def prior(self):
        return Product({"x_mm": Uniform(200.0, 800.0), "y_mm": Uniform(100.0, 400.0)})

    def region(self, theta):
        corners = np.array([[-80.0, -60.0], [80.0, 0.0], [-80.0, 60.0], [-30.0, 0.0]])
        return PolygonRegion.from_vertices(theta[:, None, :] + corners)


@pytest.mark.parametrize(
    "model",
    [
        chain(Arrow()),
        chain(SHAPES["rectangle"], effects=(GainDrift(),)),
        chain(SHAPES["ellipse"], FixedMixture(np.ones(1), np.zeros((1, 2)), np.diag([900.0, 900.0])[None])),
        chain(SHAPES["narrow"], FixedMixture(np.ones(1), np.zeros((1, 2)), np.diag([400.0, 400.0])[None])),
    ],
    ids=["a dent", "an effect", "a wide footprint on an ellipse", "a wide footprint on a rectangle"],
)
def test_what_the_tables_do_not_hold_is_asked(model):
    assert isinstance(forecast_of(model), DirectForecast)


def test_an_arm_that_turns_its_sensor_is_asked():
    model, theta = chain(SHAPES["rectangle"]), hypotheses(SHAPES["rectangle"], 50)
    designs = Designs(Grid(n_x=9, n_y=5))
    turned = prospect_of(forecast_of(model), theta, designs, turn_rad=np.linspace(-1, 1, 45))
    expected = InformationGain()(replace(turned, forecast=DirectForecast(model)))
    np.testing.assert_array_equal(InformationGain()(turned), expected)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rectangle", "ellipse"])
def test_the_whole_map_of_3000_hypotheses_is_quick(name):
    """Aim: 0.1 s of one core; three times that leaves room for a busy machine."""
    shape = SHAPES[name]
    forecast, theta = forecast_of(chain(shape)), hypotheses(shape, 3000)
    utility_map(prospect_of(forecast, theta, Designs()), InformationGain())
    again = prospect_of(forecast, theta, Designs())
    start = time.process_time()
    utility_map(again, InformationGain())
    assert time.process_time() - start < 0.3
