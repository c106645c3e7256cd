"""The simulated world: a sensor's footprint over surfaces, with concealed effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise._kinds import require_rng
from probewise.errors import ParameterError, require
from probewise.recordings.plan import Plan, Recording
from probewise.world.spots import Spot
from probewise.world.stages import Concealed, FootprintPart, Rows
from probewise.world.surfaces import Surface, common_edge_normal, distance_to_nearest_edge, seen_white_fraction

_Surfaces = Sequence[tuple[Surface, IntArray]]
"""Each surface with the rows read over it."""


@dataclass(frozen=True, eq=False)
class View:
    """What the sensor sees at each reading, before its response: the costly part of a simulation.

    `seen`: seen white fraction u, shape (n_points,); `dimming`: factor on the signal from the true height (inverse
    square) and the commanded LED, shape (n_points,); `rows`: table of the readings with the sensor's true poses.
    """

    seen: FloatArray
    dimming: FloatArray
    rows: Rows


@dataclass(frozen=True, eq=False)
class World:
    """A simulated sensor with its concealed effects, independent of the sensor models.

    Parameters
    ----------
    spot
        Footprint of the sensor.
    black, white
        Noise-free readings over uniform black and white, I_min and I_max of the paper.
    noise_sd
        Standard deviation of the Gaussian noise of one reading.
    step
        Readings are rounded to multiples of `step`; None: not rounded.
    concealed
        Effects that a plain model leaves out. They act in the order of the stages; within a stage, as listed.
    height_mm
        Height at which `spot`, `black` and `white` hold; also the sensor's height where none is commanded.
    """

    spot: Spot
    black: float = 10.0
    white: float = 60.0
    noise_sd: float = 0.6
    step: float | None = None
    concealed: tuple[Concealed, ...] = ()
    height_mm: float = 14.0

    def __post_init__(self) -> None:
        require(self.noise_sd >= 0, "noise_sd", self.noise_sd, "0 or more")
        require(self.step is None or self.step > 0, "step", self.step, "greater than 0, or None")
        require(self.height_mm > 0, "height_mm", self.height_mm, "greater than 0")

    def read(
        self,
        surface: Surface,
        x_mm: float,
        y_mm: float,
        orientation_rad: float = 0.0,
        *,
        time_s: float,
        rng: np.random.Generator | None,
        direction: tuple[float, float] = (0.0, 0.0),
        height_mm: float | None = None,
    ) -> float:
        """Take one reading over a surface, as an arm does; return the recorded reading.

        `surface`: the surface below; `x_mm`, `y_mm`, `orientation_rad`: commanded pose, lab frame; `time_s`: time of
        the reading; `rng`: generator of the noise; None: a reading without noise, but rounded; `direction`: unit vector
        of the motion to this pose, for backlash and hysteresis; (0, 0): none; `height_mm`: commanded height of the
        sensor; None: `self.height_mm`. An effect that looks back to earlier readings, such as a lag, does not act; it
        does with `Reader`.
        """
        if rng is not None:
            require_rng(rng)
        view = self.view_from_pose(surface, x_mm, y_mm, orientation_rad, time_s, direction, height_mm)
        return float(self._recorded_readings(view, rng)[0])

    def view_from_pose(
        self,
        surface: Surface,
        x_mm: float,
        y_mm: float,
        orientation_rad: float,
        time_s: float,
        direction: tuple[float, float],
        height_mm: float | None,
    ) -> View:
        """Compute what the sensor sees from one pose; parameters as for `read`."""
        rows = Rows(
            place_mm=np.array([[x_mm, y_mm]]),
            direction=np.array([direction]),
            orientation_rad=np.array([orientation_rad]),
            time_s=np.array([time_s]),
            scan=np.zeros(1, dtype=np.int64),
            scan_names=("",),
            covariates={} if height_mm is None else {"height_mm": np.array([height_mm])},
            across=np.array([common_edge_normal(surface)]),
            edge_mm=distance_to_nearest_edge(surface, np.array([x_mm]), np.array([y_mm])),
        )
        return self._view_of_rows([(surface, np.zeros(1, dtype=np.int64))], rows)

    def view(self, plan: Plan, surfaces: Mapping[str, Surface] | None = None) -> View:
        """Compute what the sensor sees at each reading of a plan, by integrating light: a simulation's costly part.

        The plan's columns `height_mm` and `led` are commands; NaN means `self.height_mm` and LED 1. The view does not
        depend on effects from the stage "response" on: worlds that differ in such effects only can share one view.
        """
        known: dict[str, Surface] = {**plan.patterns, **(surfaces or {})}
        found = []
        for name, rows in plan.rows_by_pattern():
            require(name in known, "pattern", name, f"one of {', '.join(known) or 'none'}, or give it in surfaces")
            found.append((known[name], rows))
        across, edge_mm = np.empty((len(plan), 2)), np.empty(len(plan))
        for surface, chosen in found:
            across[chosen] = common_edge_normal(surface)
            edge_mm[chosen] = distance_to_nearest_edge(surface, plan.x_mm[chosen], plan.y_mm[chosen])
        sent = Rows(
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
        return self._view_of_rows(found, sent)

    def noise_free_readings(self, view: View) -> FloatArray:
        """Turn a view into readings before noise, rounding and losses, shape (n_points,)."""
        rows = view.rows
        signal = (self.white - self.black) * self._with_effects("response", view.seen, rows) * view.dimming
        reading: FloatArray = self.black + self._with_effects("gain", signal, rows)
        for stage in ("offset", "lag", "saturation"):
            reading = self._with_effects(stage, reading, rows)
        return reading

    def expected_readings(self, plan: Plan, surfaces: Mapping[str, Surface] | None = None) -> FloatArray:
        """Return the noise-free readings of a plan, not rounded, shape (n_points,).

        `surfaces`: surfaces by name of the pattern, in place of the plan's descriptions. Raises ParameterError if the
        plan reads over a pattern that is not described.
        """
        return self.noise_free_readings(self.view(plan, surfaces))

    def simulate(
        self,
        plan: Plan,
        *,
        rng: np.random.Generator | None,
        surfaces: Mapping[str, Surface] | None = None,
        view: View | None = None,
    ) -> Recording:
        """Simulate the recording of a plan.

        `rng`: generator of the noise; None: readings without noise, but rounded; `surfaces`: surfaces by name of the
        pattern, in place of the plan's descriptions; `view`: result of `view`, if already computed. Raises
        ParameterError if the plan reads over a pattern that is not described.
        """
        return Recording(plan, self._recorded_readings(self.view(plan, surfaces) if view is None else view, rng))

    def _view_of_rows(self, surfaces: _Surfaces, sent: Rows) -> View:
        place = self._with_effects("place", sent.place_mm, sent)
        there = replace(sent, place_mm=place, orientation_rad=self._with_effects("turn", sent.orientation_rad, sent))
        pattern = self._with_effects("pattern", np.zeros_like(place), there)
        height_mm = sent.commanded_column("height_mm", otherwise=self.height_mm)
        # A tilt moves the spot in proportion to the height.
        lever = (height_mm / self.height_mm)[:, None]
        center = place + lever * self._with_effects("tilt", np.zeros_like(place), there)
        scale = self._with_effects("height", height_mm, there) / self.height_mm
        if scale.min() <= 0:
            raise ParameterError("height_mm", float(scale.min() * self.height_mm), "greater than 0 at every reading")
        retouches = any(effect.stage == "albedo" for effect in self.concealed)
        parts = self._with_effects("footprint", (FootprintPart(1.0, self.spot),))
        seen, edge_mm = np.zeros(len(place)), np.empty(len(place))
        for surface, chosen in surfaces:
            edge_mm[chosen] = distance_to_nearest_edge(surface, *(place - pattern)[chosen].T)
            white = partial(
                seen_white_fraction,
                surface,
                orientation_rad=there.orientation_rad[chosen],
                scale=scale[chosen],
                pattern_mm=pattern[chosen],
                retouch=partial(self._with_effects, "albedo") if retouches else None,
            )
            for part in parts:
                x_mm, y_mm = (center[chosen] + part.shift_mm).T
                seen[chosen] += part.share * white(part.spot, x_mm, y_mm)
        there = replace(there, edge_mm=edge_mm)
        # Illumination by the LED falls with the inverse square of the distance.
        dimming = sent.commanded_column("led", otherwise=1.0) * scale**-2.0
        return View(self._with_effects("seen", seen, there), dimming, there)

    def _recorded_readings(
        self, view: View, rng: np.random.Generator | None, white: FloatArray | None = None
    ) -> FloatArray:
        """Turn a view into readings with noise, rounding and losses; if `rng` is None, with rounding only.

        `white`: standard normal draws, which become the noise, (n_points,); None: they are drawn from `rng` too.
        """
        readings = self.noise_free_readings(view)
        if rng is not None:
            white = rng.standard_normal(len(readings)) if white is None else white
            noise = self._with_effects("noise", white, view.rows, view.seen, rng)
            readings = readings + self.noise_sd * noise
        readings = self._with_effects("quantisation", readings, view.rows)
        if self.step is not None:
            readings = np.round(readings / self.step) * self.step
        return np.asarray(readings if rng is None else self._with_effects("loss", readings, view.rows, view.seen, rng))

    def _with_effects(self, stage: str, values: Any, *more: Any) -> Any:
        """Return what the chain has at a stage with the effects of that stage (`stages.Act`)."""
        for effect in self.concealed:
            if effect.stage == stage:
                values = effect.act(values, *more)
        return values


class Reader:
    """A world that is read place after place: effects of the way there and of earlier readings act.

    The noise of each reading has a seed of its own: `seed`, followed by the reading's number, from `first` on.
    """

    def __init__(self, world: World, *, seed: Sequence[int], first: int = 0) -> None:
        self._world, self._seed, self._first = world, tuple(seed), first
        self._views: View | None = None  # of all readings
        self._white = np.empty(0)
        self._last_mm, self._direction = np.empty(0), (0.0, 0.0)

    def read(
        self,
        surface: Surface,
        x_mm: float,
        y_mm: float,
        orientation_rad: float = 0.0,
        *,
        time_s: float,
        height_mm: float | None = None,
    ) -> float:
        """Take the next reading; parameters as for `World.read`."""
        place_mm = np.array([x_mm, y_mm])
        way_mm = place_mm - self._last_mm if self._last_mm.size else np.zeros(2)
        if (length_mm := float(np.hypot(*way_mm))) > 0:
            self._direction = (float(way_mm[0]) / length_mm, float(way_mm[1]) / length_mm)
        here = self._world.view_from_pose(surface, x_mm, y_mm, orientation_rad, time_s, self._direction, height_mm)
        rng = np.random.default_rng([*self._seed, self._first + len(self._white)])
        self._views = here if self._views is None else _joined(self._views, here)
        self._last_mm, self._white = place_mm, np.append(self._white, rng.standard_normal())
        return float(self._world._recorded_readings(self._views, rng, self._white)[-1])


def _joined(before: View, after: View) -> View:
    """Join the views of readings of one scan."""
    rows: dict[str, Any] = {
        name: np.concatenate([getattr(before.rows, name), getattr(after.rows, name)])
        for name in ("place_mm", "direction", "orientation_rad", "time_s", "scan", "across", "edge_mm")
    }
    covariates = {
        name: np.append(column, after.rows.covariates[name]) for name, column in before.rows.covariates.items()
    }
    return View(
        np.append(before.seen, after.seen),
        np.append(before.dimming, after.dimming),
        replace(before.rows, **rows, covariates=covariates),
    )
