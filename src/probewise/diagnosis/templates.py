"""What could be added to a fit: the vocabulary's effects, and bases for what nobody has named.

A template is a set of columns (n_usable, k), the change of the readings that an amplitude of one makes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.coordinates import effect_values
from probewise.diagnosis.covariates import Covariate
from probewise.diagnosis.fit import Fit
from probewise.effects import NamedEffect, in_scans
from probewise.sensor import Stage

__all__ = ["EffectTemplates", "TemplateMemory", "UnknownTemplates", "effect_templates", "unknown_templates"]


@dataclass(frozen=True, eq=False)
class EffectTemplates:
    """An effect's bank about a fit, all its variants': for each entry its columns, the setting and the variant."""

    columns: tuple[FloatArray, ...]  # each (n_usable, n_columns)
    settings: tuple[FloatArray, ...]  # each (n_columns, n_params)
    variants: tuple[NamedEffect[Any], ...]
    choice: IntArray  # number of each entry's variant, (n_entries,)

    def variant(self, at: int) -> NamedEffect[Any]:
        """Give the variant of one entry."""
        variant: NamedEffect[Any] = self.variants[self.choice[at]]
        return variant

    def log_share(self, at: int, scores: FloatArray) -> float:
        """Weigh the variant of entry `at`: log of its prior probability over its posterior one.

        `scores` are the entries' log Bayes factors, (n_entries,). Added to the log evidence of that
        variant alone it gives that of the effect, the choice among its variants summed out.
        """
        return -float(np.log(self.weights(scores)[self.choice[at]])) - math.log(len(self.variants))

    def weights(self, scores: FloatArray) -> FloatArray:
        """Posterior probability of each variant, (n_variants,), by the log Bayes factors of the entries."""
        shares = np.bincount(self.choice, np.exp(scores - scores.max()), len(self.variants))
        return np.asarray(shares / shares.sum())


@dataclass(frozen=True, eq=False)
class UnknownTemplates:
    """Bases by covariate: what a mismatch outside the vocabulary may look like."""

    columns: tuple[FloatArray, ...]
    families: tuple[str, ...]  # the covariate of each


@dataclass(eq=False)
class TemplateMemory:
    """The templates of effects about fits, each laid out once."""

    usable: IntArray
    known: dict[tuple[Fit, str], EffectTemplates] = field(default_factory=dict)

    def of(self, found: Fit, effect: NamedEffect[Any]) -> EffectTemplates:
        """Give the templates of one effect about one fit."""
        key = found, effect.name
        if key not in self.known:
            self.known[key] = effect_templates(found, effect, self.usable)
        return self.known[key]


def effect_templates(found: Fit, effect: NamedEffect[Any], usable: IntArray) -> EffectTemplates:
    """Difference the chain with and without each variant of the effect."""
    variants = effect.variants()
    banks = [variant.bank() for variant in variants]
    # Variants bound to the same scans, or to none, differ in their priors alone: one prediction does for them.
    columns: list[FloatArray] = []
    first = 0
    for _, group in itertools.groupby(variants, key=lambda variant: variant.scans):
        last = first + len(list(group))
        columns += _columns(found, variants[first], np.concatenate(banks[first:last]), usable)
        first = last
    choice = np.repeat(np.arange(len(variants)), [len(bank) for bank in banks])
    return EffectTemplates(tuple(columns), tuple(itertools.chain(*banks)), variants, choice)


def _columns(found: Fit, effect: NamedEffect[Any], bank: FloatArray, usable: IntArray) -> list[FloatArray]:
    """Predict all settings of a bank at once, in the scans that the effect is bound to: each (n_usable, n_columns)."""
    plain, plan = found.model, found.model.plan
    model = plain.with_effect(effect)
    n_rows = bank.shape[0] * bank.shape[1]
    own = {e.name: effect_values(e, found.z[None, plain.columns_of(e.name)]) for e in plain.effects}
    each = {name: np.repeat(values, n_rows, axis=0) for name, values in own.items()}
    each[effect.name] = bank.reshape(n_rows, -1)
    sensor = plain.sensor.theta(found.z[None, : plain.sensor.n_params])
    theta = model.theta_of(np.repeat(sensor, n_rows, axis=0), each)
    before = np.zeros(len(plan))
    before[usable] = found.predicted
    if effect.scans:
        inside = np.flatnonzero(in_scans(plan, effect.scans))
        change = np.zeros((n_rows, len(plan)))
        change[:, inside] = model.chain.predict(theta, plan.take(inside)) - before[inside]
    elif effect.stage >= Stage.SEEN:  # what acts on what has been seen needs no second look
        view = plain.chain.look(plain.theta_of(sensor, own), plan)
        change = model.chain.read(view, theta, plan) - before
    else:
        change = model.chain.predict(theta, plan) - before
    return np.split(change[:, usable].T, len(bank), axis=1)


def unknown_templates(covariates: Sequence[Covariate], signal: FloatArray, n_points: int) -> UnknownTemplates:
    """Lay out smooth bases, steps, windows and single levels in every covariate.

    Parameters
    ----------
    covariates
        Those of the recording; each alone, with direction, and within scans.
    signal
        Predicted reading above its least, (n_usable,): what a gain multiplies.
    n_points
        Number of usable readings.
    """
    columns: list[FloatArray] = []
    families: list[str] = []
    for covariate in covariates:
        for template in _of(covariate, signal, covariates, n_points):
            if np.any(template):
                columns.append(template)
                families.append(covariate.name)
    return UnknownTemplates(tuple(columns), tuple(families))


def _of(
    covariate: Covariate, signal: FloatArray, covariates: Sequence[Covariate], n_points: int
) -> Iterator[FloatArray]:
    values = covariate.values
    if covariate.groups:
        codes = np.unique(values, return_inverse=True)[1]
        if codes.max() < 24:
            member = (codes[:, None] == np.arange(codes.max() + 1)).astype(np.float64)
            slope = next((c for c in covariates if c.name == "slope"), None)
            yield _spread(member, covariate, n_points)
            yield _spread(member * signal[covariate.rows, None], covariate, n_points)
            if slope is not None:
                whole = np.zeros(n_points)
                whole[slope.rows] = slope.values
                steep = member * whole[covariate.rows, None]
                yield _spread(steep, covariate, n_points)
                for column in steep.T:
                    yield _spread(column[:, None], covariate, n_points)
            for column in member.T:
                yield _spread(column[:, None], covariate, n_points)
        return
    scaled = (values - values.min()) / np.ptp(values)
    if covariate.scan is not None:
        yield _spread(_cosines(scaled, 6), covariate, n_points)
        yield from (_spread(w[:, None], covariate, n_points) for w in _windows(values, (4, 8, 16)))
        return
    for n_terms in (3, 8):
        smooth = _cosines(scaled, n_terms)
        yield _spread(smooth, covariate, n_points)
        if covariate.name not in ("level", "slope"):
            yield _spread(smooth * signal[covariate.rows, None], covariate, n_points)
    direction = next((c for c in covariates if c.name == "direction"), None)
    if direction is not None and covariate.name != "time":
        sign = np.zeros(n_points)
        sign[direction.rows] = direction.values
        turned = np.concatenate([np.ones((len(scaled), 1)), _cosines(scaled, 3)], axis=1)
        yield _spread(turned * sign[covariate.rows, None], covariate, n_points)
    if covariate.name == "slope":
        yield _spread(values[:, None], covariate, n_points)
        yield _spread(np.abs(values)[:, None], covariate, n_points)
    if covariate.name == "time":
        for at in np.quantile(values, np.arange(1, 16) / 16):
            yield _spread((values > at).astype(np.float64)[:, None], covariate, n_points)
    yield from (_spread(w[:, None], covariate, n_points) for w in _windows(values, (4, 8, 16)))


def _spread(columns: FloatArray, covariate: Covariate, n_points: int) -> FloatArray:
    out = np.zeros((n_points, columns.shape[1]))
    out[covariate.rows] = columns
    return out


def _cosines(scaled: FloatArray, n_terms: int) -> FloatArray:
    return np.cos(np.pi * scaled[:, None] * np.arange(1, n_terms + 1))


def _windows(values: FloatArray, parts: Sequence[int]) -> Iterator[FloatArray]:
    order = np.argsort(values, kind="stable")
    n = len(values)
    for n_parts in parts:
        width = max(n // n_parts, 2)
        for first in range(0, n - width + 1, max(width // 2, 1)):
            window = np.zeros(n)
            window[order[first : first + width]] = 1.0
            yield window


def subsets(names: Sequence[str], most: int) -> Iterator[tuple[str, ...]]:
    """List every combination of up to `most` names, each sorted, the empty one first."""
    for size in range(most + 1):
        yield from itertools.combinations(sorted(names), size)
