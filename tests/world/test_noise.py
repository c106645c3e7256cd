"""The noise of a world, the search for an amplitude. Bounds: 4 sigma, a right program fails one in 10 000."""

import math

import numpy as np
import pytest
from scipy.stats import kstest, norm, t

from probewise.errors import NotConvergedError
from probewise.proof.sensors import OTHER_NOISE, CleanSetup, amplitude_of_size, with_noise_model
from probewise.recordings import Plan, Ramp
from probewise.world import World, gaussian_spot
from probewise.world import concealed as known
from probewise.world.spots import Blob

N, N_SCANS = 20_000, 20
SPOT = gaussian_spot([Blob(1.0, (0.0, 0.0), (1.0, 1.0))], pixel_mm=0.5)


@pytest.fixture(scope="module")
def ramp():
    """Readings over a ramp from black to white, so that every level comes."""
    x = np.tile(np.linspace(0, 100, N // N_SCANS), N_SCANS)
    scan = np.repeat(np.arange(N_SCANS), N // N_SCANS)
    return Plan.from_arrays(x_mm=x, y_mm=0, scan=scan, patterns={"ramp": Ramp(0.0, 0.01)}, unit="LEGO")


@pytest.fixture(scope="module")
def noise(ramp):
    view = World(SPOT).view(ramp)

    def of(*concealed, noise_sd=0.6):
        world = World(SPOT, noise_sd=noise_sd, concealed=concealed)
        made = world.simulate(ramp, rng=np.random.default_rng(5), view=view).readings
        return (made - world.noise_free_readings(view)) / noise_sd

    return of


def test_noise_is_white_and_normal(noise):
    z = noise()
    assert kstest(z, "norm").pvalue > 1e-4
    assert abs(np.mean(z[1:] * z[:-1])) < 4 / math.sqrt(N)


def test_correlated_noise_remembers_within_a_scan_and_keeps_its_sd(noise, ramp):
    z = noise(known.correlated_noise(0.5))
    within = ramp.scan[1:] == ramp.scan[:-1]
    assert abs(z.var() - 1) < 4 * math.sqrt(2 / N * 1.25 / 0.75)
    assert abs(np.mean((z[1:] * z[:-1])[within]) - 0.5) < 4 * math.sqrt(3 / N)
    assert abs(np.mean((z[1:] * z[:-1])[~within])) < 4 / math.sqrt(N_SCANS - 1) * 1.2


def test_signal_dependent_noise_has_a_variance_in_proportion(noise, ramp):
    z = noise(known.signal_dependent_noise(3.0)) / np.sqrt(1 + 3 * 0.01 * ramp.x_mm)
    for part in np.split(z[np.argsort(ramp.x_mm)], 4):
        assert abs(part.var() - 1) < 4 * math.sqrt(2 / len(part))


def test_another_noise_sd_scales_the_noise(noise):
    np.testing.assert_allclose(noise(known.noise_sd(3.0)), 3.0 * noise(), atol=1e-9)


def test_drifting_noise_grows_to_its_factor_and_stays(noise, ramp):
    z = noise(known.drifting_noise(2.0, N / 2))
    late = z[ramp.time_s > N / 2]
    assert abs(late.std() / 2 - 1) < 4 / math.sqrt(2 * len(late))
    early = z[:1000] / (1 + ramp.time_s[:1000] / (N / 2))
    assert abs(early.std() - 1) < 4 / math.sqrt(2 * len(early))


def test_heavy_tails_are_student_t_of_the_same_sd(noise):
    z = noise(known.heavy_tails(4.0))
    assert kstest(z * math.sqrt(2), t(4).cdf).pvalue > 1e-4


def test_outliers_come_in_their_share_and_size(noise):
    """Beyond 4 sd there is next to nothing but outliers."""
    z = noise(known.outliers(0.02, 10.0))
    expected = 0.02 * 2 * norm.sf(4, scale=math.sqrt(101)) + 0.98 * 2 * norm.sf(4)
    assert abs(np.mean(np.abs(z) > 4) - expected) < 4 * math.sqrt(expected / N)
    assert abs(z.var() - 3) < 4 * math.sqrt((3 * (0.98 + 0.02 * 101**2) - 9) / N)


def test_dropouts_are_lost_to_one_value(ramp):
    world = World(SPOT, concealed=(known.dropouts(0.03, -1.0),))
    lost = world.simulate(ramp, rng=np.random.default_rng(5)).readings == -1
    assert abs(lost.mean() - 0.03) < 4 * math.sqrt(0.03 / N)


@pytest.mark.parametrize("model", OTHER_NOISE)
def test_every_kind_of_noise_differs_from_white_as_it_is_called(model, ramp, noise):
    world = with_noise_model(World(SPOT), model, duration_s=float(N))
    assert (world.step == 1.0) == (model == "quantised")
    z = noise(*world.concealed)
    kept = z[np.abs(z) < 6]  # without outliers and dropouts
    spread = {"drifting": math.sqrt(7 / 3), "signal_dependent": math.sqrt(2)}.get(model, 1.0)
    assert kept.std() == pytest.approx(spread, rel=0.1)
    assert np.mean(np.abs(z) >= 6) == pytest.approx(
        {"outliers": 0.02 * 2 * norm.sf(6 / math.sqrt(65)), "dropouts": 0.01}.get(model, 0.0), abs=0.003
    )


SPOT_OF_SIZING = gaussian_spot([Blob(1.0, (0.4, 1.5), (3.0, 2.0), 0.2)], pixel_mm=0.5)


def left_by_levels(clean, changed):
    """What a null model leaves that may change its two levels alone: a straight line through the clean readings."""
    line = np.polyfit(clean.readings, changed.readings, 1)
    return float(np.linalg.norm(changed.readings - np.polyval(line, clean.readings)))


@pytest.fixture(scope="module")
def sizer(plan):
    return CleanSetup(plan, World(SPOT_OF_SIZING, noise_sd=0.5), left_by_levels)


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
    view = World(SPOT_OF_SIZING).view(plan)
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
