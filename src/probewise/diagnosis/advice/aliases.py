"""Aliased effects in these readings, and the readings that would separate them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.evidence.laplace import Linearised, OrthonormalBlocks
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.scheduling import MOST_READINGS, rows_by_command
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.search.weighed_fit import effects_out_of_vocabulary
from probewise.effects import NamedEffect, name_of_first_copy

ALIAS_COSINE = 0.9
_LEAST_NATS = 3.0 / (100 * MOST_READINGS)  # least nats per reading; less is rounding error


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
    bases = []
    for columns in (first, second):
        raw = np.linalg.norm(problem.law(columns)) / problem.sd
        projected = problem.project(columns)
        # Columns that the fit absorbs to within a thousandth are ignored.
        if np.linalg.norm(projected) <= 1e-3 * raw:
            return 0.0
        u, lengths, _ = np.linalg.svd(projected, full_matrices=False)
        bases.append(u[:, lengths > 1e-3 * lengths[0]])
    return float(min(np.linalg.svd(bases[0].T @ bases[1], compute_uv=False)[0], 1.0))


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
    chosen: dict[str, NamedEffect[Any]] = {}
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
        telling[name], chosen[name] = templates.columns[best], templates.variant_of_entry(best)
    apparatus = prepared.apparatus
    pairs = collinear_pairs(problem, telling, otherwise=apparatus.words.settles_nothing)
    return pairs_with_separating_scans(pairs, found, chosen, problem.sd, apparatus)


def pairs_with_separating_scans(
    pairs: Sequence[Alias], found: Fit, effects: Mapping[str, NamedEffect[Any]], sd: float, apparatus: Apparatus
) -> list[Alias]:
    """Return the pairs with `settle_by` and `readings` of the best scan that the apparatus could take.

    Both effects have the size that changes the plan's readings by 0.4 noise sds rms. The best scan has the most nats
    between the two per reading, and as many readings as three nats need, at most 102. A pair that no scan separates is
    unchanged.
    """
    names = sorted({name for pair in pairs for name in pair.effects})
    null = found.model.predict(found.z[None, :])[0]
    shapes = {}
    for name in names:
        model = found.model.with_effect(effects[name])
        z = np.concatenate([found.z, model.z_of_last_effect(effects[name].bank()[0][:1])[0]])
        here = model.predict(z[None, :])[0] - null
        shapes[name] = (model, z, here, 0.4 * sd / max(float(np.sqrt(np.mean(here**2))), 1e-12))
    best = {pair.effects: (_LEAST_NATS, pair) for pair in pairs}
    scans = apparatus.candidate_measurements(found.model.plan, level=null)
    if not (best and scans):
        return list(pairs)
    everywhere = apparatus.plan_of_alternatives(scans, found.model.plan)
    null = replace(found.model, plan=everywhere).predict(found.z[None, :])[0]
    there = {
        name: (replace(model, plan=everywhere).predict(z[None, :])[0] - null) * scale
        for name, (model, z, _, scale) in shapes.items()
    }
    for scan, rows in zip(scans, rows_by_command(scans), strict=True):
        for first, second in best:
            sign = np.sign(float(shapes[first][2] @ shapes[second][2])) or 1.0
            apart = there[first][rows] - sign * there[second][rows]
            per_reading = 0.5 * float(np.sum(apart**2)) / sd**2 / len(rows)
            if per_reading > best[first, second][0]:
                readings = min(max(math.ceil(3.0 / per_reading), 1), MOST_READINGS)
                advised = replace(best[first, second][1], settle_by=scan.description, readings=readings)
                best[first, second] = (per_reading, advised)
    return [alias for _, alias in best.values()]
