"""The methods that step a law, explicit and linearly implicit, against closed forms and their orders."""

import numpy as np
import pytest

from probewise.systems.integrate import Stepper
from probewise.systems.law import LawWithEffects, Limit, StepInputs
from probewise.systems.simulator import Law
from probewise.systems.step import FOURTH_ORDER, RODAS, cheapest_steps, eighth_order_method

EIGHTH_ORDER = eighth_order_method()
SWINGS = LawWithEffects(Law({"x": 1.0, "v": 0.0}, lambda s, p, u: {"x": s["v"], "v": -s["x"] + 0 * u["t"]}))


def _between(gap, **parameters):
    """Return the inputs in a gap of this time, from time 0 on."""
    return StepInputs("t", (parameters, {"t": np.zeros(np.shape(gap))}), ({}, {"t": np.asarray(gap)}))


def _error(method, n_steps):
    """Return the error of a swing of 4 rad, of which the closed form is a cosine."""
    stepper = Stepper(SWINGS, method, _between([[4.0]]))
    s = np.array([[[1.0]], [[0.0]]])
    for k in range(n_steps):
        s = stepper.step(s, k / n_steps, 1 / n_steps)
    return float(np.hypot(s[0] - np.cos(4.0), s[1] + np.sin(4.0))[0, 0])


@pytest.mark.parametrize(("method", "order"), [(FOURTH_ORDER, 4), (EIGHTH_ORDER, 8)])
def test_the_error_falls_with_the_order_of_the_method(method, order):
    assert np.log2(_error(method, 6) / _error(method, 12)) == pytest.approx(order, abs=0.5)


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
    n_steps, cheapest = cheapest_steps(np.array(in_gap))
    assert cheapest is method
    np.testing.assert_array_equal(n_steps, steps)


def test_a_state_that_meets_its_bound_within_a_step_of_eighth_order_stays_there():
    """A filling of rate 1 with a bound at 2.5: what an eighth-order step weighs negatively must not take it back."""
    fills = LawWithEffects(Law({"x": 0.0}, lambda s, p, u: {"x": 1.0 + 0 * s["x"]})).plus(
        limits=(Limit("x", np.array([[2.5]])),)
    )
    stepper = Stepper(fills, EIGHTH_ORDER, _between([[1.0]]))
    s, found = np.zeros((1, 1, 1)), []
    for _ in range(4):
        s = stepper.step(s, 0.0, 1.0)
        found.append(float(s[0, 0, 0]))
    assert found == pytest.approx([1.0, 2.0, 2.5, 2.5])


END = 2.0


def _after(law, n_steps):
    """Return the states after a gap in a number of steps."""
    stepper = Stepper(LawWithEffects(law), RODAS, _between([[END]]))
    s = np.array([[[float(value)]] for value in law.states.values()])
    with np.errstate(all="ignore"):
        for k in range(n_steps):
            s = stepper.step(s, k / n_steps, 1 / n_steps)
    return s


def _grows(s, p, u):  # x = tan(t / 2 + 1/4) has this rate; y = sin(t) that one
    return {"x": 0.5 * (1 + s["x"] ** 2), "y": np.cos(u["t"]) - 3.0 * (s["y"] - np.sin(u["t"]))}


def test_the_error_falls_by_the_fourth_order_in_a_bent_law_with_an_input_in_time():
    law = Law({"x": np.tan(0.25), "y": 0.0}, _grows)

    def error(n_steps):
        s = _after(law, n_steps)
        return s[:, 0, 0] - [np.tan(1.25), np.sin(END)]

    orders = np.log2(np.abs(error(16) / error(32)))
    assert (orders > 3.6).all()
    assert np.abs(error(32)).max() < 2e-5


def test_a_run_that_ended_stands_still_and_one_that_runs_away_leaves_the_others():
    def rates(s, p, u):
        return {"x": s["x"] ** 2 * p["k"] - s["x"]}

    between = _between([[1.0, 0.0, 2.0]], k=np.array([[0.0], [1e200]]))
    stepper = Stepper(LawWithEffects(Law({"x": 1.0}, rates)), RODAS, between)
    s = np.array([[[1.0, 7.0, 1.0], [1.0, 7.0, 1e200]]])
    with np.errstate(all="ignore"):
        for k in range(10):
            s = stepper.step(s, k / 10, 0.1)
    np.testing.assert_allclose(s[0][0], [np.exp(-1.0), 7.0, np.exp(-2.0)], rtol=1e-4)
    assert s[0][1, 1] == 7.0
    assert not np.isfinite(s[0][1, 2])
