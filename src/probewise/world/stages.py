"""The stages of the chain from pose to reading, and the interface of an effect at each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol, TypeAlias, get_args, runtime_checkable

import numpy as np

from probewise._arrays import FloatArray
from probewise.world.rows import Rows
from probewise.world.spots import Spot

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
STAGES: tuple[Stage, ...] = get_args(Stage)
"""In order: pose, scene, footprint, u, response, gain, offsets, lag, saturation, noise, rounding."""

AFTER_VIEW = STAGES[STAGES.index("response") :]
"""The stages after `World.view`, in which the light is summed."""


@dataclass(frozen=True, eq=False)
class FootprintPart:
    """A component of the footprint: a `share` of the light comes through `spot`, moved by `shift_mm` (lab frame)."""

    share: float
    spot: Spot
    shift_mm: tuple[float, float] = (0.0, 0.0)


@runtime_checkable
class ChangesQuantity(Protocol):
    """An effect that changes one quantity per reading.

    The quantity by stage: "place", position of the sensor, (n_points, 2), mm; "turn", its orientation, rad; "pattern",
    displacement of the pattern from its description, (n_points, 2), mm; "tilt", shift of the footprint in the lab
    frame, (n_points, 2), mm; "height" above the surface, mm; "seen" and "response", the seen white fraction u; "gain",
    the signal without I_min; "offset", "lag", "saturation" and "quantisation", the reading. Shape (n_points,) unless
    given.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Return `values` with the effect on them; `rows` hold true poses, but commanded ones at "place" and "turn"."""
        ...


@runtime_checkable
class Retouches(Protocol):
    """An effect that changes the surface, at the stage "albedo"."""

    name: ClassVar[str]
    stage: ClassVar[Stage]

    def retouch(self, albedo: FloatArray, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Return the changed albedo at points `x_mm`, `y_mm` of the lab frame; all arrays of one shape."""
        ...


@runtime_checkable
class ChangesFootprint(Protocol):
    """An effect that changes the footprint, at the stage "footprint"."""

    name: ClassVar[str]
    stage: ClassVar[Stage]

    def change_footprint(self, parts: Sequence[FootprintPart]) -> tuple[FootprintPart, ...]:
        """Return the components of the changed footprint; their shares sum to one."""
        ...


@runtime_checkable
class Disturbs(Protocol):
    """An effect that changes the noise or loses readings.

    At the stage "noise", `values` are independent standard normal draws and become the noise in units of its sd; at
    "loss" they are the finished readings. Shape (n_points,).
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return `values` with the effect on them; `seen` is the seen white fraction, (n_points,)."""
        ...


Concealed: TypeAlias = ChangesQuantity | Retouches | ChangesFootprint | Disturbs
