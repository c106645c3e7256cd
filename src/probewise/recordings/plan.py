"""A plan: pose, time and pattern of every reading. A recording: a plan with its readings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from probewise._arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    data_frame,
    floats,
    frozen_int,
    read_only_floats,
    require_finite,
    rounding_error,
)
from probewise._display import ShowsItself
from probewise._kinds import checked_finite_number, checked_whole, require_kind, require_text, warn_of_likely_degrees
from probewise._words import unit_after_number
from probewise.errors import ParameterError, ShapeError, require
from probewise.recordings.cells import times_to_numbers
from probewise.recordings.columns import (
    A_PATTERN,
    SESSION,
    TableLike,
    checked_covariates,
    columns_by_name,
    how_to_describe_pattern,
    notes_on_codes,
    notes_on_names,
    numbers_per_reading,
    numeric_covariates_and_notes,
    pattern_codes,
    require_patterns,
    scan_codes_and_names,
    selected_row_numbers,
    sessions_of_scans,
    texts_to_numbers,
)
from probewise.recordings.io import LARGEST
from probewise.recordings.patterns import Pattern
from probewise.recordings.table import LARGEST_PLACE_MM


@dataclass(frozen=True)
class Instrumentation:
    """The instrument: unit, range and step of a reading, the sensor, and the columns that can be commanded.

    None is not declared; `height_mm` is the sensor's height above the surface.
    """

    unit: str = "LEGO"
    min: float | None = None
    max: float | None = None
    step: float | None = None
    sensor: str = ""
    height_mm: float | None = None
    controls: tuple[str, ...] = ()
    description: str = ""

    def __post_init__(self) -> None:
        for name in ("unit", "sensor"):
            require_text(name, getattr(self, name))
        require_kind("description", self.description, str, "a text")
        for name in ("min", "max", "step", "height_mm"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, checked_finite_number(name, getattr(self, name), "a number or None"))
        if self.min is not None and self.max is not None:
            require(self.min < self.max, "max", self.max, f"greater than min, {self.min:g}")
        for name in ("step", "height_mm"):
            if getattr(self, name) is not None:
                require(getattr(self, name) > 0, name, getattr(self, name), "a number greater than 0")
        listed = isinstance(self.controls, Iterable) and not isinstance(self.controls, str)
        fits = listed and all(isinstance(name, str) for name in self.controls)
        require(fits, "controls", self.controls, "a tuple of texts")
        object.__setattr__(self, "controls", tuple(self.controls))

    @property
    def unit_after_number(self) -> str:
        """The unit as written after a number: "LEGO units" for "LEGO", nothing for "1"."""
        return unit_after_number(self.unit)

    @property
    def declared_ends(self) -> tuple[float, ...]:
        """Least and greatest reading of the declared range, as far as they are declared: two, one or none."""
        return tuple(end for end in (self.min, self.max) if end is not None)


@dataclass(frozen=True, eq=False)
class Plan:
    """Pose, time and pattern of every reading, in the order they are taken (the order matters for lag and backlash).

    All arrays have shape (n_points,). `scan` numbers the scans from 0 in the order they are taken (a name that returns
    later is a new scan); `pattern` indexes `pattern_names`. A pattern name may be missing from `patterns` only if
    hypotheses describe that pattern. `sessions` numbers the recording that each scan is from, from 0, where several
    were joined; empty for one recording.
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
    sessions: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for name in ("scan_names", "pattern_names"):
            names: Any = getattr(self, name)
            several = isinstance(names, Sequence | np.ndarray) and not isinstance(names, str)
            if not (several and all(issubclass(kind, str) for kind in {*map(type, names)})):
                raise ParameterError(name, names, "a tuple of texts")
        if len(self.sessions) not in (0, len(self.scan_names)):
            raise ParameterError("sessions", self.sessions, f"one number per scan ({len(self.scan_names)}), or none")
        sessions = tuple(checked_whole("sessions", each, least=0, most=None) for each in self.sessions)
        object.__setattr__(self, "sessions", sessions)
        require_kind("patterns", self.patterns, Mapping, "patterns by name: {'edge': HalfPlane(...)}")
        require_patterns(self.patterns)
        require_kind("instrumentation", self.instrumentation, Instrumentation, "an Instrumentation(unit=...)")
        n_points = np.size(self.x_mm)
        numbers = ("x_mm", "y_mm", "orientation_rad", "time_s")
        arrays: dict[str, FloatArray | IntArray] = {n: read_only_floats(getattr(self, n), n) for n in numbers}
        arrays |= {name: frozen_int(getattr(self, name), name) for name in ("scan", "pattern")}
        for name, values in arrays.items():
            if values.shape != (n_points,):
                raise ShapeError(f"{name} has shape {values.shape}; allowed: ({n_points},), as x_mm")
            object.__setattr__(self, name, values)
        for name in numbers:
            require_finite(name, getattr(self, name))
        for name, n_names in (("scan", len(self.scan_names)), ("pattern", len(self.pattern_names))):
            codes = arrays[name]
            if n_points and (codes.min() < 0 or codes.max() >= n_names):
                raise ParameterError(name, (int(codes.min()), int(codes.max())), f"0 to {n_names - 1}")
        covariates = {name: read_only_floats(values, f"covariate {name}") for name, values in self.covariates.items()}
        for name, values in covariates.items():
            if values.shape != (n_points,):
                raise ShapeError(f"covariate {name} has shape {values.shape}; allowed: ({n_points},)")
        object.__setattr__(self, "covariates", covariates)

    @classmethod
    def from_arrays(
        cls,
        *,
        x_mm: ArrayLike,
        y_mm: ArrayLike,
        patterns: Mapping[str, Pattern] | Pattern,
        unit: str,
        pattern: str | Sequence[str] | None = None,
        orientation_rad: ArrayLike = 0.0,
        time_s: ArrayLike | None = None,
        scan: str | Sequence[object] | None = None,
        session: ArrayLike | None = None,
        covariates: Mapping[str, ArrayLike] | None = None,
        min: float | None = None,
        max: float | None = None,
        step: float | None = None,
        sensor: str = "",
        height_mm: float | None = None,
        controls: tuple[str, ...] = (),
    ) -> Self:
        """Make a plan from arrays, lists or columns of a table, with one entry per reading in the order they are taken.

        Raises ParameterError if a pattern is named but not described, or an argument has the wrong type; ShapeError if
        the arguments differ in length.

        Parameters
        ----------
        x_mm, y_mm
            Commanded position of the sensor, shape (n_points,); a single number holds for all readings.
        patterns
            What lies under the sensor: patterns by name, or one pattern under every reading.
        unit
            Unit of a reading, such as "V" or "LEGO".
        pattern
            Name of the pattern under each reading, or of the one under all; required if there are several.
        orientation_rad
            Rotation of the sensor about its vertical axis, anticlockwise from above, (n_points,) or one for all.
        time_s
            Times, shape (n_points,), in seconds, or dates, which become seconds since the first; by default one second
            apart.
        scan
            Name or number of the scan of each reading; a change begins a new scan. By default all are one scan.
        session
            Number of the recording of each reading, from 0, where scans are of several; by default they are of one.
        covariates
            Further numbers by name, one per reading each, such as `battery_mv`.
        min, max, step
            Range and quantisation of a reading, where they are known.
        sensor, height_mm, controls
            Name of the sensor, its height above the surface, and what else can be commanded, such as "orientation_deg".

        Examples
        --------
        >>> from probewise.recordings import HalfPlane, Plan
        >>> edge = HalfPlane(normal_rad=0.0, offset_mm=0.0)
        >>> plan = Plan.from_arrays(x_mm=[-10, 0, 10], y_mm=0, patterns=edge, unit="V")
        >>> len(plan), plan.pattern_names
        (3, ('pattern',))
        """
        x_mm, y_mm = floats(x_mm, "x_mm"), floats(y_mm, "y_mm")
        sizes = [values.size for values in (x_mm, y_mm) if values.ndim > 0]
        x = numbers_per_reading("x_mm", x_mm, sizes[0] if sizes else 1)
        n_points = len(x)
        turns = numbers_per_reading("orientation_rad", orientation_rad, n_points)
        warn_of_likely_degrees("orientation_rad", turns)
        described = dict(patterns) if isinstance(patterns, Mapping) else {"pattern": patterns}
        if not described:
            allowed = f"what lay under the sensor, by name: {{'edge': HalfPlane(...), ...}}, or {A_PATTERN}"
            raise ParameterError("patterns", patterns, allowed)
        require_patterns(described)
        code, scan_names = scan_codes_and_names(scan, n_points)
        number = numbers_per_reading("session", 0.0 if session is None else session, n_points)
        times = np.arange(n_points, dtype=np.float64) if time_s is None else time_s
        return cls(
            x_mm=x,
            y_mm=numbers_per_reading("y_mm", y_mm, n_points),
            orientation_rad=turns,
            time_s=numbers_per_reading("time_s", times_to_numbers("time_s", times)[0], n_points),
            scan=code,
            scan_names=scan_names,
            pattern=pattern_codes(pattern, described, n_points),
            pattern_names=tuple(described),
            patterns=described,
            covariates=checked_covariates(covariates, n_points),
            instrumentation=Instrumentation(
                unit=unit, min=min, max=max, step=step, sensor=sensor, height_mm=height_mm, controls=controls
            ),
            sessions=sessions_of_scans(number, code),
        )

    def __len__(self) -> int:
        return len(self.x_mm)

    @cached_property
    def direction_of_motion(self) -> FloatArray:
        """Unit vector of the last commanded motion within the scan, shape (n_points, 2).

        The first reading of a scan takes the direction of the next motion; one at the same place as the reading before
        keeps the direction; a scan that stays at one place has (0, 0).
        """
        out = np.zeros((len(self), 2))
        place = np.stack([self.x_mm, self.y_mm], axis=-1)
        still = rounding_error(place)
        for rows in self.rows_by_scan():
            moves = np.diff(place[rows], axis=0)
            moves[np.abs(moves) <= still] = 0.0
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

    @property
    def columns(self) -> dict[str, Any]:
        """The rows as columns by name, as `from_table` takes them: names of scans and patterns, numbers, covariates."""
        named = {"scan": (self.scan, self.scan_names), "pattern": (self.pattern, self.pattern_names)}
        out: dict[str, Any] = {name: [names[k] for k in rows] for name, (rows, names) in named.items()}
        out |= {name: getattr(self, name) for name in ("x_mm", "y_mm", "orientation_rad", "time_s")}
        return out | dict(self.covariates)

    def rows_by_scan(self) -> list[IntArray]:
        """Return a list of each scan's row numbers, in the order they were taken."""
        ends = np.cumsum(np.bincount(self.scan, minlength=len(self.scan_names)))
        return np.split(np.argsort(self.scan, kind="stable"), ends[:-1]) if len(ends) else []

    def rows_by_pattern(self) -> list[tuple[str, IntArray]]:
        """Return pairs of the name of each pattern that occurs and its row numbers."""
        pairs = [(name, np.flatnonzero(self.pattern == k)) for k, name in enumerate(self.pattern_names)]
        return [(name, rows) for name, rows in pairs if rows.size]

    def take(self, rows: ArrayLike | slice) -> Plan:
        """Select rows (numbers, truth values or a slice), in the given order (scans and patterns keep their names)."""
        rows = selected_row_numbers(rows, len(self))
        kept = np.unique(self.scan[rows])
        taken = {name: getattr(self, name)[rows] for name in ("x_mm", "y_mm", "orientation_rad", "time_s", "pattern")}
        return replace(
            self,
            **taken,
            scan=np.searchsorted(kept, self.scan[rows]),
            scan_names=tuple(map(self.scan_names.__getitem__, kept.tolist())),  # of a grid's designs, thousands
            covariates={name: values[rows] for name, values in self.covariates.items()},
            sessions=tuple(self.sessions[k] for k in kept) if self.sessions else (),
        )


@dataclass(frozen=True, eq=False)
class Recording(ShowsItself):
    """A plan and its readings, shape (n_points,), NaN where missing.

    `usable` is False where a reading is missing, outside the declared range, or in a row of `left_out` (numbers from
    0); such rows stay in the plan (lag and backlash need them) and are left out of every likelihood.
    """

    least_share_of_span: ClassVar[float] = 1e-3
    """Least noise sd of a light sensor, as a share of the range of its readings."""

    plan: Plan
    readings: FloatArray
    source: str = ""
    notes: tuple[str, ...] = ()
    left_out: tuple[int, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        self._require_plan()
        readings = read_only_floats(self.readings, "readings")
        if readings.shape != (len(self.plan),):
            raise ShapeError(f"readings have shape {readings.shape}; allowed: ({len(self.plan)},), one per row")
        object.__setattr__(self, "readings", readings)

    def _require_plan(self) -> None:
        require_plan(self.plan)

    def to_frame(self) -> Any:
        """Return a pandas DataFrame with the columns that `from_table` takes, a row per reading."""
        return data_frame({**self.plan.columns, "reading": self.readings})

    @property
    def relative_sd(self) -> FloatArray:
        """Declared noise sd of each reading relative to the median, (n_points,): here 1; a subclass may differ."""
        return np.ones(len(self.plan))

    @property
    def weighting_in_words(self) -> str:
        """The sds by which `rms` weights residuals, as written after its unit: here ""; a subclass may differ."""
        return ""

    def rms(self, residuals: FloatArray) -> float:
        """Return the rms of the usable readings' residuals, (n_usable,), as if all had the median of declared sds."""
        return float(np.sqrt(np.mean((residuals / self.relative_sd[self.usable]) ** 2)))

    @cached_property
    def censored(self) -> BoolArray:
        """Mask of the readings that only say that the signal is at or beyond an end, (n_points,): here none."""
        return np.zeros(len(self.plan), dtype=np.bool_)

    @classmethod
    def from_table(
        cls,
        table: TableLike,
        *,
        patterns: Mapping[str, Pattern] | Pattern,
        unit: str,
        min: float | None = None,
        max: float | None = None,
        step: float | None = None,
        sensor: str = "",
        height_mm: float | None = None,
        controls: tuple[str, ...] = (),
        source: str = "",
    ) -> Self:
        """Make a recording from a data frame or a dict of columns, named as in a recording's CSV file.

        `table` has columns `reading`, `x_mm` and `y_mm`, and optionally `orientation_deg` (or `orientation_rad`),
        `scan`, `session`, `pattern` and `time_s`. Every other numeric column is a covariate; text columns are ignored,
        except what was commanded: `led` (True and False, too), `height_mm` and `controls` are numbers. A reading is
        NaN, None or a text such as "n/a" where it is missing; `x_mm` or `y_mm` may be one number for all; `source` is
        their origin, for reports; all else is as in `Plan.from_arrays`. Raises ParameterError if a column is missing, a
        pattern is named but not described, an argument has the wrong type, or no reading is usable; ShapeError if the
        columns differ in length.

        Examples
        --------
        >>> from probewise.recordings import HalfPlane, Recording
        >>> table = {"x_mm": [-10, 0, 10], "y_mm": [0, 0, 0], "reading": [0.4, 1.6, 2.9], "battery_mv": [80, 79, 79]}
        >>> recording = Recording.from_table(table, patterns=HalfPlane(0.0, 0.0), unit="V")
        >>> list(recording.plan.covariates)
        ['battery_mv']
        """
        columns = columns_by_name(table)
        missing = [name for name in ("reading", "x_mm", "y_mm") if name not in columns]
        require(not missing, "columns", tuple(columns), f"{', '.join(missing)} among them; rename the table's columns")
        turn_deg, turn_rad = columns.get("orientation_deg"), columns.get("orientation_rad", 0.0)
        if turn_deg is not None:
            one = "one of orientation_deg and orientation_rad"
            require("orientation_rad" not in columns, "columns", tuple(columns), one)
            turn_rad = np.radians(numbers_per_reading("orientation_deg", turn_deg))
        covariates, notes = numeric_covariates_and_notes(columns, controls)
        readings = numbers_per_reading("reading", texts_to_numbers(columns["reading"]))
        plan = Plan.from_arrays(
            x_mm=numbers_per_reading("x_mm", columns["x_mm"], len(readings)),
            y_mm=columns["y_mm"],
            patterns=patterns,
            unit=unit,
            pattern=columns.get("pattern"),
            orientation_rad=turn_rad,
            time_s=columns.get("time_s"),
            scan=columns.get("scan"),
            session=covariates.pop(SESSION, None),
            covariates=covariates,
            min=min,
            max=max,
            step=step,
            sensor=sensor,
            height_mm=height_mm,
            controls=controls,
        )
        recording = cls(plan, readings, source)
        if not recording.usable.any():
            raise ParameterError("reading", readings.tolist(), "at least one number within the declared range")
        numbers = {"reading": np.where(recording.usable, readings, 0.0), "time_s": plan.time_s, **plan.covariates}
        places = {"x_mm": plan.x_mm, "y_mm": plan.y_mm}
        for part, largest in ((numbers, LARGEST), (places, LARGEST_PLACE_MM)):  # as of a file
            for name, values in part.items():
                k = int(np.argmax(np.where(np.isfinite(values), np.abs(values), 0.0)))
                is_moderate = not np.isfinite(values[k]) or abs(values[k]) <= largest
                require(is_moderate, f"{name}[{k}]", float(values[k]), f"magnitudes up to {largest:g}")
        names = [name for name in ("scan", "pattern") if name in columns]
        said = [note for name in names for note in notes_on_names(name, columns[name], f"{name}s")]
        said += notes_on_codes({**places, **plan.covariates})
        return replace(recording, notes=(*notes, *said, *recording.notes_on_unusable_readings()))

    def __len__(self) -> int:
        return len(self.plan)

    @cached_property
    def usable(self) -> BoolArray:
        """Rows whose reading is present and within the declared range, shape (n_points,)."""
        inst = self.plan.instrumentation
        ok = np.isfinite(self.readings)
        ok[list(self.left_out)] = False
        with np.errstate(invalid="ignore"):
            ok &= self.readings >= (-np.inf if inst.min is None else inst.min)
            ok &= self.readings <= (np.inf if inst.max is None else inst.max)
        return ok

    def notes_on_unusable_readings(self) -> tuple[str, ...]:
        """Return in words how many readings are unusable, one text for each reason: missing, or out of range."""
        inst = self.plan.instrumentation
        n_missing = int(np.isnan(self.readings).sum())
        n_outside = len(self) - n_missing - int(self.usable.sum())
        why = {"missing": n_missing, f"outside {range_in_words(inst.min, inst.max)}": n_outside}
        return tuple(f"{n} reading{'s' if n > 1 else ''} {reason}, left out" for reason, n in why.items() if n)

    def summary(self) -> str:
        """Summarise the recording in one line: numbers of readings, and notes."""
        unit = self.plan.instrumentation.unit
        first = f"{len(self)} readings{f' in {unit}' if unit else ''}, {int(self.usable.sum())} usable"
        return "; ".join([first, *self.notes])

    def with_readings(self, readings: FloatArray) -> Self:
        """Return a recording of the same plan with other readings, (n_points,), NaN where one is left out."""
        return replace(self, readings=readings, notes=())

    def without_declared_range(self) -> Self:
        """Return the recording without its declared range, since noise-free readings may exceed it slightly."""
        instrumentation = replace(self.plan.instrumentation, min=None, max=None)
        return replace(self, plan=replace(self.plan, instrumentation=instrumentation), notes=())

    def take(self, rows: ArrayLike | slice) -> Self:
        """Select rows (numbers, truth values or a slice), in the given order."""
        rows = selected_row_numbers(rows, len(self))
        left_out = tuple(np.flatnonzero(np.isin(rows, self.left_out)).tolist())
        return replace(self, plan=self.plan.take(rows), readings=self.readings[rows], left_out=left_out)


def require_plan(plan: object) -> None:
    """Raise ParameterError unless `plan` is a Plan; the message says how to make one."""
    allowed = "a Plan: read_plan('NAME.csv') or Plan.from_arrays(...), of probewise.recordings; a Recording has a .plan"
    require_kind("plan", plan, Plan, allowed)


def require_recording(recording: object) -> None:
    """Raise ParameterError unless `recording` is a Recording; the message says how to make one."""
    allowed = "a Recording: read_recording('NAME.csv') or Recording.from_table(table, ...), of probewise.recordings"
    if isinstance(recording, Mapping) or hasattr(recording, "columns"):
        allowed += "; a table of your own needs simulator= too"
    if callable(getattr(recording, "recording", None)) and not isinstance(recording, type):
        allowed = f"a Recording: take its .recording(), this is the {type(recording).__name__}"
    require_kind("recording", recording, Recording, allowed)


def require_patterns_described(plan: Plan) -> None:
    """Raise ParameterError where a pattern that occurs in the plan is not described."""
    for name, _ in plan.rows_by_pattern():
        require(name in plan.patterns, "pattern", name, how_to_describe_pattern(name, list(plan.patterns)))


def range_in_words(low: float | None, high: float | None) -> str:
    """Write a declared range in words; `low` or `high` is None if that end is not declared."""
    if low is None:
        return "any range" if high is None else f"the range up to {high:g}"
    return f"{low:g} to {high:g}" if high is not None else f"the range from {low:g}"


def masks_of_readings_at_ends(
    readings: FloatArray, low: float | None, high: float | None, step: float | None
) -> tuple[BoolArray, BoolArray]:
    """Return which readings, of any shape, are at the low and at the high end of a range, within half a rounding step.

    An end may be None or infinite: open.
    """

    def are_at(end: float | None) -> BoolArray:
        if end is None or not np.isfinite(end):
            return np.zeros(np.shape(readings), dtype=np.bool_)
        return np.asarray(np.abs(readings - end) <= 0.5 * (1 + 1e-9) * (step or 0.0) + 1e-12 * abs(end))

    return are_at(low), are_at(high)
