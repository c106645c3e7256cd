"""The stages of the chain from pose to reading: the table that they see, and the interface of an effect at each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol, TypeAlias, get_args, runtime_checkable

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.recordings.plan import Plan
from probewise.world.spots import Spot


@dataclass(frozen=True, eq=False)
class Rows:
    """One row per reading, in order of time.

    `place_mm`: position (x, y) of the sensor, shape (n_points, 2): commanded, or true once the arm's errors are
    applied; `direction`: unit vector of the last motion, 0 where there was none, shape (n_points, 2);
    `orientation_rad`: orientation, commanded or true, shape (n_points,); `time_s`: time, shape (n_points,); `scan`:
    number of the scan, an index of `scan_names`, shape (n_points,); `scan_names`: name of each scan; `covariates`:
    other logged columns by name, arrays of shape (n_points,); `across`: unit vector across the straight edges of the
    pattern below, (1, 0) for others (`common_edge_normal`), shape (n_points, 2); `edge_mm`: distance from the sensor's
    position to the pattern's nearest edge, infinite where there is none, (n_points,).
    """

    place_mm: FloatArray
    direction: FloatArray
    orientation_rad: FloatArray
    time_s: FloatArray
    scan: IntArray
    scan_names: tuple[str, ...]
    covariates: Mapping[str, FloatArray]
    across: FloatArray
    edge_mm: FloatArray

    @classmethod
    def from_plan(cls, plan: Plan, across: FloatArray, edge_mm: FloatArray) -> Rows:
        """Build from a plan's commanded poses, with `across` and `edge_mm` of the surfaces below."""
        return cls(
            place_mm=np.stack([plan.x_mm, plan.y_mm], axis=-1),
            direction=plan.direction_of_motion,
            orientation_rad=plan.orientation_rad,
            time_s=plan.time_s,
            scan=plan.scan,
            scan_names=plan.scan_names,
            covariates=plan.covariates,
            across=across,
            edge_mm=edge_mm,
        )

    def commanded_column(self, name: str, *, otherwise: float) -> FloatArray:
        """Return the covariate `name`, shape (n_points,), with `otherwise` in place of NaN or of an absent column."""
        column = self.covariates.get(name, np.full(len(self.time_s), np.nan))
        return np.where(np.isfinite(column), column, otherwise)

    def in_scans_mask(self, names: tuple[str, ...]) -> BoolArray:
        """Return a mask of the rows that belong to a scan in `names`, shape (n_points,)."""
        chosen = [k for k, name in enumerate(self.scan_names) if name in names]
        return np.isin(self.scan, chosen)

    def scan_start_mask(self) -> BoolArray:
        """Return a mask, shape (n_points,), of the rows that start a scan or resume it after another scan."""
        return np.concatenate([[True], self.scan[1:] != self.scan[:-1]])


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
