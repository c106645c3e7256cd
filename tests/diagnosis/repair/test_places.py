"""The order of the places in which residuals show."""

import numpy as np

from probewise.diagnosis.locate import Place
from probewise.diagnosis.repair import _controls_before_time


def place(covariate, values, start, end):
    return Place(covariate, None, start, end, 0.001, 5.0, *[np.zeros(0)] * 3, values=values)


def test_a_control_comes_before_time_where_both_hold_the_same_rows():
    time = np.arange(100.0)
    power = np.minimum(time // 10, 9.0)
    rows = [place("level", time, 0, 9), place("time", time, 50, 89), place("power_w", power, 5.0, 8.0)]
    ordered = [p.covariate for p in _controls_before_time(rows, ("power_w",))]
    assert ordered == ["level", "power_w", "time"]
    assert [p.covariate for p in _controls_before_time(rows, ())] == ["level", "time", "power_w"]
    elsewhere = [*rows[:2], place("power_w", power, 0.0, 3.0)]
    assert [p.covariate for p in _controls_before_time(elsewhere, ("power_w",))] == ["level", "time", "power_w"]
