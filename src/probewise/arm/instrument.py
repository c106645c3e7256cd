"""Instruments: poses, readings, interface, places within reach (paper, section 2.1, "Robotic Arm Test Bed")."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Literal, Protocol, Self, TypeAlias

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise._kinds import checked_number, require_kind, warn_of_likely_degrees
from probewise.errors import ParameterError, ReachError, require

Side: TypeAlias = Literal[-1, 1]
"""Direction in which a motor arrives at its goal: -1 with its count decreasing, 1 increasing."""


class Clock(Protocol):
    """A clock that can wait; Python's module `time` is one."""

    def monotonic(self) -> float:
        """Return seconds since an arbitrary time."""

    def sleep(self, seconds: float, /) -> None:
        """Wait for some seconds."""


@dataclass(frozen=True)
class Pose:
    """A pose of the sensor in the lab frame; `height_mm` is above the surface, None: the arm's default."""

    x_mm: float
    y_mm: float
    orientation_rad: float = 0.0
    height_mm: float | None = None

    def __post_init__(self) -> None:
        for name in ("x_mm", "y_mm", "orientation_rad"):
            object.__setattr__(self, name, checked_number(name, getattr(self, name)))
        warn_of_likely_degrees("orientation_rad", self.orientation_rad)
        if self.height_mm is not None:
            object.__setattr__(self, "height_mm", checked_number("height_mm", self.height_mm, "a number or None"))


@dataclass(frozen=True)
class Reading:
    """A reading with its pose (as measured by the arm, else as commanded), time, and covariates by name.

    `value` is in the sensor's unit, NaN where the reading is missing; `time_s` is since the start of the run.
    """

    value: float
    pose: Pose
    time_s: float
    covariates: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        order = "in the order Reading(value, pose, time_s)"
        object.__setattr__(self, "value", checked_number("value", self.value, f"a number, {order}"))
        require_pose(self.pose, order)
        object.__setattr__(self, "time_s", checked_number("time_s", self.time_s, f"a number, {order}"))
        require_kind("covariates", self.covariates, Mapping, "numbers by name")


def require_pose(pose: object, more: str = "") -> None:
    """Raise ParameterError unless `pose` is a Pose; `more` is added to the message."""
    require_kind("pose", pose, Pose, f"a Pose: Pose(x_mm, y_mm){', ' if more else ''}{more}")


class Instrument(Protocol):
    """An instrument that moves and reads a sensor; leaving the `with` block stops it, also after an exception."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def reachable(self, places_mm: FloatArray) -> BoolArray:
        """Return which places, shape (n_places, 2), are reachable: shape (n_places,)."""

    def orientation_rad(self, places_mm: FloatArray) -> FloatArray:
        """Return the orientation at places, (n_places, 2), of a sensor that is not turned: (n_places,).

        For an arm that turns its sensor only with its base, this is the only possible orientation.
        """

    def travel_s(self, start: Pose, places_mm: FloatArray) -> FloatArray:
        """Return the seconds to move from `start` to each place, (n_places, 2), and read there: shape (n_places,)."""

    def measure(self, pose: Pose) -> Reading:
        """Move to a pose, lower the sensor, read it and raise it; return the reading.

        Raises ReachError if the arm cannot reach the pose; LinkError if the instrument does not answer.
        """


@dataclass(frozen=True)
class ReadingScale:
    """Conversion of a value to a reading: rounded to multiples of `step` (None: not rounded), clipped to `low`, `high`.

    The default is the scale of LEGO units.
    """

    low: float = 1.0
    high: float = 100.0
    step: float | None = 1.0

    def __post_init__(self) -> None:
        require(self.low < self.high, "low", self.low, f"less than high, {self.high:g}")
        require(self.step is None or self.step > 0, "step", self.step, "greater than 0, or None")

    def clip_and_round(self, value: float) -> float:
        """Clip a value to the scale and round it to a step, within the scale; NaN, a missing reading, stays NaN."""
        if math.isnan(value):
            return value
        value = min(max(value, self.low), self.high)
        if self.step is not None:
            value = round(value / self.step) * self.step
        # A step that does not divide the range may have rounded past its end.
        return min(max(value, self.low), self.high)


FIELD_MM = (1048.0, 520.0)
"""Width and height of the paper's playing field, 131 x 65 LEGO units of 8 mm."""


class ReachablePlaces(Protocol):
    """The set of reachable places of an arm."""

    def contains(self, places_mm: FloatArray) -> BoolArray:
        """Return which places, shape (n_places, 2), are reachable: shape (n_places,)."""

    def sentence(self) -> str:
        """Describe the allowed places in words."""


def require_within_reach(workspace: ReachablePlaces, places_mm: FloatArray, of: str, *, way_out: str = "") -> None:
    """Raise ReachError if any place, (n_places, 2), is out of reach, before anything moves.

    The message names the first such place, counts the others, describes the reach, and ends with `way_out`. `of` is the
    noun of a place; its first word gets the place's number: "row of the plan" becomes "row 3 of the plan".
    """
    reached = workspace.contains(places_mm)
    if reached.all():
        return
    first, n = int(np.argmin(reached)), len(places_mm)
    within = f"; of these {n} places {int(reached.sum())} are in reach" if n > 1 else ""
    noun, _, whole = of.partition(" ")
    x_mm, y_mm = places_mm[first].tolist()
    raise ReachError(
        f"the place of {noun} {first + 1}{' ' * bool(whole)}{whole} (mm)" if n > 1 else "the place (mm)",
        (round(x_mm, 1), round(y_mm, 1)),
        f"{workspace.sentence()}{within}{way_out}",
    )


@dataclass(frozen=True)
class Reach:
    """The reachable places of an arm: a ring about its axis, intersected with the field.

    The axis stands `axis_beyond_mm` beyond the middle of the field's upper long side; `field_mm` is width and height of
    the field, whose lower left corner is the lab frame's origin. The default is the reach of the LEGO arm whose
    geometry ships with the package: all but 2 % of the field, at the corners farthest from the axis and nearest to the
    axis, where the arm cannot fold. Raises ParameterError if a length is negative or not finite, or `nearest_mm` is not
    below `farthest_mm`; ReachError if no place on the field is within reach.
    """

    field_mm: tuple[float, float] = FIELD_MM
    axis_beyond_mm: float = 60.0
    nearest_mm: float = 126.0
    farthest_mm: float = 755.0

    def __post_init__(self) -> None:
        width, height = self.field_mm
        for name, value in (("field_mm", width), ("field_mm", height), ("farthest_mm", self.farthest_mm)):
            require(math.isfinite(value) and value > 0, name, value, "a finite length greater than 0")
        for name, value in (("axis_beyond_mm", self.axis_beyond_mm), ("nearest_mm", self.nearest_mm)):
            require(math.isfinite(value) and value >= 0, name, value, "a finite length of 0 or more")
        if self.nearest_mm >= self.farthest_mm:
            raise ParameterError("nearest_mm", self.nearest_mm, f"less than farthest_mm, {self.farthest_mm:g}")
        corner = math.hypot(width / 2, height + self.axis_beyond_mm)
        if self.axis_beyond_mm > self.farthest_mm or corner < self.nearest_mm:
            allowed = (
                f"a field that comes within {self.nearest_mm:g} to {self.farthest_mm:g} mm of the axis, which stands "
                f"{self.axis_beyond_mm:g} mm beyond its upper side; move the arm or choose another field"
            )
            raise ReachError("field_mm", self.field_mm, allowed)

    @property
    def axis_mm(self) -> tuple[float, float]:
        """Place (x, y) of the axis, lab frame."""
        return self.field_mm[0] / 2, self.field_mm[1] + self.axis_beyond_mm

    @property
    def rest_mm(self) -> tuple[float, float]:
        x_mm, y_mm = self.axis_mm
        return x_mm, max(0.0, min(self.field_mm[1], y_mm - self.nearest_mm))

    def orientation_rad(self, places_mm: FloatArray) -> FloatArray:
        """Return the sensor's orientation at each place, (n_places, 2): always 0, shape (n_places,)."""
        return np.zeros(len(places_mm))

    def contains(self, places_mm: FloatArray) -> BoolArray:
        x_mm, y_mm = places_mm[:, 0], places_mm[:, 1]
        away = np.hypot(x_mm - self.axis_mm[0], y_mm - self.axis_mm[1])
        on_field = (x_mm >= 0) & (x_mm <= self.field_mm[0]) & (y_mm >= 0) & (y_mm <= self.field_mm[1])
        return on_field & (away >= self.nearest_mm) & (away <= self.farthest_mm)

    def sentence(self) -> str:
        (width, height), (x_mm, y_mm) = self.field_mm, self.axis_mm
        return (
            f"a place on the field, 0 to {width:g} mm by 0 to {height:g} mm, that is {self.nearest_mm:g} to "
            f"{self.farthest_mm:g} mm from the arm's axis at ({x_mm:g}, {y_mm:g}) mm"
        )
