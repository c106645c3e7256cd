"""What hypotheses predict at every design, as weights of levels; by asking them one by one, where no table serves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.inquiry.designs import Designs
from probewise.inquiry.sight import Sight
from probewise.recordings.plan import Plan
from probewise.sensor.stages import SensorModel

__all__ = [
    "MOST_LEVELS",
    "AskedForecast",
    "Forecast",
    "Outlook",
    "by_combination",
    "by_level",
    "predicted",
    "spread_levels",
    "thinned",
]

MOST_LEVELS = 1000
"""Levels, and cells of the reading, that the choice of a place tells apart: more than hypotheses can fill."""


_BLOCK = 2048  # designs predicted at a time: a closed form with 20 nodes stays within 20 MB for 50 hypotheses
_MOST_ASKED = 400  # hypotheses that are asked one by one
_PER_SD = 8.0  # levels a noise sd: of a few hundred hypotheses each counts by itself


class Outlook(Protocol):
    """What hypotheses predict at some designs, by level."""

    @property
    def levels(self) -> FloatArray:
        """Evenly spaced noise-free readings, (n_levels,); a prediction counts for the nearest."""
        ...

    def maps(self, weight: FloatArray) -> Iterator[tuple[IntArray, FloatArray]]:
        """Weigh the hypotheses that predict each level, one combination of the designs with all places after another.

        Parameters
        ----------
        weight
            Of the hypotheses, (n_samples,).

        Yields
        ------
        Which of the designs that are looked at these are, (n,), and the weight of each level there, (n, n_levels).
        """
        ...


class Forecast(Protocol):
    """Predict for many hypotheses at many designs at once."""

    @property
    def model(self) -> SensorModel:
        """The sensor model that readings are held against."""
        ...

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Noise-free readings of hypotheses at the rows of a plan, (n_samples, n_params) -> (n_samples, n_points)."""
        ...

    def outlook(
        self, theta: FloatArray, weight: FloatArray, designs: Designs, plan: Plan, rows: IntArray, noise_sd: float
    ) -> Outlook:
        """Look ahead.

        Parameters
        ----------
        theta, weight
            Hypotheses, (n_samples, n_params), and their weights, (n_samples,), where not all can be asked.
        designs, plan
            The designs, and the same as rows of a plan.
        rows
            Which of them to look at, (n,).
        noise_sd
            Sd of a reading's noise: levels need be no closer than to be hidden by it.
        """
        ...


@dataclass(frozen=True, eq=False)
class AskedForecast:
    """Any model: at most 400 hypotheses, taken evenly by their weight, asked at every design."""

    model: SensorModel

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """See `Forecast.predict`."""
        return predicted(self.model, theta, plan)

    def outlook(
        self, theta: FloatArray, weight: FloatArray, designs: Designs, plan: Plan, rows: IntArray, noise_sd: float
    ) -> Outlook:
        """See `Forecast.outlook`."""
        asked, share = thinned(weight, _MOST_ASKED)
        answers = predicted(self.model, theta[asked], plan.take(rows))
        levels = spread_levels(float(answers.min()), float(answers.max()), noise_sd / _PER_SD, most=MOST_LEVELS)
        per_level = 1.0 / (levels[1] - levels[0])
        index = np.rint((answers - levels[0]) * per_level).astype(np.int32)
        return _AskedOutlook(asked, share / weight[asked], index, levels, rows, designs.grid.n_places)


@dataclass(frozen=True, eq=False)
class _AskedOutlook:
    asked: IntArray
    stands_for: FloatArray
    index: IntArray
    levels: FloatArray
    rows: IntArray
    n_places: int

    def maps(self, weight: FloatArray) -> Iterator[tuple[IntArray, FloatArray]]:
        """See `Outlook.maps`."""
        own, n_levels = weight[self.asked] * self.stands_for, len(self.levels)
        for _, at, _ in by_combination(self.rows, self.n_places):
            yield at, by_level(self.index[:, at], own, n_levels)


def by_level(index: IntArray, weight: FloatArray, n_levels: int) -> FloatArray:
    """Sum the weights, (n,), of hypotheses that predict each level, index (n, n_designs) -> (n_designs, n_levels)."""
    n_designs = index.shape[1]
    key = index + np.arange(n_designs) * n_levels
    counted = np.bincount(key.ravel(), np.repeat(weight, n_designs), minlength=n_designs * n_levels)
    return np.asarray(counted.reshape(n_designs, n_levels), dtype=np.float64)


def by_combination(rows: IntArray, n_places: int) -> Iterator[tuple[int, IntArray, IntArray]]:
    """Split rows of designs, (n,): number of the combination, which of the rows are of it, and their places."""
    combination, place = np.divmod(rows, n_places)
    for number in np.unique(combination).tolist():
        at = np.flatnonzero(combination == number)
        yield number, at, place[at]


def predicted(model: SensorModel, theta: FloatArray, plan: Plan) -> FloatArray:
    """Ask every hypothesis at every row of a long plan where it can show: (n_samples, n_points)."""
    sight = Sight.of(model, theta, plan)
    if sight is not None:
        out = np.full((len(theta), len(plan)), sight.beside)
        for rows, shown in sight.parts(plan):
            if shown.size:
                out[np.ix_(shown, rows)] = model.predict(theta[shown], plan.take(rows))
        return out
    out = np.empty((len(theta), len(plan)))
    for start in range(0, len(plan), _BLOCK):
        block = np.arange(start, min(start + _BLOCK, len(plan)))
        out[:, block] = model.predict(theta, plan.take(block))
    return out


def spread_levels(low: float, high: float, spacing: float, *, most: int | None = None) -> FloatArray:
    """Even levels from one reading to another, no further apart than `spacing` unless that takes more than `most`."""
    low, high = min(low, high), max(low, high)
    n = max(2, int(np.ceil((high - low) / spacing)) + 1)
    return np.linspace(low, max(high, low + spacing), n if most is None else min(n, most))


def thinned(weight: FloatArray, n: int) -> tuple[IntArray, FloatArray]:
    """Rows of at most `n` hypotheses and what each stands for: systematic resampling without its random start."""
    some = np.flatnonzero(weight > 0)
    if len(some) <= n:
        return some, weight[some]
    ladder = np.cumsum(weight)
    rows = np.searchsorted(ladder, (np.arange(n) + 0.5) / n * ladder[-1])
    rows, count = np.unique(np.minimum(rows, len(weight) - 1), return_counts=True)
    return rows, count * (ladder[-1] / n)
