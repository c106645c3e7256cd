"""Templates of the effects that could be added to a fit.

A template is a set of columns (n_usable, k), changes of the readings at given settings of an effect, which span its
change to first order; its nonlinear parameters are fixed.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.evidence.bank import TemplateBank
from probewise.diagnosis.fitting.coordinates import effect_values
from probewise.diagnosis.fitting.fit import Fit
from probewise.effects import NamedEffect, scan_indicator
from probewise.sensor import Stage

_RUNS_AWAY = 1e9  # times the largest prediction: such a model has diverged, and its derivative is meaningless
_ROUNDING = 1e-9  # of the largest prediction: a smaller change counts as none if it is insignificant,
_LAST_DIGITS = 1e-12  # or, whatever the noise, no larger than rounding of predictions that are smooth to this share
_INSIGNIFICANT = 0.01  # noise sds; readings by the epoch vary by less than `_ROUNDING`
_AT_ONCE = 300_000  # predictions per batch, to fit a processor's cache


@dataclass(frozen=True, eq=False)
class EffectTemplates:
    """An effect's template bank about a fit: columns, setting and variant of each entry.

    Variants are the discrete choices of an effect, such as which scans it acts on; `choice` numbers them by entry.
    """

    columns: tuple[FloatArray, ...]  # each (n_usable, n_columns)
    settings: tuple[FloatArray, ...]  # each (n_columns, n_params)
    variants: tuple[NamedEffect[Any], ...]
    choice: IntArray  # number of each entry's variant, (n_entries,)

    def variant_of_entry(self, at: int) -> NamedEffect[Any]:
        """Return the variant (discrete choice, such as of scans) of entry number `at`."""
        variant: NamedEffect[Any] = self.variants[self.choice[at]]
        return variant

    @cached_property
    def variant_odds(self) -> FloatArray:
        """Prior odds of each variant against the first, (n_variants,)."""
        return np.array([variant.relative_odds for variant in self.variants])

    def variant_probabilities(self, scores: FloatArray) -> FloatArray:
        """Return the posterior probability of each variant, (n_variants,), from log Bayes factors (n_entries,)."""
        shares = np.bincount(self.choice, np.exp(scores - scores.max()), len(self.variants)) * self.variant_odds
        return np.asarray(shares / shares.sum())


@dataclass(eq=False)
class TemplateCache:
    """Cache of the templates of effects about fits, on the rows `usable`."""

    usable: IntArray
    known: dict[tuple[Fit, NamedEffect[Any]], EffectTemplates] = field(default_factory=dict)
    banks: dict[tuple[Fit, tuple[str, ...]], TemplateBank] = field(default_factory=dict)

    def coarse_bank(self, found: Fit, effects: Sequence[NamedEffect[Any]]) -> TemplateBank:
        """Return one bank of the templates of several effects about a fit, of fewer variants, labelled by name."""
        key = found, tuple(effect.name for effect in effects)
        if key not in self.banks:
            own = [
                (effect.name, t)
                for effect in effects
                for t in self.templates_of(found, effect.with_fewer_variants()).columns
            ]
            self.banks[key] = TemplateBank.of([t for _, t in own], [name for name, _ in own], len(found.residuals))
        return self.banks[key]

    def templates_of(self, found: Fit, effect: NamedEffect[Any]) -> EffectTemplates:
        """Return the templates of one effect about one fit."""
        key = found, effect
        if key not in self.known:
            self.known[key] = templates_of_effect(found, effect, self.usable)
        return self.known[key]


def templates_of_effect(
    found: Fit, effect: NamedEffect[Any], usable: IntArray, *, most: int | None = None
) -> EffectTemplates:
    """Predict the change of the readings by each bank entry of all variants of an effect, about a fit.

    Variants are its discrete choices, such as of scans. With `most`, so many entries are predicted, evenly spread.
    """
    variants = effect.variants()
    banks = [variant.bank() for variant in variants]
    choice = np.repeat(np.arange(len(variants)), [len(bank) for bank in banks])
    entries = np.concatenate(banks)
    if most is not None and most < len(entries):
        kept = np.linspace(0, len(entries) - 1, most).round().astype(np.int64)
        choice, entries = choice[kept], entries[kept]
    gates = effect.variant_masks(found.model.plan)
    if gates is not None:
        (everywhere,) = _predicted_changes(found, effect, gates.always[None, :, :], usable)
        columns = [everywhere * gates.opened[k][usable, None] for k in choice]
    else:
        # Variants bound to the same scans and patterns differ only in their priors and share one prediction.
        columns = []
        for _, group in itertools.groupby(
            range(len(choice)), key=lambda at: _scans_and_patterns_of(variants[choice[at]])
        ):
            at = list(group)
            columns += _predicted_changes(found, variants[choice[at[0]]], entries[at], usable)
    return EffectTemplates(tuple(columns), tuple(entries), variants, choice)


def _scans_and_patterns_of(variant: NamedEffect[Any]) -> tuple[object, object]:
    return variant.scans, variant.patterns


def _predicted_changes(found: Fit, effect: NamedEffect[Any], bank: FloatArray, usable: IntArray) -> list[FloatArray]:
    """Return the change of the readings by each entry of a bank, (n_usable, n_columns), 0 outside the effect's scans.

    A column is 0 too if the model with the effect diverges, or the change is no more than rounding.
    """
    plain, plan = found.model, found.model.plan
    model = plain.with_effect(effect)
    n_rows = bank.shape[0] * bank.shape[1]
    own = {e.name: effect_values(e, found.z[None, plain.coordinate_slice(e.name)]) for e in plain.effects}
    sensor = plain.sensor.theta(found.z[None, : plain.sensor.n_params])
    inside = np.flatnonzero(scan_indicator(plan, effect.scans)) if effect.scans else np.arange(len(plan))
    there = plan.take(inside) if effect.scans else plan
    kept = np.isin(usable, inside, assume_unique=True)
    at = np.searchsorted(inside, usable[kept])
    # Effects after the light integral reuse it.
    seen = None if effect.stage < Stage.SEEN else plain.chain.simulated_view(plain.joined_theta(sensor, own), there)
    change = np.zeros((n_rows, len(usable)))  # of all rows of a long plan it may be gigabytes
    step = max(_AT_ONCE // len(there), 1)
    for first in range(0, n_rows, step):
        rows = slice(first, min(first + step, n_rows))
        n = rows.stop - first
        each = {name: np.repeat(values, n, axis=0) for name, values in own.items()}
        each[effect.name] = bank.reshape(n_rows, -1)[rows]
        theta = model.joined_theta(np.repeat(sensor, n, axis=0), each)
        read = (
            model.chain.predict(theta, there)
            if seen is None
            else model.chain.readings_from_simulated_view(seen, theta, there)
        )
        change[rows, kept] = read[:, at] - found.predicted[kept]
    columns = change.T
    largest = np.abs(found.predicted).max(initial=0.0)
    columns[:, ~(np.abs(columns).max(axis=0) < _RUNS_AWAY * (1 + largest))] = 0.0  # NaN too
    none = min(_ROUNDING * largest, max(_INSIGNIFICANT * found.sd, _LAST_DIGITS * largest))
    columns[:, np.abs(columns).max(axis=0) < none] = 0.0
    return np.split(columns, len(bank), axis=1)


def combinations_up_to(names: Sequence[str], most: int) -> Iterator[tuple[str, ...]]:
    """List every combination of up to `most` names, each sorted, the empty one first."""
    for size in range(most + 1):
        yield from itertools.combinations(sorted(names), size)
