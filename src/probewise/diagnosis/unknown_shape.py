"""The null of a calibrated sensor over an unknown shape, whose parameters are nuisance parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray, read_only_floats
from probewise.diagnosis.diagnosis import Diagnosis
from probewise.diagnosis.fit import FARTHEST
from probewise.diagnosis.sensors import CalibratedSensor, SensorPrior, cached_known_scene, sensor_from_samples
from probewise.effects import NamedEffect
from probewise.errors import ParameterError
from probewise.priors import Prior
from probewise.recordings.patterns import Polygon
from probewise.recordings.plan import Plan, Recording
from probewise.scene import AnyOf, Region, Shape, outlines
from probewise.sensor import FAST_NODES, Chain

_N_DRAWS, _N_ELITE, _N_ROUNDS = 2000, 40, 8


@dataclass(frozen=True, eq=False)
class SensorAndShape:
    """A null model: a calibrated sensor over an unknown shape of known prior, which is every pattern not described.

    `starts` (n_starts, n_params) are coordinates from which it is fitted; `of` finds them.
    """

    sensor: CalibratedSensor
    shape: Shape
    starts: FloatArray
    predicts_in_bulk = predicts_dearly = False
    may_be_far_off = True  # without a missing effect the shape may be found at another place

    def coordinates(self, theta: FloatArray) -> None:
        return None

    def __post_init__(self) -> None:
        object.__setattr__(self, "starts", read_only_floats(self.starts))

    @classmethod
    def of(cls, sensor: SensorPrior, shape: Shape, recording: Recording, *, rng: np.random.Generator) -> Self:
        """Build from a calibrated sensor's posterior and a shape's prior, and search for shapes that fit the readings.

        Of a set of shapes (`AnyOf`), only the best-fitting one is kept. Raises ParameterError if no reading is usable.
        """
        known = sensor_from_samples(sensor)
        members = tuple(shape.shapes.values()) if isinstance(shape, AnyOf) else (shape,)
        found = [_search_for_shapes(cls(known, member, np.empty((0, 0))), recording, rng) for member in members]
        best = min(range(len(members)), key=lambda k: found[k][0])
        return cls(known, members[best], found[best][1])

    @property
    def n_params(self) -> int:
        return self.sensor.n_params + len(self.shape.prior.names)

    @property
    def n_gaussians(self) -> int:
        return self.sensor.n_gaussians

    @property
    def effective_n_gaussians(self) -> int:
        return self.sensor.effective_n_gaussians

    @property
    def ssf_in_words(self) -> str:
        return self.sensor.ssf_in_words

    @property
    def has_exchangeable_gaussians(self) -> bool:
        return self.sensor.has_exchangeable_gaussians

    @property
    def nuisance_names(self) -> tuple[str, ...]:
        return self.shape.prior.names

    @property
    def least_readings(self) -> int:
        return 3 * len(self.shape.prior.names) + 3

    def admits(self, effect: NamedEffect[Any]) -> bool:
        return self.sensor.admits(effect)

    def theta(self, z: FloatArray) -> FloatArray:
        """Map coordinates, (n_samples, n_params), to parameters: the sensor's columns, then the shape's."""
        k = self.sensor.n_params
        return np.concatenate([self.sensor.theta(z[:, :k]), self.shape.prior.from_unit_cube(ndtr(z[:, k:]))], axis=1)

    def chain(self, plan: Plan, effects: Sequence[NamedEffect[Any]], *, n_nodes: int) -> Chain:
        return self.sensor.chain_over(_ShapeAmongPatterns(self.shape, plan), effects, n_nodes=n_nodes)

    def with_shape_in_next_plan(self, diagnosis: Diagnosis) -> Diagnosis:
        """Return the diagnosis with undescribed patterns of its next plan described, so that the plan can be written.

        They become the shape at its posterior mean, as a polygon.
        """
        asked, names = diagnosis.next_measurement, list(diagnosis.repaired.chain.names)
        if asked is None:
            return diagnosis
        own = [names.index(name) for name in self.nuisance_names]
        believed = diagnosis.repaired.theta[:, own].mean(axis=0)
        outline = outlines(self.shape.region(believed[None, :]))[0]
        shape = Polygon(tuple((float(x), float(y)) for x, y in outline[:-1]))
        plan = asked.plan
        patterns = {name: plan.patterns.get(name, shape) for name in plan.pattern_names}
        return replace(diagnosis, next_measurement=replace(asked, plan=replace(plan, patterns=patterns)))


@dataclass(frozen=True, eq=False)
class _ShapeAmongPatterns:
    """A scene of a plan's described patterns, and of one unknown shape under every other name."""

    shape: Shape
    plan: Plan

    @property
    def names(self) -> tuple[str, ...]:
        return self.shape.prior.names

    @property
    def prior(self) -> Prior:
        return self.shape.prior

    def regions(self, theta: FloatArray) -> Mapping[str, Region]:
        """Return the region of each pattern by name, for theta (n_samples, n_params of the shape)."""
        known = cached_known_scene(self.plan).regions(theta)
        unknown = self.shape.region(theta)
        return {name: known.get(name, unknown) for name in self.plan.pattern_names}


def _search_for_shapes(
    null: SensorAndShape, recording: Recording, rng: np.random.Generator
) -> tuple[float, FloatArray]:
    """Search for shapes that fit the readings, with the sensor at its prior mean.

    Shapes are drawn from the prior, then repeatedly about the best ones.
    """
    usable = recording.usable
    if not usable.any():
        raise ParameterError("usable readings", 0, "at least one; the recording holds none")
    k = null.sensor.n_params
    chain = null.chain(recording.plan, (), n_nodes=FAST_NODES)

    def sums_of_squares(own: FloatArray) -> FloatArray:
        z = np.concatenate([np.zeros((len(own), k)), own], axis=1)
        predicted = chain.predict(null.theta(z), recording.plan)[:, usable]
        return np.asarray(np.sum((recording.readings[usable] - predicted) ** 2, axis=1))

    own = rng.standard_normal((_N_DRAWS, null.n_params - k))
    values = sums_of_squares(own)
    for shrink in 0.5 ** np.arange(_N_ROUNDS):
        elite = np.argsort(values)[:_N_ELITE]
        near = own[elite[rng.integers(_N_ELITE, size=_N_DRAWS)]]
        near = np.clip(near + 0.5 * shrink * rng.standard_normal(near.shape), -FARTHEST, FARTHEST)
        own, values = np.concatenate([own[elite], near]), np.concatenate([values[elite], sums_of_squares(near)])
    best = np.argsort(values)[:4]
    return float(values[best[0]]), np.concatenate([np.zeros((4, k)), own[best]], axis=1)
