"""The declared noise of a reading: Gaussian, then rounded, then clipped to the ends of the scale."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.effects.noise_distribution import log_gaussian_density, log_rounding_cell_density
from probewise.inference import GaussianKnown, Rounded
from probewise.inference.problem import Likelihood
from probewise.inference.rounded import ScaleEnds


@dataclass(frozen=True)
class DeclaredNoise:
    """Gaussian noise of sd `sd`, clipped to a scale and rounded to `step` within it (0: not rounded).

    If not `whole_steps`, readings are not rounded, and `step` is only the width of a reading's cell.

    Methods return the log density of each reading, (n_samples, n_points); for rounded readings, the log probability of
    the rounding cell, and for a reading at an end of the scale, the log probability of all values beyond.
    """

    sd: float
    step: float = 0.0
    ends: ScaleEnds | None = None
    whole_steps: bool = True

    @property
    def is_rounded(self) -> bool:
        """Whether readings are multiples of a step."""
        return self.whole_steps and self.step > 0

    @classmethod
    def from_likelihood(cls, likelihood: Likelihood) -> Self | None:
        """Return the noise of a likelihood with one known sd; None for any other."""
        if isinstance(likelihood, Rounded):
            return cls(likelihood.sd, likelihood.step, likelihood.ends, likelihood.whole_steps)
        if isinstance(likelihood, GaussianKnown) and np.ndim(likelihood.sd) == 0:
            return cls(float(np.asarray(likelihood.sd)))
        return None

    def inside_scale_mask(self, readings: FloatArray) -> BoolArray:
        """Return which readings, (n_points,), lie between the ends of the scale."""
        if self.ends is None:
            return np.ones(len(readings), dtype=np.bool_)
        return ~self.ends.end_mask(readings)

    def log_density(
        self,
        readings: FloatArray,
        predicted: FloatArray,
        *,
        sd: float | FloatArray | None = None,
        step: float | None = None,
    ) -> FloatArray:
        """Return the log density of readings, (n_points,), given predictions, (n_samples, n_points).

        Another `sd` or `step` than the declared one may be given; `sd` broadcasts to the predictions.
        """
        sd, step = self.sd if sd is None else sd, self.step if step is None else step
        if not step:
            return self._with_probability_beyond_ends(
                readings, predicted, sd, log_gaussian_density(readings, predicted, sd)
            )
        within = log_rounding_cell_density(readings, predicted, np.asarray(sd), step) + math.log(step)
        return self._with_probability_beyond_ends(readings, predicted, sd, within)

    def quick_log_density(self, readings: FloatArray, predicted: FloatArray, *, sd: float) -> FloatArray:
        """Return the same as `log_density`, approximately and faster if the noise is wider than the rounding cell.

        In that case, take the density at the cell's middle, with the variance of a uniform cell added to the noise's.
        """
        if sd < self.step:
            return self.log_density(readings, predicted, sd=sd)
        within = log_gaussian_density(readings, predicted, math.hypot(sd, self.step / math.sqrt(12.0)))
        return self._with_probability_beyond_ends(
            readings, predicted, sd, within + (math.log(self.step) if self.step else 0.0)
        )

    def log_uniform_density(self, readings: FloatArray, low: float, high: float) -> FloatArray:
        """Return the log density, (n_points,), of readings that are uniform from `low` to `high`; -inf outside."""
        width = np.full(len(readings), self.step or 1.0)
        if self.ends is not None:
            width = np.where(
                self.ends.lowest_reading_mask(readings), self.ends.lowest_cell + 0.5 * self.step - low, width
            )
            width = np.where(
                self.ends.highest_reading_mask(readings), high - self.ends.highest_cell + 0.5 * self.step, width
            )
        possible = (readings >= low) & (readings <= high) & (width > 0)
        return np.log(np.where(possible, width, 1.0) / (high - low)) + np.where(possible, 0.0, -np.inf)

    def _with_probability_beyond_ends(
        self, readings: FloatArray, predicted: FloatArray, sd: float | FloatArray, within: FloatArray
    ) -> FloatArray:
        """Replace the log densities of readings at an end of the scale by the log probability of all values beyond."""
        inside = self.inside_scale_mask(readings)
        if self.ends is None or inside.all():
            return within
        return np.where(inside, within, self.ends.log_prob_at_ends(readings, predicted, sd))
