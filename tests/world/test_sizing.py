"""The search for an amplitude, and the size of an effect on the noise."""

import math

import numpy as np
import pytest

from probewise.errors import NotConvergedError
from probewise.proof.sensors import CleanSetup, amplitude_of_size
from probewise.world import World, gaussian_spot
from probewise.world import concealed as known
from probewise.world.spots import Blob

SPOT = gaussian_spot([Blob(1.0, (0.4, 1.5), (3.0, 2.0), 0.2)], pixel_mm=0.5)


def left_by_levels(clean, changed):
    """What a null model leaves that may change its two levels alone: a straight line through the clean readings."""
    line = np.polyfit(clean.readings, changed.readings, 1)
    return float(np.linalg.norm(changed.readings - np.polyval(line, clean.readings)))


@pytest.fixture(scope="module")
def sizer(plan):
    return CleanSetup(plan, World(SPOT, noise_sd=0.5), left_by_levels)


CURVES = {
    "linear": lambda a: 3 * a,
    "square": lambda a: a**2,
    "square root": lambda a: math.sqrt(a),
    "late": lambda a: max(a - 2.0, 0.0) * 5,
    "levelling off": lambda a: 40 * a / (1 + a),
    "steep": lambda a: math.expm1(a),
}


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize("wanted", [5.0, 20.0])
def test_the_search_finds_the_amplitude_in_a_few_calls(name, wanted):
    calls = []

    def size(amplitude):
        calls.append(amplitude)
        return CURVES[name](amplitude)

    amplitude = amplitude_of_size(size, wanted, first=0.3, limit=1000.0)
    assert CURVES[name](amplitude) == pytest.approx(wanted, rel=0.02)
    assert len(calls) <= 12


def test_a_size_that_jumps_past_is_taken_where_it_comes_near_enough():
    assert amplitude_of_size(lambda a: 8.5 if a > 2 else 3.0, 8.0, first=1.0, limit=10.0) > 2
    with pytest.raises(NotConvergedError) as caught:
        amplitude_of_size(lambda a: 12.0 if a > 2 else 3.0, 8.0, first=1.0, limit=10.0)
    assert caught.value.partial[1] == 12.0


def test_an_effect_that_is_too_small_at_its_limit_is_refused():
    with pytest.raises(NotConvergedError, match="limit 10"):
        amplitude_of_size(lambda a: 0.1 * a, 8.0, first=1.0, limit=10.0)
    with pytest.raises(NotConvergedError):
        amplitude_of_size(lambda a: 0.0, 8.0, first=1.0, limit=10.0)


@pytest.mark.parametrize(
    "of",
    [
        lambda a: known.ambient_gradient(a, 0.3 * a),
        lambda a: known.saturation(60 - 50 * a),
        lambda a: known.gain_drift(a, 60.0),
    ],
    ids=["ambient_gradient", "saturation", "gain_drift"],
)
def test_the_ruler_measures_what_survives_the_refit(of, sizer, plan):
    amplitude = amplitude_of_size(lambda a: sizer.size(of(a)), 12.0, first=0.05, limit=1.0)
    clean, changed = (World(SPOT, concealed=c).expected_readings(plan) for c in ((), (of(amplitude),)))
    design = np.stack([np.ones(len(plan)), clean], axis=-1)
    rest = changed - design @ np.linalg.lstsq(design, changed, rcond=None)[0]
    assert np.linalg.norm(rest) / 0.5 == pytest.approx(12, rel=0.02)


def test_the_cosine_is_that_of_the_surviving_parts(sizer, plan):
    one, other = known.ambient_gradient(0.1, 0.0), known.gain_drift(0.1, 60.0)
    clean = sizer.clean_recording.readings
    design = np.stack([np.ones(len(plan)), clean], axis=-1)
    rests = [
        sizer.recording_with_effects(e).readings
        - design @ np.linalg.lstsq(design, sizer.recording_with_effects(e).readings, rcond=None)[0]
        for e in (one, other)
    ]
    expected = rests[0] @ rests[1] / np.linalg.norm(rests[0]) / np.linalg.norm(rests[1])
    assert sizer.cosine(one, other) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    "effect",
    [known.correlated_noise(0.5), known.signal_dependent_noise(3.0), known.outliers(0.04, 8.0)],
    ids=lambda e: e.name,
)
def test_the_size_of_noise_is_the_log_likelihood_that_the_truth_gains(effect, plan, sizer):
    """Second route: simulate, and take the mean of the log ratio of the two densities."""
    view = World(SPOT).view(plan)
    rng, n, rows, known = np.random.default_rng(4), len(plan), view.rows, effect.parameters
    z = np.stack([effect.act(rng.standard_normal(n), rows, view.seen, rng) for _ in range(3000)])

    def log_normal(z, variance):
        return -0.5 * (np.log(2 * np.pi * variance) + z**2 / variance)

    even = log_normal(z, np.mean(z**2))
    if effect.name == "correlated_noise":
        before = np.where(rows.scan_start_mask(), 0.0, np.roll(z, 1, axis=1))
        fresh = np.where(rows.scan_start_mask(), 1.0, 1 - known["rho"] ** 2)
        true = log_normal(z - known["rho"] * before, fresh)
    elif effect.name == "signal_dependent_noise":
        true = log_normal(z, 1 + known["ratio"] * view.seen)
    else:
        wide = np.exp(log_normal(z, 1 + known["size"] ** 2))
        true = np.log((1 - known["share"]) * np.exp(log_normal(z, 1.0)) + known["share"] * wide)
    gained = (true - even).sum(axis=1)
    assert abs(sizer.size(effect) ** 2 / 2 - gained.mean()) < 4 * gained.std() / math.sqrt(3000) + 0.02
