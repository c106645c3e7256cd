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
_SEED = 2013


@dataclass(frozen=True)
class Population:
    """A named distribution of circles, which is also the robot's prior."""

    name: str
    shape: Circle

    def circles(self, n: int, *, seed: int = _SEED) -> FloatArray:
        """Return the first `n` circles of a seed: rows (x_mm, y_mm, radius_mm), (n, 3)."""
        return np.asarray(self.shape.prior.from_unit_cube(np.random.default_rng(seed).random((n, 3))))


_POPULATIONS = (
    Population("anywhere", Circle(FIELD, (20.0, 150.0))),
    Population("inside", Circle(FIELD, (50.0, 150.0), inside=True)),
)
POPULATIONS: Mapping[str, Population] = {p.name: p for p in _POPULATIONS}


def noise_of_run_in_sds(circle: int, n: int) -> FloatArray:
    """Return the noise of the first `n` readings over a circle, in units of its sd, (n,); the same in all rows."""
    return np.random.default_rng([circle, 99]).standard_normal(n)


_IN_BATCHES = ("finishing", "information")


@dataclass(frozen=True)
class SearchConfiguration:
    """One configuration of the search.

    `population`: distribution of the circles, which is also the prior: "anywhere" (radius 20 to 150 mm) or "inside" (50
    to 150 mm, entirely in the field); `model`: the robot's sensor model, "ssf" or "naive" (a point without SSF), while
    the true sensor always has the SSF; `utility`: acquisition function by name (`inquiry.utility_named`); `noise_sd`:
    sd of the simulated noise, which the robot knows, LEGO units; `width`: of the robot's SSF over the true one;
    `learn_sensor`: whether it learns the sensor along with the shape; `batch`: readings chosen together; `method`: of
    inference and choice, "particles", or "paper" with the utility "entropy" (`experiment.paper`); `nested_stop`: when
    its nested sampling stops, "change" or "remaining".
    """

    population: str = "inside"
    model: str = "ssf"
    utility: str = "finishing"
    noise_sd: float = 1.0
    width: float = 1.0
    learn_sensor: bool = False
    batch: int = 1
    method: str = "particles"
    nested_stop: NestedStop = "change"

    def __post_init__(self) -> None:
        choices = {
            "population": POPULATIONS,
            "model": ("ssf", "naive"),
            "method": get_args(MethodName),
            "nested_stop": NESTED_STOP,
        }
        for name, allowed in choices.items():
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
            words.append(f"noise {_exact_number_text(self.noise_sd)}")
        if self.width != REFERENCE.width:
            words.append(_ssf_width_in_words(self.width))
        if self.learn_sensor:
            words.append("learning it")
        if self.batch != REFERENCE.batch:
            words.append(f"{self.batch} at once")
        return ", ".join(words)


def _exact_number_text(value: float) -> str:
    """Return a number as text: six digits if they are exact, otherwise all."""
    return text if float(text := f"{value:g}") == value else repr(float(value))


def _ssf_width_in_words(width: float) -> str:
    """Describe a wrong width: in whole percent if possible, otherwise as a factor."""
    if width != round(width, 2):
        return f"believed {float(width)!r} times as wide"
    return f"believed {abs(width - 1):.0%} too {'wide' if width > 1 else 'narrow'}"


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
        {},
        {"model": "naive"},
        {"population": "anywhere"},
        {"population": "anywhere", "model": "naive"},
        {"utility": "information"},
        {"utility": "entropy"},
        {"utility": "per-second"},
        {"utility": "about:radius_mm"},
        {"batch": 3},
        {"noise_sd": 0.5},
        {"noise_sd": 2.0},
        {"width": 1.3},
        {"width": 0.7},
        {"width": 1.3, "learn_sensor": True},
        {"width": 0.7, "learn_sensor": True},
    )
    return tuple(replace(REFERENCE, **change) for change in changes)
