"""A simulated arm with the interface of the real one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self, TypeAlias

import numpy as np

from probewise._arrays import BoolArray, FloatArray, floats
from probewise._kinds import checked_number, require_callable, require_like
from probewise.arm.geometry import Geometry
from probewise.arm.instrument import Pose, Reach, Reading, ReadingScale, require_pose, require_within_reach
from probewise.errors import ReachError, ShapeError, require

LEGO = ReadingScale()

Workspace: TypeAlias = Reach | Geometry
"""Reachable places of an arm, and the sensor's orientation there; a `Geometry` is that of a real arm."""

Light: TypeAlias = Callable[[Pose, float, float], float]
"""Function of pose, time (s) and height (mm); returns the sensor's reading."""


@dataclass(frozen=True)
class Speed:
    """Speed of an arm: it moves at `move_mm_s`; settling, lowering and reading take `read_s` together."""

    move_mm_s: float = 100.0
    read_s: float = 1.2

    def __post_init__(self) -> None:
        require(self.move_mm_s > 0, "move_mm_s", self.move_mm_s, "greater than 0")
        require(math.isfinite(self.read_s) and self.read_s >= 0, "read_s", self.read_s, "0 or more")


class SimulatedArm:
    """An Instrument that simulates moving, lowering, reading and raising; `time_s` is its clock, `pose` where it is.

    `light` is a function of pose, time (s) and height (mm) that returns the reading before the conversion by `scale`,
    by default to LEGO units 1 to 100 (paper, "Robotic Arm Test Bed"); None: none. `reach` has the reachable places and
    orientations: a `Reach`, whose sensor does not turn, or the `Geometry` of a real arm. `height_mm` is the sensor's
    above the surface when reading, unless the pose gives one. The arm starts at the pose and time of `last`, the last
    reading of an earlier run; None: at rest, at time 0.
    """

    # It takes the orientation and the height of every pose, so no person turns the sensor: mounted_rad is always 0.
    turns = lifts = True

    def __init__(
        self,
        light: Light,
        *,
        reach: Workspace | None = None,
        speed: Speed | None = None,
        scale: ReadingScale | None = LEGO,
        height_mm: float = 14.0,
        last: Reading | None = None,
    ) -> None:
        require_callable("light", light, "a function light(pose, time_s, height_mm) that returns the reading there")
        require(checked_number("height_mm", height_mm) > 0, "height_mm", height_mm, "greater than 0")
        if reach is not None:
            require_like(
                "reach", reach, ("rest_mm", "contains", "orientation_rad"), "a Reach, or the Geometry of an arm"
            )
        self._light, self._scale, self._height_mm = light, scale, height_mm
        self.reach: Workspace = Reach() if reach is None else reach
        self.speed = Speed() if speed is None else speed
        self.mounted_rad = 0.0
        self._home = Pose(*self.reach.rest_mm)
        self.pose, self.time_s = (self._home, 0.0) if last is None else (last.pose, last.time_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Return the arm to its rest position."""
        self.pose = self._home

    def reachable(self, places_mm: FloatArray) -> BoolArray:
        return self.reach.contains(_checked_places(places_mm))

    def orientation_rad(self, places_mm: FloatArray) -> FloatArray:
        return self.reach.orientation_rad(_checked_places(places_mm))

    def travel_s(self, start: Pose, places_mm: FloatArray) -> FloatArray:
        places = _checked_places(places_mm)
        away = np.hypot(places[:, 0] - start.x_mm, places[:, 1] - start.y_mm)
        return np.asarray(away / self.speed.move_mm_s + self.speed.read_s, dtype=np.float64)

    def measure(self, pose: Pose) -> Reading:
        """Simulate moving to a pose, lowering, reading and raising; the reading's time is that of its completion.

        Raises ReachError if the arm cannot reach the place, or the height is not above 0; the arm does not move.
        """
        require_pose(pose)
        place = np.array([[pose.x_mm, pose.y_mm]])
        require_within_reach(self.reach, place, "pose")
        if not math.isfinite(pose.orientation_rad):
            raise ReachError("orientation_rad", pose.orientation_rad, "a finite orientation")
        height_mm = self._height_mm if pose.height_mm is None else pose.height_mm
        if not 0 < height_mm < math.inf:
            raise ReachError("height_mm", height_mm, "above the surface: finite, greater than 0")
        self.time_s += float(self.travel_s(self.pose, place)[0])
        self.pose = pose
        value = checked_number("what light returned", self._light(pose, self.time_s, height_mm))
        value = value if self._scale is None else self._scale.clip_and_round(value)
        return Reading(value=value, pose=pose, time_s=self.time_s, covariates={"height_mm": height_mm})


def _checked_places(places_mm: FloatArray) -> FloatArray:
    places = floats(places_mm, "places_mm")
    if places.ndim != 2 or places.shape[1] != 2:
        raise ShapeError(f"places_mm has shape {places.shape}; allowed: (n_places, 2)")
    return places
