"""The page of a diagnosis: its first screen says the verdict, the chance, the gain and what to do."""

import dataclasses

import numpy as np
import pytest

from probewise.diagnosis import audit_recorded, diagnose
from probewise.recordings import Recording, paper_plan
from probewise.report import diagnosis as page
from probewise.report.covariate import category_names, covariate_label, covariate_values
from probewise.report.plots import gain_by_scan, mean_residuals
from probewise.scene import KnownScene
from probewise.sensor import Chain, FixedLevels, FixedMixture

SPOT = np.array([1.0, 0.0, 1.5, 1 / 72, 1 / 128, 0.0])


@pytest.fixture(scope="module")
def saturated():
    """A diagnosis of a third of the paper's plan, by electronics that give no more than 50 of 60."""
    plan = paper_plan()
    plan = plan.take(np.arange(0, len(plan), 3))
    exact = Chain(FixedMixture.from_parameters(SPOT), FixedLevels(10.0, 60.0), KnownScene(plan.patterns))
    noise = 0.5 * np.random.default_rng(3).standard_normal(len(plan))
    readings = np.minimum(exact.predict(np.empty((1, 0)), plan)[0], 50.0) + noise
    return diagnose(Recording(plan, readings), rng=np.random.default_rng(1))


@pytest.mark.slow
def test_the_page_says_what_is_missing_and_what_to_do(saturated):
    drawn = page.figures(saturated)
    assert {place.witness for place in saturated.where} <= set(drawn)
    audit = audit_recorded(saturated)
    html = page.write_page(saturated, drawn, source="some.csv", seed=1, audit=audit)
    screen, rest = html.split("<h2>", 1)
    assert "saturate" in screen
    assert "Hardly: with nothing missing" in screen
    assert "times as probable as before" in screen
    assert "What to do next" in screen
    assert screen.count("<img") == 1
    for heading in ("Where it shows", "Before and after", "Noise", "could have shown"):
        assert heading in rest
    assert "not seen at all" in rest


@pytest.mark.slow
def test_every_place_has_its_covariate_row_by_row(saturated):
    for place in saturated.where:
        values = covariate_values(saturated, place)
        rows = np.isfinite(values)
        assert rows.any()
        if place.start is not None and category_names(saturated, place) is None:
            assert values[rows].min() <= place.start <= place.end <= values[rows].max()


def test_labels_carry_units():
    assert covariate_label("level", "LEGO") == "predicted reading (LEGO units)"
    assert covariate_label("place", "V", "edge_0") == "place along the scans, scan edge_0 (mm)"
    assert covariate_label("battery_mv", "V") == "battery mv"


def test_residuals_are_averaged_in_even_steps_with_their_chance():
    """Ten thousand readings of a step of two: the means stand at 0 and 2 in steps of the covariate."""
    x = np.linspace(0.0, 1.0, 10_000)
    ax = mean_residuals(x, 2.0 * (x > 0.5), None, sd=1.0, label="x", unit="V")
    (line, *_) = (part for part in ax.get_lines() if part.get_label() == "model as calibrated")
    at, mean = line.get_data()
    np.testing.assert_allclose(np.diff(at), 1 / 24, rtol=0.01)
    np.testing.assert_allclose(mean, 2.0 * (at > 0.5), atol=0.01)


def test_categories_are_named_on_the_axis():
    ax = mean_residuals(
        np.repeat([-1.0, 1.0], 30),
        np.zeros(60),
        np.zeros(60),
        sd=1.0,
        label="way",
        unit="V",
        names={-1.0: "back", 1.0: "forth"},
    )
    assert [text.get_text() for text in ax.get_xticklabels()] == ["back", "forth"]


def test_of_many_scans_the_least_and_the_largest_gains_are_drawn():
    scans = [(f"scan_{k}", float(k)) for k in range(40)]
    ax = gain_by_scan(scans, 19.5, 1.9, most=4)
    assert [text.get_text() for text in ax.get_yticklabels()] == ["scan 0", "scan 1", "scan 38", "scan 39"]


@pytest.mark.slow
def test_a_repair_that_does_not_predict_is_said_not_to(saturated):
    worse = dataclasses.replace(saturated.improvement, heldout_log_density_per_reading=-1.0, heldout_sd=0.1)
    found = dataclasses.replace(saturated, improvement=worse)
    drawn = {**page.figures(saturated), "gain.png": b""}
    assert "Worse than before" in page.write_page(found, drawn, source="some.csv", seed=1)
