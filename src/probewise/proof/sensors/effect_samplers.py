"""Samplers of effects to conceal: all parameters are drawn except the amplitude."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from probewise.recordings.patterns import Uniform
from probewise.recordings.plan import Plan
from probewise.world.concealed import Concealed
from probewise.world.world import World

OfAmplitude: TypeAlias = Callable[[float], Concealed]
"""Amplitude (greater than 0) to effect."""


@dataclass(frozen=True, eq=False)
class CleanSetup:
    """A plan and a simulated sensor without effects, in which an effect will be concealed."""

    plan: Plan
    world: World

    @property
    def start_s(self) -> float:
        """Time of the first reading, s."""
        return float(self.plan.time_s[0])

    @property
    def duration_s(self) -> float:
        """Time from the first reading to the last, s."""
        return float(self.plan.time_s[-1] - self.plan.time_s[0])

    @property
    def nyquist_hz(self) -> float:
        """Half the median rate of the readings, Hz: the highest frequency that they determine."""
        return 0.5 / float(np.median(np.diff(self.plan.time_s)))

    @cached_property
    def edge_scan_names(self) -> tuple[str, ...]:
        """Names of the scans of 20 readings or more whose first reading is over a pattern that is not uniform."""
        return tuple(
            self.plan.scan_names[k]
            for k, rows in enumerate(self.plan.rows_by_scan())
            if rows.size >= 20
            and not isinstance(self.plan.patterns[self.plan.pattern_names[self.plan.pattern[rows[0]]]], Uniform)
        )

    def scans_at_orientation_of(self, scan: str) -> tuple[str, ...]:
        """Return the names of all scans, `scan` included, that start at the orientation of `scan`, in plan order."""
        first = {name: rows[0] for name, rows in zip(self.plan.scan_names, self.plan.rows_by_scan(), strict=True)}
        turn = self.plan.orientation_rad
        return tuple(name for name, row in first.items() if turn[row] == turn[first[scan]])


Draw: TypeAlias = Callable[[CleanSetup, np.random.Generator], OfAmplitude]
"""Draws all parameters of an effect except its amplitude."""


@dataclass(frozen=True)
class EffectSampler:
    """A distribution over one kind of effect, up to its amplitude.

    Parameters
    ----------
    residual_covariates
        Names of the covariates along which its residual is visible.
    draw
        Function of a setup and a generator that draws all parameters but the amplitude: returns amplitude -> effect.
    first
        First amplitude of the search for a size.
    limit
        Largest plausible amplitude.
    scalable
        Whether the search chooses the amplitude; if False, the amplitude is `first`.
    """

    residual_covariates: tuple[str, ...]
    draw: Draw
    first: float
    limit: float
    scalable: bool = True


def draw_sign(rng: np.random.Generator) -> float:
    """Draw +1.0 or -1.0, equally likely."""
    return float(rng.choice([-1.0, 1.0]))


def draw_log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number between `low` and `high` whose logarithm is uniform."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def make_draw_without_random_parameters(make: OfAmplitude) -> Draw:
    """Return `EffectSampler.draw` for an effect whose only parameter is its amplitude: nothing is drawn."""
    return lambda setup, rng: make


def make_draw_with_random_sign(make: OfAmplitude) -> Draw:
    """Return `EffectSampler.draw` for an effect of which only the sign of the amplitude is drawn."""

    def draw(setup: CleanSetup, rng: np.random.Generator) -> OfAmplitude:
        s = draw_sign(rng)
        return lambda a: make(s * a)

    return draw
