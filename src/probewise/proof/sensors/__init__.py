"""Challenge cases: simulated recordings that conceal an effect of a known size, drawn from a secret seed.

A case's sensor, plan, noise and effect follow from the seed and its number alone; its held-out readings come from the
same world. The size lambda of an effect is the norm of its residuals after a refit of the null model, in noise sds; the
caller supplies a function for that refit.
"""

from probewise.proof.sensors.cases import ALIASES, Case, draw_case, held_out_recordings
from probewise.proof.sensors.in_vocabulary import INSIDE, NEEDS_SENSOR, NO_PHYSICS, SINGLES
from probewise.proof.sensors.out_of_vocabulary import OUTSIDE
from probewise.proof.sensors.plans import PLANS, draw_plan_with_displaced_patterns, held_out_plans
from probewise.proof.sensors.regions import CovariateRegion
from probewise.proof.sensors.sensors import (
    NOISE_LEVELS,
    NOISE_MODELS,
    NOISE_NAMES,
    SSFS,
    draw_sensor,
    with_noise_model,
)
from probewise.proof.sensors.sizing import EffectSizer, NormAfterRefit, amplitude_of_size
from probewise.proof.sensors.strata import WHEEL, CaseKind, Stratum, stratum_of
from probewise.proof.sensors.truth import AliasedEffect, HiddenEffect, Truth

__all__ = [
    "ALIASES",
    "INSIDE",
    "NEEDS_SENSOR",
    "NOISE_LEVELS",
    "NOISE_MODELS",
    "NOISE_NAMES",
    "NO_PHYSICS",
    "OUTSIDE",
    "PLANS",
    "SINGLES",
    "SSFS",
    "WHEEL",
    "AliasedEffect",
    "Case",
    "CaseKind",
    "CovariateRegion",
    "EffectSizer",
    "HiddenEffect",
    "NormAfterRefit",
    "Stratum",
    "Truth",
    "amplitude_of_size",
    "draw_case",
    "draw_plan_with_displaced_patterns",
    "draw_sensor",
    "held_out_plans",
    "held_out_recordings",
    "stratum_of",
    "with_noise_model",
]
