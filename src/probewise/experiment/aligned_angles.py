"""Samples of a posterior with a shape's angles about their mean, so that moments of angles and sides mean something."""

from __future__ import annotations

from dataclasses import replace

from probewise._arrays import FloatArray
from probewise.experiment.configuration import Experiment
from probewise.nested.importance import Weighted
from probewise.scene.symmetry import mean_angles, with_angles_near


def with_aligned_angles(experiment: Experiment, posterior: Weighted) -> Weighted:
    """Return the same hypotheses with angles within half a turn of their circular mean, and sides swapped accordingly.

    An angle may then lie outside its prior's range.
    """
    theta = theta_with_aligned_angles(experiment, posterior.theta, posterior.weight)
    return posterior if theta is posterior.theta else replace(posterior, theta=theta)


def theta_with_aligned_angles(experiment: Experiment, theta: FloatArray, weight: FloatArray) -> FloatArray:
    """Return weighted samples, (n_samples, n_params), aligned as by `with_aligned_angles`."""
    own = theta[:, experiment.shape_columns]
    aligned = with_angles_near(experiment.shape, own, mean_angles(experiment.shape, own, weight))
    if aligned is own:
        return theta
    out = theta.copy()
    out[:, experiment.shape_columns] = aligned
    return out
