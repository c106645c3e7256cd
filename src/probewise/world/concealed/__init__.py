"""Effects that a world may have and a plain sensor model leaves out: one small class each, written independently of it.

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
    ExtraGaussian,
    Halo,
    HeightGradient,
    HeightOffset,
    SensorTilt,
)
from probewise.world.concealed.light import BatterySag, GainDrift, Nonlinearity
from probewise.world.concealed.noise import (
    CorrelatedNoise,
    Dropouts,
    HeavyTails,
    Outliers,
    RisingNoiseSd,
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
    Chirp,
    CubicPositionError,
    DeadZone,
    Ghost,
    OrientationDependentGain,
    PeakMemory,
    PlaceStep,
    QuadraticPositionError,
    SlippedPaper,
    StickSlip,
    ThermalGain,
)
from probewise.world.concealed.stages import (
    STAGES,
    ChangesFootprint,
    ChangesQuantity,
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
    "ChangesFootprint",
    "ChangesQuantity",
    "Chirp",
    "Concealed",
    "CorrelatedNoise",
    "CubicPositionError",
    "DeadZone",
    "Disturbs",
    "Dropouts",
    "EdgeBlur",
    "EdgeMisplacement",
    "EdgeShadow",
    "ExtraGaussian",
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
    "OrientationDependentGain",
    "OrientationError",
    "Outliers",
    "PeakMemory",
    "PeriodicPositionError",
    "PlaceStep",
    "PositionScale",
    "QuadraticPositionError",
    "Quantisation",
    "Retouches",
    "RisingNoiseSd",
    "Saturation",
    "ScanAngleError",
    "ScanMisplacement",
    "SensorTilt",
    "SignalDependentNoise",
    "SlippedPaper",
    "Stage",
    "StickSlip",
    "ThermalGain",
]
