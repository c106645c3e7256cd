"""Where on the way from pose to reading a concealed effect acts, and what it gets hold of there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np

from probewise._arrays import FloatArray
from probewise.world.rows import Rows
from probewise.world.spots import Spot

__all__ = ["ANSWERING", "STAGES", "Changes", "Concealed", "Disturbs", "Glimpse", "Looks", "Retouches", "Stage"]

Stage: TypeAlias = Literal[
    "place",
    "turn",
    "pattern",
    "albedo",
    "tilt",
    "height",
    "footprint",
    "seen",
    "response",
    "gain",
    "offset",
    "lag",
    "saturation",
    "noise",
    "quantisation",
    "loss",
]
STAGES: tuple[Stage, ...] = (
    "place",
    "turn",
    "pattern",
    "albedo",
    "tilt",
    "height",
    "footprint",
    "seen",
    "response",
    "gain",
    "offset",
    "lag",
    "saturation",
    "noise",
    "quantisation",
    "loss",
)
"""In the order of diagnosis: pose, scene, footprint, u, response, gain, offsets, lag, saturation, noise, rounding."""

ANSWERING = STAGES[STAGES.index("response") :]
"""The stages that come after the light is summed (World.look)."""


@dataclass(frozen=True, eq=False)
class Glimpse:
    """A share of the light that comes by way of a spot; `shift_mm` displaces it in the lab frame."""

    share: float
    spot: Spot
    shift_mm: tuple[float, float] = (0.0, 0.0)


@runtime_checkable
class Changes(Protocol):
    """Change one value a reading.

    By stage: "place", where the sensor stands (n_points, 2) in mm; "turn", its orientation in rad;
    "pattern", how far the pattern lies from where it is described, (n_points, 2) in mm; "tilt", how far
    the footprint is shifted in the lab frame, (n_points, 2) in mm; "height" above the surface in mm;
    "seen" and "response", the seen white fraction u; "gain", the signal without I_min; "offset", "lag",
    "saturation" and "quantisation", the reading; (n_points,) where not said otherwise.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Apply the effect."""
        ...


@runtime_checkable
class Retouches(Protocol):
    """Change the surface, at the stage "albedo"."""

    name: ClassVar[str]
    stage: ClassVar[Stage]

    def retouch(self, albedo: FloatArray, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Return the albedo at places in the lab frame, arrays of one shape in, the same shape out."""
        ...


@runtime_checkable
class Looks(Protocol):
    """Change what the sensor sees by, at the stage "footprint"."""

    name: ClassVar[str]
    stage: ClassVar[Stage]

    def look(self, glimpses: Sequence[Glimpse]) -> tuple[Glimpse, ...]:
        """Return the glimpses, shares summing to one, that take the place of these."""
        ...


@runtime_checkable
class Disturbs(Protocol):
    """Change the noise or lose readings.

    By stage: "noise", independent standard normal draws to be turned into the noise in units of its sd;
    "loss", the finished readings; (n_points,).
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Apply the effect; `seen` is the seen white fraction, (n_points,)."""
        ...


Concealed: TypeAlias = Changes | Retouches | Looks | Disturbs
