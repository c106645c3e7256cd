"""What no name explains: bases, formulas, fine structure of an SSF."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.diagnosis.diagnose_simulator import diagnose_system, prepare_system
from probewise.diagnosis.diagnosis import diagnose_prepared
from probewise.diagnosis.evidence import Linearised
from probewise.diagnosis.fit import Fit, Model, fit
from probewise.diagnosis.light_sensor import varying_covariates
from probewise.diagnosis.locate import Covariate
from probewise.diagnosis.noise import white_noise
from probewise.diagnosis.search import search
from probewise.diagnosis.sensors import default_sensor, fine_structure_slopes, with_free_form
from probewise.diagnosis.unknown_bases import PRODUCTS, bank_of_unknown_effects
from probewise.diagnosis.verdict import run_global_test
from probewise.effects import VOCABULARY, Extent
from probewise.recordings import Recording, paper_plan, two_way_plan
from probewise.systems import RunTable, Simulator, table_for
from probewise.world.spots import Blob, gaussian_spot, ring_spot
from probewise.world.world import World

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


PLAN = two_way_plan()
N = len(PLAN)
SIGNAL = 25.0 * (1 + np.tanh(PLAN.x_mm / 8))
FORTH = np.sign(PLAN.direction_of_motion[:, 0])
IN_X = 25.0 / 8 / np.cosh(PLAN.x_mm / 8) ** 2  # the signal's slope in the lab frame
SLOPE = IN_X * np.where(FORTH == 0, 1.0, FORTH)  # and along the move
STARTS = np.flatnonzero(np.diff(PLAN.scan, prepend=-1))
BASES = bank_of_unknown_effects(varying_covariates(PLAN, np.arange(N), SIGNAL, SLOPE), SIGNAL, SLOPE, PLAN.scan)
TEMPLATES = [BASES[k] for k in range(len(BASES.widths))]
TIME = (PLAN.time_s - PLAN.time_s.min()) / np.ptp(PLAN.time_s)
MISMATCHES = {
    "a rail bent along X": IN_X * (PLAN.x_mm / 50) ** 2,
    "a slip along X at a moment": IN_X * (TIME > 0.5),
    "a gain that wanders in time": SIGNAL * np.sin(9 * TIME),
    "a wave in time": np.sin(20 * TIME),
    "a tone that slides": np.sin(2 * np.pi * (4 * TIME + 14 * TIME**2)),
    "a bend of the response": SIGNAL * (SIGNAL.max() - SIGNAL),
    "a gain for each angle": SIGNAL * np.cos(2 * PLAN.orientation_rad),
    "a start of each scan": np.exp(-(np.arange(N) - np.repeat(STARTS, np.diff(STARTS, append=N))) / 2),
    "the brightest so far": np.concatenate([np.maximum.accumulate(part) for part in np.split(SIGNAL, STARTS[1:])]),
}


@pytest.mark.parametrize("mismatch", MISMATCHES.values(), ids=MISMATCHES)
def test_some_basis_holds_it(mismatch):
    left = []
    for columns in TEMPLATES:
        amount = np.linalg.lstsq(columns, mismatch)[0]
        left.append(float(np.sum((mismatch - columns @ amount) ** 2) / np.sum(mismatch**2)))
    assert min(left) < 0.1


def _three_columns_and_bases():
    """Return three columns, (3, 200), of 190, 200 and 200 rows, and the bases with and without their products."""
    rng = np.random.default_rng(8)
    columns = rng.normal([[20.0], [45.0], [1e-9]], [[3.0], [9.0], [1e-10]], (3, 200))
    rows = [np.arange(10, 200), np.arange(200), np.arange(200)]
    covariates = [Covariate(name, c[at], at) for name, c, at in zip("abc", columns, rows, strict=True)]
    level = rng.random(200)
    apart = bank_of_unknown_effects(covariates, level, np.gradient(level), None)
    return columns, bank_of_unknown_effects(covariates, level, np.gradient(level), None, multiplied=covariates), apart


def test_products_of_two_columns_are_one_family_that_no_function_of_one_imitates():
    columns, bases, apart = _three_columns_and_bases()
    assert PRODUCTS not in apart.labels
    products = [bases[int(k)][:, 0] for k in bases.indices_by_label[PRODUCTS]]
    centred = columns - columns.mean(axis=1, keepdims=True)
    centred[0] = np.where(np.arange(200) < 10, 0.0, columns[0] - columns[0, 10:].mean())
    for product, (first, second) in zip(products, [(0, 1), (0, 2), (1, 2)], strict=True):
        wanted = centred[first] * centred[second]
        assert np.corrcoef(product, wanted)[0, 1] == pytest.approx(1.0)
        assert np.all(product[:10] == 0) == (first == 0)
        every = [apart[k] for k in range(len(apart.widths))]
        left = [np.sum((wanted - t @ np.linalg.lstsq(t, wanted)[0]) ** 2) / np.sum(wanted**2) for t in every]
        assert min(left) > 0.7


NOISE_SD = 0.4


def fitted(recording: Recording, *, free: bool = True) -> Fit:
    sensor = default_sensor(Extent.of(recording), 1)
    law = white_noise(len(recording))
    one = fit(Model(sensor, (), recording.plan), recording, np.zeros(7), law.with_least_sigma(NOISE_SD))
    if not free:
        return one
    form = with_free_form(sensor)
    start = np.pad(one.z, (0, form.n_params - sensor.n_params))
    return fit(Model(form, (), recording.plan), recording, start, law.with_least_sigma(NOISE_SD))


def usable(recording: Recording) -> np.ndarray:
    return np.flatnonzero(recording.usable)


def noise_free(spot, plan) -> Recording:
    return Recording(plan, World(spot).expected_readings(plan))


@pytest.mark.parametrize("plan", [paper_plan(), two_way_plan()], ids=["paper", "two_way"])
def test_it_takes_up_what_a_free_form_leaves_of_a_ring(plan):
    recording = noise_free(ring_spot(4.0, 1.2, center_mm=(0.0, 1.5), off_axis=0.4, pixel_mm=0.5), plan)
    found = fitted(recording)
    slopes = np.concatenate([found.slopes, fine_structure_slopes(found.model, found.z, usable(recording))], axis=1)
    z = np.pad(found.z, (0, slopes.shape[1] - len(found.z)))
    design = np.concatenate([slopes / NOISE_SD, np.eye(len(z))])
    target = np.concatenate([found.residuals / NOISE_SD, -z])
    left = np.linalg.norm(target - design @ np.linalg.lstsq(design, target, rcond=None)[0])
    rest = float(np.linalg.norm(found.residuals) / NOISE_SD)
    assert rest > 1.0  # something is left of a ring, in noise sds
    assert np.sqrt(max(left**2 - np.sum(z**2), 0.0)) < 0.5 * rest


def test_effects_outlast_it():
    plan = two_way_plan()
    world = World(gaussian_spot([Blob(1.0, (0.4, -0.3), (5.0, 3.5), 0.3)], pixel_mm=0.5))
    rng = np.random.default_rng(7)
    recording = Recording(plan, world.expected_readings(plan) + NOISE_SD * rng.standard_normal(len(plan)))
    found = fitted(recording)
    law = white_noise(len(recording))
    extent = Extent.of(recording)
    more = fine_structure_slopes(found.model, found.z, usable(recording))
    without, beside = Linearised.of(found, law), Linearised.of(found, law, more)
    for name in ("backlash", "lag", "sensor_tilt", "ambient_gradient", "glint", "battery_sag", "flicker"):
        effect = VOCABULARY[name].for_extent(extent)
        model = found.model.with_effect(effect)
        z = np.concatenate([found.z, model.z_of_last_effect(effect.entries[0][:1])[0]])
        change = (model.predict(z[None, :])[0] - found.model.predict(found.z[None, :])[0])[:, None]
        kept = np.linalg.norm(beside.project(change)) / np.linalg.norm(without.project(change))
        assert kept > 0.9, name
