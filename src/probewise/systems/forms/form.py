"""A form: a generic effect that a simulator may leave out, bound to one target."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any, Self, TypeAlias

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.effect import (
    Act,
    Effect,
    Fixed,
    Say,
    StepEffect,
    VariantMasks,
    WaveEffect,
    in_words,
    thinned,
)
from probewise.priors import HeavyTailedPrior, Uniform
from probewise.systems.law_inputs import BetweenRows
from probewise.systems.table import RunTable

AMPLITUDE, POSITIVE = HeavyTailedPrior(1.0), HeavyTailedPrior(1.0, positive=True)
"""Priors of amplitudes of a form before `ReferenceFit.scaled` finds their typical size: of either sign, or positive."""

_FLAG_WIDTH = 1e-9  # of its prior
_BLOCK_ENDS, _FEW_BLOCK_ENDS = 64, 12  # intervals of an end: all, and as many as detection needs
_BLOCKS = 0.1  # odds of a step that goes back: as those of a second wave

ActBetween = Callable[[BetweenRows, FloatArray], BetweenRows]
"""Function of what other effects do between the rows and parameters (n_samples, n_params); adds the effect's."""

Form: TypeAlias = Effect
"""An effect that is bound to a target of a simulator: its act takes the table of the runs."""

StepForm: TypeAlias = StepEffect
WaveForm: TypeAlias = WaveEffect

__all__ = [
    *("AMPLITUDE", "POSITIVE", "Act", "ActInTime", "BlockForm", "Fixed", "Form", "Say", "StepForm", "WaveForm"),
    "in_words",
]


@dataclass(frozen=True)
class ActInTime:
    """An act `at_rows` of an effect that acts otherwise between the rows of a law than the law's `hold` says."""

    at_rows: Act
    between_rows: ActBetween

    def __call__(self, value: Any, theta: FloatArray, table: RunTable) -> Any:
        """Return the stage's value at the rows with the effect."""
        return self.at_rows(value, theta, table)


@dataclass(frozen=True, eq=False, kw_only=True)
class BlockForm(StepForm):
    """A step that may go back: its last parameters are its end, of prior `never` where it stays, and its begin.

    In so many intervals, `most`, a block of rows may begin or end; all blocks have a tenth of the odds of all steps.
    """

    never: Fixed
    most: int = _BLOCK_ENDS

    @cached_property
    def _ends(self) -> list[tuple[tuple[float, float], tuple[float, float] | None]]:
        """Intervals of the begin and of the end, None for a step, of each variant."""
        thinner = replace(self.change_points, at=thinned(np.array(self.change_points.at), self.most))
        return [*((begin, None) for begin in self.change_points.intervals), *combinations(thinner.intervals, 2)]

    @property
    def places(self) -> Sequence[tuple[Uniform, ...]]:
        """The priors of end and begin in each variant."""
        n_steps = len(self.change_points.intervals)
        never = replace(self.never, odds=max(len(self._ends) - n_steps, 1) / (_BLOCKS * n_steps))
        return [(never if end is None else Uniform(*end), Uniform(*begin)) for begin, end in self._ends]

    def with_fewer_variants(self) -> Self:
        """Return the form with fewer begins and ends."""
        return replace(self, change_points=self.change_points.fewer(), most=_FEW_BLOCK_ENDS)

    def variant_masks(self, plan: Any) -> VariantMasks | None:
        """Return the masks of the rows from each begin to each end."""
        along, always = self.change_points.variable_at_rows(plan), self.entries[0].copy()
        always[:, 1:] = -np.inf
        between = [(sum(begin) / 2, np.inf if end is None else sum(end) / 2) for begin, end in self._ends]
        return VariantMasks(always, np.array([(along > begin) & (along < end) for begin, end in between]))

    def redraw_by_variant(self, theta: FloatArray, weights: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Redraw end and begin: a variant by `weights`, (n_variants,), each uniform within its interval."""
        low, high = np.array([[(prior.low, prior.high) for prior in last] for last in self.places]).transpose(2, 0, 1)
        chosen = rng.choice(len(weights), len(theta), p=weights)
        drawn = low[chosen] + (high - low)[chosen] * rng.random((len(theta), 3))[:, 1:]
        return np.concatenate([theta[:, :1], drawn], axis=1)


def says_of_limit(what: str, least_ceiling: float, unit: str = "") -> Say:
    """Return the sentence of a quantity with a level: a ceiling above `least_ceiling`, otherwise a floor."""
    ceiling, floor = (in_words(f"{what} {way} no further than {{0}}", unit) for way in ("rises", "falls"))
    return lambda mean, sd: (ceiling if mean[0] > least_ceiling else floor)(mean, sd)


def flag(on: bool, odds: float = 1.0) -> tuple[float, Fixed]:
    """Return the value of a parameter that distinguishes two variants of a form, 0 or 1 to 1e-9, and its prior."""
    value = 1.0 - 0.5 * _FLAG_WIDTH if on else 0.5 * _FLAG_WIDTH
    return value, Fixed(value - 0.5 * _FLAG_WIDTH, value + 0.5 * _FLAG_WIDTH, odds)


def period_with_sd(frequency: float, sd: float, time_unit: str) -> str:
    """Return the period of a frequency, per `time_unit`, with its sd to first order, as `value_with_sd` does."""
    return value_with_sd(1 / frequency, sd / frequency**2, time_unit)
