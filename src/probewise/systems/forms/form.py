"""A form: a generic effect that a simulator may leave out, bound to one target."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects import name_of_first_copy
from probewise.effects.effect import (
    ChangePoints,
    NamedEffect,
    VariantMasks,
    sine_and_cosine_entries,
    starting_point_of_wave,
)
from probewise.effects.priors import HeavyTailedPrior, SharedScalePrior
from probewise.priors import Marginal, Product, Uniform
from probewise.sensor import Stage
from probewise.systems.law_inputs import BetweenRows
from probewise.systems.table import RunTable

AMPLITUDE, POSITIVE = HeavyTailedPrior(1.0), HeavyTailedPrior(1.0, positive=True)
"""Priors of amplitudes of a form before `ReferenceFit.scaled` finds their typical size: of either sign, or positive."""

_FLAG_WIDTH = 1e-9  # of its prior

Act = Callable[[Any, FloatArray, RunTable], Any]
"""Function of the stage's value, parameters (n_samples, n_params) and the table; returns the value with the effect."""

ActBetween = Callable[[BetweenRows, FloatArray], BetweenRows]
"""Function of what other effects do between the rows and parameters (n_samples, n_params); adds the effect's."""

Say = Callable[[FloatArray, FloatArray], str]
"""Function of the parameters' mean and sd, (n_params,) each; returns a sentence."""


@dataclass(frozen=True)
class ActInTime:
    """An act `at_rows` of an effect that acts otherwise between the rows of a law than the law's `hold` says."""

    at_rows: Act
    between_rows: ActBetween

    def __call__(self, value: Any, theta: FloatArray, table: RunTable) -> Any:
        """Return the stage's value at the rows with the effect."""
        return self.at_rows(value, theta, table)


@dataclass(frozen=True)
class Fixed(Uniform):
    """Prior of a parameter that a variant of a form fixes, to within rounding; reports leave it out.

    `odds` are the prior odds of that variant against the first.
    """

    odds: float = 1.0


def flag(on: bool, odds: float = 1.0) -> tuple[float, Fixed]:
    """Return the value of a parameter that distinguishes two variants of a form, 0 or 1 to 1e-9, and its prior."""
    value = 1.0 - 0.5 * _FLAG_WIDTH if on else 0.5 * _FLAG_WIDTH
    return value, Fixed(value - 0.5 * _FLAG_WIDTH, value + 0.5 * _FLAG_WIDTH, odds)


@dataclass(frozen=True, eq=False)
class Form(NamedEffect[Any]):
    """A form bound to its target.

    Parameters
    ----------
    name
        `name` or `name:target`.
    stage
        Stage of the chain at which it acts.
    parameters
        Prior of each parameter, by name; or of all together, where they are about as large as each other.
    units
        Unit of each parameter.
    covariates
        Names of the covariates along which the residual shows if the effect is left out.
    act
        Function of the stage's value, parameters (n_samples, n_params) and table; returns the value with the effect.
    entries
        Template bank: trial settings, (n_entries, n_columns, n_params).
    says
        Function that describes it in a sentence.
    amplitudes
        Indices of the parameters that are amplitudes.
    absent
        Parameter values, by index, at which it has no effect, if these are not zero amplitudes.
    alternatives
        Mutually exclusive variants of this form, with other priors and entries; this form itself is another variant.
    counted_from
        From where it counts a time or a column, in words; "" for 0, or if it does not count.
    expression
        Formula of a proposal, which has no name in the vocabulary; otherwise empty.
    needs_rising_time
        Whether it looks back to earlier times of a run, which time must then not fall within.
    """

    name: str
    stage: Stage
    parameters: Mapping[str, Marginal] | SharedScalePrior
    units: tuple[str, ...]
    covariates: tuple[str, ...]
    act: Act
    entries: FloatArray
    says: Say
    amplitudes: tuple[int, ...] = (0,)
    absent: Mapping[int, float] = field(default_factory=dict)
    alternatives: tuple[Form, ...] = ()
    counted_from: str = ""
    expression: str = ""
    needs_rising_time: bool = False

    @cached_property
    def prior(self) -> Product | SharedScalePrior:
        """Prior of its parameters."""
        return self.parameters if isinstance(self.parameters, SharedScalePrior) else Product(self.parameters)

    @property
    def nothing(self) -> Mapping[int, float] | None:
        """Parameter values, by index, at which it has no effect: `absent`, else all amplitudes 0; else None."""
        return dict(self.absent) or dict.fromkeys(self.amplitudes, 0.0) or None

    @property
    def fixed(self) -> tuple[str, ...]:
        """Names of the parameters that this one of several variants fixes; reports leave them out."""
        return tuple(name for name, prior in self.marginals.items() if isinstance(prior, Fixed))

    @property
    def relative_odds(self) -> float:
        """Prior odds of this one of several variants against the first."""
        return math.prod((prior.odds for prior in self.marginals.values() if isinstance(prior, Fixed)), start=1.0)

    @property
    def marginals(self) -> Mapping[str, Marginal]:
        """Prior of each parameter, by name; none of values with one scale in common."""
        return {} if isinstance(self.parameters, SharedScalePrior) else self.parameters

    @property
    def between_rows(self) -> ActBetween | None:
        """What it does between the rows of a law, if that is not what the law's `hold` makes of its act at the rows."""
        return self.act.between_rows if isinstance(self.act, ActInTime) else None

    def apply(self, value: Any, theta: FloatArray, plan: Any) -> Any:
        """Return the value of its stage with the effect applied, with parameters theta (n_samples, n_params)."""
        return self.act(value, theta, plan)

    def bank(self) -> FloatArray:
        """Return the template bank: trial settings, (n_entries, n_columns, n_params)."""
        return self.entries

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Describe the effect in plain words, given the parameters' mean and sd, (n_params,) each."""
        return self.says(mean, sd)

    @property
    def n_peaks(self) -> int:
        """Number of equivalent posterior modes within the prior.

        A phase spans two turns, which doubles it; a wave's second copy, or a second time constant, may be exchanged
        with the first.
        """
        exchangeable = name_of_first_copy(self.name) is not None or "tau2" in self.prior.names
        return (2 if exchangeable else 1) * (2 if "phase" in self.prior.names else 1)

    def variants(self) -> tuple[Form, ...]:
        """Return itself and its alternatives: the same objects at each call, so that two fits have equal effects."""
        return self._variants

    @cached_property
    def _variants(self) -> tuple[Form, ...]:
        return (replace(self, alternatives=()), *self.alternatives) if self.alternatives else (self,)


@dataclass(frozen=True, eq=False, kw_only=True)
class StepForm(Form):
    """A form with a change point, its last parameter: a variant for each interval in which that may lie."""

    change_points: ChangePoints

    @property
    def has_change_point(self) -> bool:
        """True: its variants are the intervals of a change point."""
        return True

    @cached_property
    def _variants(self) -> tuple[Form, ...]:
        out = []
        for low, high in pairwise(self.change_points.at):
            entries = self.entries.copy()
            entries[:, :, -1] = 0.5 * (low + high)
            priors = {**self.marginals, list(self.marginals)[-1]: Uniform(low, high)}
            out.append(replace(self, parameters=priors, entries=entries))
        return tuple(out)

    def with_fewer_variants(self) -> Self:
        """Return the form with its change points thinned to at most 48 intervals."""
        return replace(self, change_points=self.change_points.fewer())

    def variant_masks(self, plan: Any) -> VariantMasks | None:
        """Return the masks of the rows after each candidate change point; None where a law goes on from there.

        What is added to readings, or to their gain, is nothing before it and the same everywhere after it.
        """
        return self.change_points.masks(self.entries[0], plan) if self.stage in (Stage.OFFSET, Stage.GAIN) else None

    def redraw_by_variant(self, theta: FloatArray, weights: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Redraw theta's last column, the change point: an interval by `weights`, (n_variants,), uniform within it."""
        return self.change_points.redrawn(theta, weights, rng=rng)


@dataclass(frozen=True, eq=False, kw_only=True)
class WaveForm(Form):
    """A wave: its entries are a sine and a cosine each, its amplitude is the first parameter, its phase the last.

    The readings suggest further frequencies, `suggested` (n_suggested,): refits may start there. A test of the readings
    leaves them out, for other readings would have suggested others.
    """

    suggested: FloatArray = field(default_factory=lambda: np.zeros(0))

    def bank(self) -> FloatArray:
        """Return the template bank, (n_entries, 2, n_params), suggested frequencies last."""
        if not self.suggested.size:
            return self.entries
        return np.concatenate([self.entries, sine_and_cosine_entries(self.entries[0, 0, 0], self.suggested)])

    def start(self, entry: FloatArray, amounts: FloatArray) -> FloatArray:
        """Return the wave that is the sum of an entry's sine and cosine, in their fitted amounts, (n_params,)."""
        return starting_point_of_wave(entry, amounts)

    def with_fewer_variants(self) -> Self:
        """Return the form without suggested frequencies."""
        return self._without_suggested if self.suggested.size else self

    @cached_property
    def _without_suggested(self) -> Self:
        return replace(self, suggested=np.zeros(0))


def period_with_sd(frequency: float, sd: float, time_unit: str) -> str:
    """Return the period of a frequency, per `time_unit`, with its sd to first order, as `value_with_sd` does."""
    return value_with_sd(1 / frequency, sd / frequency**2, time_unit)
