"""Effects outside the vocabulary against their formulas."""

import math
from dataclasses import replace

import numpy as np
import pytest

from probewise.proof.sensors.effects import INSIDE, OUTSIDE
from probewise.recordings import HalfPlane
from probewise.world import Blob, World, gaussian_spot
from probewise.world.unlisted import (
    after_glow,
    bent_rail,
    chirp,
    cross_talk,
    floor,
    ghost,
    peak_memory,
    place_step,
    slipped_paper,
    stick_slip,
    thermal_gain,
    twisted_rail,
)

SPOT = gaussian_spot([Blob(1.0, (0.4, 1.5), (3.0, 2.0), 0.2)], pixel_mm=0.5)


def read(plan, *concealed):
    return World(SPOT, concealed=concealed).expected_readings(plan)


@pytest.fixture(scope="module")
def clean(plan):
    return read(plan)


def test_there_are_at_least_eight_and_none_is_in_the_vocabulary():
    assert len(OUTSIDE) >= 8
    assert not set(OUTSIDE) & set(INSIDE)


@pytest.mark.parametrize(
    ("effect", "x_mm"),
    [
        (bent_rail(0.5), lambda x: x + 0.005 * x**2),
        (twisted_rail(0.5), lambda x: x + 0.0005 * x**3),
        (place_step(0.5, 1.0), lambda x: np.where(x > 1, x + 0.5, x)),
        (stick_slip(0.5, 8.0, 0.25), lambda x: x - 0.5 + np.mod(x + 2, 8) / 8),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_the_arm_errs_along_x_by_its_formula(effect, x_mm, plan):
    np.testing.assert_allclose(read(plan, effect), read(replace(plan, x_mm=x_mm(plan.x_mm))), atol=1e-9)


def test_slipped_paper_lies_elsewhere_from_then_on(plan, clean):
    at_s = float(plan.time_s[30])
    moved = read(replace(plan, patterns={**plan.patterns, "boundary": HalfPlane(0.1, 1.5)}))
    got = read(plan, slipped_paper(0.8, at_s))
    boundary = plan.pattern == 0
    expected = np.where(plan.time_s > at_s, moved, clean)
    np.testing.assert_allclose(got[boundary], expected[boundary], atol=1e-9)


def test_a_ghost_is_a_faint_second_look_from_elsewhere(plan, clean):
    beside = read(replace(plan, x_mm=plan.x_mm + 6.0, y_mm=plan.y_mm - 2.0))
    np.testing.assert_allclose(read(plan, ghost(0.1, 6.0, -2.0)), 0.9 * clean + 0.1 * beside, atol=1e-9)


def test_thermal_gain_is_a_sum_of_waves_with_power_in_proportion_to_their_period(plan, clean):
    phases = (0.1, 1.0, 2.0)
    t = plan.time_s
    wave = sum(
        math.sqrt(1 / k) * np.cos(2 * math.pi * k * t / 200 + phase) for k, phase in enumerate(phases, start=1)
    ) * math.sqrt(2 / (1 + 1 / 2 + 1 / 3))
    np.testing.assert_allclose(read(plan, thermal_gain(0.05, 200.0, phases)), 10 + (clean - 10) * (1 + 0.05 * wave))


def test_cross_talk_is_a_gain_that_follows_the_orientation(plan, clean):
    gain = 1 + 0.1 * np.cos(2 * plan.orientation_rad + 0.3)
    np.testing.assert_allclose(read(plan, cross_talk(0.1, 0.3)), 10 + (clean - 10) * gain)


def test_light_below_the_floor_is_not_seen(plan, clean):
    np.testing.assert_allclose(read(plan, floor(0.2)), np.where(clean - 10 < 0.2 * 50, 10.0, clean))


def test_the_photodiode_remembers_the_brightest_light_of_the_scan(plan, clean):
    signal = clean - 10
    peaks = [max(signal[j] for j in range(k + 1) if plan.scan[j] == plan.scan[k]) for k in range(len(plan))]
    np.testing.assert_allclose(read(plan, peak_memory(0.1)), clean + 0.1 * np.array(peaks))


def test_each_rise_is_followed_by_a_pulse_that_dies_off(plan, clean):
    got = read(plan, after_glow(4.0, 6.0, 35.0))
    expected = clean.copy()
    for k in range(1, len(plan)):
        if clean[k - 1] <= 35 < clean[k]:
            later = np.arange(len(plan)) >= k
            expected[later] += 4 * np.exp(-(plan.time_s[later] - plan.time_s[k]) / 6)
    assert np.abs(expected - clean).max() >= 4
    np.testing.assert_allclose(got, expected)


def test_a_chirp_swings_ever_faster(plan, clean):
    """The phase is the integral of the frequency: summed up in small steps."""
    effect = chirp(2.0, 0.01, 0.0005, 0.4)
    fine = np.linspace(0, plan.time_s[-1], 200_001)
    hz = 0.01 + 0.0005 * fine
    turns = np.concatenate([[0.0], np.cumsum((hz[1:] + hz[:-1]) / 2 * np.diff(fine))])
    phase = 2 * math.pi * np.interp(plan.time_s, fine, turns) + 0.4
    np.testing.assert_allclose(read(plan, effect) - clean, 2 * np.sin(phase), atol=1e-5)
