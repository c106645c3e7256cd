"""A run has a clock and a frame of its own."""

import numpy as np

from probewise.calibration import FittedSensor
from probewise.effects import Origin
from probewise.experiment.simulation import sensor_chain_at_means
from probewise.recordings import Instrumentation
from probewise.scene import KnownScene
from probewise.sensor import SSFField, mixture_parameter_names


def test_effects_of_a_sensor_from_far_away_count_from_0_in_a_run():
    names = (*mixture_parameter_names(1), "I_min", "I_max", "gain_drift.frac", "gain_drift.tau_s")
    sensor = FittedSensor(
        names=names,
        samples=np.tile([1.0, 0.5, 1.5, 0.03, 0.08, -0.005, 11.0, 58.0, 0.2, 30.0], (500, 1)),
        n_gaussians=1,
        noise_sd=np.full(500, 0.5),
        field=SSFField(np.ones((1, 1)), 1.0, (0.0, 0.0)),
        instrumentation=Instrumentation(),
        effects=("gain_drift",),
        origins={"gain_drift": Origin(time_s=1.7e9)},
    )
    (kept,) = sensor.effects_on_new_scans
    (of_run,) = sensor_chain_at_means(sensor, KnownScene({})).effects
    assert (kept.origin, of_run.effect.origin) == (Origin(time_s=1.7e9), Origin())
