"""Prior odds of hypotheses."""

import math
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace
from typing import Any, cast

import pytest

from probewise.diagnosis import PriorOdds
from probewise.diagnosis.simulator_rows import SimulatorApparatus
from probewise.effects import RARE_EFFECTS, VOCABULARY, Extent
from probewise.recordings import two_way_plan
from probewise.sensor import Stage

OF_NO_LAW = SimpleNamespace(about=SimpleNamespace(states_with_rates_by_definition=frozenset()))
EXTENT = Extent(10.0, 60.0, two_way_plan())
EFFECTS = {**VOCABULARY, **RARE_EFFECTS}


def test_everything_about_the_mean_sums_to_one_but_for_what_is_unknown_beside():
    effects = {name: kind.for_extent(EXTENT) for name, kind in EFFECTS.items()}
    odds = PriorOdds.for_effects({name: effect for name, effect in effects.items() if effect is not None})
    named = [n for n, kind in VOCABULARY.items() if kind.stage is not Stage.NOISE and effects[n] is not None]
    total = math.exp(odds.log_prior_with_unknown(()))
    total += sum(math.exp(odds.log_prior_on_mean(names)) for k in range(4) for names in combinations(named, k))
    total += sum(math.exp(odds.log_prior_on_mean((name,))) for name in RARE_EFFECTS)
    assert total == pytest.approx(1.0, abs=1e-9)


def test_every_noise_sums_to_one():
    odds = replace(SimulatorApparatus.prior_odds(cast(Any, OF_NO_LAW), {}), n_noises=5)
    sets = (names for k in range(4) for names in combinations("abcde", k))
    assert sum(math.exp(odds.log_prior_on_noise(names)) for names in sets) == pytest.approx(1.0)
