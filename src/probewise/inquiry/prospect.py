"""What the hypotheses that are still believed promise of every design: all that a utility may ask."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray, IntArray, require_finite
from probewise.errors import ShapeError
from probewise.inquiry.designs import Designs
from probewise.inquiry.forecast import Forecast, Outlook, predicted
from probewise.inquiry.readout import Readout, entropy_bits
from probewise.recordings.plan import Plan

__all__ = ["Goal", "Prospect"]

_CELL = 0.75  # width of a cell, in sds of noise, of readings that are not rounded: hides 2 % of a nat, everywhere alike
_SETTLED = 1.0 - 1e-7  # share of the hypotheses that predict one level, from which on it is certain
_BLOCK = 512  # designs whose readings are weighed at a time: they stay in the cache


@dataclass(frozen=True)
class Goal:
    """What a run is to end on: the posterior sd of every parameter in these columns of theta below `sd`."""

    columns: tuple[int, ...]
    sd: float


@dataclass(frozen=True, eq=False)
class Prospect:
    """Hold posterior, designs and sensor; answer what a utility asks of them.

    Attributes
    ----------
    forecast
        Predicts, with its sensor model.
    readout
        Noise, rounding and range of a reading.
    theta, weight
        The whole posterior, (n_samples, n_params), and its weights, (n_samples,), summing to one.
    drawn
        A few equally weighted samples of it, (n_drawn, n_params); the paper has 50.
    designs, plan
        The designs, and the same as rows of a plan.
    rows
        Those that can be taken, (n,): every answer is about these, in this order.
    cost_s
        Seconds that each of them takes, (n,).
    goal
        What the run is to end on, where it is a matter of sds.
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
                f"theta {self.theta.shape}, weight {self.weight.shape}; allowed: (n_samples, n_params), (n_samples,)"
            )
        if len(self.plan) != len(self.designs) or self.cost_s.shape != self.rows.shape:
            raise ShapeError(
                f"{len(self.designs)} designs, {len(self.plan)} rows of a plan, {self.cost_s.size} costs of "
                f"{self.rows.size}; allowed: as many rows as designs, a cost for each that can be taken"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, one a column of theta."""
        return self.forecast.model.names

    @cached_property
    def predicted(self) -> FloatArray:
        """Noise-free readings of the few samples at every design that can be taken, (n_drawn, n)."""
        answers = predicted(self.forecast.model, self.drawn, self.plan.take(self.rows))
        require_finite("predicted", answers)
        return answers

    @cached_property
    def outlook(self) -> Outlook:
        """Levels that the whole posterior predicts."""
        noise_sd = self.readout.noise_sd / np.sqrt(max(self.designs.repeats))
        return self.forecast.outlook(self.theta, self.weight, self.designs, self.plan, self.rows, noise_sd)

    def information(self, weight: FloatArray) -> FloatArray:
        """Give the bits expected of the reading at every design, were the hypotheses so weighted, (n_samples,)."""
        mass = self.outlook.mass(weight)
        return np.maximum(self.reading_entropy(mass) - self.noise_entropy(mass), 0.0)

    def reading_entropy(self, mass: FloatArray) -> FloatArray:
        """Entropy, bits, of the reading at every design: levels (n, n_levels), noise, rounding and range together.

        `mass` may be that of some hypotheses only; it is taken to one.
        """
        out = np.zeros(len(self.rows))
        level = mass.argmax(axis=1)
        settled = mass[np.arange(len(mass)), level] >= _SETTLED * mass.sum(axis=1)
        for rows, chance in self._chances:
            known = rows[settled[rows]]
            out[known] = entropy_bits(chance)[level[known]]
            rest = rows[~settled[rows]]
            for start in range(0, len(rest), _BLOCK):
                block = rest[start : start + _BLOCK]
                part = mass[block].astype(np.float32)
                part /= part.sum(axis=1, keepdims=True)
                out[block] = entropy_bits(part @ chance)
        return out

    def noise_entropy(self, mass: FloatArray) -> FloatArray:
        """Entropy, bits, that the reading at every design would have if the hypothesis were known, on average."""
        out = np.zeros(len(self.rows))
        for rows, chance in self._chances:
            out[rows] = (mass @ entropy_bits(chance).astype(np.float64))[rows]
        return np.asarray(out / mass.sum(axis=1))

    @cached_property
    def _chances(self) -> list[tuple[IntArray, FloatArray]]:
        """Designs of each number of repeats, and the probability of each cell given each level."""
        repeats = self.designs.n_repeats[self.rows]
        return [
            (
                np.flatnonzero(repeats == n),
                self.readout.probability(self.outlook.levels, repeats=int(n), fine=_CELL).astype(np.float32),
            )
            for n in np.unique(repeats)
        ]
