"""How alike a concealed effect is to every effect that a diagnosis could name instead."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.challenge.surviving import NullRefit
from probewise.diagnosis.evidence.laplace import Blocks, Linearised
from probewise.diagnosis.evidence.templates import effect_templates
from probewise.diagnosis.fitting.fit import Fit, fit
from probewise.diagnosis.noise.law import white
from probewise.effects import VOCABULARY, Extent, NamedEffect
from probewise.recordings.plan import Recording
from probewise.sensor import Stage

__all__ = ["cosines"]

_WORTH_A_REFIT = 0.8
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
        templates = effect_templates(found, effect, usable)
        blocks = Blocks.of(problem, templates.columns, [name] * len(templates.columns))
        taken = np.add.reduceat((blocks.u.T @ problem.residual) ** 2, blocks.starts)
        best = int(np.argmax(taken))
        rho = float(np.sqrt(min(taken[best] / float(problem.residual @ problem.residual), 1.0)))
        if rho > _WORTH_A_REFIT:
            columns, setting = templates.columns[best], templates.settings[best]
            amount = np.linalg.lstsq(problem.project(columns), problem.residual)[0]
            start = effect.start(setting, np.asarray(amount, dtype=np.float64))
            z = found.z + problem.absorbed(found, columns @ amount)
            rho = _refitted(found, templates.variant(best), start, z, refit.exact(clean, changed))
        out[name] = rho
    if max(out.get(name, 0.0) for name in _LIKE_AN_SSF) > _WORTH_A_REFIT:
        out["ssf_order"] = _taken_up(found, refit.with_one_more(found, clean, changed))
    return out


def _refitted(found: Fit, effect: NamedEffect[Any], start: FloatArray, z: FloatArray, exact: Recording) -> float:
    model = found.model.with_effect(effect)
    start_z = np.concatenate([z, model.scores_of(start[None, :])[0]])
    rss = float(found.residuals @ found.residuals)
    # As floor of the sd a tenth of what survives: far enough below it to be seen, and no exact fit is asked for.
    floor = 0.1 * np.sqrt(rss / len(found.residuals))
    with_effect = fit(model, exact, start_z, white(len(found.residuals)), sd_floor=floor, tolerance=0.02)
    return _taken_up(found, with_effect)


def _taken_up(found: Fit, by: Fit) -> float:
    """Square root of the share of what a fit leaves that another takes up."""
    left = float(by.residuals @ by.residuals) / float(found.residuals @ found.residuals)
    return float(np.sqrt(np.clip(1 - left, 0.0, 1.0)))
