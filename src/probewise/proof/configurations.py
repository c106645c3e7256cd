"""The rows of a study, and the circles and the noise that all of them share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError, require
from probewise.experiment import MethodName
from probewise.inquiry import utility_named
from probewise.nested import NESTED_STOP, NestedStop
from probewise.scene import Circle, Field

FIELD = Field()
MOST_CIRCLES = 10_000
"""Largest number of circles of a row: a month of processor time, whose tasks are listed in memory."""
SEED = 2013

POPULATIONS: Mapping[str, Circle] = {
    "anywhere": Circle(FIELD, (20.0, 150.0)),
    "inside": Circle(FIELD, (50.0, 150.0), inside=True),
}
"""Named distributions of circles, which are also the robot's priors."""


def true_circle(population: str, number: int, *, seed: int = SEED) -> FloatArray:
    """Return a circle of a population, by its number from 0: x_mm, y_mm, radius_mm, (3,)."""
    cube = np.random.default_rng(seed).random((number + 1, 3))
    return np.asarray(POPULATIONS[population].prior.from_unit_cube(cube)[number])


_IN_BATCHES = ("finishing", "information")


@dataclass(frozen=True)
class SearchConfiguration:
    """One configuration of the search."""

    population: str = "inside"  # of the circles, which is also the prior: "anywhere" or "inside"
    model: str = "ssf"  # the robot's, or "naive", a point without SSF; the true sensor always has the SSF
    utility: str = "finishing"  # by name, see `inquiry.utility_named`
    noise_sd: float = 1.0  # simulated and known to the robot, LEGO units
    width: float = 1.0  # of the robot's SSF over the true one
    learn_sensor: bool = False  # along with the shape
    batch: int = 1  # readings chosen together
    method: str = "particles"  # or "paper" with the utility "entropy" (`experiment.paper`)
    nested_stop: NestedStop = "change"  # when the paper's nested sampling stops

    def __post_init__(self) -> None:
        choices = {"population": POPULATIONS, "model": ("ssf", "naive"), "method": get_args(MethodName)}
        for name, allowed in {**choices, "nested_stop": NESTED_STOP}.items():
            require(getattr(self, name) in allowed, name, getattr(self, name), " or ".join(allowed))
        utility_named(self.utility)
        for name in ("noise_sd", "width"):
            require(1e-3 <= getattr(self, name) <= 1e3, name, getattr(self, name), "from 0.001 to 1000")
        if self.model == "naive":
            for name, plain in (("width", 1.0), ("learn_sensor", False)):
                if getattr(self, name) != plain:
                    raise ParameterError(name, getattr(self, name), f'{plain} with the model "naive", which has no SSF')
        if self.batch > 1 and self.utility not in _IN_BATCHES:
            raise ParameterError("batch", self.batch, f"1, or more with the utility {' or '.join(_IN_BATCHES)}")
        ways = (self.utility, self.learn_sensor, self.batch)
        if self.method == "paper" and ways != ("entropy", False, 1):
            raise ParameterError("utility, learn_sensor, batch", ways, '("entropy", False, 1) with the method "paper"')
        if self.method != "paper" and self.nested_stop != "change":
            raise ParameterError("nested_stop", self.nested_stop, '"change", but with the method "paper"')

    @property
    def name(self) -> str:
        """Distribution of the circles, sensor model, and other differences from the reference, in words.

        Two rows that differ have different names, by which a study's file keeps their runs.
        """
        words = [self.population, "SSF" if self.model == "ssf" else "naive"]
        if self.method == "paper":
            words.append("the paper's method" + (" to remaining evidence" if self.nested_stop == "remaining" else ""))
        elif self.utility != REFERENCE.utility:
            words.append(self.utility)
        if self.noise_sd != REFERENCE.noise_sd:
            short = f"{self.noise_sd:g}"
            words.append(f"noise {short if float(short) == self.noise_sd else repr(float(self.noise_sd))}")
        if self.width != round(self.width, 2):
            words.append(f"believed {float(self.width)!r} times as wide")
        elif self.width != REFERENCE.width:
            words.append(f"believed {abs(self.width - 1):.0%} too {'wide' if self.width > 1 else 'narrow'}")
        if self.learn_sensor:
            words.append("learning it")
        if self.batch != REFERENCE.batch:
            words.append(f"{self.batch} at once")
        return ", ".join(words)


REFERENCE = SearchConfiguration()


def paper_comparison_rows(
    *, population: str = REFERENCE.population, nested_stop: NestedStop = "change"
) -> tuple[SearchConfiguration, ...]:
    """Return four rows: sensor model "ssf", then "naive", each with the reference's method, then the paper's."""
    paper = {"method": "paper", "utility": "entropy", "nested_stop": nested_stop}
    ways: tuple[dict[str, Any], ...] = ({}, paper)
    return tuple(
        replace(REFERENCE, population=population, model=model, **way) for model in ("ssf", "naive") for way in ways
    )


def standard_rows() -> tuple[SearchConfiguration, ...]:
    """Return the rows of the published table, the reference first."""
    changes: tuple[dict[str, Any], ...] = (
        *({}, {"model": "naive"}, {"population": "anywhere"}, {"population": "anywhere", "model": "naive"}),
        *({"utility": name} for name in ("information", "entropy", "per-second", "about:radius_mm")),
        *({"batch": 3}, {"noise_sd": 0.5}, {"noise_sd": 2.0}),
        *({"width": width, **learns} for learns in ({}, {"learn_sensor": True}) for width in (1.3, 0.7)),
    )
    return tuple(replace(REFERENCE, **change) for change in changes)
