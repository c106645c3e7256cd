"""A form: physics that any simulator may leave out, bound to one target of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.vocabulary import Gates, give_or_take
from probewise.priors import Product, Uniform
from probewise.sensor import Stage
from probewise.systems.table import RunTable

__all__ = ["Act", "Form", "Moments", "Say", "with_unit"]

Act = Callable[[Any, FloatArray, RunTable], Any]
"""The value of a stage, parameters (n_samples, n_params) and the table to the value with the effect."""

Say = Callable[[FloatArray, FloatArray], str]
"""Mean and sd of the parameters, (n_params,) both, to a sentence."""


@dataclass(frozen=True)
class Moments:
    """Times, row numbers, or values of a column, between which a change point lies; a form's last parameter is one.

    `gated` says that the form does nothing before the change point and the same as everywhere after it, so that one
    prediction does for all of them.
    """

    at: tuple[float, ...]
    by_row: bool
    gated: bool
    few: int = 48
    column: str = ""

    def along(self, table: RunTable) -> FloatArray:
        """Give what the change point is compared with, (n_points,)."""
        if self.column:
            return table.covariates[self.column]
        return np.arange(float(len(table))) if self.by_row else table.time_s

    def thinned(self) -> Moments:
        """Leave enough to see that something changed at one of them."""
        stride = -(-(len(self.at) - 1) // self.few)
        return replace(self, at=(*self.at[:-1:stride], self.at[-1]))


@dataclass(frozen=True, eq=False)
class Form:
    """One effect of the vocabulary of forms, bound to its target.

    Parameters
    ----------
    name
        `name` or `name:target`.
    stage
        Where in the chain it acts.
    marginals
        Prior of each parameter.
    units
        Unit of each parameter.
    covariates
        Along which its residual shows.
    act
        What it does.
    entries
        Settings to look for it with, (n_entries, n_columns, n_params).
    amplitudes
        Which parameters are amplitudes.
    says
        The sentence.
    absent
        Values of parameters at which it does nothing, where no amplitude says so.
    moments
        Where it has a change point.
    joined
        Turns an entry and its columns' amounts into a setting, where amplitudes do not scale one by one.
    expression
        The formula of a proposal, which has no name in the vocabulary; empty for every other form.
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
    moments: Moments | None = None
    joined: Callable[[FloatArray, FloatArray], FloatArray] | None = None
    expression: str = ""

    @cached_property
    def prior(self) -> Product:
        """Prior of its parameters."""
        return Product(self.marginals)

    @property
    def nothing(self) -> Mapping[int, float] | None:
        """Values at which it does nothing: all amplitudes 0, or those given."""
        return dict(self.absent) or dict.fromkeys(self.amplitudes, 0.0) or None

    def apply(self, value: Any, theta: FloatArray, plan: Any) -> Any:
        """Act with parameters theta (n_samples, n_params)."""
        return self.act(value, theta, plan)

    def bank(self) -> FloatArray:
        """Lay out settings to look for it with, (n_entries, n_columns, n_params)."""
        return self.entries

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say in plain words what it does, with its numbers, each of shape (n_params,)."""
        return self.says(mean, sd)

    def start(self, entry: FloatArray, amounts: FloatArray) -> FloatArray:
        """Turn an entry and its columns' fitted amounts into a setting."""
        if self.joined is not None:
            return self.joined(entry, amounts)
        setting = entry[0].copy()
        for k in self.amplitudes:
            setting[k] = amounts @ entry[:, k]
        return np.asarray(setting)

    @property
    def n_peaks(self) -> int:
        """Phases have two turns, so that each wave is there twice."""
        return 2 if self.joined is not None else 1

    @property
    def scans(self) -> tuple[str, ...]:
        """It acts in all runs."""
        return ()

    @property
    def patterns(self) -> tuple[str, ...]:
        """It knows no patterns."""
        return ()

    @property
    def reads(self) -> tuple[str, ...]:
        """Nothing that has to be named."""
        return ()

    def variants(self) -> tuple[Form, ...]:
        """Choose the two readings between which the change point lies."""
        if self.moments is None:
            return (self,)
        last = list(self.marginals)[-1]
        out = []
        for low, high in pairwise(self.moments.at):
            entries = self.entries.copy()
            entries[:, :, -1] = 0.5 * (low + high)
            out.append(replace(self, marginals={**self.marginals, last: Uniform(low, high)}, entries=entries))
        return tuple(out)

    def coarse(self) -> Form:
        """Look between fewer readings."""
        return self if self.moments is None else replace(self, moments=self.moments.thinned())

    def gates(self, plan: Any) -> Gates | None:
        """Act everywhere, and after the middle of each interval."""
        if self.moments is None or not self.moments.gated:
            return None
        always = self.entries[0].copy()
        always[:, -1] = -np.inf
        along = self.moments.along(plan)
        return Gates(always, np.array([along > 0.5 * (low + high) for low, high in pairwise(self.moments.at)]))

    def spread(self, theta: FloatArray, weights: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Draw the change point from all intervals by their weight."""
        if self.moments is None:
            return theta
        at = np.array(self.moments.at)
        chosen = rng.choice(len(weights), len(theta), p=weights)
        drawn = at[chosen] + np.diff(at)[chosen] * rng.random(len(theta))
        return np.concatenate([theta[:, :-1], drawn[:, None]], axis=1)


def with_unit(mean: float, sd: float, unit: str) -> str:
    """Write mean ± sd and a unit, as many digits as the sd deserves."""
    digits = give_or_take(mean, sd) if sd > 1e-7 else f"{mean:.3g} ± {sd:.1g}"
    return f"{digits} {unit}" if unit not in ("", "1") else digits
