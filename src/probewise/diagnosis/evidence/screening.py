"""Score effects to add to a fit, by templates in closed form, many at once without refits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.bank import TemplateBank
from probewise.diagnosis.evidence.laplace import (
    Linearised,
    OrthonormalBlocks,
    block_log_bayes_factors,
    scale_and_project,
)
from probewise.diagnosis.evidence.templates import EffectTemplates
from probewise.diagnosis.names import Names

_BEST_ENTRIES = 2  # best entries of each effect's bank, for pairs


def log_mean_exp(scores: FloatArray) -> float:
    """Return the log of the mean of Bayes factors that are given as logs."""
    top = float(scores.max())  # thousands of short lists: scipy's general function is ten times slower
    return top + math.log(float(np.exp(scores - top).mean())) if math.isfinite(top) else top


def log_bayes_factors_by_label(problem: Linearised, bank: TemplateBank) -> dict[str, FloatArray]:
    """Return, by label of a bank (an effect's name), the log Bayes factors of its templates, (n_entries,)."""
    scores = bank.log_bayes_factors(problem)[:, 0]
    return {name: scores[members] for name, members in bank.indices_by_label.items()}


def log_bayes_factors_of_pairs(
    problem: Linearised, templates: Mapping[str, EffectTemplates], singles: Mapping[str, FloatArray]
) -> dict[Names, float]:
    """Return the log Bayes factor of each pair of effects, by their sorted names.

    It is the sum of both effects' own (`singles`), corrected by the joint score of the best two entries of each bank.
    """
    best = {name: np.argsort(-scores)[:_BEST_ENTRIES] for name, scores in singles.items()}
    entries = [(name, int(i)) for name in templates for i in best[name]]
    pairs = list(combinations(sorted(templates), 2))
    if not pairs:
        return {}
    columns = [templates[name].columns[i] for name, i in entries]
    widths = [c.shape[1] for c in columns]
    # In a basis of their joint span, with one more axis for the rest of the residual.
    axes, turned = np.linalg.qr(scale_and_project(problem, columns))
    along = axes.T @ problem.residual
    rest = math.sqrt(max(float(problem.residual @ problem.residual - along @ along), 0.0))
    turned = np.concatenate([turned, np.zeros((1, turned.shape[1]))])
    own = dict(zip(entries, np.split(turned, np.cumsum(widths)[:-1], axis=1), strict=True))
    asked = [((a, int(i)), (b, int(j))) for a, b in pairs for i in best[a] for j in best[b]]
    both = [_joined_templates(own[first], own[second]) for first, second in asked]
    blocks = OrthonormalBlocks.of_projected_templates(np.concatenate(both, axis=1), [c.shape[1] for c in both])
    together = block_log_bayes_factors(blocks, np.append(along, rest)[:, None], problem.n_kept)[:, 0]
    apart = np.array([singles[a][i] + singles[b][j] for (a, i), (b, j) in asked])
    starts = np.concatenate([[0], np.cumsum([len(best[a]) * len(best[b]) for a, b in pairs])[:-1]])
    gained = np.logaddexp.reduceat(together, starts) - np.logaddexp.reduceat(apart, starts)
    alone = {name: log_mean_exp(scores) for name, scores in singles.items()}
    return {(a, b): alone[a] + alone[b] + float(own) for (a, b), own in zip(pairs, gained, strict=True)}


def _joined_templates(first: FloatArray, second: FloatArray) -> FloatArray:
    """Join two templates of unit rms into one of unit rms."""
    widths = first.shape[1], second.shape[1]
    scaled = [t * math.sqrt(w / sum(widths)) for t, w in zip((first, second), widths, strict=True)]
    return np.concatenate(scaled, axis=1)
