"""Twins: two effects that change the readings alike, of which one fit serves both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.evidence.templates import EffectTemplates
from probewise.diagnosis.fitting.fit import Fit

__all__ = ["are_proportional", "as_twin"]

_PROPORTIONAL = 1e-9  # one minus the cosine of two templates
_SAME_READINGS = 1e-3  # noise sds, the largest difference of two predictions
_SAME_SLOPES = 1e-3  # of the norm of a slope


def are_proportional(first: EffectTemplates, second: EffectTemplates) -> bool:
    """Tell whether each entry of two effects' banks is the same curve, up to its size and sign."""
    if first is second or [a.shape for a in first.settings] != [b.shape for b in second.settings]:
        return False
    if len(first.variants) != len(second.variants):
        return False
    a, b = (np.concatenate(templates.columns, axis=1) for templates in (first, second))
    norms = np.linalg.norm(a, axis=0) * np.linalg.norm(b, axis=0)
    return bool(np.all(np.abs(np.einsum("ij,ij->j", a, b)) >= (1 - _PROPORTIONAL) * norms) and np.all(norms > 0))


def as_twin(found: Fit, of: EffectTemplates, twin: EffectTemplates, usable: IntArray) -> Fit | None:
    """Return the fit with a twin in place of its last effect; None if it predicts or differentiates otherwise.

    Parameters
    ----------
    found
        The fit; its last effect is a variant of the first effect.
    of, twin
        Templates of the first effect, and of its twin.
    usable
        Rows with usable readings, (n_usable,).
    """
    held = found.model.effects[-1]
    variant = next((k for k, each in enumerate(of.variants) if each is held), None)
    if variant is None:
        return None
    parent, _ = found.model.without(held.name)
    model = parent.with_effect(twin.variants[variant])
    amplitudes = np.array(held.amplitudes, dtype=np.int64) + parent.n_params
    for sign in (1.0, -1.0):
        z, slopes = found.z.copy(), found.slopes.copy()
        z[amplitudes] *= sign
        slopes[:, amplitudes] *= sign
        predicted, own = (values[usable] for values in model.jacobian(z))
        if _are_same(predicted, own, replace(found, slopes=slopes)):
            return replace(found, model=model, z=z, predicted=predicted, residuals=found.residuals, slopes=own)
    return None


def _are_same(predicted: FloatArray, slopes: FloatArray, found: Fit) -> bool:
    if not np.abs(predicted - found.predicted).max() <= _SAME_READINGS * found.sd:
        return False
    apart, norms = np.linalg.norm(slopes - found.slopes, axis=0), np.linalg.norm(found.slopes, axis=0)
    return bool(np.all(apart <= _SAME_SLOPES * norms + _SAME_READINGS * found.sd))
