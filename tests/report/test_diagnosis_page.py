"""The page of a diagnosis: its first screen says the verdict, the chance, the gain and what to do."""

import dataclasses
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from mixtures import fixed_mixture

from probewise.diagnosis import EffectFound, ParameterFound, Place, diagnose
from probewise.diagnosis.advice import NextMeasurement
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.recordings import Recording, paper_plan
from probewise.report import covariates
from probewise.report import diagnosis as page
from probewise.report.residual_means import mean_residuals
from probewise.scene import KnownScene
from probewise.sensor import Chain, FixedLevels

SPOT = np.array([1.0, 0.0, 1.5, 1 / 72, 1 / 128, 0.0])


@pytest.fixture(scope="module")
def saturated():
    """A diagnosis of a third of the paper's plan, by electronics that give no more than 50 of 60."""
    plan = paper_plan()
    plan = plan.take(np.arange(0, len(plan), 3))
    exact = Chain(fixed_mixture(SPOT), FixedLevels(10.0, 60.0), KnownScene(plan.patterns))
    noise = 0.5 * np.random.default_rng(3).standard_normal(len(plan))
    readings = np.minimum(exact.predict(np.empty((1, 0)), plan)[0], 50.0) + noise
    return diagnose(Recording(plan, readings), rng=np.random.default_rng(1))


@pytest.fixture(scope="module")
def drawn(saturated):
    return {name: draw() for name, draw in page.figure_drawers(saturated).items()}


@pytest.mark.slow
def test_the_page_says_what_is_missing_and_what_to_do(saturated, drawn):
    assert {place.figure_name for place in saturated.where} <= set(drawn)
    for name, image in drawn.items():
        assert name.endswith(".svg")
        assert ElementTree.fromstring(image).tag.endswith("svg")
        assert b"nan" not in image
    html = page.page_html(saturated, drawn, source="some.csv", seed=1)
    screen, rest = html.split("<h2>", 1)
    assert "saturate" in screen
    assert "Hardly: with nothing missing" in screen
    assert "times as probable as before" in screen
    assert "What to measure next" in screen
    assert screen.count("<img") == 1
    for heading in ("Where it shows", "Before and after", "held-out", "Noise"):
        assert heading in rest


@pytest.mark.slow
def test_a_scan_is_shown_along_its_way_with_each_reading(saturated):
    """Its mean says nothing where the residual changes its sign within the scan."""
    plan, usable = saturated.recording.plan, saturated.recording.usable
    scan, by_row = plan.scan_names[0], plan.scan[usable].astype(float)
    changed = {"covariate": "scan", "scan": scan, "start": None, "end": None, "values": by_row}
    place = dataclasses.replace(saturated.where[0], **changed, without_effect=False)
    shown = page.figure_drawers(dataclasses.replace(saturated, where=(place,)))[place.figure_name]().decode()
    assert shown.count("<!-- one reading -->") == 2
    assert f"(mm), scan {scan}" in shown


def test_a_repair_that_does_not_predict_is_said_not_to():
    assert page._heldout_gain_in_words(-1.0, 0.1).startswith("Worse than before")
    assert page._heldout_gain_in_words(0.1, 0.1).startswith("No better than before")


@pytest.mark.slow
def test_the_band_of_chance_holds_ninety_five_of_a_hundred_means_after_a_fit():
    """A straight line fitted to noise: what it absorbs, by its posterior samples, makes the band narrower."""
    rng = np.random.default_rng(2)
    n, repeats = 48, 400
    x = np.linspace(-1.0, 1.0, n)
    design, noise = np.stack([np.ones(n), x], axis=1), rng.standard_normal((repeats, n))
    residuals = noise - noise @ design @ np.linalg.pinv(design)
    absorbed = rng.multivariate_normal(np.zeros(2), np.linalg.inv(design.T @ design), 4000) @ design.T
    inside = [
        np.abs(means.before) <= means.chance
        for means in (mean_residuals(x, own, None, sd=1.0, absorbed=absorbed) for own in residuals)
    ]
    by_step = np.mean(inside, axis=0)
    # 400 draws of a share of 0.95 lie below 0.90 or above 0.985 less than once in 1,000.
    assert by_step.min() > 0.90
    assert by_step.max() < 0.985


def test_places_come_as_the_headline_names_them_then_as_they_are_seen(monkeypatch):
    """The knife edge: the smallest p-value is seen in no mean, and the place is what the headline names."""
    sizes = {"slope": 1.0, "time": 5.0, "place": 3.0}
    where = [place_of(name, start) for name, start in (("slope", 0.0), ("time", 1.0), ("place", 2.0))]
    apparatus = SimpleNamespace(words=SimpleNamespace(run="scan"))
    where.append(dataclasses.replace(where[2], scan="s"))
    shares = {"place, smooth": 0.9}
    found = SimpleNamespace(verdict="unknown", unknown_shares=shares, where=tuple(where), apparatus=apparatus)
    monkeypatch.setattr(covariates, "covariate_values", lambda d, place: np.arange(3.0))
    monkeypatch.setattr(covariates, "views_of_place", lambda d, place: [place])
    sized = SimpleNamespace(
        diagnosis=found, means_in=lambda view: SimpleNamespace(largest_mean_in_sds=sizes[view.covariate])
    )
    ordered = covariates.ResidualNoise.ranked_places.func(sized)
    assert [(place.covariate, seen) for place, seen in ordered] == [("place", True), ("time", True), ("slope", False)]


def place_of(covariate, start):
    return Place(covariate, None, start, start + 1.0, 0.004, 4.0, *[np.zeros(0)] * 2, values=np.arange(3.0))


def test_an_effect_that_is_there_twice_has_the_name_of_diagnosis_json_in_the_table():
    parameter = ParameterFound("amp", "V", 1.0, 0.1, (0.8, 1.2))
    twice = EffectFound("ambient_step~again", 0.9, 9.0, "a step", (parameter,))
    assert "(ambient_step)</td>" in page._effect_table([twice])


def test_explanations_that_the_next_readings_leave_together_are_told_as_one():
    effects = (("lag",), ("delay",), ("settling",))
    plan = NextMeasurement(
        range(8), "scan again", 1.2, 12.3, ("lag", "delay", "settling"), effects,
        np.array([[0.0, 0.1, 20.0], [0.1, 0.0, 20.0], [20.0, 20.0, 0.0]]),
    )  # fmt: skip
    found = SimpleNamespace(
        next_measurement=plan, apparatus=LightSensorApparatus(), hypotheses=(), repaired=SimpleNamespace(effects=())
    )
    said = page._next_readings_in_words(found)
    rest = said.partition("Expected to separate ")[2]
    one, other = rest.split(" from ")
    assert " or " in one
    assert " or " not in other
    assert other.endswith("by 12 nats.")


def test_a_range_far_narrower_than_all_values_is_one_number():
    values = np.append(np.linspace(10.0, 60.0, 9), [57.636938104, 57.636938115])
    place = dataclasses.replace(place_of("level", 0.0), start=57.636938104, end=57.636938115, values=values)
    plan = SimpleNamespace(instrumentation=SimpleNamespace(unit="LEGO"))
    found = SimpleNamespace(apparatus=LightSensorApparatus(), recording=SimpleNamespace(plan=plan))
    assert "predicted reading, 57.64 LEGO units (p" in page._place_caption(found, place)
