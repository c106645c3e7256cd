"""The world that makes readings: a spot of light over painted surfaces, and what it conceals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import ParameterError
from probewise.recordings.plan import Plan, Recording
from probewise.world.concealed import STEPS, Concealed, Rows, Step
from probewise.world.painting import Surface
from probewise.world.rays import seen_white
from probewise.world.spots import Spot

__all__ = ["World", "simulate"]


@dataclass(frozen=True, eq=False)
class World:
    """A sensor and what is wrong with it, free of any model of it.

    Parameters
    ----------
    spot
        Where the sensor looks.
    black, white
        Noise-free readings over plain black and plain white, I_min and I_max of the paper.
    noise_sd
        Standard deviation of the Gaussian noise of one reading.
    step
        Readings are rounded to multiples of it; None: not rounded.
    concealed
        What a plain model leaves out.
    """

    spot: Spot
    black: float = 10.0
    white: float = 60.0
    noise_sd: float = 0.6
    step: float | None = None
    concealed: tuple[Concealed, ...] = ()

    def __post_init__(self) -> None:
        if not self.noise_sd >= 0:
            raise ParameterError("noise_sd", self.noise_sd, "0 or more")
        if self.step is not None and not self.step > 0:
            raise ParameterError("step", self.step, "greater than 0, or None")
        for effect in self.concealed:
            if effect.step not in STEPS:
                raise ParameterError(f"{effect.name}.step", effect.step, f"one of {', '.join(STEPS)}")

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
    ) -> float:
        """Take one reading over a surface, as an arm does.

        Parameters
        ----------
        surface
            What lies there.
        x_mm, y_mm, orientation_rad
            Where the sensor is sent, lab frame.
        time_s
            When.
        rng
            Where the noise comes from; None: a reading without noise.
        direction
            Unit vector of the move that brought it there, for backlash.
        """
        rows = Rows(
            place_mm=np.array([[x_mm, y_mm]]),
            direction=np.array([direction]),
            time_s=np.array([time_s]),
            scan=np.zeros(1, dtype=np.int64),
        )
        clean = self._clean({"": surface}, [("", np.zeros(1, dtype=np.int64))], rows, np.array([orientation_rad]))
        return float(self._noisy(clean, rows, rng)[0])

    def expected(self, plan: Plan, surfaces: Mapping[str, Surface] | None = None) -> FloatArray:
        """Return the noise-free readings of a plan, shape (n_points,).

        Parameters
        ----------
        plan
            Where, when and over what.
        surfaces
            What lies under a pattern's name, in place of what the plan says.

        Raises
        ------
        ParameterError
            If the plan reads a pattern that nobody describes.
        """
        return self._clean(self._surfaces(plan, surfaces), plan.rows_by_pattern(), _rows(plan), plan.orientation_rad)

    def simulate(
        self, plan: Plan, *, rng: np.random.Generator, surfaces: Mapping[str, Surface] | None = None
    ) -> Recording:
        """Carry out a plan.

        Parameters
        ----------
        plan
            Where, when and over what.
        rng
            Where the noise comes from.
        surfaces
            What lies under a pattern's name, in place of what the plan says.

        Raises
        ------
        ParameterError
            If the plan reads a pattern that nobody describes.
        """
        return Recording(plan, self._noisy(self.expected(plan, surfaces), _rows(plan), rng))

    def _clean(
        self,
        surfaces: Mapping[str, Surface],
        rows_by_pattern: Sequence[tuple[str, IntArray]],
        rows: Rows,
        orientation_rad: FloatArray,
    ) -> FloatArray:
        place = self._changed("place", rows.place_mm, rows)
        seen = np.empty(len(place))
        for name, chosen in rows_by_pattern:
            x_mm, y_mm = place[chosen].T
            seen[chosen] = seen_white(surfaces[name], self.spot, x_mm, y_mm, orientation_rad[chosen])
        there = Rows(place, rows.direction, rows.time_s, rows.scan)
        signal = (self.white - self.black) * self._changed("response", seen, there)
        reading = self.black + self._changed("gain", signal, there)
        return self._changed("saturation", self._changed("offset", reading, there), there)

    def _noisy(self, clean: FloatArray, rows: Rows, rng: np.random.Generator | None) -> FloatArray:
        readings = clean
        if rng is not None:
            readings = clean + self.noise_sd * self._changed("noise", rng.standard_normal(len(clean)), rows)
        return readings if self.step is None else np.round(readings / self.step) * self.step

    def _changed(self, step: Step, values: FloatArray, rows: Rows) -> FloatArray:
        for effect in self.concealed:
            if effect.step == step:
                values = effect.change(values, rows)
        return values

    def _surfaces(self, plan: Plan, surfaces: Mapping[str, Surface] | None) -> dict[str, Surface]:
        out: dict[str, Surface] = {**plan.patterns, **(surfaces or {})}
        for name, _ in plan.rows_by_pattern():
            if name not in out:
                raise ParameterError("pattern", name, f"one of {', '.join(out) or 'none'}, or give it in surfaces")
        return out


def simulate(plan: Plan, world: World, *, rng: np.random.Generator) -> Recording:
    """Carry out a plan in a world (World.simulate, as a function)."""
    return world.simulate(plan, rng=rng)


def _rows(plan: Plan) -> Rows:
    return Rows(np.stack([plan.x_mm, plan.y_mm], axis=-1), plan.direction, plan.time_s, plan.scan)
