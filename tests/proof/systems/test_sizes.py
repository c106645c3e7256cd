"""An effect is as large as was asked for, and what explains the same is found: by other routes than the world's own."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit

from probewise.proof.systems import cases
from probewise.proof.systems.alternatives import nats_of_alternative
from probewise.proof.systems.cases import (
    KINDS,
    SYSTEMS_WHEEL,
    _draw_effect_of_size,
    draw_system,
    draw_system_case,
    system_stratum_of,
    truth_json,
)
from probewise.proof.systems.forms import forms_of
from probewise.proof.systems.rivals import rivals_with_nats

BY_NAME = {kind.name: kind for kind in KINDS}


def _drawn(name, seed=3):
    return draw_system(BY_NAME[name], rng=np.random.default_rng(seed))


def _form(drawn, name):
    return next(f for f in forms_of(drawn.true_system) if f.name == name)


@pytest.mark.parametrize("wanted", [6.0, 20.0])
@pytest.mark.parametrize("name", ["sensitivity:water_c", "nonlinearity", "input_offset:flow_lpm", "gain_step"])
def test_what_a_linear_model_leaves_is_as_large_as_asked(name, wanted):
    """zero + k q^2 is linear in its parameters: a projection tells what is left."""
    drawn = _drawn("orifice flow meter")
    effect = _draw_effect_of_size(_form(drawn, name), wanted, drawn, np.random.default_rng(1))
    with_effect = drawn.simulate_diagnosed_rows([effect.form_with_parameters])
    q = drawn.diagnosed_table.columns["flow_lpm"]
    basis = np.stack([np.ones_like(q), q**2], axis=1)
    left = with_effect - basis @ np.linalg.lstsq(basis, with_effect, rcond=None)[0]
    assert np.linalg.norm(left) / drawn.kind.sd == pytest.approx(wanted, rel=0.01)
    assert effect.size_lambda == pytest.approx(wanted, rel=0.01)


def test_what_a_bent_model_leaves_is_as_large_as_asked():
    drawn = _drawn("photodiode against distance")
    effect = _draw_effect_of_size(_form(drawn, "sensitivity:board_c"), 12.0, drawn, np.random.default_rng(1))
    d, y = drawn.diagnosed_table.columns["dist_mm"], drawn.simulate_diagnosed_rows([effect.form_with_parameters])

    def law(d, dark, power, behind):
        return dark + 1e5 * power / (d + behind) ** 2

    found, _ = curve_fit(law, d, y, [0.0, 3.0, 14.0], xtol=1e-12, ftol=1e-12)
    assert np.linalg.norm(y - law(d, *found)) / drawn.kind.sd == pytest.approx(12.0, rel=0.01)


def test_an_offset_that_depends_on_a_column_is_a_sensitivity_by_another_name():
    drawn = _drawn("orifice flow meter")
    forms = forms_of(drawn.true_system)
    effect = _draw_effect_of_size(_form(drawn, "sensitivity:water_c"), 12.0, drawn, np.random.default_rng(1))
    target = drawn.simulate_diagnosed_rows([effect.form_with_parameters])
    fitted = drawn.nominal_model.fit(target, drawn.true_coordinates)
    rivals = rivals_with_nats(drawn.true_system, forms, target, fitted, drawn.nominal_model, frozenset({effect.name}))
    assert rivals["depends:zero_kpa:water_c"] < 0.01
    assert "sensitivity:baro_hpa" not in rivals
    assert all(nats < 12 for nats in rivals.values())
    found = replace(effect, rivals={"drifts:zero_kpa": 2.9, "lag": 3.1})
    assert found.aliases == {"drifts:zero_kpa": 2.9}


@pytest.mark.parametrize("number", [808, 1128])
def test_the_concealed_effects_explain_their_readings_and_an_alias_of_one_beside_the_other_does(number):
    """A pair: its own names lose nothing; one alone loses most of half its squared size."""
    case = draw_system_case(251203, number)
    own = [effect.name for effect in case.effects]
    assert nats_of_alternative(case, own) < 0.1
    assert nats_of_alternative(case, own[:1]) > 30.0
    for effect, other in zip(case.effects, reversed(own), strict=True):
        for name in list(effect.aliases)[:1]:
            assert nats_of_alternative(case, [name, other]) == pytest.approx(effect.aliases[name], abs=0.1)


@pytest.mark.parametrize("names", [[], ["lag", "delay", "settling"], ["outliers"], ["limit:elsewhere"]])
def test_what_this_system_does_not_have_explains_nothing(names):
    assert nats_of_alternative(draw_system_case(251203, 808), names) == np.inf


def test_half_of_the_wheel_is_clean():
    assert sum(s.kind == "clean" for s in SYSTEMS_WHEEL) == len(SYSTEMS_WHEEL) / 2
    own = [system_stratum_of(k) for k in range(2 * len(SYSTEMS_WHEEL))]
    assert [before for s, before in own if s.kind == "single"] == list(range(12))


@pytest.fixture
def quick(monkeypatch):
    """Only systems whose reading follows from the row."""
    monkeypatch.setattr(cases, "KINDS", tuple(kind for kind in KINDS if kind.law is None))


@pytest.mark.parametrize("number", [1, 2, pytest.param(8, marks=pytest.mark.slow), 14])
def test_a_case_follows_from_the_seed_and_its_number(number, quick):
    one, again = (truth_json(draw_system_case(12, number)) for _ in range(2))
    assert one == again
    assert one != truth_json(draw_system_case(13, number))


@pytest.mark.parametrize("number", [*range(4), *(pytest.param(k, marks=pytest.mark.slow) for k in range(4, 20))])
def test_a_case_of_every_stratum_holds_what_it_says(number, quick):
    case = draw_system_case(12, number)
    assert len(case.effects) == {"clean": 0, "pair": 2}.get(case.stratum.kind, 1)
    assert (case.noise.name != "white") is case.stratum.other_noise
    for effect in case.effects:
        assert effect.in_vocabulary is (case.stratum.kind != "outside")
        assert case.drawn.size_of_effects([effect.form_with_parameters]) == pytest.approx(case.stratum.size, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("number", [k for k in range(20) if system_stratum_of(k)[0].kind != "clean"])
def test_a_case_of_every_stratum_holds_what_it_says_of_any_system(number):
    case = draw_system_case(31, number)
    for effect in case.effects:
        assert effect.size_lambda == pytest.approx(case.stratum.size, rel=0.01)
        assert case.drawn.size_of_effects([effect.form_with_parameters]) == pytest.approx(case.stratum.size, rel=0.01)
