"""What effects take from a recording: its scales, the origin they count from, its positions, motions and scans."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from probewise._arrays import FloatArray, IntArray, distinct_values, rounding_error
from probewise.errors import require
from probewise.recordings.plan import Plan, Recording

_FAR = 10.0  # of a recording's own lengths from 0
_SAME_PLACE_MM = 1e-6


@dataclass(frozen=True)
class Origin:
    """The time, s, and the place in the lab frame, mm, from which effects count.

    Drifts, gradients and the phases of waves are relative to it. A recording far from 0, such as one in seconds since
    1970, would else have drifts of thousands of hours at its first reading, and phases that turn with the last digit of
    a frequency.
    """

    time_s: float = 0.0
    x_mm: float = 0.0
    y_mm: float = 0.0

    def __post_init__(self) -> None:
        given = (self.time_s, self.x_mm, self.y_mm)
        require(np.isfinite(given).all(), "Origin", given, "finite numbers")

    @classmethod
    def of(cls, plan: Plan) -> Self:
        """Choose the origin for a recording by its plan, for each axis on its own.

        The origin is 0 where the recording comes within ten of its own lengths of 0: its duration, or the diagonal of
        its places. Farther away, the origin is the first time, and the middle of the places.
        """
        length_mm = float(np.hypot(np.ptp(plan.x_mm), np.ptp(plan.y_mm)))

        def middle_mm(places_mm: FloatArray) -> float:
            far = is_far_from_zero(places_mm, length_mm)
            return float(places_mm.min() + places_mm.max()) / 2 if far else 0.0

        time_s = float(plan.time_s.min()) if is_far_from_zero(plan.time_s, float(np.ptp(plan.time_s))) else 0.0
        return cls(time_s, middle_mm(plan.x_mm), middle_mm(plan.y_mm))

    def seconds(self, plan: Plan) -> FloatArray:
        """Return the time of each reading since the origin, s, (n_points,)."""
        return plan.time_s - self.time_s

    def hours(self, plan: Plan) -> FloatArray:
        """Return the time of each reading since the origin, h, (n_points,)."""
        return self.seconds(plan) / 3600


def origins_of(effects: Iterable[object]) -> dict[str, Origin]:
    """Return the origins of those effects that do not count from 0, by the effect's name."""
    bound = {getattr(effect, "name", ""): getattr(effect, "binding", None) for effect in effects}
    return {name: own.where.origin for name, own in bound.items() if own is not None and own.where.origin != ZERO}


def is_far_from_zero(values: FloatArray, length: float) -> bool:
    """Return whether all values, (n_points,), lie more than ten times `length` from 0; False for length 0."""
    return float(np.nanmin(np.abs(values))) > _FAR * length > 0.0


ZERO = Origin()  # time 0 and the place (0, 0)


@dataclass(frozen=True, eq=False)
class Extent:
    """Scales of a recording, from the range of its usable readings and from its plan.

    `low`, `high`: least and largest usable reading; `plan`: pose, time and pattern of every reading; `counted_from`:
    time and place from which effects on this recording count; by default those of `Origin.of`.
    """

    low: float
    high: float
    plan: Plan
    counted_from: Origin | None = None

    def __post_init__(self) -> None:
        require(self.low < self.high, "Extent(low, high)", (self.low, self.high), "low < high")

    @classmethod
    def usual(cls, origin: Origin) -> Self:
        """Return an extent that can show every effect, of a scan of 100 mm there and back, of 50 units of reading."""
        return cls(0.0, 50.0, _scan_there_and_back(), origin)

    @classmethod
    def of(cls, recording: Recording) -> Self:
        """Measure the scales of a recording.

        Raises ParameterError if there is no usable reading.
        """
        readings = recording.readings[recording.usable]
        require(readings.size > 0, "usable readings", 0, "at least one; the recording holds none")
        low, high = float(readings.min()), float(readings.max())
        tiny = (max(abs(low), abs(high)) or 1.0) * 1e-6  # relative: the unit of a reading may be large
        return cls(low, max(high, low + tiny), recording.plan)

    @property
    def reading_unit(self) -> str:
        """Unit of a reading, as written after a number."""
        return self.plan.instrumentation.unit_after_number

    @property
    def span(self) -> float:
        """Largest minus least usable reading."""
        return self.high - self.low

    @property
    def small_change(self) -> float:
        """Typical size of what is added to readings: a hundredth of their span."""
        return 0.01 * self.span

    @property
    def small_shift_mm(self) -> float:
        """Typical displacement, mm: 0.003 of the longest scan."""
        return 0.003 * self.length_mm

    @property
    def small_play_mm(self) -> float:
        """Typical error of the arm where it turns, jumps or is pushed, mm: 0.005 of the longest scan."""
        return 0.005 * self.length_mm

    @cached_property
    def origin(self) -> Origin:
        """Time and place from which effects on this recording count."""
        return Origin.of(self.plan) if self.counted_from is None else self.counted_from

    @cached_property
    def length_mm(self) -> float:
        """Diagonal of the X and Y ranges of the longest scan, mm; 1 if nothing moves."""
        plan = self.plan
        ends = [(plan.x_mm[rows], plan.y_mm[rows]) for rows in plan.rows_by_scan() if rows.size]
        longest = max(float(np.hypot(np.ptp(x), np.ptp(y))) for x, y in ends)
        return longest if longest > rounding_error(np.append(plan.x_mm, plan.y_mm)) else 1.0

    @cached_property
    def duration_s(self) -> float:
        """Time from the first reading to the last, s; 1 where no time passes."""
        return float(np.ptp(self.plan.time_s)) or 1.0

    @cached_property
    def gap_s(self) -> float:
        """Median time between consecutive readings of a scan, s; 1 where no time passes."""
        return median_gap_s(self.plan)


@lru_cache(maxsize=1)
def _scan_there_and_back() -> Plan:
    """Return a plan over an edge: 100 mm along X, and back with the sensor turned by 90 degrees and less battery."""
    there, scan, one = np.linspace(-50.0, 50.0, 41), np.repeat([0, 1], 41), np.zeros(82, dtype=np.int64)
    time_s = np.arange(82.0)
    return Plan(
        x_mm=np.append(there, there[::-1]),
        y_mm=np.zeros(82),
        orientation_rad=0.5 * np.pi * scan,
        time_s=time_s,
        scan=scan,
        scan_names=("there", "back"),
        pattern=one,
        pattern_names=("field",),
        covariates={"battery_mv": 8000.0 - time_s},
    )


def median_gap_s(plan: Plan) -> float:
    """Return the median time between consecutive readings of a scan, s; 1 where no time passes."""
    gaps = np.diff(plan.time_s)[np.diff(plan.scan) == 0]
    gaps = gaps[gaps > rounding_error(plan.time_s)]
    return float(np.median(gaps)) if gaps.size else 1.0


def distinct_positions_mm(axis_mm: FloatArray) -> FloatArray:
    """Return the distinct positions along one axis, sorted, (n_distinct,); of those within 1e-6 mm, the least."""
    return distinct_values(axis_mm, within=_SAME_PLACE_MM)


def sign_of_motion(plan: Plan) -> FloatArray:
    """Return the sign of each reading's last motion, (n_points,): along X, or Y where X stays; 0 without motion."""
    along_x, along_y = np.sign(plan.direction_of_motion).T
    return np.asarray(np.where(along_x != 0, along_x, along_y))


def sign_of_change(values: FloatArray, by_scan: Iterable[IntArray], still: ArrayLike) -> FloatArray:
    """Return the sign of the change of values from the previous row of the scan, (n_samples, n_points) both.

    Where they change by at most `still`, the sign of the last change holds; before a scan's first, the sign of that.
    """
    out = np.zeros_like(values)
    for rows in by_scan:
        if len(rows) < 2:
            continue
        changes = np.diff(values[:, rows], axis=1)
        signs = np.where(np.abs(changes) > still, np.sign(changes), 0.0)
        last = np.maximum.accumulate(np.where(signs != 0, np.arange(signs.shape[1]), -1), axis=1)
        last = np.where(last < 0, np.argmax(signs != 0, axis=1)[:, None], last)
        out[:, rows[1:]] = np.take_along_axis(signs, last, axis=1)
        out[:, rows[0]] = out[:, rows[1]]
    return out


def scan_indicator(plan: Plan, names: tuple[str, ...]) -> FloatArray:
    """Return 1.0 for the readings of these scans, 0.0 for the others, (n_points,)."""
    member = np.array([name in names for name in plan.scan_names], dtype=np.float64)
    return np.asarray(member[plan.scan])


def orientation_deg(plan: Plan) -> FloatArray:
    """Return the orientation of each reading, rounded to 1e-6 degrees, (n_points,).

    Orientations of the plan that differ by whole turns become the least of them: 0 and 360 degrees are both 0.
    """
    turned = np.degrees(plan.orientation_rad)
    # Rounded after the turns are taken off, since most decimals have another last digit a turn on; 359.9999999 is 0.
    _, which = np.unique(np.round(turned % 360.0, 6) % 360.0, return_inverse=True)
    recorded = np.round(turned, 6)
    least = np.full(which.max(initial=-1) + 1, np.inf)
    np.minimum.at(least, which, recorded)
    return np.asarray(least[which], dtype=np.float64)


def candidate_scan_groups(plan: Plan) -> tuple[tuple[str, ...], ...]:
    """List groups of scan names as candidates: each mounting (all scans of one orientation) and each single scan.

    Of several recordings that were joined, each mounting of each recording and each whole recording are candidates too:
    the sensor may have been mounted anew in between, or not. A group of all scans is left out, since nothing remains
    for comparison. A scan in which the sensor turns belongs to no mounting.
    """
    turned_deg = orientation_deg(plan)
    sessions = plan.sessions or (0,) * len(plan.scan_names)
    mountings: dict[float, list[str]] = {}
    mountings_of_session: dict[tuple[int, float], list[str]] = {}
    recordings: dict[int, list[str]] = {}
    for name, rows, session in zip(plan.scan_names, plan.rows_by_scan(), sessions, strict=True):
        recordings.setdefault(session, []).append(name)
        angles = np.unique(turned_deg[rows]).tolist()
        if len(angles) == 1:
            mountings.setdefault(angles[0], []).append(name)
            mountings_of_session.setdefault((session, angles[0]), []).append(name)
    singles = [[name] for name in plan.scan_names]
    groups = (*mountings.values(), *singles, *mountings_of_session.values(), *recordings.values())
    found = dict.fromkeys(tuple(dict.fromkeys(names)) for names in groups)
    every = set(plan.scan_names)
    return tuple(group for group in found if set(group) != every)
