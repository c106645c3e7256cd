"""What is left of a budget, and what it allows."""

import math

import numpy as np
import pytest

from probewise.errors import ParameterError
from probewise.investigation import Budget
from probewise.recordings import paper_plan


def first_scans(n):
    plan = paper_plan()
    return plan.take(plan.scan < n)


def test_a_plan_that_can_be_afforded_is_taken_whole():
    plan = first_scans(2)
    assert Budget(len(plan)).affordable_scans(plan, 0.0) is plan


def test_scans_are_taken_whole_or_not_at_all():
    plan = first_scans(2)
    n_first = int((plan.scan == 0).sum())
    cut = Budget(len(plan) - 1).affordable_scans(plan, 0.0)
    assert len(cut) == n_first
    assert cut.scan_names == plan.scan_names[:1]


def test_what_is_too_dear_is_not_taken():
    plan = first_scans(1)
    assert Budget(len(plan) - 1).affordable_scans(plan, 0.0) is None
    assert Budget(minutes=0.001).affordable_scans(plan, 0.0) is None


def test_minutes_count_from_the_end_of_the_last_round():
    plan = first_scans(1)
    minutes = float(plan.time_s.max() + 600.0) / 60
    assert Budget(minutes=minutes + 0.01).affordable_scans(plan, -600.0) is plan
    assert Budget(minutes=minutes - 0.01).affordable_scans(plan, -600.0) is None


def test_spending_never_leaves_less_than_nothing():
    left = Budget(10, 1.0).minus(first_scans(1), 0.0)
    assert (left.readings, left.minutes) == (0, pytest.approx(max(1.0 - first_scans(1).time_s.max() / 60, 0.0)))


@pytest.mark.parametrize("wrong", [-1, math.nan])
def test_a_budget_below_nothing_is_refused(wrong):
    with pytest.raises(ParameterError, match="0 or more"):
        Budget(readings=wrong)
    with pytest.raises(ParameterError, match="0 or more"):
        Budget(minutes=wrong)


def test_an_empty_budget_affords_nothing():
    assert Budget(0).affordable_scans(first_scans(1), 0.0) is None
    assert np.isinf(Budget().minutes)
