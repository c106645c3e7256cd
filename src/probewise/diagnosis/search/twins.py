"""Twins: pairs of effects with proportional templates, so that the fit of one is reused for the other."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.evidence.templates import EffectTemplates
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.search.weighed_fit import WeighedFit

_PROPORTIONAL = 1e-9  # one minus the cosine of two templates
_SAME_READINGS = 1e-3  # noise sds, the largest difference of two predictions
_SAME_SLOPES = 1e-3  # of the norm of a slope


def are_proportional(first: EffectTemplates, second: EffectTemplates) -> bool:
    """Return whether all corresponding templates of two effects are proportional; False if both are one object."""
    if first is second or [a.shape for a in first.settings] != [b.shape for b in second.settings]:
        return False
    if len(first.variants) != len(second.variants):
        return False
    a, b = (np.concatenate(templates.columns, axis=1) for templates in (first, second))
    norms = np.linalg.norm(a, axis=0) * np.linalg.norm(b, axis=0)
    return bool(np.all(np.abs(np.einsum("ij,ij->j", a, b)) >= (1 - _PROPORTIONAL) * norms) and np.all(norms > 0))


@dataclass(frozen=True, eq=False)
class TwinSwap:
    """The exchange of an effect `name` for its `twin`, with the templates of both."""

    name: str
    of_first: EffectTemplates
    twin: str
    of_twin: EffectTemplates

    def candidate_with_twin(self, candidate: WeighedFit, usable: IntArray) -> WeighedFit | None:
        """Return a candidate with the twin in place of the effect; None if this changes predictions or slopes."""
        found = self._fit_with_twin(candidate.found, usable)
        if found is None:
            return None
        weights = {self.twin if name == self.name else name: own for name, own in candidate.weights.items()}
        return replace(candidate, found=found, weights=weights)

    def _fit_with_twin(self, found: Fit, usable: IntArray) -> Fit | None:
        effects, of = list(found.model.effects), self.of_first.variants
        pair = next(((i, k) for i, held in enumerate(effects) for k, each in enumerate(of) if each is held), None)
        if pair is None:
            return None
        at, variant = pair
        held, effects[at] = effects[at], self.of_twin.variants[variant]
        model = replace(found.model, effects=tuple(effects))
        amplitudes = np.array(held.amplitudes, dtype=np.int64) + found.model.coordinate_slice(held.name).start
        for sign in (1.0, -1.0):
            z, slopes = found.z.copy(), found.slopes.copy()
            z[amplitudes] *= sign
            slopes[:, amplitudes] *= sign
            predicted, own = (values[usable] for values in model.predict_and_differentiate(z))
            if _has_same_predictions(predicted, own, replace(found, slopes=slopes)):
                residuals = found.residuals + found.predicted - predicted
                return replace(found, model=model, z=z, predicted=predicted, residuals=residuals, slopes=own)
        return None


def _has_same_predictions(predicted: FloatArray, slopes: FloatArray, found: Fit) -> bool:
    if not np.abs(predicted - found.predicted).max() <= _SAME_READINGS * found.sd:
        return False
    apart, norms = np.linalg.norm(slopes - found.slopes, axis=0), np.linalg.norm(found.slopes, axis=0)
    return bool(np.all(apart <= _SAME_SLOPES * norms + _SAME_READINGS * found.sd))
