"""Scans that the arm could take next."""

from dataclasses import replace

import numpy as np

from probewise.diagnosis.light_sensor import (
    LightSensorApparatus,
    candidate_scans,
    rows_of_distinct_scans,
    varying_covariates,
)
from probewise.recordings import two_way_plan


def without_controls():
    plan = two_way_plan()
    return replace(plan, instrumentation=replace(plan.instrumentation, controls=()))


def lying(plan):
    return plan.pattern_names[int(plan.pattern[np.argmax(plan.time_s)])]


def test_without_hands_all_scans_are_over_what_lies_there():
    plan = without_controls()
    offered = LightSensorApparatus(hands=False).candidate_measurements(plan)
    assert offered
    assert {scan.plan.pattern_names[int(k)] for scan in offered for k in scan.plan.pattern} == {lying(plan)}
    assert "lay" not in {scan.kind for scan in offered}
    assert len(offered) < len(LightSensorApparatus().candidate_measurements(plan))


def test_a_scan_that_returns_after_a_whole_turn_is_the_same_scan_at_the_same_orientation():
    """It is neither offered twice, nor a value of the covariate `orientation`."""
    plan = two_way_plan()
    turned = replace(plan, orientation_rad=plan.orientation_rad - 2 * np.pi * (plan.scan % 2))
    assert [scan.tolist() for scan in rows_of_distinct_scans(turned)] == [
        scan.tolist() for scan in rows_of_distinct_scans(plan)
    ]
    level, everything = np.linspace(0.0, 1.0, len(plan)), np.arange(len(plan))

    def orientations(of):
        found = varying_covariates(of, everything, level, level)
        return next(
            np.unique(covariate.values, return_inverse=True)[1]
            for covariate in found
            if covariate.name == "orientation"
        )

    kinds = orientations(plan)
    assert len(set(zip(kinds, orientations(turned), strict=True))) == kinds.max() + 1


def test_a_scan_is_raised_from_the_height_at_which_it_was_taken():
    plan = two_way_plan()
    plan = replace(plan, instrumentation=replace(plan.instrumentation, controls=("height_mm",), height_mm=16.0))
    second, third = rows_of_distinct_scans(plan)[1:3]
    heights = np.full(len(plan), np.nan)
    heights[second], heights[third[::2]] = 20.0, 20.0
    lifted = replace(plan, covariates={**plan.covariates, "height_mm": heights})
    raised = [scan for scan in candidate_scans(lifted) if scan.kind == "raise"]
    np.testing.assert_array_equal(raised[0].plan.covariates["height_mm"], 20.0)
    np.testing.assert_array_equal(raised[1].plan.covariates["height_mm"], 25.0)
    np.testing.assert_array_equal(np.unique(raised[2].plan.covariates["height_mm"]), [20.0, 25.0])
    endings = ("with the sensor at 20 mm", "with the sensor at 25 mm", "with the sensor at 1.25 times its height")
    assert all(scan.description.endswith(words) for scan, words in zip(raised[:3], endings, strict=True))
