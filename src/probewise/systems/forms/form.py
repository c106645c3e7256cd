"""A form: a generic effect that a simulator may leave out, bound to one target."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects import name_of_first_copy
from probewise.effects.effect import VariantMasks
from probewise.effects.priors import SharedScalePrior
from probewise.priors import Product, Uniform
from probewise.sensor import Stage
from probewise.systems.law_inputs import BetweenRows
from probewise.systems.table import RunTable

_FLAG_WIDTH = 1e-9  # of its prior
_FEW = 48  # positions of a change point that are enough to detect one

Act = Callable[[Any, FloatArray, RunTable], Any]
"""Function of the stage's value, parameters (n_samples, n_params) and the table; returns the value with the effect."""

ActBetween = Callable[[BetweenRows, FloatArray], BetweenRows]
"""Function of what other effects do between the rows and parameters (n_samples, n_params); adds the effect's."""


@dataclass(frozen=True)
class ActInTime:
    """An act `at_rows` of an effect that acts otherwise between the rows of a law than the law's `hold` says."""

    at_rows: Act
    between_rows: ActBetween

    def __call__(self, value: Any, theta: FloatArray, table: RunTable) -> Any:
        """Return the stage's value at the rows with the effect."""
        return self.at_rows(value, theta, table)


Say = Callable[[FloatArray, FloatArray], str]
"""Function of the parameters' mean and sd, (n_params,) each; returns a sentence."""


@dataclass(frozen=True)
class ChangePoints:
    """Candidate positions of a change point (times, row numbers or values of a column), a form's last parameter.

    `gated`: the form has no effect before the change point and the same effect everywhere after it, so that one
    prediction serves all change points.
    """

    at: tuple[float, ...]
    by_row: bool
    gated: bool
    column: str = ""

    def variable_at_rows(self, table: RunTable) -> FloatArray:
        """Return the column, row number or time that is compared with the change point, (n_points,)."""
        if self.column:
            return table.covariates[self.column]
        return table.row_number if self.by_row else table.time_s

    def thinned(self) -> ChangePoints:
        """Return change points at a subset of the positions, at most 48 intervals, enough to detect a change."""
        stride = -(-(len(self.at) - 1) // _FEW)
        return replace(self, at=(*self.at[:-1:stride], self.at[-1]))


@dataclass(frozen=True, eq=False)
class Form:
    """A form bound to its target.

    Parameters
    ----------
    name
        `name` or `name:target`.
    stage
        Stage of the chain at which it acts.
    marginals
        Prior of each parameter, by name.
    units
        Unit of each parameter.
    covariates
        Names of the covariates along which the residual shows if the effect is left out.
    act
        Function of the stage's value, parameters (n_samples, n_params) and table; returns the value with the effect.
    entries
        Template bank: trial settings, (n_entries, n_columns, n_params).
    amplitudes
        Indices of the parameters that are amplitudes.
    says
        Function that describes it in a sentence.
    absent
        Parameter values, by index, at which it has no effect, if these are not zero amplitudes.
    change_points
        Candidate positions of its change point, if it has one.
    joined
        Converts an entry and the fitted amounts of its columns to a setting, if amplitudes do not scale independently.
    expression
        Formula of a proposal, which has no name in the vocabulary; otherwise empty.
    alternatives
        Mutually exclusive variants of this form, with other priors and entries; this form itself is another variant.
    fixed
        Names of parameters that are zero in this one of several alternatives; reports leave them out.
    needs_rising_time
        Whether it looks back to earlier times of a run, which time must then not fall within.
    counted_from
        From where it counts a time or a column, in words; "" for 0, or if it does not count.
    suggested
        Further trial settings, as `entries`, that the readings suggest: refits may start there. A test of the readings
        leaves them out, for other readings would have suggested others.
    shared_scale
        Whether its parameters, all with the same prior, are about as large as each other: see `SharedScalePrior`.
    exchangeable
        Whether it is the sum of two terms of the same kind and priors, so that each mode is there twice.
    relative_odds
        Prior odds of this one of several alternatives against the first.
    """

    name: str
    stage: Stage
    marginals: Mapping[str, Any]
    units: tuple[str, ...]
    covariates: tuple[str, ...]
    act: Act
    entries: FloatArray
    amplitudes: tuple[int, ...]
    says: Say
    absent: Mapping[int, float] = field(default_factory=dict)
    change_points: ChangePoints | None = None
    joined: Callable[[FloatArray, FloatArray], FloatArray] | None = None
    expression: str = ""
    alternatives: tuple[Form, ...] = ()
    fixed: tuple[str, ...] = ()
    needs_rising_time: bool = False
    counted_from: str = ""
    suggested: FloatArray | None = None
    shared_scale: bool = False
    exchangeable: bool = False
    relative_odds: float = 1.0

    @cached_property
    def prior(self) -> Product | SharedScalePrior:
        """Prior of its parameters."""
        if self.shared_scale:
            return SharedScalePrior(tuple(self.marginals), next(iter(self.marginals.values())))
        return Product(self.marginals)

    @property
    def nothing(self) -> Mapping[int, float] | None:
        """Parameter values, by index, at which it has no effect: `absent`, else all amplitudes 0; else None."""
        return dict(self.absent) or dict.fromkeys(self.amplitudes, 0.0) or None

    @property
    def between_rows(self) -> ActBetween | None:
        """What it does between the rows of a law, if that is not what the law's `hold` makes of its act at the rows."""
        return self.act.between_rows if isinstance(self.act, ActInTime) else None

    def apply(self, value: Any, theta: FloatArray, plan: Any) -> Any:
        """Return the value of its stage with the effect applied, with parameters theta (n_samples, n_params)."""
        return self.act(value, theta, plan)

    def bank(self) -> FloatArray:
        """Return the template bank: trial settings, (n_entries, n_columns, n_params), suggested ones last."""
        return self.entries if self.suggested is None else np.concatenate([self.entries, self.suggested])

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Describe the effect in plain words, given the parameters' mean and sd, (n_params,) each."""
        return self.says(mean, sd)

    def start(self, entry: FloatArray, amounts: FloatArray) -> FloatArray:
        """Return the starting point of a refit, (n_params,), from a bank entry and its columns' fitted amounts."""
        if self.joined is not None:
            return self.joined(entry, amounts)
        setting = entry[0].copy()
        for k in self.amplitudes:
            setting[k] = amounts @ entry[:, k]
        return np.asarray(setting)

    @property
    def n_peaks(self) -> int:
        """Number of equivalent posterior modes within the prior.

        A phase spans two turns, which doubles it; a wave's second copy may be exchanged with the first.
        """
        if "phase" not in self.marginals:
            return 2 if self.exchangeable else 1
        return 2 if name_of_first_copy(self.name) is None else 4

    @property
    def scans(self) -> tuple[str, ...]:
        """Names of the runs to which it is restricted: always (), for it acts in all."""
        return ()

    @property
    def patterns(self) -> tuple[str, ...]:
        """Names of the patterns to which it is restricted: always (), for tables have none."""
        return ()

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of further columns that it needs: always ()."""
        return ()

    @property
    def has_change_point(self) -> bool:
        """Whether its variants are the intervals of a change point."""
        return self.change_points is not None

    def variants(self) -> tuple[Form, ...]:
        """Return itself and its alternatives, or one variant for each interval in which its change point may lie.

        They are the same objects at each call, so that two fits with the same variant have equal effects.
        """
        return self._variants

    @cached_property
    def _variants(self) -> tuple[Form, ...]:
        if self.change_points is None:
            return (replace(self, alternatives=()), *self.alternatives) if self.alternatives else (self,)
        last = list(self.marginals)[-1]
        out = []
        for low, high in pairwise(self.change_points.at):
            entries = self.entries.copy()
            entries[:, :, -1] = 0.5 * (low + high)
            out.append(replace(self, marginals={**self.marginals, last: Uniform(low, high)}, entries=entries))
        return tuple(out)

    def with_fewer_variants(self) -> Form:
        """Return the form with its change points thinned to at most 48 intervals, and without suggested settings."""
        if self.suggested is not None:
            return self._without_suggested
        return self if self.change_points is None else replace(self, change_points=self.change_points.thinned())

    @cached_property
    def _without_suggested(self) -> Form:
        return replace(self, suggested=None)

    def variant_masks(self, plan: Any) -> VariantMasks | None:
        """Return the masks of the rows after each candidate change point, (n_variants, n_points); None for other forms.

        With them is the bank entry that acts on all rows. Only a form without effect before the change point, and with
        the same effect everywhere after it, has them.
        """
        if self.change_points is None or not self.change_points.gated:
            return None
        always = self.entries[0].copy()
        always[:, -1] = -np.inf
        along = self.change_points.variable_at_rows(plan)
        return VariantMasks(
            always, np.array([along > 0.5 * (low + high) for low, high in pairwise(self.change_points.at)])
        )

    def redraw_by_variant(self, theta: FloatArray, weights: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Redraw theta's last column, the change point: an interval by `weights`, (n_variants,), uniform within it."""
        if self.change_points is None:
            return theta
        at = np.array(self.change_points.at)
        chosen = rng.choice(len(weights), len(theta), p=weights)
        drawn = at[chosen] + np.diff(at)[chosen] * rng.random(len(theta))
        return np.concatenate([theta[:, :-1], drawn[:, None]], axis=1)


def flag_with_prior(on: bool) -> tuple[float, Uniform]:
    """Return the value of a parameter that tells two variants of a form apart, 0 or 1 to 1e-9, and its prior."""
    value = 1.0 - 0.5 * _FLAG_WIDTH if on else 0.5 * _FLAG_WIDTH
    return value, Uniform(value - 0.5 * _FLAG_WIDTH, value + 0.5 * _FLAG_WIDTH)


def period_with_sd(frequency: float, sd: float, time_unit: str) -> str:
    """Return the period of a frequency, per `time_unit`, with its sd to first order, as `value_with_sd` does."""
    return value_with_sd(1 / frequency, sd / frequency**2, time_unit)
