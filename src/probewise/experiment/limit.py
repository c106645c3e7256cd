"""A lower bound on the mean number of readings of an experiment, for any strategy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from probewise.experiment.configuration import Experiment
from probewise.experiment.journal import PATTERN
from probewise.inquiry import Bound, capacity_bits, fewest_readings, prior_entropy, target_entropy

_MET = 5.0  # noise sds from the background at which a reading counts as on the shape


def least_readings(experiment: Experiment, *, rng: np.random.Generator, n_samples: int = 20_000) -> Bound:
    """Return a lower bound on the mean number of readings: bits needed over bits per reading, search plus refinement.

    The search ends with the first reading on the shape. Any reading before is on the shape with probability p at most,
    that of the best first place, and so carries at most the information of a yes or no with probability p; a yes leaves
    a share p of all hypotheses. From there to the target sd, a reading carries at most the sensor's capacity.

    Parameters
    ----------
    experiment
        An experiment with one shape and a known sensor.
    rng, n_samples
        Random generator and number of draws from the prior.
    """
    prior = experiment.prior
    theta = prior.from_unit_cube(rng.random((n_samples, len(prior.names))))
    weight = np.full(n_samples, 1.0 / n_samples)
    designs = experiment.designs
    plan = replace(designs.plan(PATTERN), instrumentation=experiment.instrumentation)
    predictive = experiment.forecast.predictive(
        theta, weight, designs, plan, np.arange(experiment.grid.n_places), experiment.noise_sd
    )
    _, mass = next(predictive.level_weights(weight))
    levels = predictive.levels
    beside = levels[int(mass.sum(axis=0).argmax())]
    covered = float(mass[:, np.abs(levels - beside) > _MET * experiment.noise_sd].sum(axis=1).max())
    prior_bits = prior_entropy(prior, rng=rng)
    return fewest_readings(
        prior_bits,
        prior_bits + math.log2(covered),
        target_entropy(len(prior.names), experiment.stop_sd_mm),
        most_covered=covered,
        capacity=capacity_bits(float(levels[0]), float(levels[-1]), experiment.readout),
    )
