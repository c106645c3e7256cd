"""Audit of a plan."""

from dataclasses import replace

import numpy as np
import pytest
from hand_made import hand_made_sensor

from probewise.diagnosis import audit_plan
from probewise.diagnosis.audit import Expected
from probewise.diagnosis.light_sensor import candidate_scans
from probewise.diagnosis.sensors import default_sensor
from probewise.effects import VOCABULARY, Extent
from probewise.recordings import paper_plan, two_way_plan
from probewise.recordings.plan import Plan
from probewise.scene import KnownScene
from probewise.sensor import Chain, FreeLevels, FreeMixture

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
