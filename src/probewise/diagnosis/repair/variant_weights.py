"""The probabilities of an effect's discrete choices, such as the interval of a step, beside the other effects of a fit.

The search finds them when it adds the effect. An effect that was added later takes its share of the residual away, and
the choice is far better known.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.evidence.bank import TemplateBank
from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.evidence.screening import log_bayes_factors_by_label
from probewise.diagnosis.evidence.templates import templates_of_effect
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.noise.law import NoiseLaw


def weights_beside_other_effects(
    found: Fit, law: NoiseLaw, usable: IntArray, weights: Mapping[str, FloatArray]
) -> Mapping[str, FloatArray]:
    """Return the probabilities of each effect's variants (discrete choices), given a fit with several effects.

    Parameters
    ----------
    found
        The fit, in which each effect is bound to one variant.
    law
        The noise.
    usable
        Rows of the readings, (n_usable,).
    weights
        The probabilities as each effect was added, by effect, (n_variants,). They are returned for a single effect, and
        for one whose choice no parameter shows.
    """
    effects = found.model.effects
    if len(effects) < 2:
        return weights
    out = dict(weights)
    for effect in effects:
        if effect.has_change_point and len(effect.variants()) == len(weights[effect.name]) > 1:
            without = _fit_without(found, effect.name, usable)
            templates = templates_of_effect(without, effect, usable)
            bank = TemplateBank.of(templates.columns, [effect.name] * len(templates.columns), len(found.residuals))
            scores = log_bayes_factors_by_label(Linearised.of(without, law), bank)[effect.name]
            if np.isfinite(scores).all():
                out[effect.name] = templates.variant_probabilities(scores)
    return out


def _fit_without(found: Fit, name: str, usable: IntArray) -> Fit:
    """Return a fit without one of its effects: what that explains is in the residuals, the other parameters stay."""
    model, stay = found.model.model_and_mask_without(name)
    change = found.change_by_effect(name, usable)
    return Fit(
        model,
        found.z[stay],
        found.predicted - change,
        found.residuals + change,
        found.slopes[:, stay],
        sd=found.sd,
        objective=found.objective,
    )
