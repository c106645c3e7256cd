"""Lost and outlying readings."""

import numpy as np
import pytest
from scipy.stats import betabinom

from probewise.diagnosis import diagnose
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.evidence import held_out_gain
from probewise.diagnosis.fit import Model, fit
from probewise.diagnosis.locate import Covariate, window_columns
from probewise.diagnosis.noise import NoiseLaw, white_noise
from probewise.diagnosis.outlying import clustering_log_bayes_factors, outlier_probabilities
from probewise.recordings import Recording, paper_plan
from probewise.systems import Simulator, table_for
from probewise.world.spots import Blob, gaussian_spot
from probewise.world.world import World

N = 60
TIME = np.arange(float(N))
LOST = np.arange(N) % 4 == 1
LAW = NoiseLaw(np.ones(N), np.zeros(N), LOST)
WITHOUT = white_noise(int((~LOST).sum()))


def test_lost_readings_change_no_density_of_held_out_readings():
    """A line predicts more than a constant, and as much more where lost readings are missing in the table instead."""
    x = np.sin(0.7 * TIME)
    y = 1.0 + 0.1 * x + 0.1 * np.random.default_rng(5).standard_normal(N)
    simulators = (
        Simulator("y", "V", {"a": (-5, 5)}, simulate=lambda p, u: p["a"] + 0 * u["x"]),
        Simulator("y", "V", {"a": (-5, 5), "b": (-5, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"]),
    )
    gains = []
    for readings, law in ((np.where(LOST, -20.0, y), LAW), (np.where(LOST, np.nan, y), WITHOUT)):
        fits = []
        for simulator in simulators:
            prepared = prepare_system(simulator, table_for(simulator, {"x": x, "y": readings}), with_effects=False)
            model = Model(prepared.null, (), prepared.recording.plan)
            fits.append(fit(model, prepared.recording, np.zeros(model.n_params), law))
        parts = (TIME[prepared.recording.usable] // 20).astype(int), ("1", "2", "3")
        gain = held_out_gain(*fits, prepared.recording, law, parts, law_of_null=law)
        gains.append(gain.per_reading * gain.n_readings)
    assert gains[1] > 1
    assert gains[0] == pytest.approx(gains[1], rel=1e-3)


N_OF_OUTLYING = 120
PLACE = Covariate("place", np.linspace(-50, 50, N_OF_OUTLYING), np.arange(N_OF_OUTLYING))


def tailed(n: int = N_OF_OUTLYING) -> NoiseLaw:
    return NoiseLaw(np.ones(n), np.zeros(n), np.zeros(n, dtype=bool), share=0.05, times=6.0)


def test_the_evidence_is_that_of_two_beta_binomials_against_one():
    """Of given numbers in and out of a window, the order within each being even."""
    far_out = np.zeros(N_OF_OUTLYING)
    far_out[[3, 5, 8, 70]] = 1.0
    columns, _ = window_columns(PLACE, N_OF_OUTLYING)
    one = betabinom(N_OF_OUTLYING, 0.5, 0.5).logpmf(4) - np.log(_choose(N_OF_OUTLYING, 4))
    expected = []
    for column in columns.T:
        n, k = int(column.sum()), int(far_out @ column)
        inside = betabinom(n, 0.5, 0.5).logpmf(k) - np.log(_choose(n, k))
        rest = betabinom(N_OF_OUTLYING - n, 0.5, 0.5).logpmf(4 - k) - np.log(_choose(N_OF_OUTLYING - n, 4 - k))
        expected.append(inside + rest - one)
    found = clustering_log_bayes_factors(far_out, [PLACE])
    assert found == {"place, far out": pytest.approx(float(np.log(np.mean(np.exp(expected)))))}


def _choose(n: int, k: int) -> float:
    return float(np.prod([(n - i) / (k - i) for i in range(k)])) if k else 1.0


def test_what_is_in_the_tail_follows_bayes_rule():
    law = tailed()
    residuals = np.random.default_rng(2).standard_normal(N_OF_OUTLYING)
    residuals[10] = 9.0
    sigma = float(law.likeliest_sigma(law(residuals)[:, None])[0])
    odds = (0.05 / 6) * np.exp(-0.5 * (residuals / sigma / 6) ** 2) / (0.95 * np.exp(-0.5 * (residuals / sigma) ** 2))
    np.testing.assert_allclose(outlier_probabilities(residuals, law), odds / (1 + odds))
    assert outlier_probabilities(residuals, law)[10] > 0.999
    residuals[10] = 1e6  # where both densities are nothing
    assert outlier_probabilities(residuals, law)[10] == 1.0


def spotted(rows: np.ndarray) -> Recording:
    """A clean recording with a dozen readings far out."""
    plan = paper_plan()
    world = World(gaussian_spot([Blob(1.0, (0.4, -0.3), (5.0, 3.5), 0.3)], pixel_mm=0.5))
    rng = np.random.default_rng(11)
    readings = world.expected_readings(plan) + 0.4 * rng.standard_normal(len(plan))
    readings[rows] += 5.0 * rng.choice([-1.0, 1.0], len(rows))
    return Recording(plan, readings)


@pytest.mark.slow
def test_outliers_anywhere_are_noise_and_at_one_end_of_a_scan_they_are_not():
    anywhere = diagnose(spotted(np.random.default_rng(4).choice(404, 12, replace=False)), rng=np.random.default_rng(0))
    assert anywhere.verdict == "noise"
    at_one_end = np.concatenate([np.arange(k, k + 12, 4) for k in (86, 187, 288, 389)])
    found = diagnose(spotted(at_one_end), rng=np.random.default_rng(0))
    assert found.verdict == "unknown"
    assert "Outlying readings cluster in place" in found.reason
    assert found.where
