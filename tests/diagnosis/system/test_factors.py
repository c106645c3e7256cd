"""A scale parameter that depends on a column by a factor, not linearly: a rate that grows with the temperature."""

import numpy as np
import pytest

from probewise.diagnosis.diagnose_simulator import diagnose_system
from probewise.systems import FittedSystem, RunTable, Simulator, System, predict_system
from probewise.systems.forms import ReferenceFit, bind_forms
from probewise.systems.forms.binding import extract_stored_fit

NAME = "depends:rate:temp_c"
_HOURS, _TEMP = (a.ravel() for a in np.meshgrid(np.linspace(1.0, 40.0, 12), np.linspace(20.0, 80.0, 8)))
SIMULATOR = Simulator(
    "y",
    "V",
    {"start": (5, 15), "rate": ("log", 1e-4, 1.0)},
    simulate=lambda p, u: p["start"] * np.exp(-p["rate"] * u["hours"]),
)


def _table(y):
    return RunTable({"hours": _HOURS, "temp_c": _TEMP, "y": y})


def _about(misfit):
    table = _table(np.zeros(_HOURS.size))
    system = System.of(SIMULATOR, table)
    return ReferenceFit(system, table, np.zeros(system.n_params), 0.05, misfit=misfit)


def test_a_scale_parameter_changes_linearly_first_and_by_a_factor_of_the_same_slope_second():
    about = _about(100.0)
    form = bind_forms(about)[NAME]
    start, rate = about.theta[0]
    warmer = _TEMP - _TEMP.mean()
    linear, factor = form.variants()
    for variant, expected in (
        (linear, lambda a: rate + a * warmer),
        (factor, lambda a: rate * np.exp(a / rate * warmer)),
    ):
        (which,) = np.unique(variant.bank()[:, :, 1])
        chain = about.system.chain(about.table, [variant])
        found = chain.predict(np.array([[start, rate, 3e-4, which]]), about.table)[0]
        np.testing.assert_allclose(found, start * np.exp(-expected(3e-4) * _HOURS), rtol=1e-6)
        assert variant.fixed == ("as_factor",)
        assert np.isfinite(variant.prior.log_prob(np.array([[3e-4, which]])))[0]


def test_a_misfit_that_asks_for_a_small_change_offers_the_linear_one_alone():
    assert len(bind_forms(_about(1.0))[NAME].variants()) == 1


@pytest.mark.single_case
@pytest.mark.slow
def test_a_rate_that_doubles_every_ten_degrees_is_named_with_its_slope_at_the_mean():
    """By a factor of 64 over the table: linearly, it would fall below zero at the cold end."""
    rng = np.random.default_rng(2)
    rate = 0.02 * 2 ** ((_TEMP - _TEMP.mean()) / 10)
    y = 10.0 * np.exp(-rate * _HOURS) + 0.05 * rng.standard_normal(_HOURS.size)
    found = diagnose_system(SIMULATOR, _table(y), rng=np.random.default_rng(0))
    assert found.verdict == "named"
    assert found.combination == (NAME,)
    (effect,) = [e for e in found.effects if e.name == NAME]
    (slope,) = effect.parameters
    assert slope.name == "a"
    assert slope.mean == pytest.approx(0.02 * np.log(2) / 10, rel=0.05)
    assert "exponentially" in effect.sentence


def test_a_stored_model_of_an_earlier_version_depends_linearly():
    """Its file holds `a` alone: predictions are those of the same file with the new parameter at 0."""
    about = _about(1.0)
    names = ("start", "rate", f"{NAME}.a")
    samples = np.array([10.0, 0.02, 3e-4]) * (1 + 0.01 * np.random.default_rng(0).standard_normal((500, 3)))
    old = FittedSystem(SIMULATOR, names, samples, np.full(500, 0.05), effects=(NAME,), known=extract_stored_fit(about))
    mean = predict_system(old, about.table, rng=np.random.default_rng(0)).mean
    rate = samples[:, 1:2] + samples[:, 2:] * (_TEMP - _TEMP.mean())
    np.testing.assert_allclose(mean, (samples[:, :1] * np.exp(-rate * _HOURS)).mean(axis=0), atol=0.02)
