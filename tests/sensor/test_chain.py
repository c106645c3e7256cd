"""The chain of stages, its effects, and the naive sensor."""

from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
import pytest
from mixtures import fixed_mixture
from scipy.special import ndtr

from probewise.effects import EFFECTS
from probewise.errors import ParameterError, ShapeError
from probewise.priors import Product, Uniform
from probewise.recordings import patterns as kinds
from probewise.recordings.plan import Plan
from probewise.scene import Circle, Ellipse, HypothesisScene, KnownScene
from probewise.sensor import (
    ACCURATE_NODES,
    FAST_NODES,
    Chain,
    FixedLevels,
    FixedMixture,
    FreeLevels,
    FreeMixture,
    NaiveSensor,
    Stage,
)

PATTERNS = {
    "boundary": kinds.HalfPlane(0.0, 0.0),
    "corner": kinds.Quadrant((1.0, 2.0), (-1, 1)),
    "grey": kinds.HalfPlane(0.5, 1.0, inside=0.9, outside=0.2),
    "disc": kinds.Disc((3.0, 1.0), 8.0),
}
ONE = np.array([1.0, 0.5, 1.5, 0.02, 0.01, 0.005])
TWO = np.concatenate([ONE, [0.6, -2.0, 3.0, 0.03, 0.05, -0.01]])


def plan_of(n_points=24, seed=0, names=tuple(PATTERNS), patterns=PATTERNS):
    rng = np.random.default_rng(seed)
    return Plan(
        x_mm=rng.uniform(-12, 12, n_points),
        y_mm=rng.uniform(-12, 12, n_points),
        orientation_rad=rng.choice(np.radians([0, 90, 180, 270]), n_points),
        time_s=np.arange(n_points) * 1.0,
        scan=np.zeros(n_points, dtype=int),
        scan_names=("scan",),
        pattern=rng.integers(0, len(names), n_points),
        pattern_names=names,
        patterns=patterns,
    )


def thetas(n, n_gaussians, seed=1):
    rng = np.random.default_rng(seed)
    shape = TWO[: 6 * n_gaussians] * rng.uniform(0.9, 1.1, (n, 6 * n_gaussians))
    return np.concatenate([shape, rng.uniform([[8.0, 45.0]], [[12.0, 55.0]], (n, 2))], axis=1)


CHAINS = {
    "one_free": (Chain(FreeMixture(1), FreeLevels(), KnownScene(PATTERNS)), lambda n: thetas(n, 1)),
    "two_free": (Chain(FreeMixture(2), FreeLevels(), KnownScene(PATTERNS)), lambda n: thetas(n, 2)),
    "known_sensor": (
        Chain(fixed_mixture(TWO), FixedLevels(10, 50), HypothesisScene(Circle())),
        lambda n: np.random.default_rng(2).uniform([-5, -5, 5], [5, 5, 12], (n, 3)),
    ),
    "naive": (
        NaiveSensor(FreeLevels(), HypothesisScene(Circle())),
        lambda n: np.random.default_rng(2).uniform([10, 50, -5, -5, 5], [12, 52, 5, 5, 12], (n, 5)),
    ),
}


@pytest.fixture(params=CHAINS, name="model")
def _model(request):
    return CHAINS[request.param]


def test_hypotheses_predicted_in_blocks_read_as_all_at_once(monkeypatch):
    plan, chain = plan_of(40), Chain(FreeMixture(2), FreeLevels(), KnownScene(PATTERNS))
    chain = chain.with_effects(EFFECTS["height_gradient"](), EFFECTS["position_scale"]())
    theta = np.concatenate([thetas(30, 2), np.random.default_rng(3).normal(0, 0.01, (30, 3))], axis=1)
    whole = chain.predict(theta, plan)
    monkeypatch.setattr("probewise.sensor.chain._MOST_NUMBERS", 7 * 40 * 2)
    np.testing.assert_allclose(chain.predict(theta, plan), whole, atol=1e-8)


def test_theta_of_another_width_is_refused(model):
    sensor, draw = model
    with pytest.raises(ShapeError, match="theta has shape"):
        sensor.predict(draw(2)[:, :-1], plan_of())


@pytest.mark.parametrize(
    "shape", [Circle(), pytest.param(Ellipse(), marks=pytest.mark.slow)], ids=["circle", "ellipse"]
)
def test_few_nodes_are_enough_for_the_robot(shape):
    """Stated error of FAST_NODES: 1e-4 of the span; of the default: 1e-8. Footprint sd 3 and 10 mm."""
    ssf = FixedMixture([1.0], [[1.0, 2.0]], [[[100.0, 0.0], [0.0, 9.0]]])
    levels, scene = FixedLevels(10, 50), HypothesisScene(shape)
    theta = shape.prior.from_unit_cube(np.random.default_rng(0).random((60, len(shape.prior.names))))
    plan = replace(plan_of(40), x_mm=np.linspace(0, 1048, 40), y_mm=np.linspace(0, 520, 40)[::-1])
    full = Chain(ssf, levels, scene, n_nodes=256).predict(theta, plan)
    for n_nodes, error in ((FAST_NODES, 1e-4), (ACCURATE_NODES, 1e-8)):
        fast = Chain(ssf, levels, scene, n_nodes=n_nodes).predict(theta, plan)
        assert np.abs(full - fast).max() < 40 * error


def test_the_naive_sensor_reads_by_the_point_under_it():
    """Paper, naive likelihood: white where the distance is at most the radius."""
    plan = replace(plan_of(3), x_mm=[0.0, 8.0, 8.1], y_mm=[0.0, 0.0, 0.0])
    theta = np.array([[10.0, 50.0, 0.0, 0.0, 8.0], [10.0, 50.0, 100.0, 0.0, 8.0]])
    found = CHAINS["naive"][0].predict(theta, plan)
    assert found.tolist() == [[50.0, 50.0, 10.0], [10.0, 10.0, 10.0]]


def test_a_pattern_that_the_scene_lacks_is_named():
    with pytest.raises(
        ParameterError, match=r"one that is described \('disc'\); 'boundary' is named but not described"
    ):
        Chain(FreeMixture(1), FreeLevels(), KnownScene({"disc": PATTERNS["disc"]})).predict(
            thetas(1, 1), plan_of(names=("boundary",))
        )


@dataclass(frozen=True)
class Doer:
    """An effect made of a function: what the stages hand it, and its one parameter."""

    name: str
    stage: Stage
    does: object
    prior = Product({"size": Uniform(-10.0, 10.0)})

    def apply(self, value, theta, plan):
        assert theta.shape[1] == 1
        return self.does(value, theta)


CURVE = Doer("curve", Stage.RESPONSE, lambda u, t: u**t)
GAIN = Doer("gain", Stage.GAIN, lambda signal, t: signal * (1 + t))
OFFSET = Doer("offset", Stage.OFFSET, lambda reading, t: reading + t)
CLIP = Doer("clip", Stage.SATURATION, lambda reading, t: np.minimum(reading, t))


def test_effects_stack_in_the_order_of_the_stages_whatever_the_order_given():
    """reading = min(I_min + (I_max - I_min) R^c (1 + g) + o, level), worked out by hand."""
    base = CHAINS["two_free"][0]
    plan, theta = plan_of(), thetas(4, 2)
    plain = base.predict(theta, plan)
    i_min, span = theta[:, -2:-1], theta[:, -1:] - theta[:, -2:-1]
    wanted = np.minimum(i_min + span * ((plain - i_min) / span) ** 1.4 * 1.2 + 0.7, 40.0)
    sizes = {"curve": 1.4, "gain": 0.2, "offset": 0.7, "clip": 40.0}
    for given_order in permutations((CURVE, GAIN, OFFSET, CLIP)):
        chain = base.with_effects(*given_order)
        assert chain.names[-4:] == ("curve.size", "gain.size", "offset.size", "clip.size")
        columns = np.array([[sizes[effect.name] for effect in chain.effects]])
        found = chain.predict(np.concatenate([theta, np.repeat(columns, 4, axis=0)], axis=1), plan)
        assert found == pytest.approx(wanted, abs=1e-9)
    with pytest.raises(ParameterError, match="each name once"):
        base.with_effects(GAIN, GAIN)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("height_mm", 0.0, "height_mm is 0.0; allowed: greater than 0"),
        ("height_mm", -5.0, "height_mm is -5.0; allowed: greater than 0"),
        ("led", 255.0, "led is 255.0; allowed: 0 .* to 1"),
        ("led", -1.0, "led is -1.0; allowed: 0 .* to 1"),
    ],
)
def test_a_commanded_height_or_led_that_cannot_be_is_refused(column, value, message):
    plan = commanded(column, [np.nan, value])
    with pytest.raises(ParameterError, match=message):
        RAISED.predict(np.empty((1, 0)), plan)


@pytest.mark.parametrize("ratio", [0.05, 0.5, 1.0, 3.0, 30.0])
def test_a_commanded_height_scales_footprint_and_light_however_far_it_is(ratio):
    plan = commanded("height_mm", [14.0 * ratio, np.nan])
    expected = 10.0 + 50.0 * ndtr(np.array([2.0 / (4.0 * ratio), 2.0 / 4.0])) / np.array([ratio**2, 1.0])
    np.testing.assert_allclose(RAISED.predict(np.empty((1, 0)), plan)[0], expected, rtol=1e-9)


RAISED = Chain(
    FixedMixture([1.0], [[0.0, 0.0]], [[[16.0, 0.0], [0.0, 16.0]]]),
    FixedLevels(10.0, 60.0),
    KnownScene({"edge": kinds.HalfPlane(0.0, 0.0)}),
)


def commanded(column, values):
    return Plan.from_arrays(
        x_mm=[2.0, 2.0], y_mm=0, patterns=RAISED.scene.patterns, unit="V", height_mm=14.0, covariates={column: values}
    )
