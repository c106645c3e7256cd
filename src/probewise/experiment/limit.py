"""How few readings an experiment could do with, on average, whatever chose them."""

from __future__ import annotations

import math

import numpy as np

from probewise.experiment.journal import PATTERN
from probewise.experiment.setting import Experiment
from probewise.inquiry import Bound, capacity_bits, fewest_readings, prior_entropy, target_entropy

__all__ = ["least_readings"]

_MET = 5.0  # noise sds from what is read beside the shape, so that a reading says that the shape is there


def least_readings(experiment: Experiment, *, rng: np.random.Generator, n_samples: int = 20_000) -> Bound:
    """Bits needed over bits that readings can carry, search and refinement apart.

    The search ends with the first reading on the shape. The best first place lies on it with some
    probability p: its reading carries no more than a yes or no of that probability, and the yes leaves
    a share p of all hypotheses. From there to the sd that is asked for every reading carries no more than
    the sensor's capacity.

    Parameters
    ----------
    experiment
        One shape, known sensor: its prior, its sensor, the sd that it ends on.
    rng, n_samples
        Draw hypotheses from the prior.
    """
    prior = experiment.prior
    theta = prior.from_unit_cube(rng.random((n_samples, len(prior.names))))
    weight = np.full(n_samples, 1.0 / n_samples)
    designs = experiment.designs
    outlook = experiment.forecast.outlook(
        theta, weight, designs, designs.plan(PATTERN), np.arange(experiment.grid.n_places), experiment.noise_sd
    )
    _, mass = next(outlook.maps(weight))
    levels = outlook.levels
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
