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


def test_a_size_that_jumps_past_is_taken_where_it_comes_near_enough():
    assert amplitude_of_size(lambda a: 8.5 if a > 2 else 3.0, 8.0, first=1.0, limit=10.0) > 2
    with pytest.raises(NotConvergedError) as caught:
        amplitude_of_size(lambda a: 12.0 if a > 2 else 3.0, 8.0, first=1.0, limit=10.0)
    assert caught.value.partial[1] == 12.0


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
