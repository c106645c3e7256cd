"""Effects on the footprint act in order of name: a convention that hardly matters."""

import itertools
from dataclasses import dataclass

import numpy as np
import pytest

from probewise.effects import RARE_EFFECTS, VOCABULARY, Extent, Known
from probewise.priors import Empty
from probewise.recordings import paper_plan
from probewise.scene import KnownScene
from probewise.sensor import Chain, FixedLevels, FixedMixture, Stage

SIZES = {
    "edge_blur": (2.0,),
    "halo": (0.05, 20.0),
    "height_gradient": (0.002,),
    "height_offset": (0.5,),
    "reflection": (0.04, 8.0, 3.0),
    "slow_sinking": (0.2,),
}
PLAN = paper_plan()
MIXTURE = FixedMixture(np.ones(1), np.array([[1.0, 1.5]]), np.array([[[16.0, 0.0], [0.0, 9.0]]]))


def known(name):
    effect = {**VOCABULARY, **RARE_EFFECTS}[name].for_extent(Extent(10.0, 60.0, PLAN)).variants()[0]
    return Known(effect, SIZES[name])


def test_the_sizes_are_those_of_all_effects_on_the_footprint():
    kinds = {**VOCABULARY, **RARE_EFFECTS}
    assert {name for name, kind in kinds.items() if kind.stage == Stage.FOOTPRINT} == set(SIZES)


@dataclass(frozen=True)
class InTurn:
    """Effects of known parameters, one after the other, as one effect."""

    effects: tuple[Known, ...]

    name = "in_turn"
    stage = Stage.FOOTPRINT
    prior = Empty()

    def apply(self, value, theta, plan):
        for effect in self.effects:
            value = effect.apply(value, theta, plan)
        return value


def readings(*effects):
    return Chain(MIXTURE, FixedLevels(10.0, 60.0), KnownScene(PLAN.patterns), effects).predict(np.empty((1, 0)), PLAN)


@pytest.mark.parametrize(("first", "second"), list(itertools.combinations(sorted(SIZES), 2)))
def test_another_order_changes_readings_by_a_fraction_of_the_noise(first, second):
    """At most 0.3 % of the span, a quarter of an sd of the paper's noise."""
    effects = known(first), known(second)
    by_name = readings(InTurn(effects))
    np.testing.assert_array_equal(readings(*effects[::-1]), by_name)
    np.testing.assert_allclose(readings(InTurn(effects[::-1])), by_name, atol=0.15)
