"""What a reading is worth, against counting, quadrature and what must hold of any information."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import norm

from probewise.errors import ParameterError, ShapeError
from probewise.inquiry import (
    Finishing,
    Goal,
    Grid,
    InformationAbout,
    InformationGain,
    ParameterValue,
    PerSecond,
    ReadingEntropy,
    WhichShape,
    choose_several,
    utility_map,
    utility_named,
)

APART = [[0.0, 0.0, 0.0], [0.0, 40.0, 40.0], [0.0, 0.0, 80.0], [0.0, 40.0, 120.0]]
"""Four hypotheses: the first place tells nothing, the second one bit, the third all two."""


def by_quadrature(levels, weight, sd):
    """H(y) - H(noise) of a mixture of Gaussians, bits, on a fine line."""
    y = np.linspace(min(levels) - 8 * sd, max(levels) + 8 * sd, 20001)
    density = sum(w * norm.pdf(y, m, sd) for m, w in zip(levels, weight, strict=True))
    whole = -np.trapezoid(np.where(density > 0, density * np.log2(np.maximum(density, 1e-300)), 0.0), y)
    return whole - 0.5 * np.log2(2 * np.pi * np.e * sd**2)


def test_predictions_nearer_than_the_noise_tell_what_quadrature_says(made):
    """The cells of unrounded readings, three quarters of a noise sd, hide 0.03 bits at most."""
    table = np.random.default_rng(0).normal(0.0, [[0.5, 1.0, 2.0, 4.0, 8.0]], (40, 5))
    weight = np.random.default_rng(1).dirichlet(np.ones(40))
    exact = [by_quadrature(column, weight, 1.0) for column in table.T]
    bits = InformationGain()(made.listed(table, weight=weight, step=None))
    np.testing.assert_allclose(bits, exact, atol=0.04)


def test_information_about_a_label_leaves_the_rest_out(made):
    """Rows 0, 1 | 2, 3: the second place tells rows of one label apart, the third also the labels."""
    label = ParameterValue("row", n_bins=2)
    np.testing.assert_allclose(InformationAbout(label)(made.listed(APART)), [0.0, 0.0, 1.0], atol=1e-3)


def test_worth_a_second_prefers_the_near_place(made):
    inputs = made.listed(APART, cost_s=[1.0, 1.0, 4.0])
    np.testing.assert_allclose(PerSecond()(inputs), InformationGain()(inputs) / [1.0, 1.0, 4.0])
    assert int(np.argmax(PerSecond()(inputs))) == 1
    with pytest.raises(ParameterError, match="cost_s"):
        PerSecond()(made.listed(APART, cost_s=[0.0, 1.0, 1.0]))


def test_a_map_of_one_of_two_measures_says_which(made):
    """Near the end the default shows probabilities, before that bits: a colour bar has one quantity."""
    spread = np.array([2.0, 2.0, 4.5]) * np.random.default_rng(8).standard_normal((300, 3))
    far = made.over_discs(made.chain(20), np.array([500.0, 250.0, 100.0]) + spread, grid=Grid(n_x=66, n_y=33))
    near = replace(far, goal=Goal((0, 1, 2), 4.0))
    assert utility_map(far, Finishing()).label == "expected information (bits)"
    shown = utility_map(near, Finishing(least=1e-6))
    assert shown.label == "probability that a reading there ends the run"
    assert 0 < shown.highest_utility <= 1
    np.testing.assert_array_equal(shown.values[near.rows], Finishing(least=1e-6)(near))


def test_readings_chosen_together_do_not_repeat_each_other(made):
    """Two bits in two places of one bit each, a third that repeats the first but for a little less noise's worth."""
    table = [[0.0, 0.0, 0.0], [0.0, 40.0, 0.0], [40.0, 0.0, 30.0], [40.0, 40.0, 30.0]]
    chosen = choose_several(made.listed(table), 2, rng=np.random.default_rng(6))
    assert set(chosen) in ({0, 1}, {1, 2})


@dataclass(frozen=True, eq=False)
class Given:
    """A utility that gives what it is told to."""

    values: np.ndarray
    label: str = "given"

    def __call__(self, inputs):
        return self.values


def test_a_utility_of_the_wrong_size_or_not_finite_is_refused(made):
    with pytest.raises(ShapeError, match="one per design"):
        utility_map(made.listed(APART), Given(np.zeros(2)))
    with pytest.raises(ParameterError, match="finite"):
        utility_map(made.listed(APART), Given(np.full(3, np.nan)))


@pytest.mark.parametrize(
    ("name", "utility"),
    [
        ("finishing", Finishing()),
        ("information", InformationGain()),
        ("entropy", ReadingEntropy()),
        ("per-second", PerSecond()),
        ("about:radius_mm", InformationAbout(ParameterValue("radius_mm"))),
        ("which-shape", InformationAbout(WhichShape())),
    ],
)
def test_a_utility_has_a_name(name, utility):
    assert utility_named(name) == utility


def test_unknown_names_list_those_that_are_known(made):
    with pytest.raises(ParameterError, match="finishing, information, entropy"):
        utility_named("entropie")
    with pytest.raises(ParameterError, match="one of row"):
        InformationAbout(ParameterValue("radius_mm"))(made.listed(APART))
    with pytest.raises(ParameterError, match="the hypotheses of two shapes"):
        InformationAbout(WhichShape())(made.listed(APART))


def narrow(made, goal, *, sd=6.0, seed=0):
    """An input near the end: a disc known to a few millimetres."""
    theta = np.array([500.0, 250.0, 80.0]) + sd * np.random.default_rng(seed).standard_normal((600, 3))
    inputs = made.over_discs(made.chain(20), theta, grid=Grid(n_x=131, n_y=65))
    return replace(inputs, goal=goal)


def test_near_the_end_the_reading_that_may_end_the_run_is_preferred(made):
    """Only the radius is asked for, and it is unknown by little more than allowed."""
    goal = Goal((2,), 5.0)
    inputs = narrow(made, goal)
    chance = Finishing()(inputs)
    assert chance.max() > 0.25
    assert chance.max() <= 1.0
    best = int(chance.argmax())
    assert chance[best] == pytest.approx(by_importance(made, inputs, goal, best), abs=0.06)


def by_importance(made, inputs, goal, design, n=4000):
    """Draw readings from every hypothesis, reweigh all by each, count how often the sds are small enough."""
    level = made.chain(20).predict(inputs.theta, inputs.plan.take(np.array([design])))[:, 0]
    rng = np.random.default_rng(1)
    reading = rng.choice(level, n) + rng.standard_normal(n)
    weight = np.exp(-0.5 * (reading[:, None] - level) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    lengths = inputs.theta[:, goal.columns]
    spread = weight @ lengths**2 - (weight @ lengths) ** 2
    return (spread < goal.sd**2).all(axis=1).mean()


@pytest.mark.slow
def test_far_from_the_end_or_without_a_goal_information_decides(made):
    far = narrow(made, Goal((0, 1, 2), 0.2))
    np.testing.assert_array_equal(Finishing()(far), InformationGain()(far))
    goalless = narrow(made, None)
    np.testing.assert_array_equal(Finishing()(goalless), InformationGain()(goalless))
    hopeless = narrow(made, Goal((0, 1, 2), 1.0))
    np.testing.assert_array_equal(Finishing()(hopeless), InformationGain()(hopeless))


def test_the_bins_of_entropy_are_as_wide_as_the_instruments_step():
    assert utility_named("entropy", bin_width=0.005) == ReadingEntropy(0.005)
    assert utility_named("entropy") == ReadingEntropy(1.0)
