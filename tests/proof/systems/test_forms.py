"""What acts row by row: forms of the readings and of the inputs, by hand."""

from itertools import pairwise

import numpy as np
import pytest

from probewise.proof.systems.forms import behind_gear_play, delayed_values, direction_of_change
from probewise.proof.systems.kinds import SystemTable


def _rows(t, run=None, **columns):
    t = np.asarray(t, dtype=float)
    run = np.zeros(len(t), dtype=int) if run is None else np.asarray(run)
    return SystemTable({"t_s": t, **columns}, run, "t_s", int(run.max()) + 1)


@pytest.mark.parametrize(
    ("name", "numbers", "change"),
    [
        ("offset_drift", {"a": 0.02}, lambda rows, y: 0.02 * rows.t),
        ("offset_step", {"a": 0.3, "at_s": 12.0}, lambda rows, y: 0.3 * (rows.t > 12)),
        (
            "offset_per_run",
            {"values[0]": 0.1, "values[1]": 0.0, "values[2]": -0.2},
            lambda rows, y: np.array([0.1, 0, -0.2])[rows.run],
        ),
        ("gain_drift", {"a": 0.01}, lambda rows, y: y * 0.01 * rows.t),
        ("gain_step", {"a": 0.1, "at_s": 12.0}, lambda rows, y: y * 0.1 * (rows.t > 12)),
        (
            "gain_per_run",
            {"values[0]": 0.1, "values[1]": 0.0, "values[2]": -0.2},
            lambda rows, y: y * np.array([0.1, 0, -0.2])[rows.run],
        ),
        ("sensitivity:warm", {"a": 0.5}, lambda rows, y: 0.5 * rows.columns["warm"]),
        (
            "interference",
            {"a": 0.2, "hz": 0.3, "phase": 1.0},
            lambda rows, y: 0.2 * np.sin(2 * np.pi * 0.3 * rows.t + 1.0),
        ),
        ("settling", {"a": 0.2, "tau_s": 1.5}, lambda rows, y: 0.2 * np.exp(-rows.time_since_start / 1.5)),
        ("hysteresis", {"a": 0.1}, lambda rows, y: -0.1 + 0 * y),
        ("saturation", {"level": 1.2}, lambda rows, y: np.minimum(y, 1.2) - y),
        ("saturation (floor)", {"level": 0.6}, lambda rows, y: np.maximum(y, 0.6) - y),
    ],
)
def test_a_form_of_the_reading_is_what_it_says(solve, name, numbers, change):
    found, rows, bare = solve(name, numbers)
    np.testing.assert_allclose(found - bare, change(rows, bare), atol=1e-9)


def test_a_bend_leaves_both_ends_where_they_are(solve):
    found, _, bare = solve("nonlinearity", {"a": 0.1, "power": 2.0})
    z = (bare - bare.min()) / np.ptp(bare)
    np.testing.assert_allclose(found - bare, 0.1 * np.ptp(bare) * (z**2 - z), atol=1e-9)


def test_a_lag_mixes_each_reading_with_the_one_before_within_a_run(solve):
    found, rows, bare = solve("lag", {"tau_s": 0.8})
    for own in rows.rows_by_run:
        expected = [bare[own[0]]]
        for before, row in pairwise(own):
            stays = np.exp(-(rows.t[row] - rows.t[before]) / 0.8)
            expected.append(stays * expected[-1] + (1 - stays) * bare[row])
        np.testing.assert_allclose(found[own], expected)


def test_what_comes_late_is_read_on_the_straight_line_and_begins_as_it_is():
    rows = _rows([0, 1, 2, 4])
    late = [delayed_values(np.array([0.0, 10.0, 20.0, 20.0]), rows, tau) for tau in (0.5, 3.0)]
    np.testing.assert_allclose(late, [[0, 5, 15, 20], [0, 0, 0, 10]])


def test_the_way_is_kept_at_rest_and_known_at_the_first_row():
    rows = _rows(range(6))
    np.testing.assert_array_equal(direction_of_change(np.array([0.0, 0, 1, 1, 0, 0]), rows), [1, 1, 1, 1, -1, -1])


def test_play_moves_nothing_until_it_is_taken_up():
    rows = _rows(range(7))
    found = behind_gear_play(np.array([0.0, 1, 2, 1.5, 1.2, 0, 1]), rows, {"width": 1.0})
    np.testing.assert_allclose(found, [-0.5, 0.5, 1.5, 1.5, 1.5, 0.5, 0.5])


@pytest.mark.parametrize(
    ("name", "numbers", "felt"),
    [
        ("input_offset:u", {"a": 0.2}, lambda u: u + 0.2),
        ("input_gain:u", {"a": 0.2}, lambda u: 1.2 * u),
        ("input_saturation:u", {"level": 1.1}, lambda u: np.minimum(u, 1.1)),
        ("dead_zone:u", {"width": 0.4}, lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.4, 0)),
    ],
)
def test_an_input_is_felt_as_the_form_says(solve, name, numbers, felt):
    """With k = 0 the reading is the sum of what was felt, each as long as it was held."""
    u = np.array([1.0, 0.2, 2.0, -0.3, -1.0, 0.5, 0.0])
    found, rows, _ = solve(name, numbers, k=0.0, u=u)
    t = rows.t[rows.run == 0]
    np.testing.assert_allclose(
        found[rows.run == 0], 2 + np.concatenate([[0], np.cumsum(np.diff(t) * felt(u)[:-1])]), atol=1e-7
    )
