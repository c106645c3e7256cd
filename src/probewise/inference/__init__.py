"""Likelihoods of readings, and the inference problem: a prior, a sensor model, a likelihood and a recording.

The likelihoods are the paper's naive one, its Student-t (the noise sd of each data set integrated out), Gaussian ones,
and one of rounded readings; any sensor model works with any of them.
"""

from probewise.inference.gaussian import GaussianInferred, GaussianKnown
from probewise.inference.naive import Naive
from probewise.inference.noise_bounds import reading_span, sd_ceiling, sd_floor, student_t_of
from probewise.inference.problem import Likelihood, Problem, SensorProblem
from probewise.inference.rounded import Rounded
from probewise.inference.student_t import PooledSigma, StudentT, log_sigma_integral

__all__ = [
    "GaussianInferred",
    "GaussianKnown",
    "Likelihood",
    "Naive",
    "PooledSigma",
    "Problem",
    "Rounded",
    "SensorProblem",
    "StudentT",
    "log_sigma_integral",
    "reading_span",
    "sd_ceiling",
    "sd_floor",
    "student_t_of",
]

student_t = student_t_of
"""The old name of `student_t_of`."""
