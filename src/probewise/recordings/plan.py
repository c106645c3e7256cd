"""A plan says where, when and over what to read; a recording is a plan with its readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray, frozen, frozen_int, require_finite
from probewise._display import ShowsItself
from probewise.errors import ParameterError, ShapeError
from probewise.recordings.patterns import Pattern

__all__ = ["Instrumentation", "Plan", "Recording"]


@dataclass(frozen=True)
class Instrumentation:
    """What took the readings: unit and range of a reading, the sensor, what can be commanded."""

    unit: str = "LEGO"
    min: float | None = None
    max: float | None = None
    step: float | None = None  # quantisation as declared; None = not declared
    sensor: str = ""
    height_mm: float | None = None
    controls: tuple[str, ...] = ()
    description: str = ""

    @property
    def ends(self) -> tuple[float, ...]:
        """Ends of the range, as far as they are declared."""
        return tuple(end for end in (self.min, self.max) if end is not None)


@dataclass(frozen=True, eq=False)
class Plan:
    """Hold one row a reading, in the order of taking: order is information.

    All arrays have shape (n_points,). `scan` numbers the scans from 0 in order of taking
    (a name that returns later is a new scan); `pattern` indexes `pattern_names`. A pattern
    name may be missing from `patterns` only where a hypothesis takes its place.
    """

    x_mm: FloatArray
    y_mm: FloatArray
    orientation_rad: FloatArray
    time_s: FloatArray
    scan: IntArray
    scan_names: tuple[str, ...]
    pattern: IntArray
    pattern_names: tuple[str, ...]
    patterns: Mapping[str, Pattern] = field(default_factory=dict)
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    instrumentation: Instrumentation = field(default_factory=Instrumentation)

    def __post_init__(self) -> None:
        n_points = np.size(self.x_mm)
        for name in ("x_mm", "y_mm", "orientation_rad", "time_s"):
            values = frozen(getattr(self, name))
            if values.shape != (n_points,):
                raise ShapeError(f"{name} has shape {values.shape}; allowed: ({n_points},), as x_mm")
            require_finite(name, values)
            object.__setattr__(self, name, values)
        for name, n_names in (("scan", len(self.scan_names)), ("pattern", len(self.pattern_names))):
            codes = frozen_int(getattr(self, name))
            if codes.shape != (n_points,):
                raise ShapeError(f"{name} has shape {codes.shape}; allowed: ({n_points},), as x_mm")
            if n_points and (codes.min() < 0 or codes.max() >= n_names):
                raise ParameterError(name, (int(codes.min()), int(codes.max())), f"0 to {n_names - 1}")
            object.__setattr__(self, name, codes)
        covariates = {name: frozen(values) for name, values in self.covariates.items()}
        for name, values in covariates.items():
            if values.shape != (n_points,):
                raise ShapeError(f"covariate {name} has shape {values.shape}; allowed: ({n_points},)")
        object.__setattr__(self, "covariates", covariates)

    def __len__(self) -> int:
        return len(self.x_mm)

    @cached_property
    def direction(self) -> FloatArray:
        """Unit vector of the last commanded move within the scan, shape (n_points, 2).

        The first reading of a scan takes that of the next move; a repeat keeps the last
        move's; a scan that stays at one place has (0, 0).
        """
        out = np.zeros((len(self), 2))
        place = np.stack([self.x_mm, self.y_mm], axis=-1)
        for rows in self.rows_by_scan():
            moves = np.diff(place[rows], axis=0)
            lengths = np.hypot(moves[:, 0], moves[:, 1])
            moved = np.flatnonzero(lengths > 0)
            if moved.size == 0:
                continue
            units = moves[moved] / lengths[moved, None]
            last = np.searchsorted(moved, np.arange(len(rows) - 1), side="right") - 1
            out[rows[1:]] = units[np.maximum(last, 0)]
            out[rows[0]] = units[0]
        out.flags.writeable = False
        return out

    def rows_by_scan(self) -> list[IntArray]:
        """Row numbers of each scan, in order of taking."""
        return [np.flatnonzero(self.scan == k) for k in range(len(self.scan_names))]

    def rows_by_pattern(self) -> list[tuple[str, IntArray]]:
        """Pattern names that occur, each with its row numbers."""
        pairs = [(name, np.flatnonzero(self.pattern == k)) for k, name in enumerate(self.pattern_names)]
        return [(name, rows) for name, rows in pairs if rows.size]

    def take(self, rows: IntArray | BoolArray) -> Plan:
        """Keep these rows, in their order (scans and patterns keep their names)."""
        rows = np.flatnonzero(rows) if np.asarray(rows).dtype == np.bool_ else np.asarray(rows, dtype=np.int64)
        kept = np.unique(self.scan[rows])
        return Plan(
            x_mm=self.x_mm[rows],
            y_mm=self.y_mm[rows],
            orientation_rad=self.orientation_rad[rows],
            time_s=self.time_s[rows],
            scan=np.searchsorted(kept, self.scan[rows]),
            scan_names=tuple(self.scan_names[k] for k in kept),
            pattern=self.pattern[rows],
            pattern_names=self.pattern_names,
            patterns=self.patterns,
            covariates={name: values[rows] for name, values in self.covariates.items()},
            instrumentation=self.instrumentation,
        )


@dataclass(frozen=True, eq=False)
class Recording(ShowsItself):
    """Hold a plan and what was read: `readings`, shape (n_points,), NaN where missing.

    `usable` is False where a reading is missing or outside the declared range; such rows
    stay in the plan (lag and backlash need them) and are left out of every likelihood.
    """

    plan: Plan
    readings: FloatArray
    source: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        readings = frozen(self.readings)
        if readings.shape != (len(self.plan),):
            raise ShapeError(f"readings have shape {readings.shape}; allowed: ({len(self.plan)},), as the plan")
        object.__setattr__(self, "readings", readings)

    def __len__(self) -> int:
        return len(self.plan)

    @cached_property
    def usable(self) -> BoolArray:
        """Rows whose reading is present and within the declared range, shape (n_points,)."""
        inst = self.plan.instrumentation
        ok = np.isfinite(self.readings)
        with np.errstate(invalid="ignore"):
            if inst.min is not None:
                ok &= self.readings >= inst.min
            if inst.max is not None:
                ok &= self.readings <= inst.max
        return ok

    def unlimited(self) -> Recording:
        """Declare no range: what was calculated without noise may lie beyond it by a little, and counts too."""
        instrumentation = replace(self.plan.instrumentation, min=None, max=None)
        return Recording(replace(self.plan, instrumentation=instrumentation), self.readings, self.source)

    def take(self, rows: IntArray | BoolArray) -> Recording:
        """Keep these rows, in their order."""
        return Recording(self.plan.take(rows), self.readings[rows], self.source, self.notes)
