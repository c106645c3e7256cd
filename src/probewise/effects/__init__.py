"""The physics that a sensor model may leave out, each effect one function at one stage of the chain.

The paper's model (eq. modelI) holds the footprint and two levels and nothing else; these are the named
departures from it. A new effect is one class (a `NamedEffect`) and one line in `VOCABULARY`.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from probewise.effects.albedo import AlbedoGradient, AlbedoPatch
from probewise.effects.angles import OrientationError, ScanAngleError
from probewise.effects.edges import EdgeBlur, EdgeShadow, Halo
from probewise.effects.extent import Extent
from probewise.effects.faults import Dropouts, Outliers
from probewise.effects.gain import BatterySag, GainDrift
from probewise.effects.glint import Glint
from probewise.effects.heavy_tailed import HeavyTailed, LogHeavyTailed
from probewise.effects.height import HeightGradient, HeightOffset
from probewise.effects.knocks import ArmKnock, GainStep
from probewise.effects.known import Known
from probewise.effects.lattice import Quantisation, lattice_step, lattice_step_sd
from probewise.effects.misplacement import EdgeMisplacement, ScanMisplacement
from probewise.effects.moves import in_scans, sign_of_move
from probewise.effects.noise import CorrelatedNoise, DriftingNoise, NoisePerRun, RandomWalk, SignalDependentNoise
from probewise.effects.noise_law import NoiseRows, draw_readings, log_density, variance
from probewise.effects.offsets import AmbientGradient, AmbientStep, OffsetDrift
from probewise.effects.pose import Backlash, PositionScale
from probewise.effects.predictive_mixture import PredictiveMixture
from probewise.effects.rails import BentRails, MissingTooth
from probewise.effects.readings import Hysteresis, Lag
from probewise.effects.reflection import Reflection
from probewise.effects.response import Nonlinearity
from probewise.effects.saturation import Saturation
from probewise.effects.tilt import SensorTilt
from probewise.effects.vocabulary import NamedEffect, NoiseEffect
from probewise.effects.waves import Flicker, PeriodicPositionError, StickSlip
from probewise.effects.wear import SlowSinking, SlowTurn

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
"""Every effect that the diagnosis weighs, by name."""

UNNAMED: Mapping[str, type[NamedEffect[Any]]] = MappingProxyType(
    {
        effect.name: effect
        for effect in (ArmKnock, GainStep, BentRails, MissingTooth, StickSlip, Reflection, SlowTurn, SlowSinking)
    }
)
"""Physics outside the vocabulary, by names of our own: what a diagnosis says is unknown, and what it may be."""

EFFECTS: Mapping[str, type[NamedEffect[Any]]] = MappingProxyType({**VOCABULARY, **UNNAMED})
"""All physics that has a formula here, by name, whether the vocabulary has it or not."""

PROPOSAL = "formula:"
"""What the names of formulas begin with that are proposed for what has no name."""


def is_out_of_vocabulary(name: str) -> bool:
    """Tell whether an effect has a formula and no name in the vocabulary."""
    return name in UNNAMED or name.startswith(PROPOSAL)


AGAIN = "~again"
"""What the name of an effect ends with that may be there a second time, beside the first."""


def public_name(name: str) -> str:
    """Name an effect as a person knows it, be it the first of its kind or the second."""
    return name.removesuffix(AGAIN)


def spoken_name(name: str) -> str:
    """Write a name without underscores, but for those of a person's own columns, parameters and states."""
    own = public_name(name)
    return own if ":" in own else own.replace("_", " ")


def first_of(name: str) -> str | None:
    """Name the effect that has to be there before this one; None where it can stand alone."""
    return name.removesuffix(AGAIN) if name.endswith(AGAIN) else None


NUISANCES: Mapping[str, type[NoiseEffect]] = MappingProxyType({DriftingNoise.name: DriftingNoise})
"""What may be wrong with the noise and has no name in the vocabulary, by a name of our own."""

__all__ = [
    "AGAIN",
    "EFFECTS",
    "NUISANCES",
    "PROPOSAL",
    "UNNAMED",
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
    "DriftingNoise",
    "Dropouts",
    "EdgeBlur",
    "EdgeMisplacement",
    "EdgeShadow",
    "Extent",
    "Flicker",
    "GainDrift",
    "GainStep",
    "Glint",
    "Halo",
    "HeavyTailed",
    "HeightGradient",
    "HeightOffset",
    "Hysteresis",
    "Known",
    "Lag",
    "LogHeavyTailed",
    "MissingTooth",
    "NamedEffect",
    "NoiseEffect",
    "NoisePerRun",
    "NoiseRows",
    "Nonlinearity",
    "OffsetDrift",
    "OrientationError",
    "Outliers",
    "PeriodicPositionError",
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
    "draw_readings",
    "first_of",
    "in_scans",
    "is_out_of_vocabulary",
    "lattice_step",
    "lattice_step_sd",
    "log_density",
    "public_name",
    "sign_of_move",
    "spoken_name",
    "variance",
]
