"""What hypotheses predict at every design: weights of levels, by a table of discs or by asking them one by one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.inquiry.designs import Designs
from probewise.inquiry.discs import DiscTable
from probewise.inquiry.grid import Grid
from probewise.inquiry.sight import Sight
from probewise.recordings.plan import Plan
from probewise.sensor.stages import SensorModel

__all__ = ["AskedForecast", "DiscForecast", "Forecast", "Outlook", "forecast_of", "predicted"]

_BLOCK = 2048  # designs predicted at a time: a closed form with 20 nodes stays within 20 MB for 50 hypotheses
_MOST_ASKED = 400  # hypotheses that are asked one by one
# Levels a noise sd. Rounding to the nearest adds to the noise's variance 2 % where thousands of hypotheses
# average over it; of a few each counts by itself.
_PER_SD_OF_MANY = 2.0
_PER_SD_OF_FEW = 8.0


class Outlook(Protocol):
    """What hypotheses predict at some designs, by level."""

    @property
    def levels(self) -> FloatArray:
        """Evenly spaced noise-free readings, (n_levels,); a prediction counts for the nearest."""
        ...

    def mass(self, weight: FloatArray) -> FloatArray:
        """Weight of the hypotheses that predict each level, (n_samples,) -> (n_designs, n_levels)."""
        ...


class Forecast(Protocol):
    """Predict for many hypotheses at many designs at once."""

    @property
    def model(self) -> SensorModel:
        """The sensor model that answers for single hypotheses."""
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
class DiscForecast:
    """All hypotheses, from the table of what the sensor reads of a disc."""

    model: SensorModel
    table: DiscTable

    def outlook(
        self, theta: FloatArray, weight: FloatArray, designs: Designs, plan: Plan, rows: IntArray, noise_sd: float
    ) -> Outlook:
        """See `Forecast.outlook`."""
        levels = spread_levels(self.table.dark, self.table.bright, noise_sd / _PER_SD_OF_MANY)
        turns = plan.orientation_rad.reshape(-1, designs.grid.n_places)
        return _DiscOutlook(self.table, theta, designs.grid, turns, rows, levels)


@dataclass(frozen=True, eq=False)
class _DiscOutlook:
    table: DiscTable
    theta: FloatArray
    grid: Grid
    turns_rad: FloatArray
    rows: IntArray
    levels: FloatArray

    def mass(self, weight: FloatArray) -> FloatArray:
        """See `Outlook.mass`: one map for each way that the sensor stands; the table knows no other setting."""
        some = weight > 0
        maps: dict[bytes, FloatArray] = {}
        for turn in self.turns_rad:
            if turn.tobytes() not in maps:
                maps[turn.tobytes()] = self.table.mass(self.theta[some], weight[some], self.grid, self.levels, turn)
        every = [maps[turn.tobytes()] for turn in self.turns_rad]
        whole = every[0] if len(every) == 1 else np.concatenate(every)
        return whole if len(self.rows) == len(whole) else whole[self.rows]


@dataclass(frozen=True, eq=False)
class AskedForecast:
    """Any model: at most 400 hypotheses, taken evenly by their weight, asked at every design."""

    model: SensorModel

    def outlook(
        self, theta: FloatArray, weight: FloatArray, designs: Designs, plan: Plan, rows: IntArray, noise_sd: float
    ) -> Outlook:
        """See `Forecast.outlook`."""
        asked, share = thinned(weight, _MOST_ASKED)
        answers = predicted(self.model, theta[asked], plan.take(rows))
        levels = spread_levels(float(answers.min()), float(answers.max()), noise_sd / _PER_SD_OF_FEW)
        per_level = 1.0 / (levels[1] - levels[0])
        index = np.rint((answers - levels[0]) * per_level).astype(np.int32)
        return _AskedOutlook(asked, share / weight[asked], index, levels)


@dataclass(frozen=True, eq=False)
class _AskedOutlook:
    asked: IntArray
    stands_for: FloatArray
    index: IntArray
    levels: FloatArray

    def mass(self, weight: FloatArray) -> FloatArray:
        """See `Outlook.mass`."""
        n_designs, n_levels = self.index.shape[1], len(self.levels)
        key = self.index + np.arange(n_designs) * n_levels
        own = np.repeat(weight[self.asked] * self.stands_for, n_designs)
        counted = np.bincount(key.ravel(), own, minlength=n_designs * n_levels)
        return np.asarray(counted.reshape(n_designs, n_levels), dtype=np.float64)


def forecast_of(model: SensorModel) -> Forecast:
    """Choose the way that a model allows: the table where it can be made."""
    table = DiscTable.of(model)
    return AskedForecast(model) if table is None else DiscForecast(table if table.margin_mm else model, table)


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


def spread_levels(low: float, high: float, spacing: float) -> FloatArray:
    """Even levels from one reading to another, no further apart than `spacing`."""
    low, high = min(low, high), max(low, high)
    return np.linspace(low, max(high, low + spacing), max(2, int(np.ceil((high - low) / spacing)) + 1))


def thinned(weight: FloatArray, n: int) -> tuple[IntArray, FloatArray]:
    """Rows of at most `n` hypotheses and what each stands for: systematic resampling without its random start."""
    some = np.flatnonzero(weight > 0)
    if len(some) <= n:
        return some, weight[some]
    ladder = np.cumsum(weight)
    rows = np.searchsorted(ladder, (np.arange(n) + 0.5) / n * ladder[-1])
    rows, count = np.unique(np.minimum(rows, len(weight) - 1), return_counts=True)
    return rows, count * (ladder[-1] / n)
