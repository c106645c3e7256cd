"""Aliased effects in these readings, and the readings that would separate them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
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
class _Columns:
    """The columns of an effect, in noise sds: in `old` readings and `further` ones, (n_points, n_columns) each.

    `of_run`: whether each is the value of one run; then `further` are the columns of the mean of all runs' values.
    """

    old: FloatArray
    further: FloatArray
    of_run: bool

    @classmethod
    def of(
        cls,
        entry: EffectEntry,
        problem: Linearised,
        found: Fit,
        usable: IntArray,
        everywhere: tuple[Plan, FloatArray],
        apparatus: Apparatus,
    ) -> _Columns:
        """Linearise the readings of `usable` rows, and those of another plan with its predictions without effects."""
        model, (plan, expected) = found.model, everywhere
        old = problem.whiten(entry.changes(found, model.plan, model.predict(found.z[None, :])[0])[usable])
        length = max(float(np.linalg.norm(old)), 1e-300)
        further = entry.changes(found, plan, expected) / problem.sd
        n_known = len(apparatus.coordinates_of_new_run(model))
        of_run = len(apparatus.coordinates_of_new_run(model.with_effect(entry.effect))) > n_known
        if of_run:  # the new run's value is about the mean of the others
            further = np.repeat(further.mean(axis=1, keepdims=True), further.shape[1], axis=1)
        return cls(old / length, further / length, of_run)


Amounts = tuple[_Columns, FloatArray]
"""A change by an effect: its columns, and how much of each, (n_columns,)."""


def nats_against(slopes: Sequence[FloatArray], truth: Amounts, rival: Amounts, rows: IntArray) -> FloatArray:
    """Return the expected log Bayes factor of an effect that acts over another, which is refitted, (n_counts,).

    `slopes`: of the old readings, and of those of one further run, by coordinates with a standard normal prior; `rows`:
    those of the run, of which any number are taken, evenly spread. A rival with a value per run has one more there,
    known as far as its values scatter. NaN if an effect has no finite change.
    """
    (true, values), (other, others), (p, k) = truth, rival, (slopes[0].shape[1], rival[0].old.shape[1])
    own = other.further[rows, :1] * (k * others.std()) if other.of_run else np.zeros((len(rows), 0))
    after = np.concatenate([slopes[1], other.further[rows], own, true.further[rows] @ values[:, None]], axis=1)
    absent = np.zeros((len(slopes[0]), own.shape[1]))
    before = np.concatenate([slopes[0], other.old, absent, true.old @ values[:, None]], axis=1)
    products = before.T @ before + COUNTS[:, None, None] * (after.T @ after / len(after))
    if not np.isfinite(products).all():
        return np.full(len(COUNTS), np.nan)
    precision = np.concatenate([np.ones(p), np.full(k, _FREE), np.ones(own.shape[1])])
    fitted, along = products[:, :-1, :-1] + np.diag(precision), products[:, :-1, -1:]
    scale = np.sqrt(np.einsum("mii->mi", fitted))[:, :, None]  # against rounding
    among, along = fitted / (scale * scale.transpose(0, 2, 1)), along / scale
    absorbed = along.transpose(0, 2, 1) @ np.linalg.solve(among, along)
    return np.asarray(0.5 * (products[:, -1, -1] - absorbed[:, 0, 0]))


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

    `templates`: for each effect, its best-fitting template columns (n_points, k); `otherwise`: the `settle_by` of each
    pair; its `readings` are 0.
    """
    pairs = list(itertools.combinations(sorted(templates), 2))
    cosines = [projected_cosine(problem, templates[one], templates[other]) for one, other in pairs]
    out = [Alias(pair, c, otherwise, 0) for pair, c in zip(pairs, cosines, strict=True) if c >= ALIAS_COSINE]
    return sorted(out, key=lambda alias: -alias.cosine)


def aliases_with_separating_plans(searched: Searched, problem: Linearised, found: Fit) -> list[Alias]:
    """List the aliased pairs of effects of the vocabulary on the mean, each with the scan that separates it best.

    An effect's template is the best-fitting entry of its bank (its changes of readings, at a grid of its parameters).
    """
    prepared, misfit_templates = searched.prepared, searched.misfit_templates
    telling, chosen = dict[str, FloatArray](), dict[str, EffectEntry]()
    for name, effect in prepared.effects.items():
        is_copy = name_of_first_copy(name) is not None
        if name in prepared.noise_effect_names or effects_out_of_vocabulary((name,)) or is_copy:
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
    everywhere = apparatus.plan_of_alternatives(scans, plan)
    expected, slopes = replace(found.model, plan=everywhere).predict_and_differentiate(found.z)
    of_run = apparatus.coordinates_of_new_run(found.model)  # a further run has values of its own of these
    shared, own = slopes / problem.sd, slopes[:, of_run] / problem.sd
    shared[:, of_run] = 0.0
    further, known = np.concatenate([shared, own], axis=1), problem.whiten(found.slopes)
    before = np.concatenate([known, np.zeros((len(known), len(of_run)))], axis=1)
    columns = {
        name: _Columns.of(entries[name], problem, found, usable, (everywhere, expected), apparatus)
        for name in sorted({name for pair in pairs for name in pair.effects})
    }
    sized = {pair.effects: _collinear_amounts(problem, *(columns[name] for name in pair.effects)) for pair in pairs}
    best = {pair.effects: (MOST_READINGS + 1, -NOTHING_NATS, pair) for pair in pairs}  # the least is best
    for scan, rows in zip(scans, rows_by_command(scans), strict=True):
        for effects, (one, other) in sized.items():
            gained = [
                nats_against((before, further[rows]), true, rival, rows) for true, rival in ((one, other), (other, one))
            ]
            nats = np.min([nats - nats[0] for nats in gained], axis=0)
            if not nats[-1] > NOTHING_NATS:
                continue
            enough = np.flatnonzero(nats >= ENOUGH_NATS)
            needed = int(COUNTS[enough[0]]) if enough.size else MOST_READINGS + 1
            most = float(nats[enough[0] if enough.size else -1])
            if (needed, -most) < best[effects][:2]:
                asked = replace(best[effects][2], settle_by=scan.description, readings=min(needed, MOST_READINGS))
                best[effects] = (needed, -most, asked)
    return [alias for _, _, alias in best.values()]


def _collinear_amounts(problem: Linearised, *effects: _Columns) -> list[Amounts]:
    """Return the most collinear changes by two effects, each of lambda 8."""
    (first, of_first), (second, of_second) = (_projected_basis(problem, effect.old) for effect in effects)
    if not (first.size and second.size):
        return [(effect, np.zeros(effect.old.shape[1])) for effect in effects]
    left, _, right = np.linalg.svd(first.T @ second)
    out = []
    for effect, values in zip(effects, (of_first @ left[:, 0], of_second @ right[0]), strict=True):
        seen = max(1.0, LEAST_SHARE * float(np.linalg.norm(effect.old @ values)))
        out.append((effect, values * (LAMBDA / seen)))
    return out
