"""The one interface that readings come through, simulated arm or LEGO NXT."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Protocol, Self

from probewise._arrays import BoolArray, FloatArray

__all__ = ["Instrument", "Pose", "Reading"]


@dataclass(frozen=True)
class Pose:
    """Where the sensor is to stand, lab frame; `height_mm` above the surface, None: where the arm reads by default."""

    x_mm: float
    y_mm: float
    orientation_rad: float = 0.0
    height_mm: float | None = None


@dataclass(frozen=True)
class Reading:
    """What the sensor returned, where and when: the pose that was asked for, or a better one that the arm knows of."""

    value: float
    pose: Pose
    time_s: float
    covariates: Mapping[str, float] = field(default_factory=dict)


class Instrument(Protocol):
    """Move, lower, read. Leaving the `with` block brings it to rest, after an exception too."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def reachable(self, places_mm: FloatArray) -> BoolArray:
        """Tell which places, shape (n_places, 2), the arm can take: shape (n_places,)."""
        ...

    def orientation_rad(self, places_mm: FloatArray) -> FloatArray:
        """Tell how the sensor stands at each place, (n_places, 2), where nothing turns it: shape (n_places,).

        A sensor whose arm turns with its base has no choice: this is the orientation of every pose there.
        """
        ...

    def travel_s(self, start: Pose, places_mm: FloatArray) -> FloatArray:
        """Seconds to move to each place and read there, shape (n_places,)."""
        ...

    def measure(self, pose: Pose) -> Reading:
        """Move there, lower, read, raise.

        Raises
        ------
        ReachError
            If the arm cannot take the pose.
        LinkError
            If the instrument does not answer.
        """
        ...
