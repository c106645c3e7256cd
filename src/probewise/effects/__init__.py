"""Effects: physics that a sensor model may leave out, each one function at one stage of the chain.

The paper's model, M = I_min + (I_max - I_min) R, holds the footprint (in its response R) and two levels; these are the
named departures from it. A new effect is a class (a `NamedEffect`), passed as ``effects={**VOCABULARY, name: class}``.

Drifts, gradients, scales and the phases of waves count from an `Origin`: time 0 and place (0, 0), or, where all of a
recording lies farther from 0 than ten times its duration (or its size), its first time (or the middle of its places).
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from probewise.effects import noise, optics, pose, reading
from probewise.effects.effect import NamedEffect, NoiseEffect
from probewise.effects.known import Estimated, Known
from probewise.effects.priors import HeavyTailedPrior, LogHeavyTailedPrior
from probewise.effects.reference import Extent, Origin

VOCABULARY: Mapping[str, type[NamedEffect[Any]]] = MappingProxyType(
    {
        effect.name: effect
        for effect in (
            reading.AmbientGradient,
            reading.AmbientStep,
            reading.OffsetDrift,
            reading.GainDrift,
            reading.BatterySag,
            reading.Flicker,
            reading.Saturation,
            reading.Nonlinearity,
            reading.Hysteresis,
            reading.Lag,
            pose.Backlash,
            pose.PositionScale,
            pose.PeriodicPositionError,
            optics.EdgeMisplacement,
            optics.ScanMisplacement,
            pose.ScanAngleError,
            pose.OrientationError,
            pose.SensorTilt,
            optics.HeightGradient,
            optics.HeightOffset,
            optics.AlbedoGradient,
            optics.AlbedoPatch,
            optics.EdgeBlur,
            optics.EdgeShadow,
            optics.Halo,
            optics.Glint,
            noise.Quantisation,
            noise.SignalDependentNoise,
            noise.CorrelatedNoise,
            noise.Outliers,
            noise.Dropouts,
        )
    }
)
"""Every effect that the diagnosis considers, by name."""

RARE_EFFECTS: Mapping[str, type[NamedEffect[Any]]] = MappingProxyType(
    {
        effect.name: effect
        for effect in (
            pose.ArmKnock,
            reading.GainStep,
            pose.BentRails,
            pose.MissingTooth,
            pose.StickSlip,
            optics.Reflection,
            pose.SlowTurn,
            optics.SlowSinking,
            reading.Overshoot,
            reading.Polarisation,
        )
    }
)
"""Rare physics outside the vocabulary, by name.

A diagnosis names it where hardly anything else out of vocabulary explains the readings; otherwise it suggests it as a
form of the unknown.
"""


EFFECTS: Mapping[str, type[NamedEffect[Any]]] = MappingProxyType({**VOCABULARY, **RARE_EFFECTS})
"""Every effect that has a formula here, by name, in the vocabulary or out of it."""

PROPOSAL = "formula:"
"""Prefix of the names of formulas that are proposed for a residual which no named effect explains."""


def is_out_of_vocabulary(name: str) -> bool:
    """Return whether an effect is outside the vocabulary: a rare one, or a proposed formula."""
    return name in RARE_EFFECTS or name.startswith(PROPOSAL)


AGAIN = "~again"
"""Suffix of an effect's second copy: the same physics twice, as two steps of the light."""


def name_without_copy_suffix(name: str) -> str:
    """Return an effect's name without the suffix of a second copy, "~again"."""
    return name.removesuffix(AGAIN)


def spoken_name(name: str) -> str:
    """Return an effect's name without a copy's suffix; spaces for underscores, unless with a target ("drifts:a_1")."""
    own = name_without_copy_suffix(name)
    return own if ":" in own else own.replace("_", " ")


def name_of_first_copy(name: str) -> str | None:
    """Return the name of the first copy if `name` is that of a second copy, otherwise None."""
    return name.removesuffix(AGAIN) if name.endswith(AGAIN) else None


NUISANCES: Mapping[str, type[NoiseEffect]] = MappingProxyType({noise.DriftingNoise.name: noise.DriftingNoise})
"""Departures of the noise that have no name in the vocabulary; they only keep the tests of the mean valid."""

__all__ = [
    "AGAIN",
    "EFFECTS",
    "NUISANCES",
    "PROPOSAL",
    "RARE_EFFECTS",
    "VOCABULARY",
    "Estimated",
    "Extent",
    "HeavyTailedPrior",
    "Known",
    "LogHeavyTailedPrior",
    "NamedEffect",
    "NoiseEffect",
    "Origin",
    "is_out_of_vocabulary",
    "name_of_first_copy",
    "name_without_copy_suffix",
    "spoken_name",
]
