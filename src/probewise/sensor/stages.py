"""The stages of the sensor chain from pose to reading, and the value that each one transforms.

In order: pose, scene, footprint, seen fraction, response curve, gain, offset, lag, saturation, noise. An effect is one
function at one stage.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import accumulate, pairwise
from typing import Any, Protocol, TypeVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ShapeError
from probewise.priors import Prior
from probewise.recordings.plan import Plan
from probewise.scene.regions import Region


class Stage(IntEnum):
    """The stage at which an effect acts; effects act in the order of the stages.

    INPUT, PARAMETER, RATE, HYSTERESIS and BEND are stages of `probewise.systems` alone: a light sensor's `Chain`
    ignores an effect at one of these.
    """

    INPUT = 0
    PARAMETER = 1
    RATE = 2
    POSE = 3
    SCENE = 4
    FOOTPRINT = 5
    SEEN = 6
    RESPONSE = 7
    GAIN = 8
    OFFSET = 9
    HYSTERESIS = 10
    BEND = 11
    LAG = 12
    SATURATION = 13
    NOISE = 14


@dataclass(frozen=True, eq=False)
class Poses:
    """True poses of the sensor: arrays that broadcast to (n_samples, n_points)."""

    x_mm: FloatArray
    y_mm: FloatArray
    orientation_rad: FloatArray

    @property
    def arrays(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The three arrays: x_mm, y_mm, orientation_rad."""
        return self.x_mm, self.y_mm, self.orientation_rad


@dataclass(frozen=True, eq=False)
class SceneView:
    """The scene: region by pattern name, and each reading's displacement of its pattern from the described place.

    `dx_mm`, `dy_mm` broadcast to (n_samples, n_points).
    """

    regions: Mapping[str, Region]
    dx_mm: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    dy_mm: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))


@dataclass(frozen=True, eq=False)
class Footprint:
    """The SSF as a mixture of Gaussians in the sensor frame.

    Arrays broadcast to (n_samples, n_points, n_gaussians): `weight` (sums to one over the
    last axis), mean `u_mm`, `v_mm`, covariance `var_u`, `var_v`, `cov_uv` in mm^2.
    `brightness` (n_samples, n_points) is the signal strength relative to calibration.
    """

    weight: FloatArray
    u_mm: FloatArray
    v_mm: FloatArray
    var_u: FloatArray
    var_v: FloatArray
    cov_uv: FloatArray
    brightness: FloatArray = field(default_factory=lambda: np.ones((1, 1)))

    @property
    def moments(self) -> tuple[FloatArray, ...]:
        """Mean and covariance of each Gaussian: u_mm, v_mm, var_u, var_v, cov_uv."""
        return (self.u_mm, self.v_mm, self.var_u, self.var_v, self.cov_uv)


@dataclass(frozen=True, eq=False)
class View:
    """The view: white fraction `seen` (n_samples, n_points), and the poses and regions it was computed from.

    `poses` are the true ones minus the displacement of each reading's pattern from its described place; `brightness` is
    the strength of the signal relative to calibration.
    """

    seen: FloatArray
    poses: Poses
    regions: Mapping[str, Region]
    brightness: FloatArray = field(default_factory=lambda: np.ones((1, 1)))


@dataclass(frozen=True, eq=False)
class NoiseParameters:
    """Noise of the readings: `sd` broadcasts to (n_samples, n_points); unless stated, the rest are (n_samples, 1).

    `rho` is the AR(1) correlation within a scan. A random walk of the offset has steps of `walk` sds from row to row;
    where it has come to by each reading is uncertain by the sd `offset_sd`, which broadcasts as `sd`. With probability
    `wide_share` a reading's own noise is `wide_times` as wide; with probability `lost_share` a reading is lost and
    reads `lost_value`. Readings are rounded to `step`, 0 for none. `seen` (n_samples, n_points) is the white fraction,
    for noise that depends on the signal.
    """

    sd: FloatArray
    rho: FloatArray
    seen: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    wide_share: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    wide_times: FloatArray = field(default_factory=lambda: np.ones((1, 1)))
    lost_share: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    lost_value: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    step: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    walk: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    offset_sd: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))


V = TypeVar("V")


class Effect(Protocol[V]):
    """Physics that a model may leave out: one function at one stage.

    `apply` takes and returns that stage's value. Of a light sensor: Poses, SceneView, Footprint, View (SEEN), an array
    (n_samples, n_points) of white fraction R (RESPONSE), signal (GAIN), reading (OFFSET, LAG, SATURATION), or
    NoiseParameters (NOISE). For the other stages see `probewise.systems`.
    """

    @property
    def name(self) -> str:
        """Name in the vocabulary, or one of the user's own."""
        ...

    @property
    def stage(self) -> Stage:
        """The stage of the chain at which it acts."""
        ...

    @property
    def prior(self) -> Prior:
        """Prior of its parameters, named without the effect's name."""
        ...

    def apply(self, value: V, theta: FloatArray, plan: Plan) -> V:
        """Return the stage's value with the effect applied, with its parameters theta (n_samples, n_params)."""
        ...


AnyEffect = Effect[Any]
E = TypeVar("E", bound=AnyEffect)


def parameter_names_of_effects(effects: Iterable[AnyEffect]) -> Iterator[str]:
    """Return the names of the effects' parameters as "effect.parameter", one per column of theta."""
    return (f"{effect.name}.{name}" for effect in effects for name in effect.prior.names)


def effects_with_columns(effects: Sequence[E], first: int = 0) -> list[tuple[E, slice]]:
    """Return each effect with the slice of its columns of theta, which follow one another from column `first` on."""
    ends = accumulate((len(effect.prior.names) for effect in effects), initial=first)
    return [(effect, slice(*both)) for effect, both in zip(effects, pairwise(ends), strict=True)]


class SensorModel(Protocol):
    """Anything that predicts readings: the chain, the naive sensor, a user's own simulator."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, one per column of theta."""
        ...

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Predict noise-free readings, theta (n_samples, n_params) -> (n_samples, n_points)."""
        ...


def require_theta_columns(theta: FloatArray, names: tuple[str, ...]) -> None:
    """Raise ShapeError unless theta has shape (n_samples, len(names))."""
    if theta.ndim != 2 or theta.shape[1] != len(names):
        raise ShapeError(f"theta has shape {theta.shape}; allowed: (n_samples, {len(names)}) for {names}")
