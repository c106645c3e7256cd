"""Posterior, designs and predictive distributions: the input of every utility."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray, IntArray, require_finite
from probewise.errors import ShapeError
from probewise.inquiry.designs import Designs
from probewise.inquiry.forecast import MOST_LEVELS, Forecast, PredictiveDistributions
from probewise.inquiry.readout import Readout, entropy_bits
from probewise.recordings.plan import Plan

_CELL = 0.75  # width of a cell in noise sds, for unrounded readings: loses 2 % of a nat, uniformly
_SETTLED = 1.0 - 1e-7  # weight of one level from which it counts as certain
_BLOCK = 512  # designs per batch, to fit the cache


@dataclass(frozen=True)
class Goal:
    """The stopping rule of a run: the posterior sds of the columns `columns` of theta are all below `sd`."""

    columns: tuple[int, ...]
    sd: float


@dataclass(frozen=True, eq=False)
class UtilityInput:
    """Posterior, designs and sensor, with the quantities that utilities need; ShapeError if the arrays do not match.

    Attributes
    ----------
    forecast
        Predictions, with the sensor model.
    readout
        Noise, rounding and range of a reading.
    theta, weight
        The whole posterior, (n_samples, n_params), and its weights, (n_samples,), summing to one.
    drawn
        A few equally weighted posterior samples, (n_drawn, n_params); 50 in the paper.
    designs, plan
        The designs, and the same as rows of a plan.
    rows
        Indices of the available designs, (n,); all results are for these, in this order.
    cost_s
        Seconds that each available design takes, (n,).
    goal
        The stopping rule, if it is one of sds; else None.
    """

    forecast: Forecast
    readout: Readout
    theta: FloatArray
    weight: FloatArray
    drawn: FloatArray
    designs: Designs
    plan: Plan
    rows: IntArray
    cost_s: FloatArray
    goal: Goal | None = None

    def __post_init__(self) -> None:
        if self.theta.ndim != 2 or self.weight.shape != (len(self.theta),) or 0 in self.theta.shape:
            raise ShapeError(
                f"theta has shape {self.theta.shape}, weight {self.weight.shape}; "
                "allowed: (n_samples, n_params), (n_samples,)"
            )
        if len(self.plan) != len(self.designs) or self.cost_s.shape != self.rows.shape:
            raise ShapeError(
                f"{len(self.designs)} designs, {len(self.plan)} rows of a plan, {self.cost_s.size} costs of "
                f"{self.rows.size}; allowed: as many rows as designs, a cost for each that can be taken"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, one per column of theta."""
        return self.forecast.model.names

    @cached_property
    def predicted(self) -> FloatArray:
        """Noise-free readings of the drawn samples at every available design, (n_drawn, n)."""
        answers = self.forecast.predict(self.drawn, self.plan.take(self.rows))
        require_finite("predicted", answers)
        return answers

    @cached_property
    def predictive(self) -> PredictiveDistributions:
        """Predictive distribution under the whole posterior, as weights of levels."""
        noise_sd = self.readout.noise_sd / np.sqrt(max(self.designs.repeats))
        return self.forecast.predictive(self.theta, self.weight, self.designs, self.plan, self.rows, noise_sd)

    def information(self, weight: FloatArray) -> FloatArray:
        """Return the expected information in bits of a reading at every available design, for weights (n_samples,)."""
        out = np.empty(len(self.rows))
        for at, mass in self.predictive.level_weights(weight):
            chance = self._cell_probability(at)
            out[at] = np.maximum(_entropy_of_readings(mass, chance) - _entropy_of_noise(mass, chance), 0.0)
        return out

    def reading_entropy(self, weight: FloatArray) -> FloatArray:
        """Return the entropy in bits of the reading at every available design, including noise, rounding and range.

        The weights, (n_samples,), need not sum to one, and may be 0 for some hypotheses.
        """
        out = np.empty(len(self.rows))
        for at, mass in self.predictive.level_weights(weight):
            out[at] = _entropy_of_readings(mass, self._cell_probability(at))
        return out

    def _cell_probability(self, at: IntArray) -> FloatArray:
        """Return the probability of each cell given each level, (n_levels, n_cells), at designs of equal repeats."""
        n = int(self.designs.n_repeats[self.rows[at[0]]])
        chance = self.readout.cell_probability(self.predictive.levels, repeats=n, fine=_CELL, most=MOST_LEVELS)
        return np.asarray(chance.astype(np.float32))


def _entropy_of_readings(mass: FloatArray, chance: FloatArray) -> FloatArray:
    """Return the entropy in bits of the reading's cell, for unnormalised weights of levels (n, n_levels): (n,)."""
    level = mass.argmax(axis=1)
    settled = mass[np.arange(len(mass)), level] >= _SETTLED * mass.sum(axis=1)
    out = np.asarray(entropy_bits(chance)[level], dtype=np.float64)
    rest = np.flatnonzero(~settled)
    for start in range(0, len(rest), _BLOCK):
        block = rest[start : start + _BLOCK]
        part = mass[block].astype(np.float32)
        part /= part.sum(axis=1, keepdims=True)
        out[block] = entropy_bits(part @ chance)
    return out


def _entropy_of_noise(mass: FloatArray, chance: FloatArray) -> FloatArray:
    """Return the mean entropy in bits of a reading given its level, for unnormalised weights (n, n_levels): (n,)."""
    return np.asarray(mass @ entropy_bits(chance).astype(np.float64) / mass.sum(axis=1))
