"""The vocabulary of forms is one: bound by the library, concealed by the independent world, worded by the report."""

import numpy as np
import pytest

from probewise.diagnosis.fit import Model
from probewise.diagnosis.words import FORMS_IN_WORDS, effect_has_words, effect_in_words
from probewise.effects import name_without_copy_suffix
from probewise.proof.refits import SystemRefit
from probewise.proof.systems.cases import draw_system
from probewise.proof.systems.forms import ADDED_FAMILIES, FAMILIES, SystemEffect, forms_of
from probewise.proof.systems.kinds import BATH, OSCILLATOR
from probewise.systems import Law, Noise, RunTable, Simulator, System
from probewise.systems.forms import ReferenceFit, bind_forms

_T = np.tile(np.arange(0.0, 6.0, 0.2), 2)
TABLE = RunTable(
    {
        "t_s": _T,
        "run": np.repeat([1.0, 2.0], len(_T) // 2),
        "push": np.sin(_T) + 0.3 * np.sin(3.1 * _T),
        "room_c": np.random.default_rng(1).normal(20, 2, len(_T)),
        "y": np.zeros(len(_T)),
    },
    time="t_s",
    run="run",
)


@pytest.fixture(scope="module", name="names")
def _names():
    """Every form of a mass on a spring that is pushed, in the file's own words."""
    law = Law(
        {"x": 0.5, "v": 0.0},
        lambda s, p, u: {"x": s["v"], "v": u["push"] - p["k"] * s["x"] - 0.3 * s["v"]},
        max_step_s=0.1,
    )
    simulator = Simulator("y", "m", {"k": (0.5, 2.0)}, law=law, time="t_s", run="run", noise=Noise(sd=0.01))
    system = System.of(simulator, TABLE)
    return {
        name_without_copy_suffix(name)
        for name in bind_forms(ReferenceFit(system, TABLE, np.zeros(system.n_params), 0.01))
    }


def test_every_form_has_a_counterpart_in_the_world_that_conceals(names):
    assert {name.split(":")[0] for name in names} == {family.split()[0] for family in (*FAMILIES, *ADDED_FAMILIES)}


def test_the_report_has_words_for_every_form(names):
    assert [name for name in names if not effect_has_words(name)] == []
    assert {effect_in_words(name).count("{") for name in names} == {0}


def test_the_report_has_words_for_nothing_else(names):
    of_the_noise = {"random_walk", "noise_per_run"}
    assert set(FORMS_IN_WORDS) <= {name.split(":")[0] for name in names} | of_the_noise


@pytest.mark.parametrize(
    ("kind", "share"), [(BATH, 1e-4), pytest.param(OSCILLATOR, 0.15, marks=pytest.mark.slow)], ids=["formula", "law"]
)
def test_the_library_and_the_world_that_conceals_have_the_same_formulas(kind, share):
    """Readings with each form, by the engine and by the world; of a law to how they integrate and delay a column."""
    rng = np.random.default_rng(3)
    drawn, refit = draw_system(kind, rng=rng), SystemRefit()
    bare = drawn.true_system
    forms = refit.forms(refit.refit(drawn, bare.readings))
    theta = refit.model.theta(refit.true_z[None, :])
    differ = {}
    for form in forms_of(bare):
        effect = SystemEffect(form, form.of_amplitude(form.first, form.draw(rng)))
        if effect.name not in forms:  # none that could be seen
            continue
        wanted = refit.recording(drawn.simulate_diagnosed_rows([effect])).readings
        found = []
        for variant in forms[effect.name].variants():
            values = [[effect.values.get(name, 0.0) for name in variant.prior.names]]
            chain = Model(refit.model.sensor, (variant,), refit.model.plan).chain
            found.append(chain.predict(np.append(theta, values, axis=1), refit.model.plan)[0])
        change = np.abs(wanted - refit.recording(bare.readings).readings).max()
        if (off := min(np.abs(readings - wanted).max() for readings in found)) > share * change:
            differ[form.name] = off, change
    assert not differ
