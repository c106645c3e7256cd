"""Formulas for effects out of vocabulary."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.diagnosis.diagnose_simulator import diagnose_system, prepare_system
from probewise.diagnosis.diagnosis import diagnose_prepared
from probewise.diagnosis.search import search
from probewise.diagnosis.verdict import run_global_test
from probewise.systems import RunTable, Simulator, table_for

SD = 0.05


def _diagnosed(change, *, seed):
    """Diagnose three runs of a straight line with a change that it leaves out."""
    rng = np.random.default_rng(seed)
    run = np.repeat([1.0, 2.0, 3.0], 60)
    time = np.concatenate([np.sort(rng.uniform(0, 100, 60)) + 100 * k for k in range(3)])
    force = 10 * rng.random(180)
    room = 20 + np.cumsum(rng.normal(size=180)) * 0.4
    damp = 50 + np.cumsum(rng.normal(size=180))
    columns = {"t_s": time, "run": run, "force": force, "room": room, "damp": damp}
    y = 2.0 + 0.5 * force + change(columns) + SD * rng.normal(size=180)
    table = RunTable({**columns, "y": y}, time="t_s", run="run")
    simulator = Simulator(
        "y", "V", {"zero": (-10, 10), "slope": (0, 2)}, simulate=lambda p, u: p["zero"] + p["slope"] * u["force"],
        time="t_s", run="run",
    )  # fmt: skip
    return diagnose_system(simulator, table, rng=np.random.default_rng(0))


@pytest.mark.slow
def test_a_square_wave_is_no_pair_of_sinusoids():
    """A share of .35 of every 23 s, of lambda about 30."""
    found = _diagnosed(lambda u: 0.23 * ((u["t_s"] / 23.0) % 1 < 0.35), seed=1)
    assert found.verdict == "unknown"
    (wave,) = [e for e in found.repaired.chain.effects if e.name.startswith("formula:")]
    assert wave.expression.startswith("a while")
    values = dict(zip(wave.prior.names, found.repaired.effect_samples(wave.name).mean(axis=0), strict=True))
    assert 1 / values["hz"] == pytest.approx(23.0, rel=0.01)
    # The rest of each period with the other sign is the same wave.
    assert abs(values["a"]) == pytest.approx(0.23, abs=0.05)
    assert values["share"] == pytest.approx(0.35 if values["a"] > 0 else 0.65, abs=0.02)


@pytest.mark.slow
def test_creep_in_proportion_to_the_load_is_a_formula_that_the_repaired_model_holds():
    """No offset settles alike in seven weighings; what stands beside the formula is no doubt about it."""
    rng, t = np.random.default_rng(11), np.array([2.0, 5, 10, 20, 40, 80, 160, 300, 600])
    load, since = np.repeat([0.5, 1, 2, 5, 2, 1, 5], 9), np.tile(t, 7)
    y = load * (1.0021 - 9e-4 * np.expm1(-since / 90)) + 8e-4 + 2e-4 * rng.normal(size=63)
    columns = {"s": since, "weighing": np.repeat(np.arange(7.0), 9), "load": load, "kg": y}
    scale = Simulator(
        "kg", "kg", {"gain": (0.9, 1.1), "zero": (-0.1, 0.1)}, simulate=lambda p, u: p["zero"] + p["gain"] * u["load"],
        time="s", run="weighing",
    )  # fmt: skip
    table = RunTable(columns, time="s", run="weighing")
    found = diagnose_system(scale, table, rng=np.random.default_rng(0))
    assert found.verdict == "unknown"
    assert found.formula.expression.startswith("a kg exp(-s / tau_s)")
    a, tau = (p.interval95 for p in found.formula.parameters)
    assert a[0] < -9e-4 * np.exp(-2 / 90) < a[1]
    assert tau[0] < 90 < tau[1]
    assert sum(share for names, share in found.combination_shares.items() if names) > 0.85


def _prepared_with_climate(change, *, seed=5, **more):
    """Prepare a line in x, read in a room whose temperature and humidity change it as the simulator does not say."""
    rng = np.random.default_rng(seed)
    temp, damp, x = 20 + 4 * rng.normal(size=150), 40 + 12 * rng.normal(size=150), rng.uniform(0, 1, 150)
    y = 1.0 + 2.0 * x + change(temp, damp) + SD * rng.normal(size=150)
    columns = {"lot": np.repeat([1.0, 2.0, 3.0], 50), "x": x, "temp": temp, "damp": damp, **more, "y": y}
    simulator = Simulator(
        "y", "V", {"a": (-5, 5), "b": (0, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"], run="lot"
    )
    return prepare_system(simulator, table_for(simulator, columns))


@pytest.mark.slow
def test_a_product_beside_both_of_its_columns_is_what_remains():
    """Without a mean taken off, most of a product is an influence of each column, and these have names."""
    prepared = _prepared_with_climate(lambda temp, damp: 0.001 * temp * damp)
    found = diagnose_prepared(prepared, rng=np.random.default_rng(1))
    assert {name.rpartition(":")[2] for name in found.combination} == {"temp", "damp"}
    remainder = found.remainder
    assert remainder is not None
    assert remainder.formula is not None
    low, high = remainder.formula.parameters[0].interval95
    assert low < 0.001 < high


def test_a_formula_that_the_readings_proposed_is_no_test_of_them():
    """A p-value that counts the best of hundreds of formulas, chosen by these readings, is too small."""
    rng = np.random.default_rng(4)
    x = rng.uniform(0.0, 1.0, 60)
    simulator = Simulator("y", "V", {"a": (-5, 5)}, simulate=lambda p, u: p["a"] + 2.0 * u["x"])
    table = table_for(simulator, {"x": x, "y": 1.0 + 2.0 * x + 0.4 * SD * np.cos(9 * x) + SD * rng.normal(size=60)})
    prepared = prepare_system(simulator, table)
    searched = search(prepared, depth=0)
    formulas = prepared.apparatus.proposed_formulas()
    assert len(formulas) > 5
    more = replace(searched, prepared=replace(prepared, effects={**prepared.effects, **formulas}))
    tests = [run_global_test(each, rng=np.random.default_rng(1)) for each in (searched, more)]
    assert tests[0].p_value == tests[1].p_value
