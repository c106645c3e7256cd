"""Bases for what has no name: each kind of mismatch is in the span of one of them, or nearly so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probewise.diagnosis.evidence.bank import TemplateBank
from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.light_sensor.covariates import varying_covariates
from probewise.diagnosis.noise.law import white_noise
from probewise.diagnosis.residuals.bases import bank_of_unknown_effects, bases_unlike_named
from probewise.diagnosis.residuals.covariate import Covariate
from probewise.recordings import two_way_plan

PLAN = two_way_plan()
N = len(PLAN)
SIGNAL = 25.0 * (1 + np.tanh(PLAN.x_mm / 8))
FORTH = np.sign(PLAN.direction_of_motion[:, 0])
IN_X = 25.0 / 8 / np.cosh(PLAN.x_mm / 8) ** 2  # the signal's slope in the lab frame
SLOPE = IN_X * np.where(FORTH == 0, 1.0, FORTH)  # and along the move
STARTS = np.flatnonzero(np.diff(PLAN.scan, prepend=-1))
BASES = bank_of_unknown_effects(varying_covariates(PLAN, np.arange(N), SIGNAL, SLOPE), SIGNAL, SLOPE, PLAN.scan)
TEMPLATES = [BASES[k] for k in range(len(BASES.widths))]
TIME = (PLAN.time_s - PLAN.time_s.min()) / np.ptp(PLAN.time_s)
MISMATCHES = {
    "a rail bent along X": IN_X * (PLAN.x_mm / 50) ** 2,
    "a slip along X at a moment": IN_X * (TIME > 0.5),
    "a gain that wanders in time": SIGNAL * np.sin(9 * TIME),
    "a wave in time": np.sin(20 * TIME),
    "a tone that slides": np.sin(2 * np.pi * (4 * TIME + 14 * TIME**2)),
    "a bend of the response": SIGNAL * (SIGNAL.max() - SIGNAL),
    "a gain for each angle": SIGNAL * np.cos(2 * PLAN.orientation_rad),
    "a start of each scan": np.exp(-(np.arange(N) - np.repeat(STARTS, np.diff(STARTS, append=N))) / 2),
    "the brightest so far": np.concatenate([np.maximum.accumulate(part) for part in np.split(SIGNAL, STARTS[1:])]),
}


@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_what_varies_does_not_depend_on_the_unit(unit):
    """Readings and a column in picoamperes; a level that is constant but for its last digit does not vary."""
    usable = np.arange(N)

    def names(signal, slope, column):
        plan = replace(PLAN, covariates={"dark": column})
        return [covariate.name for covariate in varying_covariates(plan, usable, signal, slope)]

    assert {"level", "slope", "dark"} <= set(names(SIGNAL, SLOPE, TIME))
    assert names(unit * SIGNAL, unit * SLOPE, unit * TIME) == names(SIGNAL, SLOPE, TIME)
    still = unit * (30.0 + np.tile([0.0, 1e-14], N)[:N])
    assert not {"level", "slope", "dark"} & set(names(still, still - still[0], still))


@pytest.mark.parametrize("mismatch", MISMATCHES.values(), ids=MISMATCHES)
def test_some_basis_holds_it(mismatch):
    left = []
    for columns in TEMPLATES:
        amount = np.linalg.lstsq(columns, mismatch)[0]
        left.append(float(np.sum((mismatch - columns @ amount) ** 2) / np.sum(mismatch**2)))
    assert min(left) < 0.1


def test_every_basis_is_of_the_rows_and_has_a_family():
    assert len(BASES.widths) == len(BASES.labels)
    assert BASES.columns.shape == (N, BASES.widths.sum())
    assert all(np.isfinite(columns).all() and np.any(columns) for columns in TEMPLATES)


def test_what_a_name_describes_is_no_unknown():
    """One offset per run is a name's; it becomes zero, and its share of the prior is not given to other bases."""
    rng = np.random.default_rng(3)
    run, x = np.repeat(np.arange(6), 20), np.tile(np.linspace(0, 1, 20), 6)
    covariates = [
        Covariate("x", x, np.arange(len(x))),
        Covariate("run", run.astype(np.float64), np.arange(len(x)), groups=True),
    ]
    signal = x + 0.1 * rng.random(len(x))
    bases = bank_of_unknown_effects(covariates, signal, np.gradient(signal), run)
    each = (run[:, None] == np.arange(6)).astype(np.float64)
    mean = np.ones((len(x), 1)) / np.sqrt(len(x))
    problem = Linearised(mean, rng.standard_normal(len(x)), white_noise(len(x)), 1.0, len(x))
    named = TemplateBank.of([each], ["offset_per_run"], len(x))
    left = bases_unlike_named(bases, named, problem)
    of_runs = left.indices_by_label["run"]
    assert len(of_runs) == len(bases.indices_by_label["run"])
    assert [bool(np.any(left[k])) for k in of_runs] == [False] + [True] * (len(of_runs) - 1)
    factors = left.log_bayes_factors(problem)[:, 0]
    assert factors[of_runs[0]] < -40
