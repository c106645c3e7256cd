"""What acts within a law acts in continuous time: against solutions by hand."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.errors import NotConvergedError
from probewise.proof.systems.simulate import simulate_noise_free

from .conftest import small

SINCE = np.tile([0.0, 0.7, 1.0, 1.9, 2.4, 3.5, 4.0], 3)


def test_nothing_added_is_the_law_itself(solve):
    _, _, bare = solve("damping:x", {"a": 0.0})
    np.testing.assert_allclose(bare, 2 * np.exp(-0.5 * SINCE), rtol=1e-7)


def test_damping_adds_to_the_decay(solve):
    found, *_ = solve("damping:x", {"a": 0.3})
    np.testing.assert_allclose(found, 2 * np.exp(-0.8 * SINCE), rtol=1e-7)


@pytest.mark.parametrize(
    ("name", "solution"),
    [
        ("drag:x", lambda a, t: 2 / (1 + 2 * a * t)),
        ("quadratic:x:x", lambda a, t: 2 / (1 + 2 * a * t)),
        ("cubic:x:x", lambda a, t: 2 / np.sqrt(1 + 8 * a * t)),
        ("forcing:x", lambda a, t: 2 + a * t),
        ("damping:x", lambda a, t: 2 * np.exp(-a * t)),
    ],
)
def test_a_term_alone_solves_as_by_hand(solve, name, solution):
    found, *_ = solve(name, {"a": 0.4}, k=0.0)
    np.testing.assert_allclose(found, solution(0.4, SINCE), rtol=1e-7)


def test_dry_friction_slows_down_steadily_and_then_holds(solve):
    found, *_ = solve("friction:x", {"a": 0.9}, k=0.0)
    np.testing.assert_allclose(found, np.maximum(2 - 0.9 * SINCE, 0), atol=1e-7)


def test_what_rests_breaks_loose_when_the_force_is_larger_and_not_before(solve):
    """From rest, u = 0.5 is held by a friction of 0.8; u = 2 leaves 1.2 to move it."""
    found, *_ = solve("friction:x", {"a": 0.8}, k=0.0, x0=0.0, u=[0.5, 0.5, 0.5, 2.0, 2.0, 2.0, 2.0])
    np.testing.assert_allclose(found, 1.2 * np.maximum(SINCE - 1.9, 0), atol=1e-7)


def test_a_bound_holds_and_lets_go_at_once(solve):
    """It rises by 1 to its bound of 2.5, waits, and falls by 2 from the row on at which the input turns."""
    found, *_ = solve("limit:x", {"level": 2.5}, k=0.0, u=[1, 1, 1, 1, -2, -2, -2])
    rising = np.minimum(2 + SINCE, 2.5)
    np.testing.assert_allclose(found, np.where(SINCE <= 2.4, rising, 2.5 - 2 * (SINCE - 2.4)), atol=1e-7)


def test_a_periodic_force_is_integrated_between_the_rows(solve):
    found, rows, _ = solve("periodic_forcing:x", {"a": 0.6, "hz": 0.3, "phase": 0.4}, k=0.0)
    w = 2 * np.pi * 0.3
    begin = rows.t - rows.time_since_start
    np.testing.assert_allclose(found, 2 + 0.6 / w * (np.cos(w * begin + 0.4) - np.cos(w * rows.t + 0.4)), rtol=1e-6)


def test_a_parameter_that_drifts_does_so_between_the_rows_too(solve):
    found, rows, _ = solve("drifts:k", {"a": 0.02})
    begin = rows.t - rows.time_since_start
    np.testing.assert_allclose(found, 2 * np.exp(-0.5 * SINCE - 0.01 * (rows.t**2 - begin**2)), rtol=1e-7)


def test_a_parameter_steps_at_its_moment_not_at_a_row(solve):
    found, rows, _ = solve("steps:k", {"a": 0.3, "at_s": 11.45})
    after = np.where(rows.run == 1, np.maximum(rows.t - 11.45, 0), np.where(rows.run > 1, SINCE, 0))
    np.testing.assert_allclose(found, 2 * np.exp(-0.5 * SINCE - 0.3 * after), rtol=1e-6)


def test_a_parameter_follows_a_logged_column_on_straight_lines(solve):
    found, rows, _ = solve("depends:k:warm", {"a": 0.2})
    warm = rows.columns["warm"] - rows.columns["warm"].mean()
    area = np.zeros(len(rows))
    for own in rows.rows_by_run:
        area[own[1:]] = np.cumsum(np.diff(rows.t[own]) * (warm[own[1:]] + warm[own[:-1]]) / 2)
    np.testing.assert_allclose(found, 2 * np.exp(-0.5 * SINCE - 0.2 * area), rtol=1e-7)


def test_an_input_is_held_as_in_the_row_before(solve):
    u = np.array([1.0, 0.0, 2.0, 0.0, -1.0, 0.5, 0.0])
    _, rows, bare = solve("damping:x", {"a": 0.0}, k=0.0, u=u)
    area = np.concatenate([[0], np.cumsum(np.diff(SINCE[:7]) * u[:-1])])
    np.testing.assert_allclose(bare[rows.run == 0], 2 + area, rtol=1e-7)


def test_an_input_moves_on_straight_lines_where_the_owner_says_so(solve):
    u = np.array([1.0, 0.0, 2.0, 0.0, -1.0, 0.5, 0.0])
    _, rows, bare = solve("damping:x", {"a": 0.0}, k=0.0, u=u, linear=True)
    area = np.concatenate([[0], np.cumsum(np.diff(SINCE[:7]) * (u[:-1] + u[1:]) / 2)])
    np.testing.assert_allclose(bare[rows.run == 0], 2 + area, rtol=1e-7)


def test_an_input_that_comes_late_jumps_between_the_rows(solve):
    """u goes from 0 to 1 at the row of 1.0, and is felt from 1.25 on."""
    found, *_ = solve("input_delay:u", {"tau_s": 0.25}, k=0.0, u=[0, 0, 1, 1, 1, 1, 1])
    np.testing.assert_allclose(found, 2 + np.maximum(SINCE - 1.25, 0), atol=1e-6)


def test_a_law_that_runs_away_between_two_rows_is_refused():
    kind, rows, _ = small()
    runaway = replace(kind, text=kind.text.replace('u["u"] - p["k"] * s["x"]', 'p["k"] * 50 * s["x"] ** 2'))
    with np.errstate(all="ignore"), pytest.raises(NotConvergedError, match="runs away"):
        simulate_noise_free(runaway, rows, {"k": 0.9})
