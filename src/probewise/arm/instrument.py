"""The interface of all instruments, and poses and readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Protocol, Self

from probewise._arrays import BoolArray, FloatArray
from probewise._kinds import checked_number, require_kind, warn_of_likely_degrees


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
        ...

    def orientation_rad(self, places_mm: FloatArray) -> FloatArray:
        """Return the sensor's own orientation at places, (n_places, 2), to which a design's is added: (n_places,).

        For an arm that turns its sensor only with its base, this is the only possible orientation.
        """
        ...

    def travel_s(self, start: Pose, places_mm: FloatArray) -> FloatArray:
        """Return the seconds to move from `start` to each place, (n_places, 2), and read there: shape (n_places,)."""
        ...

    def measure(self, pose: Pose) -> Reading:
        """Move to a pose, lower the sensor, read it and raise it; return the reading.

        Raises
        ------
        ReachError
            If the arm cannot reach the pose.
        LinkError
            If the instrument does not answer.
        """
        ...
