"""The physics that a sensor model may leave out, each effect one function at one stage of the chain.

The paper's model (eq. modelI) holds the footprint and two levels and nothing else; these are the named
departures from it. A new effect is one class (a `NamedEffect`) and one line in `VOCABULARY`.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from probewise.effects.gain import GainDrift
from probewise.effects.heavy_tailed import HeavyTailed, LogHeavyTailed
from probewise.effects.known import Known
from probewise.effects.noise import CorrelatedNoise
from probewise.effects.offsets import AmbientGradient
from probewise.effects.pose import Backlash
from probewise.effects.response import Nonlinearity
from probewise.effects.saturation import Saturation
from probewise.effects.vocabulary import Extent, NamedEffect

VOCABULARY: Mapping[str, type[NamedEffect[Any]]] = MappingProxyType(
    {
        effect.name: effect
        for effect in (Backlash, GainDrift, AmbientGradient, Saturation, Nonlinearity, CorrelatedNoise)
    }
)
"""Every effect that can be named, by name."""

__all__ = [
    "VOCABULARY",
    "AmbientGradient",
    "Backlash",
    "CorrelatedNoise",
    "Extent",
    "GainDrift",
    "HeavyTailed",
    "Known",
    "LogHeavyTailed",
    "NamedEffect",
    "Nonlinearity",
    "Saturation",
]
