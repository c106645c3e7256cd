"""The methods that step a law, explicit and linearly implicit, against closed forms and their orders."""

import numpy as np
import pytest

from probewise.systems.integrate import Stepper
from probewise.systems.law import LawWithEffects, StepInputs, rosenbrock_step, runge_kutta_step
from probewise.systems.simulator import Law

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


@pytest.mark.parametrize(("method", "order"), [(runge_kutta_step, 4), (rosenbrock_step, 3)])
def test_the_error_falls_with_the_order_of_the_method(method, order):
    assert np.log2(_error(method, 12) / _error(method, 24)) == pytest.approx(order, abs=0.5)


END = 2.0


def _after(law, n_steps):
    """Return the states after a gap in a number of steps."""
    stepper = Stepper(LawWithEffects(law), rosenbrock_step, _between([[END]]))
    s = np.array([[[float(value)]] for value in law.states.values()])
    with np.errstate(all="ignore"):
        for k in range(n_steps):
            s = stepper.step(s, k / n_steps, 1 / n_steps)
    return s


def _grows(s, p, u):  # x = tan(t / 2 + 1/4) has this rate; y = sin(t) that one
    return {"x": 0.5 * (1 + s["x"] ** 2), "y": np.cos(u["t"]) - 3.0 * (s["y"] - np.sin(u["t"]))}


def test_the_error_falls_by_the_third_order_in_a_bent_law_with_an_input_in_time():
    law = Law({"x": np.tan(0.25), "y": 0.0}, _grows)

    def error(n_steps):
        s = _after(law, n_steps)
        return s[:, 0, 0] - [np.tan(1.25), np.sin(END)]

    orders = np.log2(np.abs(error(16) / error(32)))
    assert (orders > 2.6).all()
    assert np.abs(error(32)).max() < 1e-4


def test_a_run_that_ended_stands_still_and_one_that_runs_away_leaves_the_others():
    def rates(s, p, u):
        return {"x": s["x"] ** 2 * p["k"] - s["x"]}

    between = _between([[1.0, 0.0, 2.0]], k=np.array([[0.0], [1e200]]))
    stepper = Stepper(LawWithEffects(Law({"x": 1.0}, rates)), rosenbrock_step, between)
    s = np.array([[[1.0, 7.0, 1.0], [1.0, 7.0, 1e200]]])
    with np.errstate(all="ignore"):
        for k in range(10):
            s = stepper.step(s, k / 10, 0.1)
    np.testing.assert_allclose(s[0][0], [np.exp(-1.0), 7.0, np.exp(-2.0)], rtol=1e-3)
    assert s[0][1, 1] == 7.0
    assert not np.isfinite(s[0][1, 2])
