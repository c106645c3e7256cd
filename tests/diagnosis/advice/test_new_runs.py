"""A run that is yet to be recorded has values of its own, of which only the prior is known."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from heater import ABOUT, TABLE

from probewise.diagnosis.advice import Rival, measurement_separating_rivals, slopes_split_by_run
from probewise.diagnosis.fit import Model
from probewise.diagnosis.simulator_rows import SimulatorApparatus
from probewise.systems.forms import bind_forms

APPARATUS = SimulatorApparatus(ABOUT)
NULL = Model(cast(Any, ABOUT.system), (), cast(Any, TABLE))
OFFSETS = NULL.with_effect(cast(Any, bind_forms(ABOUT)["offset_per_run"]))
PLAN = APPARATUS.plan_of_alternatives(APPARATUS.candidate_measurements(cast(Any, TABLE))[:2], cast(Any, TABLE))
FIRST = np.flatnonzero(PLAN.scan == 0)


def rival(model: Model, z: np.ndarray, root: float = 1e-9) -> Rival:
    return Rival("a", model, z, root * np.eye(len(z)), 0.5, APPARATUS.coordinates_of_new_run(model))


def test_a_new_run_begins_where_the_prior_says():
    """`start_c` has the prior sd 5, and one value in all rows of a run; the other run has another."""
    spread = rival(NULL, ABOUT.z).predictive_distribution(PLAN, 0.05).covariance - np.eye(len(PLAN))
    np.testing.assert_allclose(spread[np.ix_(FIRST, FIRST)], (5 / 0.05) ** 2, rtol=1e-3)
    np.testing.assert_allclose(np.delete(spread[FIRST], FIRST, axis=1), 0.0, atol=1e-3)


def test_the_values_of_recorded_runs_tell_nothing_of_a_new_one():
    """Rivals that start recorded runs differently, and agree on all else, differ in no run yet to be recorded."""
    other = ABOUT.z + np.array([0.0, 0.0, 0.2, 0.2, 0.2])  # by a degree, twenty noise sds
    rivals = [rival(NULL, ABOUT.z), rival(NULL, other)]
    asked = measurement_separating_rivals(rivals, 0.05, cast(Any, TABLE), APPARATUS)
    assert asked is None or asked.expected_log_bayes_factor < 0.5
    known = [replace(r, of_run=np.zeros(0, dtype=np.int64)) for r in rivals]
    would = measurement_separating_rivals(known, 0.05, cast(Any, TABLE), APPARATUS)
    assert would is not None
    assert would.expected_log_bayes_factor > 100


def test_the_gain_of_the_heater_tells_as_much_as_a_run_with_its_own_start_can():
    """By a second route: the start is fitted to the new run, by least squares with its prior."""
    other = ABOUT.z + np.array([0.3, 0.0, 0.4, -0.3, 0.2])
    rivals = [rival(NULL, ABOUT.z), rival(NULL, other)]
    asked = measurement_separating_rivals(rivals, 0.05, cast(Any, TABLE), APPARATUS)
    assert asked is not None
    table = cast(Any, asked.plan)
    apart = np.subtract(*(NULL.predict(z[None, :], asked.plan)[0] for z in (other, ABOUT.z))) / 0.05
    left = 0.0
    for rows in table.rows_by_scan():
        ones = np.append(np.full(len(rows), 5 / 0.05), 1.0)
        own = np.append(apart[rows], 0.0)
        left += float(np.sum((own - ones * (ones @ own) / (ones @ ones)) ** 2))
    assert asked.expected_log_bayes_factor == pytest.approx(left / 2, rel=0.02)


def test_an_effect_with_a_value_per_run_has_another_one_in_a_new_run():
    of_run = APPARATUS.coordinates_of_new_run(OFFSETS)
    np.testing.assert_array_equal(of_run, [2, 3, 4, 5, 6, 7])
    z = np.append(ABOUT.z, [1.0, -0.5, 0.2])
    _, slopes = OFFSETS.predict_and_differentiate(z, PLAN)
    shared, own = slopes_split_by_run(slopes, of_run, PLAN)
    assert not shared[:, of_run].any()
    assert (np.count_nonzero(own[FIRST], axis=0) > 0).sum() >= 2  # its start and its offset
    np.testing.assert_allclose(own.sum(axis=1), slopes[:, of_run].sum(axis=1))
