"""The fine grid of possible places over the field."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError, ShapeError
from probewise.recordings.plan import Plan


@dataclass(frozen=True)
class Grid:
    """Evenly spaced places over the field, edges included; by default the paper's 131 x 65 over 1048 x 520 mm."""

    width_mm: float = 1048.0
    height_mm: float = 520.0
    n_x: int = 131
    n_y: int = 65

    def __post_init__(self) -> None:
        for name in ("width_mm", "height_mm"):
            value = getattr(self, name)
            if not (0 < value < np.inf):
                raise ParameterError(name, value, "finite, greater than 0")
        for name in ("n_x", "n_y"):
            if getattr(self, name) < 2:
                raise ParameterError(name, getattr(self, name), "2 or more")

    @property
    def n_places(self) -> int:
        """Number of places."""
        return self.n_x * self.n_y

    @cached_property
    def x_mm(self) -> FloatArray:
        """X of each column, (n_x,)."""
        return _read_only(np.linspace(0.0, self.width_mm, self.n_x))

    @cached_property
    def y_mm(self) -> FloatArray:
        """Y of each row, the lowest first, (n_y,)."""
        return _read_only(np.linspace(0.0, self.height_mm, self.n_y))

    @cached_property
    def places_mm(self) -> FloatArray:
        """All places, shape (n_places, 2), lab frame: x runs fastest, so that `image` needs no transpose."""
        x, y = np.meshgrid(self.x_mm, self.y_mm)
        return _read_only(np.stack([x.ravel(), y.ravel()], axis=-1))

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
        n = self.n_places
        return Plan(
            x_mm=self.places_mm[:, 0],
            y_mm=self.places_mm[:, 1],
            orientation_rad=np.full(n, orientation_rad),
            time_s=np.full(n, time_s),
            scan=np.arange(n),
            scan_names=tuple(str(k) for k in range(n)),
            pattern=np.zeros(n, dtype=np.int64),
            pattern_names=(pattern_name,),
        )


def _read_only(values: FloatArray) -> FloatArray:
    values.flags.writeable = False
    return values
