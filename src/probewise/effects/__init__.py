"""Effects: physics that a sensor model may leave out, each one function at one stage of the chain.

The paper's model, M = I_min + (I_max - I_min) R, holds the footprint (in its response R) and two levels; these are the
named departures from it. A new effect is a class (a `NamedEffect`), passed as ``effects={**VOCABULARY, name: class}``.

Drifts, gradients, scales and the phases of waves count from an `Origin`: time 0 and place (0, 0), or, where all of a
recording lies farther from 0 than ten times its duration (or its size), its first time (or the middle of its places).
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from probewise.effects.effect import NamedEffect, NoiseEffect
from probewise.effects.known import Estimated, Informed, Known
from probewise.effects.noise import (
    CorrelatedNoise,
    DriftingNoise,
    Dropouts,
    NoisePerRun,
    Outliers,
    Quantisation,
    RandomWalk,
    SignalDependentNoise,
    lattice_step,
    sd_of_estimated_lattice_step,
)
from probewise.effects.noise_distribution import FittedReadings, PredictiveMixture, log_density, reading_variance
from probewise.effects.optics import (
    AlbedoGradient,
    AlbedoPatch,
    EdgeBlur,
    EdgeMisplacement,
    EdgeShadow,
    Glint,
    Halo,
    HeightGradient,
    HeightOffset,
    Reflection,
    ScanMisplacement,
    SlowSinking,
)
from probewise.effects.pose import (
    ArmKnock,
    Backlash,
    BentRails,
    MissingTooth,
    OrientationError,
    PeriodicPositionError,
    PositionScale,
    ScanAngleError,
    SensorTilt,
    SlowTurn,
    StickSlip,
)
from probewise.effects.priors import HeavyTailedPrior, LogHeavyTailedPrior
from probewise.effects.reading import (
    AmbientGradient,
    AmbientStep,
    BatterySag,
    Flicker,
    GainDrift,
    GainStep,
    Hysteresis,
    Lag,
    Nonlinearity,
    OffsetDrift,
    Overshoot,
    Polarisation,
    Saturation,
)
from probewise.effects.reference import (
    CountsFromOrigin,
    Extent,
    Origin,
    orientation_deg,
    origins_of,
    scan_indicator,
    sign_of_motion,
)

VOCABULARY: Mapping[str, type[NamedEffect[Any]]] = MappingProxyType(
    {
        effect.name: effect
        for effect in (
            AmbientGradient,
            AmbientStep,
            OffsetDrift,
            GainDrift,
            BatterySag,
            Flicker,
            Saturation,
            Nonlinearity,
            Hysteresis,
            Lag,
            Backlash,
            PositionScale,
            PeriodicPositionError,
            EdgeMisplacement,
            ScanMisplacement,
            ScanAngleError,
            OrientationError,
            SensorTilt,
            HeightGradient,
            HeightOffset,
            AlbedoGradient,
            AlbedoPatch,
            EdgeBlur,
            EdgeShadow,
            Halo,
            Glint,
            Quantisation,
            SignalDependentNoise,
            CorrelatedNoise,
            Outliers,
            Dropouts,
        )
    }
)
"""Every effect that the diagnosis considers, by name."""

RARE_EFFECTS: Mapping[str, type[NamedEffect[Any]]] = MappingProxyType(
    {
        effect.name: effect
        for effect in (
            ArmKnock,
            GainStep,
            BentRails,
            MissingTooth,
            StickSlip,
            Reflection,
            SlowTurn,
            SlowSinking,
            Overshoot,
            Polarisation,
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


NUISANCES: Mapping[str, type[NoiseEffect]] = MappingProxyType({DriftingNoise.name: DriftingNoise})
"""Departures of the noise that have no name in the vocabulary; they only keep the tests of the mean valid."""

__all__ = [
    "AGAIN",
    "EFFECTS",
    "NUISANCES",
    "PROPOSAL",
    "RARE_EFFECTS",
    "VOCABULARY",
    "AlbedoGradient",
    "AlbedoPatch",
    "AmbientGradient",
    "AmbientStep",
    "ArmKnock",
    "Backlash",
    "BatterySag",
    "BentRails",
    "CorrelatedNoise",
    "CountsFromOrigin",
    "DriftingNoise",
    "Dropouts",
    "EdgeBlur",
    "EdgeMisplacement",
    "EdgeShadow",
    "Estimated",
    "Extent",
    "FittedReadings",
    "Flicker",
    "GainDrift",
    "GainStep",
    "Glint",
    "Halo",
    "HeavyTailedPrior",
    "HeightGradient",
    "HeightOffset",
    "Hysteresis",
    "Informed",
    "Known",
    "Lag",
    "LogHeavyTailedPrior",
    "MissingTooth",
    "NamedEffect",
    "NoiseEffect",
    "NoisePerRun",
    "Nonlinearity",
    "OffsetDrift",
    "OrientationError",
    "Origin",
    "Outliers",
    "Overshoot",
    "PeriodicPositionError",
    "Polarisation",
    "PositionScale",
    "PredictiveMixture",
    "Quantisation",
    "RandomWalk",
    "Reflection",
    "Saturation",
    "ScanAngleError",
    "ScanMisplacement",
    "SensorTilt",
    "SignalDependentNoise",
    "SlowSinking",
    "SlowTurn",
    "StickSlip",
    "is_out_of_vocabulary",
    "lattice_step",
    "log_density",
    "name_of_first_copy",
    "name_without_copy_suffix",
    "orientation_deg",
    "origins_of",
    "reading_variance",
    "scan_indicator",
    "sd_of_estimated_lattice_step",
    "sign_of_motion",
    "spoken_name",
]
