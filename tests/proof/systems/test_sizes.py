"""An effect is as large as was asked for, and what explains the same is found: by other routes than the world's own."""

import numpy as np
import pytest

from probewise.proof.challenge import _right_model_and_readings
from probewise.proof.refits import SystemRefit, nats_of_alternative, rivals_with_nats, run_table
from probewise.proof.systems import cases
from probewise.proof.systems.cases import (
    KINDS,
    SYSTEMS_WHEEL,
    Stratum,
    SystemCase,
    draw_effect_of_size,
    draw_system,
    draw_system_case,
    make_noise,
    simulator_file_text,
    system_stratum_of,
    table_text,
)
from probewise.proof.systems.forms import SystemEffect, forms_of
from probewise.systems import predict_system

BY_NAME = {kind.name: kind for kind in KINDS}


def _drawn(name, seed=3):
    return draw_system(BY_NAME[name], rng=np.random.default_rng(seed))


def _form(drawn, name):
    return next(f for f in forms_of(drawn.true_system) if f.name == name)


def _concealed(drawn, name, wanted):
    return draw_effect_of_size(_form(drawn, name), wanted, drawn, SystemRefit(), np.random.default_rng(1))


def _size(drawn, effect):
    return np.linalg.norm(SystemRefit()(drawn, drawn.simulate_diagnosed_rows([effect])))


def _case(drawn, effects):
    """A case without noise."""
    free = drawn.simulate_all_rows(effects)
    noise = make_noise("white", free, drawn.table, drawn.kind.sd, rng=np.random.default_rng(0))
    return SystemCase(Stratum("single"), drawn, tuple(effects), noise, "", (), free, free)


@pytest.mark.parametrize("wanted", [6.0, 20.0])
@pytest.mark.parametrize("name", ["sensitivity:water_c", "nonlinearity", "input_offset:flow_lpm", "gain_step"])
def test_what_a_linear_model_leaves_is_as_large_as_asked(name, wanted):
    """zero + k q^2 is linear in its parameters: a projection tells what is left."""
    drawn = _drawn("orifice flow meter")
    effect = _concealed(drawn, name, wanted)
    with_effect = drawn.simulate_diagnosed_rows([effect])
    q = drawn.diagnosed_table.columns["flow_lpm"]
    basis = np.stack([np.ones_like(q), q**2], axis=1)
    left = with_effect - basis @ np.linalg.lstsq(basis, with_effect, rcond=None)[0]
    assert np.linalg.norm(left) / drawn.kind.sd == pytest.approx(wanted, rel=0.01)
    assert effect.size_lambda == pytest.approx(wanted, rel=0.01)


def test_an_offset_that_depends_on_a_column_is_a_sensitivity_by_another_name():
    drawn, refit = _drawn("orifice flow meter"), SystemRefit()
    effect = _concealed(drawn, "sensitivity:water_c", 12.0)
    case = _case(drawn, [effect])
    rivals = rivals_with_nats(refit, case, effect)
    assert rivals["depends:zero_kpa:water_c"] < 0.01
    assert "sensitivity:baro_hpa" not in rivals
    assert all(nats < 12 for nats in rivals.values())
    assert nats_of_alternative(refit, case, ["depends:zero_kpa:water_c"]) < 0.01
    for names in ([], ["lag", "delay", "settling"], ["outliers"], ["limit:elsewhere"]):  # not in this system
        assert nats_of_alternative(refit, case, names) == np.inf


def test_the_concealed_effects_explain_their_readings_and_an_alias_of_one_beside_the_other_does():
    """A pair: its own names lose nothing; one alone loses most of half its squared size."""
    drawn, refit = _drawn("orifice flow meter"), SystemRefit()
    pair = [_concealed(drawn, name, 12.0) for name in ("gain_step", "sensitivity:water_c")]
    case = _case(drawn, pair)
    assert nats_of_alternative(refit, case, [e.name for e in pair]) < 0.1
    assert nats_of_alternative(refit, case, ["gain_step"]) > 30.0
    (alias, nats), *_ = rivals_with_nats(refit, case, pair[1]).items()
    assert nats_of_alternative(refit, case, [alias, "gain_step"]) == pytest.approx(nats, abs=0.1)


def test_the_right_model_knows_what_nobody_can_but_not_the_held_out_runs_own_values():
    """Two offsets in two held-out runs: they are the mean of the others' offsets."""
    drawn, refit = _drawn("orifice flow meter"), SystemRefit()
    n, form = drawn.table.n_runs, _form(drawn, "offset_per_run")
    values = dict.fromkeys([f"values[{k}]" for k in range(n)], 0.2) | {f"values[{n - 1}]": 5.0}
    case = _case(drawn, [SystemEffect(form, values, 12.0)])
    held = drawn.held_out_row_numbers
    later = run_table(drawn.table.select_rows(held), drawn.kind, case.readings[held])
    model, table = _right_model_and_readings(case, later, refit, rng=np.random.default_rng(0))
    np.testing.assert_allclose(table.covariates[drawn.kind.reading], case.readings[held] - 0.2)
    np.testing.assert_allclose(model.noise_sd, drawn.kind.sd)
    found = predict_system(model, table, rng=np.random.default_rng(1))
    assert np.abs(found.mean - drawn.simulate_all_rows([])[held]).max() < 0.5 * drawn.kind.sd


def test_half_of_the_wheel_is_clean():
    assert sum(s.kind == "clean" for s in SYSTEMS_WHEEL) == len(SYSTEMS_WHEEL) / 2
    own = [system_stratum_of(k) for k in range(2 * len(SYSTEMS_WHEEL))]
    assert [before for s, before in own if s.kind == "single"] == list(range(12))


def _stated(case):
    return simulator_file_text(case), table_text(case, np.arange(len(case.drawn.table)))


@pytest.fixture
def quick(monkeypatch):
    """Only systems whose reading follows from the row."""
    monkeypatch.setattr(cases, "KINDS", tuple(kind for kind in KINDS if kind.law is None))


@pytest.mark.parametrize("number", [1, 2, pytest.param(8, marks=pytest.mark.slow), 14])
def test_a_case_follows_from_the_seed_and_its_number(number, quick):
    one, again = (_stated(draw_system_case(12, number, after_refit=SystemRefit())) for _ in range(2))
    assert one == again
    assert one != _stated(draw_system_case(13, number, after_refit=SystemRefit()))


@pytest.mark.parametrize("number", [*range(4), *(pytest.param(k, marks=pytest.mark.slow) for k in range(4, 20))])
def test_a_case_of_every_stratum_holds_what_it_says(number, quick):
    case = draw_system_case(12, number, after_refit=SystemRefit())
    assert len(case.effects) == {"clean": 0, "pair": 2}.get(case.stratum.kind, 1)
    assert (case.noise.name != "white") is case.stratum.other_noise
    for effect in case.effects:
        assert effect.in_vocabulary is (case.stratum.kind != "outside")
        assert _size(case.drawn, effect) == pytest.approx(case.stratum.size, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("number", [k for k in range(20) if system_stratum_of(k)[0].kind != "clean"])
def test_a_case_of_every_stratum_holds_what_it_says_of_any_system(number):
    case = draw_system_case(31, number, after_refit=SystemRefit())
    for effect in case.effects:
        assert effect.size_lambda == pytest.approx(case.stratum.size, rel=0.01)
        assert _size(case.drawn, effect) == pytest.approx(case.stratum.size, rel=0.01)
