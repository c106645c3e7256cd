"""The circles and the noise that the rows of a study share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.scene import Circle, Field

FIELD = Field()
MOST_CIRCLES = 10_000
"""Largest number of circles of a row: a month of processor time, whose tasks are listed in memory."""
_SEED = 2013


@dataclass(frozen=True)
class Population:
    """A named distribution of circles, which is also the robot's prior."""

    name: str
    shape: Circle

    def circles(self, n: int, *, seed: int = _SEED) -> FloatArray:
        """Return the first `n` circles of a seed: rows (x_mm, y_mm, radius_mm), (n, 3). ParameterError if n < 1."""
        if n < 1:
            raise ParameterError("n", n, "1 or more")
        return np.asarray(self.shape.prior.from_unit_cube(np.random.default_rng(seed).random((n, 3))))


POPULATIONS: Mapping[str, Population] = {
    p.name: p
    for p in (
        Population("anywhere", Circle(FIELD, (20.0, 150.0))),
        Population("inside", Circle(FIELD, (50.0, 150.0), inside=True)),
    )
}


def noise_of_run_in_sds(circle: int, n: int) -> FloatArray:
    """Return the noise of the first `n` readings over a circle, in units of its sd, (n,); the same in all rows."""
    return np.random.default_rng([circle, 99]).standard_normal(n)
