"""What a problem is, and what is kept of a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray

__all__ = ["Engine", "Found", "Instrument", "Problem", "found_by_particles"]

Instrument = Callable[[float], float]


@dataclass(frozen=True, eq=False)
class Found:
    """How a run ended: readings; mean, sd and central 95 % interval of each parameter that has a goal."""

    n_readings: int
    mean: FloatArray
    sd: FloatArray
    low: FloatArray
    high: FloatArray


Engine = Callable[[Instrument, np.random.Generator], Found]


@dataclass(frozen=True, eq=False)
class Problem:
    """A problem, and the engines that solve it.

    Parameters
    ----------
    engines
        By name, ours first: each finds what has a goal with an instrument, and draws from a generator.
    draw
        Draws the true parameters.
    read
        Gives a reading of these parameters at a setting.
    goals
        The sd that ends a run, by parameter; the parameters that have one come first in every engine's order.
    most_readings
        A run ends there, too, and counts as so many.
    """

    engines: Mapping[str, Engine]
    draw: Callable[[np.random.Generator], Mapping[str, float]]
    read: Callable[[Mapping[str, float], float, np.random.Generator], float]
    goals: Mapping[str, float]
    most_readings: int


def found_by_particles(n_readings: int, values: FloatArray, weight: FloatArray) -> Found:
    """Summarise weighted particles, (n_parameters, n_particles)."""
    mean = values @ weight
    sd = np.sqrt(np.maximum((values - mean[:, None]) ** 2 @ weight, 0.0))
    low, high = np.empty(len(values)), np.empty(len(values))
    for k, row in enumerate(values):
        order = np.argsort(row)
        ladder = np.cumsum(weight[order])
        at = np.searchsorted(ladder / ladder[-1], [0.025, 0.975])
        low[k], high[k] = row[order][at]
    return Found(n_readings, mean, sd, low, high)
