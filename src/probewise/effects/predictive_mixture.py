"""The posterior predictive distribution of readings: mean, sd, and log density of the measured values."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.effects.limited_range import limited_mean, log_probability_at_end
from probewise.effects.noise_distribution import log_density, reading_variance
from probewise.recordings.ends import masks_of_readings_at_ends
from probewise.sensor.stages import NoiseParameters


@dataclass(eq=False)
class PredictiveMixture:
    """The predictive distribution of readings: the mixture of posterior samples' predictions, added block by block.

    Parameters
    ----------
    readings
        Measured readings, (n_points,).
    scored
        Mask of the readings that get a log density, (n_points,).
    step
        The declared rounding step, if any.
    ends
        Smallest and largest reading of the instrument; infinite for an open end. At an end the "density" is a
        probability: that the noise reaches the end.
    """

    readings: FloatArray
    scored: BoolArray
    step: float | None = None
    ends: tuple[float, float] = (-math.inf, math.inf)
    n_samples: int = field(default=0, init=False)
    _center: FloatArray | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        n_points = len(self.readings)
        self._total, self._squares, self._of_noise = np.zeros(n_points), np.zeros(n_points), np.zeros(n_points)
        self._limited_total = np.zeros(n_points)
        self._log_sum = np.full(int(self.scored.sum()), -np.inf)

    def add(self, mean: FloatArray, noise: NoiseParameters, between: FloatArray | None = None) -> None:
        """Add noise-free predictions, (n_samples, n_points), and the noise about them.

        `between` (n_points,) is an additional smoothing sd of the density, for samples whose predictions lie farther
        apart than the noise; mean and sd are unaffected.
        """
        if self._center is None:
            self._center = mean.mean(axis=0)  # sums about a nearby value keep their precision
        self.n_samples += len(mean)
        self._total += (mean - self._center).sum(axis=0)
        self._squares += ((mean - self._center) ** 2).sum(axis=0)
        self._of_noise += np.broadcast_to(reading_variance(noise), mean.shape).sum(axis=0)
        if self._is_limited:
            self._limited_total += limited_mean(noise, mean, *self.ends).sum(axis=0)
        if self.step is not None:  # `reading_variance` above leaves it out: the pooled sd includes a declared rounding
            noise = replace(noise, step=np.full((1, 1), self.step))
        if between is not None:
            noise = replace(noise, sd=np.hypot(np.broadcast_to(noise.sd, mean.shape), between))
        if self._log_sum.size:
            log_p = self._log_density_of_scored(noise, mean)
            self._log_sum = np.logaddexp(self._log_sum, np.logaddexp.reduce(log_p, axis=0))

    @property
    def _is_limited(self) -> bool:
        return bool(np.isfinite(self.ends).any())

    @property
    def _are_at_end(self) -> BoolArray:
        at_low, at_high = masks_of_readings_at_ends(self.readings, *self.ends, self.step)
        return at_low | at_high

    def _log_density_of_scored(self, noise: NoiseParameters, mean: FloatArray) -> FloatArray:
        """Return the log density of each scored reading, or log probability at an end, (n_samples, n_scored)."""
        readings = self.readings[self.scored]
        out = log_density(_noise_of_rows(noise, self.scored), readings, mean[:, self.scored])
        if not self._is_limited:
            return out
        for at_end, is_high in zip(
            masks_of_readings_at_ends(readings, *self.ends, self.step), (False, True), strict=True
        ):
            rows = np.flatnonzero(self.scored)[at_end]
            own = _noise_of_rows(noise, rows)
            out[:, at_end] = log_probability_at_end(own, self.readings[rows], mean[:, rows], is_high=is_high)
        return out

    def mean_sd_and_log_density(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return mean and sd of a new reading at each row, and log density of the measured one: (n_points,) each.

        The density is NaN where a reading is not scored. The mean is within the range of the instrument; the sd is
        that of a reading which no end limits.
        """
        n = self.n_samples
        shift = self._total / n
        spread = np.maximum(self._squares / n - shift**2, 0.0)
        scores = np.full(len(self.readings), np.nan)
        scores[self.scored] = self._log_sum - math.log(n)
        base = np.zeros(len(self.readings)) if self._center is None else self._center
        mean = base + shift
        if self._is_limited:
            mean = np.clip(self._limited_total / n, *self.ends)
            scores = np.where(self._are_at_end, np.minimum(scores, 0.0), scores)
        return mean, np.sqrt(spread + self._of_noise / n), scores


def _noise_of_rows(noise: NoiseParameters, rows: BoolArray | IntArray) -> NoiseParameters:
    sd = noise.sd if noise.sd.shape[-1] == 1 else noise.sd[:, rows]
    return replace(noise, sd=sd, walked=noise.walked if len(noise.walked) == 1 else noise.walked[rows])
