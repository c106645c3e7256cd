"""A sensor model made by hand."""

import numpy as np

from probewise.calibration import FittedSensor, OrderEvidence
from probewise.recordings import Instrumentation
from probewise.sensor import footprint_of, mean_ssf_field


def hand_made_sensor():
    """One sample far off, as the posterior of a long scan along one line may have."""
    rng = np.random.default_rng(0)
    samples = np.array([0.5, 0.0, 1.5, 1 / 32, 1 / 12.5, 0.0, 10.0, 60.0]) + 1e-3 * rng.standard_normal((500, 8))
    samples[0, 3:6] = 0.5, 0.9, 0.65
    axis = np.arange(-20.0, 20.5)
    return FittedSensor(
        names=("a_1", "u_1", "v_1", "A_1", "B_1", "C_1", "I_min", "I_max"),
        samples=samples,
        n_gaussians=1,
        noise_sd=np.full(500, 0.6),
        field=mean_ssf_field(footprint_of(samples[1:2, :6], 1), u_mm=axis, v_mm=axis),
        instrumentation=Instrumentation(),
        orders=(OrderEvidence(1, -389.8199, 0.0234), OrderEvidence(2, -394.28, 0.53)),
    )
