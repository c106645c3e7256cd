"""Check during recording that each sheet matches its pattern: white reads bright, black reads dark."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from probewise.scene import region_of

if TYPE_CHECKING:
    from probewise._arrays import BoolArray, FloatArray
    from probewise.recordings import Pattern, Plan

_SEES_MM = 14.0  # radius of the sensor's view
_LOOK_MM = 25.0  # margin around the plan's places within which a sheet shows its pattern
_SHARE = 0.05  # least contrast of white and black, as a share of the range of readings
_OFF = 0.35  # largest deviation from a level, as a share of the contrast; beyond any noise
_FEWEST = 3
_SPREAD_SHARE = 0.15  # largest spread of readings of one shade, as a share of the range

_AROUND_MM = np.stack(
    [
        radius * np.array([math.cos(turn), math.sin(turn)])
        for radius in (0.0, _SEES_MM / 2, _SEES_MM)
        for turn in np.arange(8) * math.pi / 4
    ]
)


class SheetCheck:
    """A check of each sheet against its pattern, by the readings over its uniform white and black.

    Parameters
    ----------
    plan
        The plan, with its patterns and the range of readings.
    white_is_bright
        Whether white is known to read higher than black, as with the LEGO light sensor.
    """

    def __init__(self, plan: Plan, *, white_is_bright: bool) -> None:
        self._plan, self._bright = plan, white_is_bright
        ends = plan.instrumentation.declared_ends
        self._range = ends[1] - ends[0] if len(ends) == 2 else math.nan
        self._read: dict[bool, list[float]] = {True: [], False: []}
        self._reported: set[tuple[str, bool]] = set()
        places = np.stack([plan.x_mm, plan.y_mm], axis=-1)
        self._shades = np.full(len(plan), math.nan)
        for name, rows in plan.rows_by_pattern():
            self._shades[rows] = uniform_shades_at_places(plan.patterns[name], places[rows])

    def complaint_about_reading(self, row: int, value: float) -> str | None:
        """Return a complaint if the reading of a plan's row contradicts its sheet's pattern, else None.

        There is at most one complaint for each sheet and shade, white or black.
        """
        shade = self._shades[row]
        if math.isnan(shade) or math.isnan(value):
            return None
        name, is_white = self._plan.pattern_names[int(self._plan.pattern[row])], bool(shade)
        wrong = self._complaint_against_earlier(is_white, value)
        if wrong is None:
            self._read[is_white].append(value)
            return None
        if (name, is_white) in self._reported:
            return None
        self._reported.add((name, is_white))
        place = f"({self._plan.x_mm[row]:g}, {self._plan.y_mm[row]:g}) mm"
        return f"sheet {name!r} contradicts its pattern: at {place} it is {_colour_in_words(is_white)}, and {wrong}"

    def complaint_about_levels(self, name: str, values: dict[bool, float]) -> str | None:
        """Check a sheet by a reading over its white (True) and one over its black (False); return a complaint or None.

        Readings that are right are kept as levels for later checks.
        """
        wrong = None
        if len(values) == 2:
            contrast = values[True] - values[False]
            if self._bright and contrast < self._least_contrast(*values.values()):
                wrong = f"it reads {values[True]:g} where it should be white and {values[False]:g} where black"
        for is_white, value in values.items():
            told = self._complaint_against_earlier(is_white, value)
            wrong = wrong or (None if told is None else f"where it should be {_colour_in_words(is_white)} {told}")
        if wrong is not None:
            return f"sheet {name!r} contradicts its pattern: {wrong}"
        for is_white, value in values.items():
            self._read[is_white].append(value)
        return None

    def white_and_black_places(
        self, name: str, allowed: Callable[[FloatArray], BoolArray]
    ) -> dict[bool, tuple[float, float]]:
        """Choose where to check a sheet: a reachable place over uniform white (True), one over uniform black (False).

        Return (x, y) in mm in the plan's frame, by these keys; a key is missing if there is no such place.

        Parameters
        ----------
        name
            The pattern.
        allowed
            Function that returns the mask, (n,), of reachable places, (n, 2), in the plan's frame.
        """
        rows = np.flatnonzero(self._plan.pattern == self._plan.pattern_names.index(name))
        there = np.unique(np.stack([self._plan.x_mm[rows], self._plan.y_mm[rows]], axis=-1), axis=0)
        beside = there.mean(axis=0) + _LOOK_MM * np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)])
        candidates = np.concatenate([there, beside])
        candidates = candidates[allowed(candidates)]
        if not len(candidates):
            return {}
        found = uniform_shades_at_places(self._plan.patterns[name], candidates)
        middle = there.mean(axis=0)
        out = {}
        for is_white in (True, False):
            fitting = candidates[found == float(is_white)]
            if len(fitting):
                x, y = fitting[np.argmin(((fitting - middle) ** 2).sum(axis=-1))].tolist()
                out[is_white] = (x, y)
        return out

    def _complaint_against_earlier(self, is_white: bool, value: float) -> str | None:
        """Return a complaint if a reading over white or black contradicts earlier readings of the sheets, else None."""
        own, other = self._read[is_white], self._read[not is_white]
        if own and other:
            level, opposite = float(np.median(own)), float(np.median(other))
            if abs(value - level) > max(_OFF * abs(opposite - level), self._least_contrast(level, opposite)):
                colour, other_colour = _colour_in_words(is_white), _colour_in_words(not is_white)
                return f"reads {value:g}; {colour} read {level:g} so far, {other_colour} {opposite:g}"
        elif len(own) >= _FEWEST:
            level = float(np.median(own))
            if abs(value - level) > _SPREAD_SHARE * (self._range if math.isfinite(self._range) else abs(level)):
                return f"reads {value:g}; {_colour_in_words(is_white)} read {level:g} so far"
        elif other and self._bright:
            opposite = float(np.median(other))
            if (value - opposite) * (1 if is_white else -1) < self._least_contrast(value, opposite):
                return f"reads {value:g}, where {_colour_in_words(not is_white)} read {opposite:g}"
        return None

    def _least_contrast(self, *levels: float) -> float:
        return _SHARE * (self._range if math.isfinite(self._range) else max(abs(level) for level in levels))


def uniform_shades_at_places(pattern: Pattern, places_mm: FloatArray) -> FloatArray:
    """Return the shade that the sensor sees at each place, (n, 2), as (n,): 1 all white, 0 all black, else NaN."""
    seen = (places_mm[:, None, :] + _AROUND_MM).reshape(-1, 2)
    albedo = region_of(pattern).albedo(seen)[0].reshape(len(places_mm), -1)
    low, high = albedo.min(axis=1), albedo.max(axis=1)
    return np.where((low == high) & ((low >= 1) | (high <= 0)), np.clip(low, 0.0, 1.0), math.nan)


def _colour_in_words(is_white: bool) -> str:
    return "white" if is_white else "black"
