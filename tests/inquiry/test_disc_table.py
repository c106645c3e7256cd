"""The table of what a sensor reads of a disc, against the sensor model itself."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.effects import EFFECTS, VOCABULARY, Known
from probewise.inquiry import Designs, DiscForecast, Grid, Readout, TabulatedChain, UtilityInput, forecast_of
from probewise.inquiry.disc_table import DiscTable
from probewise.inquiry.forecast import MOST_LEVELS
from probewise.scene import Circle, HypothesisScene, Rectangle
from probewise.sensor import Chain, FixedLevels, FixedMixture

LEVELS = np.linspace(10.0, 60.0, 101)


def rng(seed=0):
    return np.random.default_rng(seed)


@pytest.fixture(scope="module")
def places():
    return Designs(Grid(), (0.0, 0.7, -2.0)).plan("field").take(rng(1).integers(3 * 8515, size=400))


def test_the_table_predicts_what_the_model_does_at_any_place_and_orientation(made, places):
    """Two routes: quadrature of 64 nodes for every pair, and the interpolated table; the levels are 50 apart."""
    theta = made.circles(60)
    table = DiscTable.of(made.chain())
    away = np.abs(table.predict(theta, places) - made.chain().predict(theta, places))
    assert away.max() < 0.03
    assert np.sqrt((away**2).mean()) < 0.001


def test_the_led_dims_what_the_table_predicts_as_what_the_model_does(made, places):
    led = rng(2).uniform(size=len(places))
    led[:20], led[20:40] = 0.0, np.nan
    dimmed = replace(places, covariates={"led": led})
    theta, chain = made.circles(60), made.chain()
    np.testing.assert_allclose(forecast_of(chain).model.predict(theta, dimmed), chain.predict(theta, dimmed), atol=0.03)
    naive = made.naive()
    assert (DiscTable.of(naive).predict(theta, dimmed) == naive.predict(theta, dimmed)).all()


@pytest.mark.parametrize("turned", [False, True])
def test_the_weights_of_levels_are_those_of_asking_every_hypothesis(made, turned):
    """On a subset of places: by rounding a hypothesis may count for the next level, but the mean stays."""
    theta, grid = made.circles(300), Grid()
    weight = rng(2).dirichlet(np.ones(300))
    turn = rng(4).uniform(-3, 3, grid.n_places) if turned else np.zeros(grid.n_places)
    mass = DiscTable.of(made.chain()).level_histogram(theta, weight, grid, LEVELS, turn)
    rows = rng(3).integers(grid.n_places, size=300)
    answers = made.chain().predict(theta, replace(grid.plan("field"), orientation_rad=turn).take(rows))
    np.testing.assert_allclose(mass.sum(axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(mass[rows] @ LEVELS, weight @ answers, atol=0.02)
    counted = np.zeros((300, len(LEVELS)))
    index = np.rint((answers - 10.0) / 0.5).astype(int)
    np.add.at(counted, (np.arange(300) + 0 * index, index), np.broadcast_to(weight[:, None], index.shape))
    apart = np.abs(np.cumsum(counted, axis=1) - np.cumsum(mass[rows], axis=1))
    assert np.quantile(apart, 0.99) < weight.max()


def test_the_naive_sensor_is_counted_exactly(made):
    theta, grid = made.circles(200), Grid()
    mass = DiscTable.of(made.naive()).level_histogram(
        theta, np.full(200, 0.005), grid, np.array([10.0, 60.0]), np.zeros(grid.n_places)
    )
    share = (made.naive().predict(theta, grid.plan("field")) > 35).mean(axis=0)
    np.testing.assert_allclose(mass[:, 1], share, atol=1e-12)


def test_discs_that_leave_the_field_or_lie_between_its_rows_are_counted(made):
    theta = np.array([[0.0, 0.0, 20.0], [1048.0, 520.0, 150.0], [500.3, 260.9, 20.0], [524.0, -10.0, 20.0]])
    grid = Grid()
    mass = DiscTable.of(made.chain()).level_histogram(theta, np.full(4, 0.25), grid, LEVELS, np.zeros(grid.n_places))
    expected = made.chain().predict(theta, grid.plan("field")).mean(axis=0)
    np.testing.assert_allclose(mass @ LEVELS, expected, atol=0.25)  # one hypothesis a place: its level is rounded


def test_only_a_known_sensor_over_one_circle_has_a_table(made):
    mixture = FixedMixture([1.0], [[0.0, 0.0]], [[[9.0, 0.0], [0.0, 9.0]]])
    rectangles = Chain(mixture, FixedLevels(10.0, 60.0), HypothesisScene(Rectangle()))
    assert DiscTable.of(rectangles) is None
    assert not isinstance(forecast_of(rectangles), DiscForecast)
    wide = FixedMixture([1.0], [[0.0, 0.0]], [[[900.0, 0.0], [0.0, 900.0]]])
    assert DiscTable.of(Chain(wide, FixedLevels(10.0, 60.0), HypothesisScene(Circle()))) is None
    assert DiscTable.of(made.chain().with_effects(VOCABULARY["backlash"]())) is None


def test_a_sensor_of_sixteen_bits_chooses_its_place_as_quickly_as_another():
    """A thousand levels and cells, however little noise there is: 32,768 were too many for a level's number."""
    mixture = FixedMixture([1.0], [[0.0, 1.5]], [[[16.0, 0.0], [0.0, 6.25]]])
    circle = Circle(radius_mm=(50.0, 150.0), inside=True)
    grid = Grid(1048.0, 520.0, 27, 14)
    theta = circle.prior.from_unit_cube(rng().random((200, 3)))
    bits = []
    for scale, noise_sd in ((1.0, 0.05), (1000.0, 0.5)):
        model = Chain(mixture, FixedLevels(10.0 * scale, 60.0 * scale), HypothesisScene(circle))
        inputs = UtilityInput(
            forecast_of(model), Readout(noise_sd), theta, np.full(200, 1 / 200), theta, Designs(grid),
            Designs(grid).plan("field"), np.arange(grid.n_places), np.ones(grid.n_places),
        )  # fmt: skip
        assert len(inputs.predictive.levels) == MOST_LEVELS
        bits.append(inputs.information(inputs.weight))
    # A hundred times less noise tells no less anywhere, and what 200 circles can tell bounds both.
    assert (bits[1] > bits[0] - 0.05).all()
    assert bits[1].max() <= np.log2(200)


@pytest.mark.parametrize("names", [("backlash",), ("edge_blur",), ("backlash", "edge_blur", "saturation")])
def test_a_sensor_with_known_effects_is_looked_up_too(made, places, names):
    """A repaired sensor predicts from the table what its chain predicts by quadrature."""
    values = {"backlash": (6.0,), "edge_blur": (8.0,), "saturation": (45.0, 1.0)}
    model = replace(made.chain(), effects=tuple(Known(EFFECTS[name](), values[name]) for name in names))
    forecast, theta = forecast_of(model), made.circles(40)
    assert isinstance(forecast.model, DiscTable | TabulatedChain)
    run = replace(places, scan=np.zeros(len(places), dtype=np.int64), scan_names=("run",))
    away = np.abs(forecast.predict(theta, run) - model.predict(theta, run))
    assert away.max() < 0.05
    assert np.sqrt((away**2).mean()) < 0.002
    # A rival beside what is known looks the same table up.
    acting = TabulatedChain.of(model.with_effects(EFFECTS["hysteresis"]()), forecast.model)
    both = np.concatenate([theta, np.full((40, 1), 4.0)], axis=1)
    expected = model.with_effects(EFFECTS["hysteresis"]()).predict(both, run)
    assert np.abs(acting.predict(both, run) - expected).max() < 0.05


def test_an_effect_that_changes_with_the_place_is_asked_itself(made):
    graded = replace(made.chain(), effects=(Known(EFFECTS["albedo_gradient"](), (1e-4, 0.0)),))
    assert forecast_of(graded).model is graded
