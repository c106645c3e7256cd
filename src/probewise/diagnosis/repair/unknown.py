"""Repair a model where nothing in the vocabulary explains the residual: by bases orthogonal to what is known.

The correction is a Gaussian process of finite rank: the amplitudes of the bases have normal priors, and each
basis is projected past everything that the sensor model could take up. It belongs to the recording's rows
and covariates; it names no physics, so the sensor written to sensor.json does not carry it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.diagnosis.evidence.bank import Bank
from probewise.diagnosis.evidence.held_out import HeldOut, compare_parts
from probewise.diagnosis.evidence.laplace import SCALES, Linearised
from probewise.diagnosis.fitting.fit import Fit

__all__ = ["Correction", "correct"]

_ABOUT_EQUAL = 5.0  # nats


@dataclass(frozen=True, eq=False)
class Correction:
    """What the bases add: `change` of the readings (n_points,), and its gain on scans kept back."""

    change: FloatArray
    columns: FloatArray
    held_out: HeldOut

    @property
    def gains_nothing(self) -> bool:
        """Whether readings kept back, where there are any, speak against it."""
        return bool(self.held_out.by_scan) and self.held_out.per_reading <= 0


def correct(found: Fit, problem: Linearised, bases: Bank, scan: IntArray) -> Correction:
    """Correct a fit by the most telling basis.

    Parameters
    ----------
    found, problem
        The null, and its linearisation under the noise model found.
    bases
        What may be missing.
    scan
        Scan of each usable row, for keeping scans back, shape (n_points,).
    """
    scores = bases.log_bayes_factors(problem)[:, 0]
    # Among bases of about equal evidence the one of fewest columns: what needs an amplitude for each scan
    # says nothing of the next scan.
    rivals = np.flatnonzero(scores > scores.max() - _ABOUT_EQUAL)
    columns = bases[min(map(int, rivals), key=lambda i: (int(bases.widths[i]), -float(scores[i])))]
    norms = np.sqrt(np.mean(columns**2, axis=0))
    columns = columns[:, norms > 0] / norms[norms > 0]
    everything = np.ones(len(found.residuals), dtype=np.bool_)
    plain = np.zeros((len(columns), 0))
    change = found.residuals - _without(found, problem, columns, everything, everything)[0]

    def gain(out: BoolArray) -> FloatArray:
        return _log_density(found, problem, columns, out) - _log_density(found, problem, plain, out)

    return Correction(change, columns, compare_parts(scan, gain))


def _without(
    found: Fit, problem: Linearised, columns: FloatArray, kept: BoolArray, asked: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Fit parameters and amplitudes to the rows kept; return residual and variance of the mean of the rows asked."""
    sd, p = problem.sd, found.slopes.shape[1]
    design = np.concatenate([found.slopes, columns], axis=1)
    center = np.concatenate([-found.z, np.zeros(columns.shape[1])])
    # Amplitudes start from a wide prior, then take their own common size as its scale (empirical Bayes):
    # a scan that was never seen is as uncertain as the seen ones differ.
    size = sd * SCALES[5]
    for _ in range(3):
        precision = np.concatenate([np.ones(p), np.full(columns.shape[1], size**-2)])
        covariance = np.linalg.inv(design[kept].T @ design[kept] / sd**2 + np.diag(precision))
        amount = covariance @ (design[kept].T @ found.residuals[kept] / sd**2 + precision * center)
        if columns.shape[1] > 1:
            size = max(float(np.sqrt(np.mean(amount[p:] ** 2))), 1e-3 * sd)
    return (
        found.residuals[asked] - design[asked] @ amount,
        np.asarray(np.einsum("ij,jk,ik->i", design[asked], covariance, design[asked])),
    )


def _log_density(found: Fit, problem: Linearised, columns: FloatArray, out: BoolArray) -> FloatArray:
    miss, spread = _without(found, problem, columns, ~out, out)
    kept_miss, _ = _without(found, problem, columns, ~out, ~out)
    n_free = max(len(kept_miss) - found.slopes.shape[1] - columns.shape[1], 1)
    total = float(kept_miss @ kept_miss) / n_free + spread
    return np.asarray(-0.5 * np.log(2 * math.pi * total) - 0.5 * miss**2 / total)
