"""Audit of a plan and of a table."""

from dataclasses import replace

import numpy as np
import pytest
from hand_made import hand_made_sensor
from heater import heater, runs

from probewise.diagnosis import audit as system_audit
from probewise.diagnosis import audit_plan, audit_system
from probewise.diagnosis.audit import Expected
from probewise.diagnosis.light_sensor import candidate_scans
from probewise.diagnosis.sensors import default_sensor
from probewise.effects import VOCABULARY, Extent
from probewise.errors import ParameterError
from probewise.recordings import paper_plan, two_way_plan
from probewise.recordings.plan import Plan
from probewise.scene import KnownScene
from probewise.sensor import Chain, FreeLevels, FreeMixture
from probewise.systems import Noise, Simulator

TWO = {name: VOCABULARY[name] for name in ("backlash", "edge_misplacement")}


def thinned(plan: Plan, step: int = 4) -> Plan:
    return plan.take(np.arange(0, len(plan), step))


SD = 0.5


def sights_of(plan: Plan):
    """A sensor, the surviving share of backlash, its cosine to an edge that lies elsewhere, and its smallest size."""
    extent = Extent(10.0, 60.0, plan)
    sensor, built = default_sensor(extent, 1), {name: kind.for_extent(extent) for name, kind in TWO.items()}
    bank = Expected(sensor, np.full(sensor.n_params, 0.1), SD, lambda _: built, "").bank(plan)
    share, like, smallest = bank.seen_in(np.arange(len(plan)))["backlash"]
    return sensor, share, like["edge_misplacement"], smallest


def by_least_squares(plan: Plan, sensor) -> tuple[float, float]:
    """The same two numbers from predictions of plain chains and ordinary least squares."""
    z = np.full(sensor.n_params, 0.1)

    def predict(effects, theta):
        chain = Chain(FreeMixture(1), FreeLevels(), KnownScene(plan.patterns), effects)
        return chain.predict(theta, plan)[0] / SD

    def own(z):
        return predict((), sensor.theta(z[None, :]))

    step = 1e-5
    slopes = np.stack([(own(z + step * e) - own(z - step * e)) / (2 * step) for e in np.eye(len(z))], axis=1)
    design = np.concatenate([slopes, np.eye(len(z))])
    left, raw = [], []
    for kind in TWO.values():
        theta = np.concatenate([sensor.theta(z[None, :]), [[1e-3]]], axis=1)
        trace = predict((kind(),), theta) - own(z)
        padded = np.concatenate([trace, np.zeros(len(z))])
        left.append(padded - design @ np.linalg.lstsq(design, padded, rcond=None)[0])
        raw.append(np.linalg.norm(trace))
    cosine = abs(left[0] @ left[1]) / (np.linalg.norm(left[0]) * np.linalg.norm(left[1]))
    return float(np.linalg.norm(left[0]) / raw[0]), float(cosine)


@pytest.mark.parametrize("plan", [thinned(paper_plan()), thinned(two_way_plan(), 8)])
def test_share_and_cosine_are_those_of_least_squares(plan):
    sensor, share, cosine, _ = sights_of(plan)
    np.testing.assert_allclose((share, cosine), by_least_squares(plan, sensor), rtol=0.02, atol=1e-3)


def test_the_smallest_size_leaves_lambda_eight():
    """A trace of that size, from the chain, has length 8 once the fit has taken its part."""
    plan = thinned(two_way_plan(), 8)
    sensor, share, _, smallest = sights_of(plan)
    (width_mm,) = smallest.values()
    theta = sensor.theta(np.full((1, sensor.n_params), 0.1))
    plain = Chain(FreeMixture(1), FreeLevels(), KnownScene(plan.patterns))
    with_play = plain.with_effects(VOCABULARY["backlash"]())
    trace = with_play.predict(np.concatenate([theta, [[width_mm]]], axis=1), plan) - plain.predict(theta, plan)
    assert share * np.linalg.norm(trace) / SD == pytest.approx(8.0, rel=0.05)


@pytest.mark.slow
def test_what_a_cure_claims_is_seen_after_all_of_it():
    audit = audit_plan(thinned(paper_plan()))
    before, after = ({e.name: e.detectability for e in effects} for effects in (audit.effects, audit.after))
    cured = [name for cure in audit.cures for name in cure.cured]
    assert {"lag", "backlash"} & set(cured)
    assert all(before[name] != "fine" and after[name] == "fine" for name in cured)
    assert audit.cures[-1].cured
    assert audit.cure_plan is not None
    assert len(audit.cure_plan) == audit.extra_readings
    said = audit.summary()
    assert len(said.splitlines()) <= 25
    assert max(map(len, said.splitlines())) <= 130
    assert all(effect.name in said for effect in audit.effects)


@pytest.mark.slow
def test_what_no_scan_of_the_same_sheet_parts_another_sheet_does():
    """A sensor that looks beside itself, and an edge that lies elsewhere."""
    audit = audit_plan(paper_plan())
    cured = {name: cure.kind for cure in audit.cures for name in cure.cured}
    assert cured["sensor_tilt"] == cured["edge_misplacement"] == "lay"
    assert cured["backlash"] == "respeed"
    assert audit.extra_readings <= 150
    plan = audit.cure_plan
    assert plan is not None
    assert {name for name, _ in plan.rows_by_pattern()} <= plan.patterns.keys()


def test_only_what_the_apparatus_can_command_is_asked_for():
    plan = paper_plan()
    kinds = {command.kind for command in candidate_scans(plan)}
    assert kinds == {"repeat", "reverse", "respeed", "rotate"}
    able = replace(plan, instrumentation=replace(plan.instrumentation, controls=("led", "height_mm")))
    assert {command.kind for command in candidate_scans(able)} == {"repeat", "reverse", "respeed", "relight", "raise"}


def test_another_noise_sd_shows_only_beside_a_calibrated_sensor():
    effects = {name: VOCABULARY[name] for name in ("noise_sd", "offset_drift")}
    alone, beside = (audit_plan(paper_plan(), sensor=known, effects=effects) for known in (None, hand_made_sensor()))
    assert alone.effects[0].reason == "the model's own parameters absorb it"
    assert beside.effects[0].detectability == "fine"


TABLE = runs()


@pytest.fixture(scope="module")
def audit():
    return audit_system(heater(), TABLE)


def of(audit, name):
    return next(effect for effect in audit.effects if effect.name == name)


def test_a_start_of_its_own_absorbs_an_offset_of_each_run(audit):
    """Both add a constant to every row of a run."""
    assert of(audit, "offset_per_run").detectability == "invisible"


def test_rows_that_show_an_effect_grow_with_the_square_of_what_is_absorbed(audit):
    for effect in audit.effects:
        if effect.rows is not None:
            np.testing.assert_allclose(effect.rows, (8 / effect.share) ** 2, atol=1.0)


def test_a_gap_in_a_column_hides_nothing(audit):
    room = TABLE.columns["room_c"].copy()
    room[7] = np.nan
    found = audit_system(heater(), TABLE.with_columns({"room_c": room}))
    assert [e.name for e in found.effects] == [e.name for e in audit.effects]
    assert of(found, "sensitivity:room_c").detectability == of(audit, "sensitivity:room_c").detectability
    assert "gaps of room_c are interpolated" in found.assumed


def test_what_needs_a_time_says_so_where_none_was_recorded():
    simulator = heater(time=None, simulate=lambda p, data: p["start_c"] + p["gain"] * data["power_w"] * p["tau_s"])
    found = audit_system(simulator, {**TABLE.columns})
    assert of(found, "lag").reason == "no time was recorded"


def test_readings_that_change_nowhere_are_refused():
    simulator = heater(simulate=lambda p, data: p["start_c"] + 0.0 * data["t_s"], noise=Noise(sd=0.1), per_run=())
    with pytest.raises(ParameterError, match="the same in all rows"):
        audit_system(simulator, TABLE)


def test_a_plan_that_lacks_a_cell_is_told_in_which_row():
    """Before, its readings were said to be the same in all rows."""
    x = np.where(np.arange(40) == 7, np.nan, np.linspace(0.0, 1.0, 40))
    simulator = Simulator("y", "V", {"a": (0, 5)}, simulate=lambda p, u: p["a"] * u["x"])
    with pytest.raises(ParameterError, match="no finite reading in 1 of 40 rows, first in row 7"):
        audit_system(simulator, {"x": x})


@pytest.mark.parametrize("most", [100, 200])
def test_a_part_of_a_long_table_tells_the_sizes_that_all_of_it_shows(most, monkeypatch):
    whole = audit_system(heater(), runs(n=150))
    monkeypatch.setattr(system_audit, "_MOST_ROWS", most)
    part = {effect.name: effect.smallest for effect in audit_system(heater(), runs(n=150)).effects}
    ratios = [
        part[effect.name][0].amount / effect.smallest[0].amount
        for effect in whole.effects
        if effect.smallest and effect.smallest[0].amount and part[effect.name] and part[effect.name][0].amount
    ]
    assert len(ratios) > 10
    np.testing.assert_allclose(np.median(ratios), 1.0, atol=0.05)
    assert np.mean(np.abs(np.log(ratios)) < 0.2) > 0.8
