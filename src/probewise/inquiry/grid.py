"""The possible next readings: the places of a fine grid over the field, with orientations, repeats and settings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np

from probewise._arrays import FloatArray, IntArray, read_only_floats
from probewise._kinds import checked_finite_number, checked_whole
from probewise.errors import ShapeError, require
from probewise.recordings.plan import Plan

_MOST_REPEATS = 1000


@dataclass(frozen=True)
class Grid:
    """Evenly spaced places over the field, edges included; by default the paper's 131 x 65 over 1048 x 520 mm."""

    width_mm: float = 1048.0
    height_mm: float = 520.0
    n_x: int = 131
    n_y: int = 65

    def __post_init__(self) -> None:
        for name in ("width_mm", "height_mm"):
            length_mm = checked_finite_number(name, getattr(self, name))
            require(length_mm > 0, name, length_mm, "finite, greater than 0")
        for name in ("n_x", "n_y"):
            checked_whole(name, getattr(self, name), least=2)

    @property
    def n_places(self) -> int:
        """Number of places."""
        return self.n_x * self.n_y

    @cached_property
    def x_mm(self) -> FloatArray:
        """X of each column, (n_x,)."""
        return read_only_floats(np.linspace(0.0, self.width_mm, self.n_x))

    @cached_property
    def y_mm(self) -> FloatArray:
        """Y of each row, the lowest first, (n_y,)."""
        return read_only_floats(np.linspace(0.0, self.height_mm, self.n_y))

    @cached_property
    def places_mm(self) -> FloatArray:
        """All places, shape (n_places, 2), lab frame: x runs fastest, so that `image` needs no transpose."""
        x, y = np.meshgrid(self.x_mm, self.y_mm)
        return read_only_floats(np.stack([x.ravel(), y.ravel()], axis=-1))

    def image(self, values: FloatArray) -> FloatArray:
        """Arrange one value per place as an image, (n_places,) -> (n_y, n_x), lower row first."""
        if values.shape != (self.n_places,):
            raise ShapeError(f"values have shape {values.shape}; allowed: ({self.n_places},), one per place")
        return values.reshape(self.n_y, self.n_x)

    def plan(self, pattern_name: str, *, orientation_rad: float = 0.0, time_s: float = 0.0) -> Plan:
        """Return a plan with one reading per place, all at the same time.

        Each place is a scan of its own, because they are alternatives and not a sequence: effects of the order of
        readings must not act between them.
        """
        return Designs(self, (orientation_rad,)).plan(pattern_name, time_s=time_s)


@dataclass(frozen=True)
class Design:
    """One possible reading: place, orientation, repeats and other settings."""

    x_mm: float
    y_mm: float
    orientation_rad: float = 0.0
    repeats: int = 1
    settings: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class Designs:
    """The possible readings: every place of a grid with every orientation, number of repeats and other setting.

    Rows run over all places for the first combination, then for the next, so that values reshape to
    (n_combinations, n_places).

    Parameters
    ----------
    grid
        The places.
    orientations_rad
        Possible orientations of the sensor.
    repeats
        Possible numbers of repeated readings, which are averaged.
    settings
        Other quantities by name with their possible values, which become covariates of the plan, such as
        ("height_mm", (8.0, 14.0)).
    """

    grid: Grid = field(default_factory=Grid)
    orientations_rad: tuple[float, ...] = (0.0,)
    repeats: tuple[int, ...] = (1,)
    settings: tuple[tuple[str, tuple[float, ...]], ...] = ()

    def __post_init__(self) -> None:
        turns, few = self.orientations_rad, f"one number or more, each from 1 to {_MOST_REPEATS}"
        require(turns and np.isfinite(turns).all(), "orientations_rad", turns, "one finite angle or more")
        require(self.repeats and all(1 <= n <= _MOST_REPEATS for n in self.repeats), "repeats", self.repeats, few)
        for name, values in self.settings:
            require(values and np.isfinite(values).all(), f"settings {name}", values, "one finite value or more")

    def __len__(self) -> int:
        return self.grid.n_places * len(self.setting_combinations)

    @cached_property
    def setting_combinations(self) -> tuple[Design, ...]:
        """The combinations of orientation, settings and repeats, as designs at (0, 0); repeats vary fastest."""
        names = [name for name, _ in self.settings]
        return tuple(
            Design(0.0, 0.0, turn, n, tuple(zip(names, values, strict=True)))
            for turn in self.orientations_rad
            for values in product(*(values for _, values in self.settings))
            for n in self.repeats
        )

    def __getitem__(self, row: int) -> Design:
        """Return one design by its row."""
        which, place = divmod(row, self.grid.n_places)
        x_mm, y_mm = self.grid.places_mm[place].tolist()
        return replace(self.setting_combinations[which], x_mm=x_mm, y_mm=y_mm)

    @cached_property
    def n_repeats(self) -> IntArray:
        """Number of readings of each design, (n_designs,)."""
        return np.repeat([combination.repeats for combination in self.setting_combinations], self.grid.n_places)

    def plan(self, pattern_name: str, *, time_s: float = 0.0) -> Plan:
        """Return a plan with one row per design, in order, each a scan of its own (see `Grid.plan`)."""
        return replace(self._plan_without_time, pattern_names=(pattern_name,), time_s=np.full(len(self), time_s))

    @cached_property
    def _plan_without_time(self) -> Plan:
        """The plan of all designs with time 0 and pattern name "", cached because it has thousands of scan names."""
        n_places, n_designs, combinations = self.grid.n_places, len(self), self.setting_combinations
        return Plan(
            x_mm=np.tile(self.grid.places_mm[:, 0], len(combinations)),
            y_mm=np.tile(self.grid.places_mm[:, 1], len(combinations)),
            orientation_rad=np.repeat([c.orientation_rad for c in combinations], n_places),
            time_s=np.zeros(n_designs),
            scan=np.arange(n_designs),
            scan_names=tuple(str(k) for k in range(n_designs)),
            pattern=np.zeros(n_designs, dtype=np.int64),
            pattern_names=("",),
            covariates={n: np.repeat([dict(c.settings)[n] for c in combinations], n_places) for n, _ in self.settings},
        )

    def cost_s(self, travel_s: FloatArray, read_s: float) -> FloatArray:
        """Return the duration of each design in seconds, (n_designs,).

        `travel_s`: seconds to move to each place and read there once, (n_places,). `read_s`: of each repeated reading.
        """
        return np.tile(travel_s, len(self.setting_combinations)) + read_s * (self.n_repeats - 1)
