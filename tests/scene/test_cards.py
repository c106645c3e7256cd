"""Cards of known place and albedo that lie on the field, over a shape of unknown place."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.errors import ParameterError
from probewise.experiment import with_cards
from probewise.experiment.rivals import rivals_of
from probewise.inquiry import DiscForecast, TabulatedChain, forecast_of
from probewise.proof.study import BRIGHT, DARK, REFERENCE, experiment_of, footprint_pixels
from probewise.recordings import Disc, Plan
from probewise.scene import Card, CardedScene
from probewise.world import World

CARDS = (Card(300.0, 200.0, 60.0, 40.0, 0.5), Card(700.0, 100.0, 30.0, 30.0, 1.0))


@pytest.fixture(scope="module")
def chain():
    plain = experiment_of(REFERENCE).model
    return replace(plain, scene=CardedScene(plain.scene.shape, CARDS))


@pytest.fixture(scope="module")
def plan():
    rng = np.random.default_rng(4)
    about = [rng.uniform(card.corners_mm.min(axis=0) - 15, card.corners_mm.max(axis=0) + 15, (12, 2)) for card in CARDS]
    x_mm, y_mm = np.concatenate([rng.uniform((0, 0), (1048, 520), (10, 2)), *about]).T
    zero = np.zeros(len(x_mm), dtype=np.int64)
    return Plan(x_mm, y_mm, np.full(len(x_mm), 0.3), np.arange(len(x_mm)) * 8.0, zero, ("s",), zero, ("field",))


def test_the_closed_form_reads_cards_as_the_pixels_do(chain, plan):
    """Two routes: polygons under Gaussians, and rays that land on the card before they land on the disc."""
    for disc in (np.array([500.0, 300.0, 100.0]), np.array([700.0, 120.0, 80.0])):
        world = World(footprint_pixels(), black=DARK, white=BRIGHT, noise_sd=0.0)
        surface = with_cards(Disc((disc[0], disc[1]), disc[2]), CARDS)
        read = [world.read(surface, x, y, 0.3, time_s=0.0, rng=None) for x, y in zip(plan.x_mm, plan.y_mm, strict=True)]
        np.testing.assert_allclose(chain.predict(disc[None], plan)[0], read, atol=0.05)


def test_tables_with_cards_laid_over_them_are_the_chain(chain, plan):
    theta = np.array([[500.0, 300.0, 100.0], [340.0, 215.0, 60.0], [700.0, 120.0, 80.0]])
    forecast = forecast_of(chain)
    assert isinstance(forecast, DiscForecast)
    np.testing.assert_allclose(forecast.model.predict(theta, plan), chain.predict(theta, plan), atol=0.02)
    dimmed = replace(plan, covariates={"led": np.linspace(0.0, 1.0, len(plan))})
    np.testing.assert_allclose(forecast.model.predict(theta, dimmed), chain.predict(theta, dimmed), atol=0.02)
    likelihood = experiment_of(REFERENCE).likelihood
    rng = np.random.default_rng(1)
    for rival in rivals_of(chain, likelihood, (1048.0, 520.0)):
        if rival.effect is None:
            continue
        acting = chain.with_effects(rival.effect)
        quick = TabulatedChain.of(acting, forecast.model)
        if quick is not None:
            n_own = len(rival.effect.prior.names)
            own = rival.effect.prior.from_unit_cube(rng.uniform(0.3, 0.7, (len(theta), n_own)))
            both = np.concatenate([theta, own], axis=1)
            np.testing.assert_allclose(quick.predict(both, plan), acting.predict(both, plan), atol=0.05)


def test_a_card_tells_a_tilt_and_an_error_of_scale_from_another_shape(chain):
    plain = experiment_of(REFERENCE)
    with_card, without = (
        {
            (rival.name, rival.effect.prior.names)
            for rival in rivals_of(model, plain.likelihood, (1048.0, 520.0))
            if rival.effect is not None
        }
        for model in (chain, plain.model)
    )
    assert {name for name, _ in with_card} - {name for name, _ in without} == {"sensor_tilt"}
    assert {names for name, names in with_card if name == "position_scale"} == {("x", "y")}
    assert {names for name, names in without if name == "position_scale"} == {
        ("x",),
        ("y",),
    }  # no circle imitates these


def test_an_outlook_knows_that_a_card_tells_nothing_of_the_shape(chain):
    experiment = replace(experiment_of(REFERENCE), model=chain)
    theta = experiment.prior.from_unit_cube(np.random.default_rng(2).random((500, 3)))
    even = np.full(len(theta), 1 / len(theta))
    plan = experiment.designs.plan("field")
    predictive = experiment.forecast.predictive(theta, even, experiment.designs, plan, np.arange(len(plan)), 1.0)
    ((_, mass),) = list(predictive.level_weights(even))
    on_card = int(np.argmin((plan.x_mm - 300.0) ** 2 + (plan.y_mm - 200.0) ** 2))
    beside = int(np.argmin((plan.x_mm - 500.0) ** 2 + (plan.y_mm - 260.0) ** 2))
    assert mass[on_card].max() > 0.999
    assert predictive.levels[mass[on_card].argmax()] == pytest.approx((DARK + BRIGHT) / 2, abs=0.5)
    assert mass[beside].max() < 0.99


@pytest.mark.parametrize("wrong", [(0.0, 0.0, -1.0, 5.0, 1.0), (0.0, 0.0, 5.0, 5.0, 1.5), (np.nan, 0.0, 5.0, 5.0, 1.0)])
def test_a_card_has_a_place_a_size_and_an_albedo(wrong):
    with pytest.raises(ParameterError, match="card"):
        Card(*wrong)
