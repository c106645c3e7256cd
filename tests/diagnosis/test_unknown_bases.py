"""Basis functions of unknown effects."""

import numpy as np
import pytest

from probewise.diagnosis.light_sensor import varying_covariates
from probewise.diagnosis.locate import Covariate
from probewise.diagnosis.unknown_bases import PRODUCTS, bank_of_unknown_effects
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


@pytest.mark.parametrize("mismatch", MISMATCHES.values(), ids=MISMATCHES)
def test_some_basis_holds_it(mismatch):
    left = []
    for columns in TEMPLATES:
        amount = np.linalg.lstsq(columns, mismatch)[0]
        left.append(float(np.sum((mismatch - columns @ amount) ** 2) / np.sum(mismatch**2)))
    assert min(left) < 0.1


def _three_columns_and_bases():
    """Return three columns, (3, 200), of 190, 200 and 200 rows, and the bases with and without their products."""
    rng = np.random.default_rng(8)
    columns = rng.normal([[20.0], [45.0], [1e-9]], [[3.0], [9.0], [1e-10]], (3, 200))
    rows = [np.arange(10, 200), np.arange(200), np.arange(200)]
    covariates = [Covariate(name, c[at], at) for name, c, at in zip("abc", columns, rows, strict=True)]
    level = rng.random(200)
    apart = bank_of_unknown_effects(covariates, level, np.gradient(level), None)
    return columns, bank_of_unknown_effects(covariates, level, np.gradient(level), None, multiplied=covariates), apart


def test_products_of_two_columns_are_one_family_that_no_function_of_one_imitates():
    columns, bases, apart = _three_columns_and_bases()
    assert PRODUCTS not in apart.labels
    products = [bases[int(k)][:, 0] for k in bases.indices_by_label[PRODUCTS]]
    centred = columns - columns.mean(axis=1, keepdims=True)
    centred[0] = np.where(np.arange(200) < 10, 0.0, columns[0] - columns[0, 10:].mean())
    for product, (first, second) in zip(products, [(0, 1), (0, 2), (1, 2)], strict=True):
        wanted = centred[first] * centred[second]
        assert np.corrcoef(product, wanted)[0, 1] == pytest.approx(1.0)
        assert np.all(product[:10] == 0) == (first == 0)
        every = [apart[k] for k in range(len(apart.widths))]
        left = [np.sum((wanted - t @ np.linalg.lstsq(t, wanted)[0]) ** 2) / np.sum(wanted**2) for t in every]
        assert min(left) > 0.7
