"""In a rate that is another state by definition hardly anything is missing: its effects have a tenth of the prior."""

import math
from functools import cache

import numpy as np
import pytest

from probewise.diagnosis import PriorOdds
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.systems import Law, Simulator, table_for
from probewise.systems.forms import names_in_definitions

_T = 0.2 * np.arange(60)


@cache
def _prepared(rates):
    law = Law({"angle": 1.0, "speed": 0.0}, rates, max_step_s=0.1)
    simulator = Simulator("y", "rad", {"stiff": (0.5, 2), "loss": (0.01, 0.5)}, law=law, time="t_s")
    y = np.exp(-0.05 * _T) * np.cos(_T) + 0.01 * np.random.default_rng(2).standard_normal(len(_T))
    return prepare_system(simulator, table_for(simulator, {"t_s": _T, "y": y}))


def _pendulum(s, p, u):
    return {"angle": s["speed"], "speed": -p["stiff"] * s["angle"] - p["loss"] * s["speed"]}


def test_the_rate_of_an_angle_is_the_speed_by_definition():
    prepared = _prepared(_pendulum)
    about = prepared.apparatus.about
    assert about.states_with_rates_by_definition == {"angle"}
    within = names_in_definitions(about, {**prepared.effects, **prepared.apparatus.proposed_formulas()})
    assert {"quadratic:angle:speed", "forcing:angle", "coupling:angle:speed", "periodic_forcing:angle~again"} <= within
    assert not any("speed" in name.split(":")[1] for name in within if not name.startswith("formula"))
    assert not any(name.startswith(("limit", "formula:reading", "formula:rate:speed")) for name in within)
    assert any(name.startswith("formula:rate:angle:") for name in within)


@pytest.mark.parametrize("factor", ["stiff", "by parts"])
def test_a_rate_with_a_parameter_or_a_loss_is_no_definition(factor):
    def rates(s, p, u):
        own = p["stiff"] * s["speed"] if factor == "stiff" else s["speed"] - 1e-3 * s["angle"]
        return {**_pendulum(s, p, u), "angle": own}

    assert _prepared(rates).apparatus.about.states_with_rates_by_definition == frozenset()


def test_prior_odds_of_effects_in_a_definition():
    prepared = _prepared(_pendulum)
    odds = prepared.apparatus.prior_odds(prepared.effects)
    apart = odds.log_prior_on_mean(("quadratic:speed:angle",)) - odds.log_prior_on_mean(("quadratic:angle:speed",))
    assert apart == pytest.approx(math.log(10))


def test_combinations_of_unlikely_effects_sum_to_those_of_their_size():
    odds = PriorOdds(n_named=5, n_unnamed=0, unlikely=frozenset("ab"), unlikely_weight=0.1)
    single = sum(math.exp(odds.log_prior_on_mean((name,))) for name in "abcde")
    pairs = sum(math.exp(odds.log_prior_on_mean((a, b))) for a in "abcde" for b in "abcde" if a < b)
    assert (single, pairs) == pytest.approx(odds.by_size[:2])
    alone = odds.single_effect_priors("abcde", ())
    assert alone[("a",), ()] == pytest.approx(0.1 * alone[("c",), ()])
