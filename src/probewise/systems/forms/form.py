"""A form: a generic effect that a simulator may leave out, bound to one target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.effect import Act, Effect, Fixed, Say, StepEffect, WaveEffect
from probewise.effects.priors import HeavyTailedPrior
from probewise.systems.law_inputs import BetweenRows
from probewise.systems.table import RunTable

AMPLITUDE, POSITIVE = HeavyTailedPrior(1.0), HeavyTailedPrior(1.0, positive=True)
"""Priors of amplitudes of a form before `ReferenceFit.scaled` finds their typical size: of either sign, or positive."""

_FLAG_WIDTH = 1e-9  # of its prior

ActBetween = Callable[[BetweenRows, FloatArray], BetweenRows]
"""Function of what other effects do between the rows and parameters (n_samples, n_params); adds the effect's."""

Form: TypeAlias = Effect
"""An effect that is bound to a target of a simulator: its act takes the table of the runs."""

StepForm: TypeAlias = StepEffect
WaveForm: TypeAlias = WaveEffect

__all__ = ["AMPLITUDE", "POSITIVE", "Act", "ActInTime", "Fixed", "Form", "Say", "StepForm", "WaveForm"]


@dataclass(frozen=True)
class ActInTime:
    """An act `at_rows` of an effect that acts otherwise between the rows of a law than the law's `hold` says."""

    at_rows: Act
    between_rows: ActBetween

    def __call__(self, value: Any, theta: FloatArray, table: RunTable) -> Any:
        """Return the stage's value at the rows with the effect."""
        return self.at_rows(value, theta, table)


def flag(on: bool, odds: float = 1.0) -> tuple[float, Fixed]:
    """Return the value of a parameter that distinguishes two variants of a form, 0 or 1 to 1e-9, and its prior."""
    value = 1.0 - 0.5 * _FLAG_WIDTH if on else 0.5 * _FLAG_WIDTH
    return value, Fixed(value - 0.5 * _FLAG_WIDTH, value + 0.5 * _FLAG_WIDTH, odds)


def period_with_sd(frequency: float, sd: float, time_unit: str) -> str:
    """Return the period of a frequency, per `time_unit`, with its sd to first order, as `value_with_sd` does."""
    return value_with_sd(1 / frequency, sd / frequency**2, time_unit)
