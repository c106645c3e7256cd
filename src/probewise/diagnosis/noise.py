"""Is it only the noise? Whitening by a noise model, and tests of what is left.

A wrong noise model makes false alarms by the dozen, and a missed effect of the mean looks like correlated
noise; so every hypothesis about the mean is weighed under white and under each other noise model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.effects import NamedEffect
from probewise.recordings.plan import Recording
from probewise.sensor.stages import NoiseLevel

__all__ = ["NoiseModel", "Whitener", "noise_statistics", "steps_within_scans", "white"]


def steps_within_scans(recording: Recording) -> IntArray:
    """Count the rows back to the previous usable reading of the same scan, 0 where there is none.

    Shape (n_usable,): a missing reading makes its neighbours two steps apart.
    """
    rows = np.flatnonzero(recording.usable)
    steps = np.diff(rows, prepend=rows[:1])
    same = np.diff(recording.plan.scan[rows], prepend=-1) == 0
    return np.where(same, steps, 0).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Whitener:
    """Turn readings with correlated noise of uneven sd into independent ones of equal sd.

    `sd` (n_points,) is relative to the overall sd; `carry` (n_points,) is the correlation with the
    previous reading, 0 for the first of a scan.
    """

    sd: FloatArray
    carry: FloatArray

    def __call__(self, columns: FloatArray) -> FloatArray:
        """Whiten columns, shape (n_points,) or (n_points, n_columns)."""
        flat = columns.ndim == 1
        y = columns[:, None] if flat else columns
        y = y / self.sd[:, None]
        if np.any(self.carry):
            carry = self.carry[1:, None]
            y = np.concatenate([y[:1], (y[1:] - carry * y[:-1]) / np.sqrt(1 - carry**2)])
        return y[:, 0] if flat else y

    def log_det(self) -> float:
        """Return half the log determinant of the relative covariance."""
        return float(np.log(self.sd).sum() + 0.5 * np.log1p(-(self.carry**2)).sum())


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """A set of effects on the noise with equally weighted settings of their parameters.

    `settings` holds one row a node, the effects' parameters side by side; `whiteners` one a node.
    """

    effects: tuple[NamedEffect[Any], ...]
    settings: FloatArray
    whiteners: tuple[Whitener, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its effects; () for white noise."""
        return tuple(effect.name for effect in self.effects)

    @classmethod
    def of(cls, effects: Sequence[NamedEffect[Any]], recording: Recording) -> NoiseModel:
        """Lay out the nodes: every combination of the effects' banks."""
        banks = [effect.bank()[:, 0, :] for effect in effects]
        settings = np.zeros((1, 0))
        for bank in banks:
            settings = np.concatenate(
                [np.repeat(settings, len(bank), axis=0), np.tile(bank, (len(settings), 1))], axis=1
            )
        usable, plan, steps = recording.usable, recording.plan, steps_within_scans(recording)
        whiteners = []
        for row in settings:
            level = NoiseLevel(sd=np.ones((1, len(plan))), rho=np.zeros((1, 1)))
            at = 0
            for effect in effects:
                n_params = len(effect.prior.names)
                level = effect.apply(level, row[None, at : at + n_params], plan)
                at += n_params
            sd = np.broadcast_to(level.sd, (1, len(plan)))[0, usable]
            carry = np.where(steps > 0, float(level.rho[0, 0]) ** np.maximum(steps, 1), 0.0)
            whiteners.append(Whitener(sd, carry))
        return cls(tuple(effects), settings, tuple(whiteners))


def white(n_points: int) -> Whitener:
    """Leave readings as they are."""
    return Whitener(np.ones(n_points), np.zeros(n_points))


def noise_statistics(residuals: FloatArray, steps: IntArray, level: FloatArray) -> FloatArray:
    """Measure what white normal noise has none of, shape (3, n_draws).

    Parameters
    ----------
    residuals
        Whitened residuals, shape (n_points, n_draws).
    steps
        Rows back to the previous reading of the scan, 0 for none, shape (n_points,).
    level
        Predicted readings, shape (n_points,).

    Returns
    -------
    Correlation of neighbours, excess kurtosis, and correlation of the squares with the level.
    """
    r = residuals / np.sqrt(np.maximum(np.mean(residuals**2, axis=0), 1e-300))
    neighbours = np.flatnonzero(steps == 1)
    lag_1 = (r[neighbours] * r[neighbours - 1]).mean(axis=0) if neighbours.size else np.zeros(r.shape[1])
    kurtosis = (r**4).mean(axis=0) - 3
    tilt = level - level.mean()
    tilt = tilt / max(float(np.linalg.norm(tilt)), 1e-300)
    return np.stack([lag_1, kurtosis, tilt @ (r**2)])
