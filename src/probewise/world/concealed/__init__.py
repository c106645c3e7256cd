"""Effects that a world may have and a plain sensor model leaves out: one small class each, with independent formulas.

A concealed effect acts at one stage of the chain from pose to reading. To add one, write a frozen
dataclass with `name`, `stage` and the method of that stage (`stages`); `World` applies it there.
"""

from probewise.world.concealed.arm import (
    Backlash,
    OrientationError,
    PeriodicPositionError,
    PositionScale,
    ScanAngleError,
)
from probewise.world.concealed.converter import Lag, Quantisation, Saturation
from probewise.world.concealed.footprint import (
    EdgeBlur,
    EdgeShadow,
    Halo,
    HeightGradient,
    HeightOffset,
    SensorTilt,
    SSFOrder,
)
from probewise.world.concealed.light import BatterySag, GainDrift, Nonlinearity
from probewise.world.concealed.noise import (
    CorrelatedNoise,
    DriftingNoise,
    Dropouts,
    HeavyTails,
    Outliers,
    SignalDependentNoise,
)
from probewise.world.concealed.offsets import (
    AmbientGradient,
    AmbientStep,
    Flicker,
    Glint,
    Hysteresis,
    OffsetDrift,
)
from probewise.world.concealed.out_of_vocabulary import (
    AfterGlow,
    BentRail,
    Chirp,
    CrossTalk,
    DeadZone,
    Ghost,
    PeakMemory,
    PlaceStep,
    SlippedPaper,
    StickSlip,
    ThermalGain,
    TwistedRail,
)
from probewise.world.concealed.stages import (
    STAGES,
    Changes,
    ChangesFootprint,
    Concealed,
    Disturbs,
    FootprintPart,
    Retouches,
    Stage,
)
from probewise.world.concealed.surface import AlbedoGradient, AlbedoPatch, EdgeMisplacement, ScanMisplacement

__all__ = [
    "STAGES",
    "AfterGlow",
    "AlbedoGradient",
    "AlbedoPatch",
    "AmbientGradient",
    "AmbientStep",
    "Backlash",
    "BatterySag",
    "BentRail",
    "Changes",
    "ChangesFootprint",
    "Chirp",
    "Concealed",
    "CorrelatedNoise",
    "CrossTalk",
    "DeadZone",
    "Disturbs",
    "DriftingNoise",
    "Dropouts",
    "EdgeBlur",
    "EdgeMisplacement",
    "EdgeShadow",
    "Flicker",
    "FootprintPart",
    "GainDrift",
    "Ghost",
    "Glint",
    "Halo",
    "HeavyTails",
    "HeightGradient",
    "HeightOffset",
    "Hysteresis",
    "Lag",
    "Nonlinearity",
    "OffsetDrift",
    "OrientationError",
    "Outliers",
    "PeakMemory",
    "PeriodicPositionError",
    "PlaceStep",
    "PositionScale",
    "Quantisation",
    "Retouches",
    "SSFOrder",
    "Saturation",
    "ScanAngleError",
    "ScanMisplacement",
    "SensorTilt",
    "SignalDependentNoise",
    "SlippedPaper",
    "Stage",
    "StickSlip",
    "ThermalGain",
    "TwistedRail",
]

Glimpse = FootprintPart
"""The old name of `FootprintPart`."""

Looks = ChangesFootprint
"""The old name of `ChangesFootprint`."""
