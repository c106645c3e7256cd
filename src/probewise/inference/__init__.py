"""Likelihoods of readings, and the inference problem: a prior, a sensor model, a likelihood and a recording.

The likelihoods are the paper's naive one, its Student-t (the noise sd of each data set integrated out), a Gaussian one
of known sd, and one of rounded readings; any sensor model works with any of them.
"""

from probewise.inference.likelihoods import GaussianKnown, Naive, StudentT, log_sigma_integral
from probewise.inference.problem import (
    Likelihood,
    SensorProblem,
    reading_span,
    sd_ceiling,
    sd_floor,
    sd_of_numbers,
    student_t_of,
)
from probewise.inference.rounded import Rounded

__all__ = [
    "GaussianKnown",
    "Likelihood",
    "Naive",
    "Rounded",
    "SensorProblem",
    "StudentT",
    "log_sigma_integral",
    "reading_span",
    "sd_ceiling",
    "sd_floor",
    "sd_of_numbers",
    "student_t_of",
]
