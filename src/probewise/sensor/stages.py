"""The stages a reading passes from pose to number, and the value that each one handles.

Order (the vocabulary's): pose, scene, footprint, seen fraction, response curve, gain, offset,
lag, saturation, noise. An effect is one function at one stage; the chain applies the effects
of each stage in the order of stages, whatever the order in which they were found.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Protocol, TypeVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ShapeError
from probewise.priors import Prior
from probewise.recordings.plan import Plan
from probewise.scene.albedo import Region

__all__ = [
    "Effect",
    "Footprint",
    "NoiseLevel",
    "Poses",
    "SceneView",
    "SensorModel",
    "Stage",
    "View",
    "require_columns",
]


class Stage(IntEnum):
    """Where in the chain an effect acts."""

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
    BEND = 10
    LAG = 11
    SATURATION = 12
    NOISE = 13


@dataclass(frozen=True, eq=False)
class Poses:
    """Where the sensor really stands: arrays that broadcast to (n_samples, n_points)."""

    x_mm: FloatArray
    y_mm: FloatArray
    orientation_rad: FloatArray


@dataclass(frozen=True, eq=False)
class SceneView:
    """What lies under it: region by pattern name, and how far each reading's pattern lies from where it should.

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
    `brightness` (n_samples, n_points) is how strong the signal is of what it was calibrated at.
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
    """What the sensor sees: white fraction `seen` (n_samples, n_points), from which place of which regions.

    `poses` are relative to the patterns as they are described; `brightness` is the footprint's.
    """

    seen: FloatArray
    poses: Poses
    regions: Mapping[str, Region]
    brightness: FloatArray = field(default_factory=lambda: np.ones((1, 1)))


@dataclass(frozen=True, eq=False)
class NoiseLevel:
    """Noise of one reading: `sd` broadcasts to (n_samples, n_points); the rest are (n_samples, 1).

    `rho` is AR(1) within a scan. A random walk of the offset gains `walk` sds from row to row, and has taken `walked`
    (n_points,) steps by each row. With the share `wide_share` a reading's noise is `wide_times` as wide;
    with the share `lost_share` a reading is lost to `lost_value`; what is left is rounded to `step`,
    0 for none. `seen` (n_samples, n_points) is the white fraction that was seen, for what goes with it.
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
    walked: FloatArray = field(default_factory=lambda: np.zeros(1))


V = TypeVar("V")


class Effect(Protocol[V]):
    """Physics that a model may leave out: one function at one stage.

    `apply` takes and returns that stage's value: Poses, SceneView, Footprint, View (SEEN), an
    array (n_samples, n_points) of seen fraction u (RESPONSE), signal (GAIN), reading (OFFSET,
    LAG, SATURATION), or NoiseLevel (NOISE).
    """

    @property
    def name(self) -> str:
        """Name in the vocabulary, or one of the user's own."""
        ...

    @property
    def stage(self) -> Stage:
        """The stage it acts at."""
        ...

    @property
    def prior(self) -> Prior:
        """Prior of its parameters; names are the vocabulary's, without the effect's name."""
        ...

    def apply(self, value: V, theta: FloatArray, plan: Plan) -> V:
        """Apply with parameters theta (n_samples, n_params of this effect)."""
        ...


AnyEffect = Effect[Any]


class SensorModel(Protocol):
    """Anything that predicts readings: the chain, the naive sensor, a user's own simulator."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, one a column of theta."""
        ...

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Noise-free readings, theta (n_samples, n_params) -> (n_samples, n_points)."""
        ...


def require_columns(theta: FloatArray, names: tuple[str, ...]) -> None:
    """Raise ShapeError unless theta has shape (n_samples, len(names))."""
    if theta.ndim != 2 or theta.shape[1] != len(names):
        raise ShapeError(f"theta has shape {theta.shape}; allowed: (n_samples, {len(names)}) for {names}")
