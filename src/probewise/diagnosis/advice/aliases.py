"""Aliased effects in these readings, and the readings that would separate them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.advice.separating_readings import COUNTS, Amounts, EffectEntry, ReadingsWithEffects
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.evidence.laplace import Linearised, OrthonormalBlocks
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.scheduling import ENOUGH_NATS, MOST_READINGS, NOTHING_NATS, rows_by_command
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.search.weighed_fit import effects_out_of_vocabulary
from probewise.effects import name_of_first_copy

ALIAS_COSINE = 0.9
_LAMBDA = 8.0  # size of an effect at which it is detected for certain
_LEAST_SHARE = 0.05  # least share of its change of the readings that counts for its lambda, whatever a fit absorbs


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

    Parameters
    ----------
    problem
        The linearised null fit, whose parameters are projected out of the templates.
    templates
        For each effect, its best-fitting template columns (n_points, k).
    otherwise
        The `settle_by` of each pair; its `readings` are 0.
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

    Parameters
    ----------
    searched
        Result of the search.
    problem, found
        The null fit, linearised and as a fit.
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

    Parameters
    ----------
    pairs
        The aliased pairs.
    problem, found
        The null fit, linearised and as a fit.
    entries
        The entry of each effect's bank that is taken for it, by name.
    usable
        The rows of the plan with a usable reading.
    apparatus
        The apparatus that can measure more.
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
        seen = max(1.0, _LEAST_SHARE * float(np.linalg.norm(own @ values)))
        out.append(Amounts(name, values * (_LAMBDA / seen)))
    return out
