"""What could be added to a fit: the vocabulary's effects, and bases for what nobody has named.

A template is a set of columns (n_usable, k), the change of the readings that an amplitude of one makes.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.coordinates import effect_values
from probewise.diagnosis.covariates import Covariate
from probewise.diagnosis.fit import Fit
from probewise.effects import NamedEffect

__all__ = ["EffectTemplates", "UnknownTemplates", "effect_templates", "unknown_templates"]


@dataclass(frozen=True, eq=False)
class EffectTemplates:
    """An effect's bank about a fit: for each entry its columns and the setting that made it."""

    effect: NamedEffect[Any]
    columns: tuple[FloatArray, ...]  # each (n_usable, n_columns)
    settings: FloatArray  # (n_bank, n_columns, n_params)


@dataclass(frozen=True, eq=False)
class UnknownTemplates:
    """Bases by covariate: what a mismatch outside the vocabulary may look like."""

    columns: tuple[FloatArray, ...]
    families: tuple[str, ...]  # the covariate of each


def effect_templates(found: Fit, effect: NamedEffect[Any], usable: IntArray) -> EffectTemplates:
    """Difference the chain with and without the effect, all settings in one prediction."""
    bank = effect.bank()
    n_bank, n_columns, n_params = bank.shape
    model = found.model.with_effect(effect)
    z = np.repeat(found.z[None, :], n_bank * n_columns, axis=0)
    own = {e.name: effect_values(e, z[:, found.model.columns_of(e.name)]) for e in found.model.effects}
    own[effect.name] = bank.reshape(n_bank * n_columns, n_params)
    rows = model.theta_of(model.sensor.theta(z[:, : model.sensor.n_params]), own)
    change = (model.chain.predict(rows, model.plan)[:, usable] - found.predicted).T
    return EffectTemplates(effect, tuple(np.split(change, n_bank, axis=1)), bank)


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
