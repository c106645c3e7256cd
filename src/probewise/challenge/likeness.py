"""How alike a concealed effect is to every effect that a diagnosis could name instead, and what one of two leaves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.challenge.surviving import NullRefit
from probewise.diagnosis.evidence.laplace import Blocks, Linearised
from probewise.diagnosis.evidence.templates import EffectTemplates, effect_templates
from probewise.diagnosis.fitting.fit import Fit, fit
from probewise.diagnosis.noise.law import white
from probewise.effects import VOCABULARY, Extent, NamedEffect
from probewise.recordings.plan import Recording
from probewise.sensor import Stage

__all__ = ["cosines", "left_beside"]

_WORTH_A_REFIT = 0.8
_STARTS = 3  # variants of an effect that are refitted where it is one of two
_LIKE_AN_SSF = ("halo", "edge_blur")  # what looks like these may be an SSF of one Gaussian more


def cosines(
    refit: NullRefit,
    clean: Recording,
    changed: Recording,
    *,
    vocabulary: Mapping[str, type[NamedEffect[Any]]] = VOCABULARY,
) -> dict[str, float]:
    """Compare what survives of an effect with every named effect on the mean, each at its best.

    Parameters
    ----------
    refit
        The null.
    clean, changed
        Noise-free readings without and with the effect.
    vocabulary
        The effects to compare with, by name.

    Returns
    -------
    For each name rho: the square root of the share of the surviving sum of squares that the effect of that name
    takes up together with the null. Those that take up most of it are refitted in full, the others linearised. Where
    what survives is like a skirt or a blur, "ssf_order" too: one Gaussian more, and no physics left out.
    """
    found = refit.refit(clean, changed)
    usable = np.flatnonzero(clean.usable)
    problem = Linearised.of(found, white(len(usable)))
    extent = Extent.of(clean)
    out: dict[str, float] = {}
    for name, kind in vocabulary.items():
        effect = kind.for_extent(extent)
        if effect is None or effect.stage is Stage.NOISE:
            continue
        templates, taken = _taken_by_each(problem, found, effect, usable)
        best = int(np.argmax(taken))
        rho = float(np.sqrt(min(taken[best] / float(problem.residual @ problem.residual), 1.0)))
        if rho > _WORTH_A_REFIT:
            exact = refit.exact(clean, changed)
            rho = _taken_up(found, _with_effect(problem, found, effect, templates, best, exact))
        out[name] = rho
    if max(out.get(name, 0.0) for name in _LIKE_AN_SSF) > _WORTH_A_REFIT:
        out["ssf_order"] = _taken_up(found, refit.with_one_more(found, clean, changed))
    return out


def left_beside(refit: NullRefit, clean: Recording, both: Recording, names: Iterable[str]) -> dict[str, float]:
    """Tell what is left of two effects where one of them is named, in units of the reading: what shows of the other.

    Parameters
    ----------
    refit
        The null.
    clean, both
        Noise-free readings without any effect and with both.
    names
        The ones that are fitted, together with the null, each by itself.

    Returns
    -------
    For each name the root of the sum of squares of the residuals: in noise sds, the size of the other beside it.
    Readings that a ceiling cuts off say nothing of a paler patch, however large it would be alone.
    """
    found, exact = refit.refit(clean, both), refit.exact(clean, both)
    usable = np.flatnonzero(clean.usable)
    problem = Linearised.of(found, white(len(usable)))
    out = {}
    for name in names:
        effect = VOCABULARY[name].for_extent(Extent.of(clean))
        fits = [found]
        if effect is not None:
            templates, taken = _taken_by_each(problem, found, effect, usable)
            best = {int(templates.choice[k]): int(k) for k in np.argsort(taken)}  # of each variant, the best last
            starts = [*best.values()][-_STARTS:]
            fits += [_with_effect(problem, found, effect, templates, at, exact) for at in starts]
        out[name] = min(float(np.linalg.norm(by.residuals)) for by in fits)
    return out


def _taken_by_each(
    problem: Linearised, found: Fit, effect: NamedEffect[Any], usable: IntArray
) -> tuple[EffectTemplates, FloatArray]:
    """Lay out an effect's bank, and what each entry takes up of the sum of squares, (n_entries,)."""
    templates = effect_templates(found, effect, usable)
    blocks = Blocks.of(problem, templates.columns, [effect.name] * len(templates.columns))
    return templates, np.add.reduceat((blocks.u.T @ problem.residual) ** 2, blocks.starts)


def _with_effect(
    problem: Linearised, found: Fit, effect: NamedEffect[Any], templates: EffectTemplates, at: int, exact: Recording
) -> Fit:
    """Refit the null and an effect from an entry of its bank."""
    columns, setting = templates.columns[at], templates.settings[at]
    amount = np.linalg.lstsq(problem.project(columns), problem.residual)[0]
    start = effect.start(setting, np.asarray(amount, dtype=np.float64))
    z = found.z + problem.absorbed(found, columns @ amount)
    model = found.model.with_effect(templates.variant(at))
    start_z = np.concatenate([z, model.scores_of(start[None, :])[0]])
    rss = float(found.residuals @ found.residuals)
    # As floor of the sd a tenth of what survives: far enough below it to be seen, and no exact fit is asked for.
    floor = 0.1 * np.sqrt(rss / len(found.residuals))
    return fit(model, exact, start_z, white(len(found.residuals), least=floor), tolerance=0.02)


def _taken_up(found: Fit, by: Fit) -> float:
    """Square root of the share of what a fit leaves that another takes up."""
    left = float(by.residuals @ by.residuals) / float(found.residuals @ found.residuals)
    return float(np.sqrt(np.clip(1 - left, 0.0, 1.0)))
