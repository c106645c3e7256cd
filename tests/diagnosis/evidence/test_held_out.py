"""What is kept back in turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probewise.diagnosis.evidence.held_out import mean_gain_over_parts
from probewise.diagnosis.light_sensor.held_out_parts import held_out_parts
from probewise.recordings import Recording, paper_plan

PAPER = Recording(paper_plan(), np.zeros(len(paper_plan())))


def test_a_few_scans_are_kept_back_one_by_one():
    parts, names = held_out_parts(PAPER)
    np.testing.assert_array_equal(parts, PAPER.plan.scan)
    assert names == PAPER.plan.scan_names


def test_many_scans_side_by_side_are_kept_back_by_pattern_and_orientation():
    """Sixteen scans: eight lines over each of two orientations."""
    plan = PAPER.plan
    rows = np.flatnonzero(plan.scan < 2)
    scan = np.concatenate([8 * plan.scan[rows] + (np.arange(len(rows)) // 12) % 8])
    taken = plan.take(rows)
    many = type(taken)(
        **{
            **{name: getattr(taken, name) for name in taken.__dataclass_fields__},
            "scan": np.sort(scan),
            "scan_names": tuple(f"line_{k}" for k in range(16)),
        }
    )
    parts, names = held_out_parts(Recording(many, np.zeros(len(many))))
    assert len(names) == 2
    assert names[0].endswith("0 degrees")
    np.testing.assert_array_equal(parts, np.round(many.orientation_rad / (np.pi / 2)).astype(int) - int(parts[0] != 0))
    a_turn_more = replace(many, orientation_rad=many.orientation_rad + 2 * np.pi * (many.scan % 2))
    again, names_again = held_out_parts(Recording(a_turn_more, np.zeros(len(many))))
    np.testing.assert_array_equal(again, parts)
    assert names_again == names
    held = mean_gain_over_parts(parts, lambda out: np.where(parts[out] == 0, 1.0, -1.0), names)
    assert dict(held.by_scan) == {names[0]: 1.0, names[1]: -1.0}
