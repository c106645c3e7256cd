"""Aliased effects in these readings, and the readings that would separate them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.diagnosis.apparatus import ENOUGH_NATS, MOST_READINGS, NOTHING_NATS, Apparatus, rows_by_command
from probewise.diagnosis.evidence import Linearised, OrthonormalBlocks
from probewise.diagnosis.fit import Fit
from probewise.diagnosis.search.refits import effects_out_of_vocabulary
from probewise.diagnosis.search.searched import Searched
from probewise.effects import NamedEffect, name_of_first_copy
from probewise.recordings.plan import Plan

COUNTS = np.array([0, 1, 2, 3, 4, 6, 8, 12, 18, 26, 36, 51, 72, MOST_READINGS])
"""Numbers of further readings that are tried."""

_FREE = 1e-6  # prior precision of a rival's amounts, in changes of one noise sd: they are free


@dataclass(frozen=True, eq=False)
class EffectEntry:
    """An effect at the settings of its parameters, (n_columns, n_effect_params), that make one template."""

    effect: NamedEffect[Any]
    settings: FloatArray

    def changes(self, found: Fit, plan: Plan, without: FloatArray) -> FloatArray:
        """Return the change of a plan's readings by each setting, about a fit, (n_points, n_columns).

        `without` are the predictions of the fit, (n_points,). Changes are not finite where the model diverges.
        """
        model = replace(found.model, plan=plan).with_effect(self.effect)
        own = model.z_of_last_effect(self.settings)
        points = np.concatenate([np.repeat(found.z[None, :], len(own), axis=0), own], axis=1)
        with np.errstate(all="ignore"):
            return np.asarray((model.predict(points) - without).T)


@dataclass(frozen=True, eq=False)
class Amounts:
    """A change by an effect, as amounts of its columns: `values` (n_columns,)."""

    name: str
    values: FloatArray

    @property
    def variance(self) -> float:
        """Variance of the amounts, and so of one more."""
        return max(float(np.var(self.values)), 1e-12)


@dataclass(frozen=True, eq=False)
class LinearReadings:
    """Readings linearised about a fit, in noise sds: `slopes` (n_points, n_params) and `columns` (n_points, n_columns).

    Slopes are by the fit's coordinates, which have a standard normal prior; columns are changes by effects.
    """

    slopes: FloatArray
    columns: FloatArray


@dataclass(frozen=True, eq=False)
class ReadingsWithEffects:
    """Old readings and possible further ones, linearised about a fit, with the columns of several effects.

    `old`, `further`: the readings; `of_effect`: numbers of each effect's columns, by name; `of_run`, `columns_of_run`:
    masks of the coordinates, and of the columns, of which each run has a value of its own.
    """

    old: LinearReadings
    further: LinearReadings
    of_effect: Mapping[str, IntArray]
    of_run: BoolArray
    columns_of_run: BoolArray

    @classmethod
    def of(
        cls,
        problem: Linearised,
        found: Fit,
        entries: Mapping[str, EffectEntry],
        *,
        usable: IntArray,
        plan: Plan,
        apparatus: Apparatus,
    ) -> Self:
        """Linearise about a fit the readings of its `usable` rows, and those of a `plan` of further ones.

        An effect's columns are scaled to a length of one noise sd in all, on the old readings.
        """
        model, predicted = found.model, found.model.predict(found.z[None, :])[0]
        expected, slopes = replace(model, plan=plan).predict_and_differentiate(found.z)
        n_known = len(apparatus.coordinates_of_new_run(model))
        old, further, of_run = [], [], []
        for entry in entries.values():
            columns = problem.whiten(entry.changes(found, model.plan, predicted)[usable])
            length = max(float(np.linalg.norm(columns)), 1e-300)
            old.append(columns / length)
            further.append(entry.changes(found, plan, expected) / problem.sd / length)
            varies = len(apparatus.coordinates_of_new_run(model.with_effect(entry.effect))) > n_known
            of_run.append(np.full(columns.shape[1], varies))
        ends = np.cumsum([columns.shape[1] for columns in old])
        return cls(
            LinearReadings(problem.whiten(found.slopes), np.concatenate(old, axis=1)),
            LinearReadings(slopes / problem.sd, np.concatenate(further, axis=1)),
            dict(zip(entries, np.split(np.arange(ends[-1]), ends[:-1]), strict=True)),
            np.isin(np.arange(model.n_params), apparatus.coordinates_of_new_run(model)),
            np.concatenate(of_run),
        )

    def in_one_run(self, rows: IntArray) -> NatsInOneRun:
        """Return the readings with those further ones alone whose row numbers are these: rows of one run."""
        further = LinearReadings(self.further.slopes[rows], self.further.columns[rows])
        return NatsInOneRun(self.old, further, self.of_effect, self.of_run, self.columns_of_run)


@dataclass(frozen=True, eq=False)
class NatsInOneRun(ReadingsWithEffects):
    """Nats that separate effects after any number of readings, evenly spread, of one further run."""

    def nats_against(self, truth: Amounts, rival: Amounts) -> FloatArray:
        """Return the expected log Bayes factor of an effect that acts over another, which is refitted, (n_counts,).

        It is a Kullback-Leibler divergence of normal distributions: of an effect with a value per run, that of the
        further run is normal with the mean and the variance of the others. NaN if an effect has no finite change.
        """
        columns, others = self.of_effect[truth.name], self.of_effect[rival.name]
        own, others_own = self._numbers_of_own_values(columns), self._numbers_of_own_values(others)
        every, fitted = np.concatenate([columns, own]), np.concatenate([others, others_own])
        products = self._projected_products
        among = products[:, fitted[:, None], fitted]
        along = products[:, fitted[:, None], every]
        left = products[:, every[:, None], every]
        if not (np.isfinite(among).all() and np.isfinite(left).all()):
            return np.full(len(COUNTS), np.nan)
        prior = np.concatenate([np.full(len(others), _FREE), np.full(len(others_own), 1 / rival.variance)])
        left = left - along.transpose(0, 2, 1) @ np.linalg.solve(among + np.diag(prior), along)
        n = len(columns)
        twice = np.einsum("i,mij,j->m", truth.values, left[:, :n, :n], truth.values)
        if own.size:
            spread = np.eye(len(own)) + truth.variance * products[:, own[:, None], own]
            twice += truth.variance * np.einsum("mii->m", left[:, n:, n:]) - np.linalg.slogdet(spread)[1]
        if others_own.size:
            spread = np.eye(len(others_own)) + rival.variance * products[:, others_own[:, None], others_own]
            absorbed = len(others_own) - np.einsum("mii->m", np.linalg.inv(spread))
            twice += np.linalg.slogdet(spread)[1] - absorbed
        return np.asarray(0.5 * twice)

    def _numbers_of_own_values(self, columns: IntArray) -> IntArray:
        """Return the numbers, behind all columns, of the columns by the further run's own values of an effect."""
        number = self.old.columns.shape[1] + np.cumsum(self.columns_of_run) - 1
        return np.asarray(number[columns[self.columns_of_run[columns]]])

    @cached_property
    def _projected_products(self) -> FloatArray:
        """Products of all columns with the parameters, and their prior, projected out, (n_counts, k, k)."""
        n_old, n_params = self.old.slopes.shape
        own, own_columns = self.further.slopes[:, self.of_run], self.further.columns[:, self.columns_of_run]
        shared, shared_columns = self.further.slopes.copy(), self.further.columns.copy()
        shared[:, self.of_run] = 0.0
        for numbers in self.of_effect.values():  # the new run's value is about the mean of the others
            if self.columns_of_run[numbers].all():
                shared_columns[:, numbers] = shared_columns[:, numbers].mean(axis=1, keepdims=True)
        absent, absent_columns = np.zeros((n_old, own.shape[1])), np.zeros((n_old, own_columns.shape[1]))
        before = np.concatenate([self.old.slopes, absent, self.old.columns, absent_columns], axis=1)
        after = np.concatenate([shared, own, shared_columns, own_columns], axis=1)
        p = n_params + own.shape[1]
        products = before.T @ before + COUNTS[:, None, None] * (after.T @ after / len(after))
        products[:, :p, :p] += np.eye(p)
        scale = np.sqrt(np.einsum("mii->mi", products[:, :p, :p]))[:, :, None]  # against rounding
        among, with_columns = products[:, :p, :p] / (scale * scale.transpose(0, 2, 1)), products[:, :p, p:] / scale
        if not np.isfinite(among).all():
            return np.full_like(products[:, p:, p:], np.nan)
        absorbed = with_columns.transpose(0, 2, 1) @ np.linalg.solve(among, with_columns)
        return np.asarray(products[:, p:, p:] - absorbed)


ALIAS_COSINE = 0.9
LAMBDA = 8.0
"""Size of an effect at which it is detected for certain, and at which a plan is judged."""

LEAST_SHARE = 0.05
"""Least share of an effect's change of the readings that counts as its own, whatever a fit absorbs."""


@dataclass(frozen=True)
class Alias:
    """Two effects that a recording hardly tells apart, and the measurement that would.

    `cosine`: largest principal cosine of their templates, with the null's parameters projected out; `settle_by`: the
    separating scan in words, or that there is none; `readings`: how many of its readings are needed, or 0.
    """

    effects: tuple[str, str]
    cosine: float
    settle_by: str
    readings: int


def projected_cosine(problem: Linearised, first: FloatArray, second: FloatArray) -> float:
    """Return the largest principal cosine of two templates (n_points, k), a fit projected out; 0 if it absorbs one."""
    bases = [_projected_basis(problem, problem.whiten(c))[0] for c in (first, second)]
    if not all(basis.size for basis in bases):
        return 0.0
    return float(min(np.linalg.svd(bases[0].T @ bases[1], compute_uv=False)[0], 1.0))


def _projected_basis(problem: Linearised, whitened: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormalise a whitened template, (n_points, k), with a fit projected out; nothing is left if it is absorbed.

    Returns the directions, (n_rows, n_directions), and the amounts of the columns that make each, (k, n_directions).
    """
    projected = problem.project_whitened(whitened)
    # Columns that the fit absorbs to within a thousandth are ignored.
    if not np.linalg.norm(projected) > 1e-3 * np.linalg.norm(whitened):
        return projected[:, :0], np.zeros((projected.shape[1], 0))
    u, lengths, axes = np.linalg.svd(projected, full_matrices=False)
    kept = lengths > 1e-3 * lengths[0]
    return u[:, kept], axes[kept].T / lengths[kept]


def collinear_pairs(problem: Linearised, templates: Mapping[str, FloatArray], *, otherwise: str) -> list[Alias]:
    """List the pairs of effects whose projected templates have a cosine of 0.9 or more, the most collinear first.

    `problem`: the linearised null fit, whose parameters are projected out of the templates; `templates`: for each
    effect, its best-fitting template columns (n_points, k); `otherwise`: the `settle_by` of each pair; its `readings`
    are 0.
    """
    out = []
    for pair in itertools.combinations(sorted(templates), 2):
        cosine = projected_cosine(problem, templates[pair[0]], templates[pair[1]])
        if cosine >= ALIAS_COSINE:
            out.append(Alias(pair, cosine, otherwise, 0))
    return sorted(out, key=lambda alias: -alias.cosine)


def aliases_with_separating_plans(searched: Searched, problem: Linearised, found: Fit) -> list[Alias]:
    """List the aliased pairs of effects of the vocabulary on the mean, each with the scan that separates it best.

    An effect's template is the best-fitting entry of its bank (its changes of readings, at a grid of its parameters).
    """
    prepared, misfit_templates = searched.prepared, searched.misfit_templates
    telling: dict[str, FloatArray] = {}
    chosen: dict[str, EffectEntry] = {}
    for name, effect in prepared.effects.items():
        if (
            name in prepared.noise_effect_names
            or effects_out_of_vocabulary((name,))
            or name_of_first_copy(name) is not None
        ):
            continue
        templates = misfit_templates.templates.templates_of(misfit_templates.about, effect.with_fewer_variants())
        blocks = OrthonormalBlocks.of(problem, templates.columns)
        scores = np.add.reduceat((blocks.u.T @ problem.residual) ** 2, blocks.starts)
        best = int(np.argmax(scores))
        telling[name] = templates.columns[best]
        chosen[name] = EffectEntry(templates.variant_of_entry(best), templates.settings[best])
    pairs = collinear_pairs(problem, telling, otherwise=prepared.apparatus.words.settles_nothing)
    return pairs_with_separating_scans(pairs, problem, found, chosen, prepared.usable_rows, prepared.apparatus)


def pairs_with_separating_scans(
    pairs: Sequence[Alias],
    problem: Linearised,
    found: Fit,
    entries: Mapping[str, EffectEntry],
    usable: IntArray,
    apparatus: Apparatus,
) -> list[Alias]:
    """Return the pairs with `settle_by` and `readings` of the best scan that the apparatus could take.

    That is the scan that adds three nats between the two in the fewest readings, at most 102, or else the one that adds
    most, if more than half a nat. All parameters are refitted to old and new readings, and the other effect with them;
    of the two cases, that the one acts or the other, the harder one counts. The effect that acts has lambda 8 in the
    old readings. A pair that no scan separates is unchanged.

    `entries`: the entry of each effect's bank that is taken for it, by name.
    """
    plan = found.model.plan
    scans = apparatus.candidate_measurements(plan, level=found.model.predict(found.z[None, :])[0])
    if not (pairs and scans):
        return list(pairs)
    named = {name: entries[name] for name in sorted({name for pair in pairs for name in pair.effects})}
    everywhere = apparatus.plan_of_alternatives(scans, plan)
    readings = ReadingsWithEffects.of(problem, found, named, usable=usable, plan=everywhere, apparatus=apparatus)
    sized = {pair.effects: _collinear_amounts(problem, readings, *pair.effects) for pair in pairs}
    best = {pair.effects: (MOST_READINGS + 1, -NOTHING_NATS, pair) for pair in pairs}  # the least is best
    for scan, rows in zip(scans, rows_by_command(scans), strict=True):
        taken = readings.in_one_run(rows)
        for effects, (one, other) in sized.items():
            nats = _gained(taken.nats_against(one, other))
            if not nats[-1] > NOTHING_NATS:
                continue
            nats = np.minimum(nats, _gained(taken.nats_against(other, one)))
            enough = np.flatnonzero(nats >= ENOUGH_NATS)
            needed = int(COUNTS[enough[0]]) if enough.size else MOST_READINGS + 1
            most = float(nats[enough[0] if enough.size else -1])
            if (needed, -most) < best[effects][:2]:
                asked = replace(best[effects][2], settle_by=scan.description, readings=min(needed, MOST_READINGS))
                best[effects] = (needed, -most, asked)
    return [alias for _, _, alias in best.values()]


def _gained(nats: FloatArray) -> FloatArray:
    return np.asarray(nats - nats[0])


def _collinear_amounts(problem: Linearised, readings: ReadingsWithEffects, *names: str) -> list[Amounts]:
    """Return the most collinear changes by two effects, each of lambda 8."""
    columns = [readings.old.columns[:, readings.of_effect[name]] for name in names]
    (first, of_first), (second, of_second) = (_projected_basis(problem, c) for c in columns)
    if not (first.size and second.size):
        return [Amounts(name, np.zeros(c.shape[1])) for name, c in zip(names, columns, strict=True)]
    left, _, right = np.linalg.svd(first.T @ second)
    out = []
    for name, values, own in zip(names, (of_first @ left[:, 0], of_second @ right[0]), columns, strict=True):
        seen = max(1.0, LEAST_SHARE * float(np.linalg.norm(own @ values)))
        out.append(Amounts(name, values * (LAMBDA / seen)))
    return out
