"""What acts within a law acts in continuous time: against solutions by hand."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.errors import NotConvergedError
from probewise.proof.systems.simulate import simulate_noise_free

from .conftest import T, small

SINCE = np.tile(T, 3)
FALLS = {"k": 0.0}  # of the law x' = u - k x from 2, so that only what was added acts
W = 2 * np.pi * 0.3
U = np.array([1.0, 0.0, 2.0, 0.0, -1.0, 0.5, 0.0])


def _begin(rows):
    return rows.t - rows.time_since_start


def _brought(between):
    """Integrate, over each run, a column that has these values between its rows."""
    return np.tile(np.concatenate([[0], np.cumsum(np.diff(T) * between)]), 3)


def _area_of_warm(rows):
    warm, area = rows.columns["warm"] - rows.columns["warm"].mean(), np.zeros(len(rows))
    for own in rows.rows_by_run:
        area[own[1:]] = np.cumsum(np.diff(rows.t[own]) * (warm[own[1:]] + warm[own[:-1]]) / 2)
    return area


def _after(rows, at_s):
    return np.where(rows.run == 1, np.maximum(rows.t - at_s, 0), np.where(rows.run > 1, SINCE, 0))


SOLUTIONS = {
    "nothing": ("damping:x", {"a": 0.0}, {}, lambda rows: 2 * np.exp(-0.5 * SINCE)),
    "damping beside a decay": ("damping:x", {"a": 0.3}, {}, lambda rows: 2 * np.exp(-0.8 * SINCE)),
    "damping": ("damping:x", {"a": 0.4}, FALLS, lambda rows: 2 * np.exp(-0.4 * SINCE)),
    "drag": ("drag:x", {"a": 0.4}, FALLS, lambda rows: 2 / (1 + 0.8 * SINCE)),
    "a square": ("quadratic:x:x", {"a": 0.4}, FALLS, lambda rows: 2 / (1 + 0.8 * SINCE)),
    "a cube": ("cubic:x:x", {"a": 0.4}, FALLS, lambda rows: 2 / np.sqrt(1 + 3.2 * SINCE)),
    "a constant force": ("forcing:x", {"a": 0.4}, FALLS, lambda rows: 2 + 0.4 * SINCE),
    "dry friction, until it rests": ("friction:x", {"a": 0.9}, FALLS, lambda rows: np.maximum(2 - 0.9 * SINCE, 0)),
    "rest, until a force of 2 leaves 1.2 of it": (
        "friction:x",
        {"a": 0.8},
        {"k": 0.0, "x0": 0.0, "u": [0.5, 0.5, 0.5, 2.0, 2.0, 2.0, 2.0]},
        lambda rows: 1.2 * np.maximum(SINCE - 1.9, 0),
    ),
    "a bound, which lets go at once": (
        "limit:x",
        {"level": 2.5},
        {"k": 0.0, "u": [1, 1, 1, 1, -2, -2, -2]},
        lambda rows: np.where(SINCE <= 2.4, np.minimum(2 + SINCE, 2.5), 2.5 - 2 * (SINCE - 2.4)),
    ),
    "a periodic force": (
        "periodic_forcing:x",
        {"a": 0.6, "hz": 0.3, "phase": 0.4},
        FALLS,
        lambda rows: 2 + 0.6 / W * (np.cos(W * _begin(rows) + 0.4) - np.cos(W * rows.t + 0.4)),
    ),
    "a drift": (
        "drifts:k", {"a": 0.02}, {}, lambda rows: 2 * np.exp(-0.5 * SINCE - 0.01 * (rows.t**2 - _begin(rows) ** 2))
    ),
    "a step between two rows": (
        "steps:k", {"a": 0.3, "at_s": 11.45}, {}, lambda rows: 2 * np.exp(-0.5 * SINCE - 0.3 * _after(rows, 11.45))
    ),
    "a logged column on straight lines": (
        "depends:k:warm", {"a": 0.2}, {}, lambda rows: 2 * np.exp(-0.5 * SINCE - 0.2 * _area_of_warm(rows))
    ),
    "an input held as in the row before": (
        "damping:x", {"a": 0.0}, {"k": 0.0, "u": U}, lambda rows: 2 + _brought(U[:-1])
    ),
    "an input on straight lines": (
        "damping:x", {"a": 0.0}, {"k": 0.0, "u": U, "linear": True}, lambda rows: 2 + _brought((U[:-1] + U[1:]) / 2)
    ),
    "a late input, which jumps between the rows": (
        "input_delay:u",
        {"tau_s": 0.25},
        {"k": 0.0, "u": [0, 0, 1, 1, 1, 1, 1]},
        lambda rows: 2 + np.maximum(SINCE - 1.25, 0),
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", SOLUTIONS)
def test_what_is_added_to_a_law_solves_as_by_hand(solve, what):
    name, numbers, options, solution = SOLUTIONS[what]
    found, rows, _ = solve(name, numbers, **options)
    np.testing.assert_allclose(found, solution(rows), rtol=1e-6, atol=1e-7 if name != "input_delay:u" else 1e-6)


def test_a_law_that_runs_away_between_two_rows_is_refused():
    kind, rows, _ = small()
    runaway = replace(kind, text=kind.text.replace('u["u"] - p["k"] * s["x"]', 'p["k"] * 50 * s["x"] ** 2'))
    with np.errstate(all="ignore"), pytest.raises(NotConvergedError, match="runs away"):
        simulate_noise_free(runaway, rows, {"k": 0.9})
