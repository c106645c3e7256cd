"""Sensor models made by hand: one Gaussian, and the levels of black and white."""

import numpy as np
from mixtures import fixed_mixture

from probewise.calibration import FittedSensor, OrderEvidence
from probewise.recordings import Instrumentation, Recording, paper_plan
from probewise.scene import KnownScene
from probewise.sensor import Chain, FixedLevels, footprint_of, mean_ssf_field

NAMES = ("a_1", "u_1", "v_1", "A_1", "B_1", "C_1", "I_min", "I_max")
TRUTH = np.array([0.5, 0.0, 1.5, 1 / 32, 1 / 12.5, 0.0, 10.0, 60.0])


def sensor_of(samples, **changes):
    """A sensor with these posterior samples, by default (n_samples, 8), and the field of the truth."""
    axis = np.arange(-20.0, 20.5)
    known = {
        "names": NAMES,
        "noise_sd": np.full(len(samples), 0.6),
        "field": mean_ssf_field(footprint_of(TRUTH[None, :6], 1), u_mm=axis, v_mm=axis),
        "instrumentation": Instrumentation(),
    }
    return FittedSensor(samples=samples, n_gaussians=1, **{**known, **changes})


def hand_made_sensor():
    """One sample far off, as the posterior of a long scan along one line may have."""
    samples = TRUTH + 1e-3 * np.random.default_rng(0).standard_normal((500, 8))
    samples[0, 3:6] = 0.5, 0.9, 0.65
    return sensor_of(samples, orders=(OrderEvidence(1, -389.8199, 0.0234), OrderEvidence(2, -394.28, 0.53)))


def spread_sensor():
    spread = np.array([0.1, 0.02, 0.02, 0.0005, 0.001, 0.001, 0.03, 0.03])
    return sensor_of(TRUTH + spread * np.random.default_rng(0).standard_normal((500, 8)))


def small_recording():
    """Every fourth reading of the paper's plan, by the chain itself with noise of sd 0.6."""
    plan = paper_plan()
    plan = plan.take(np.arange(0, len(plan), 4))
    chain = Chain(fixed_mixture(TRUTH[:6]), FixedLevels(10.0, 60.0), KnownScene(plan.patterns))
    noise = 0.6 * np.random.default_rng(1).standard_normal(len(plan))
    return Recording(plan, chain.predict(np.empty((1, 0)), plan)[0] + noise)
