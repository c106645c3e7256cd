"""Runge-Kutta methods: their orders on a problem with a closed form, and the choice between them."""

import numpy as np
import pytest

from probewise.systems.law import LawWithEffects, Limit, Stepper
from probewise.systems.simulator import Law
from probewise.systems.step import FOURTH_ORDER, StepSchedule, eighth_order_method

EIGHTH_ORDER = eighth_order_method()
SWINGS = LawWithEffects(Law({"x": 1.0, "v": 0.0}, lambda s, p, u: {"x": s["v"], "v": -s["x"] + 0 * u["t"]}))


def _error(method, n_steps):
    """Return the error of a swing of 4 rad, of which the closed form is a cosine."""
    stepper = Stepper(SWINGS, method, lambda share: ({}, {"t": 4.0 * share}), np.array([[4.0]]))
    s = {"x": np.ones((1, 1)), "v": np.zeros((1, 1))}
    for k in range(n_steps):
        s = stepper.step(s, k / n_steps, 1 / n_steps)
    return float(np.hypot(s["x"] - np.cos(4.0), s["v"] + np.sin(4.0))[0, 0])


@pytest.mark.parametrize(("method", "order"), [(FOURTH_ORDER, 4), (EIGHTH_ORDER, 8)])
def test_the_error_falls_with_the_order_of_the_method(method, order):
    assert np.log2(_error(method, 6) / _error(method, 12)) == pytest.approx(order, abs=0.5)


def test_for_as_many_evaluations_the_eighth_order_is_a_thousand_times_as_exact():
    assert _error(EIGHTH_ORDER, 4) < 1e-3 * _error(FOURTH_ORDER, 12)


@pytest.mark.parametrize("method", [FOURTH_ORDER, EIGHTH_ORDER])
def test_each_stage_is_where_its_coefficients_add_up_to(method):
    """Butcher's row sums: a rate of 1 must carry every stage as far as the stage's time."""
    np.testing.assert_allclose([sum(row) for row in method.a], method.c, atol=1e-14)
    assert sum(method.b) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize(
    ("in_gap", "method", "steps"),
    [
        ([1, 1, 1], FOURTH_ORDER, [1, 1, 1]),
        ([2, 2, 2], EIGHTH_ORDER, [1, 1, 1]),
        ([3, 7, 12], EIGHTH_ORDER, [1, 3, 4]),
        ([1, 1, 1, 1, 30], EIGHTH_ORDER, [1, 1, 1, 1, 10]),
        ([1, 1, 1, 1, 1, 1, 1, 1, 6], FOURTH_ORDER, [1, 1, 1, 1, 1, 1, 1, 1, 6]),
    ],
)
def test_the_method_is_the_one_whose_accuracy_costs_least(in_gap, method, steps):
    schedule = StepSchedule.from_fourth_order_steps(np.array(in_gap))
    assert schedule.method is method
    np.testing.assert_array_equal(schedule.n_steps, steps)


def test_a_state_that_meets_its_bound_within_a_step_of_eighth_order_stays_there():
    """A filling of rate 1 with a bound at 2.5: what an eighth-order step weighs negatively must not take it back."""
    fills = LawWithEffects(Law({"x": 0.0}, lambda s, p, u: {"x": 1.0 + 0 * s["x"]})).with_limit(
        Limit("x", np.array([[2.5]]))
    )
    stepper = Stepper(fills, EIGHTH_ORDER, lambda share: ({}, {}), np.array([[1.0]]))
    s, found = {"x": np.zeros((1, 1))}, []
    for _ in range(4):
        s = stepper.step(s, 0.0, 1.0)
        found.append(float(s["x"][0, 0]))
    assert found == pytest.approx([1.0, 2.0, 2.5, 2.5])
