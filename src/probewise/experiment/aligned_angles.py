"""Posterior samples with a shape's angles brought near their mean, so that means and sds of angles are meaningful."""

from __future__ import annotations

from dataclasses import replace

from probewise._arrays import FloatArray
from probewise.experiment.configuration import Experiment
from probewise.nested import Weighted
from probewise.scene.symmetry import mean_angles, with_angles_near


def with_aligned_angles(experiment: Experiment, posterior: Weighted) -> Weighted:
    """Return the posterior of the same shapes with angles brought near their circular mean, and sides swapped to match.

    An angle may then lie outside its prior's range.
    """
    theta = theta_with_aligned_angles(experiment, posterior.theta, posterior.weight)
    return posterior if theta is posterior.theta else replace(posterior, theta=theta)


def theta_with_aligned_angles(experiment: Experiment, theta: FloatArray, weight: FloatArray) -> FloatArray:
    """Return samples, (n_samples, n_params), aligned as by `with_aligned_angles`; `weight` (n_samples,)."""
    own = theta[:, experiment.shape_columns]
    aligned = with_angles_near(experiment.shape, own, mean_angles(experiment.shape, own, weight))
    if aligned is own:
        return theta
    out = theta.copy()
    out[:, experiment.shape_columns] = aligned
    return out
