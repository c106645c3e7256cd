"""Calibrate a sensor's spatial sensitivity function (SSF) from a recording.

The evidence gives its number of Gaussians N (the order), the posterior mean its field. Paper, sections 2.7
(evidence, eq. 18; likelihood, eq. 19 and 20; weighted mean of sampled SSF fields) and 3.1 (table of log evidences).
"""

from probewise.calibration.fields import (
    QuantitySummary,
    ScanNoise,
    choose_pixel_mm,
    draw_sd,
    mixture_moments,
    noise_by_scan,
    posterior_mean_ssf_field,
    ssf_quantities,
)
from probewise.calibration.fit import Calibration, OrderFit, calibrate
from probewise.calibration.paper import OrderPosterior, estimate_ssf, problem_for
from probewise.calibration.prediction import predict
from probewise.calibration.priors import (
    PriorRow,
    ScanGeometry,
    SSFPrior,
    blind_axis_rad,
    default_prior,
    paper_prior,
    scan_geometry,
)
from probewise.calibration.sensor_file import FittedSensor, OrderEvidence, read_sensor, write_sensor

__all__ = [
    "Calibration",
    "FittedSensor",
    "OrderEvidence",
    "OrderFit",
    "OrderPosterior",
    "PriorRow",
    "QuantitySummary",
    "SSFPrior",
    "ScanGeometry",
    "ScanNoise",
    "blind_axis_rad",
    "calibrate",
    "choose_pixel_mm",
    "default_prior",
    "draw_sd",
    "estimate_ssf",
    "mixture_moments",
    "noise_by_scan",
    "paper_prior",
    "posterior_mean_ssf_field",
    "predict",
    "problem_for",
    "read_sensor",
    "scan_geometry",
    "ssf_quantities",
    "write_sensor",
]
