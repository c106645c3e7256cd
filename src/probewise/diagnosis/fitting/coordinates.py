"""Coordinates in which every prior is a standard normal, so that fits and evidences need no special case.

The sensor's natural coordinates are the logits of the Gaussians' shares, their means, the logs of their widths, the
inverse hyperbolic tangents of their correlations, and the two levels: all unbounded, with a normal prior. (They are not
the natural parameters of an exponential family.) An effect's coordinates are the standard-normal transforms of its own
prior.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from probewise._arrays import FloatArray, read_only_floats
from probewise.effects import Extent, NamedEffect
from probewise.errors import ShapeError
from probewise.recordings.plan import Plan
from probewise.scene import KnownScene, Scene
from probewise.sensor import Chain, FreeLevels, FreeMixture

FARTHEST = 6.0
"""Bound of every coordinate: six standard deviations of its prior."""


LEAST_READINGS = 24
"""Fewest usable readings for a verdict on a sensor."""


class CalibratedSensor(ABC):
    """A sensor over known patterns as a `Null`, with a normal prior of the natural coordinates of SSF and levels.

    `center` (n_params,) is the prior's mean, `factor` a square root of its covariance. `calibrated_height_mm` is the
    height of an earlier calibration; None: the height that a plan declares.
    """

    n_gaussians: int
    center: FloatArray
    factor: FloatArray
    calibrated_height_mm: float | None

    def __post_init__(self) -> None:
        n = self.n_params
        object.__setattr__(self, "center", read_only_floats(self.center))
        object.__setattr__(self, "factor", read_only_floats(self.factor))
        if self.center.shape != (n,) or self.factor.shape != (n, n):
            raise ShapeError(
                f"center {self.center.shape} and factor {self.factor.shape} do not fit; allowed: ({n},) and "
                f"({n}, {n}) for {self.n_gaussians} Gaussians"
            )

    @property
    @abstractmethod
    def n_params(self) -> int:
        """Number of coordinates."""

    @property
    @abstractmethod
    def effective_n_gaussians(self) -> int:
        """Number of Gaussians that its SSF counts as, the measure of its complexity."""

    @property
    @abstractmethod
    def ssf_in_words(self) -> str:
        """Description of its SSF, in words."""

    @property
    def predicts_in_bulk(self) -> bool:
        """False: every sample costs as much as the first."""
        return False

    def coordinates(self, theta: FloatArray) -> FloatArray | None:
        """Return None: what it simulates is no array of readings."""
        return None

    @property
    def predicts_cheaply_nearby(self) -> bool:
        """False: a prediction costs as much near another one as elsewhere."""
        return False

    @property
    def may_be_far_off(self) -> bool:
        """False: a fit of a sensor without a missing effect is near enough to screen the effects about it."""
        return False

    @property
    def has_exchangeable_gaussians(self) -> bool:
        """Whether its Gaussians are exchangeable."""
        return False

    @abstractmethod
    def theta_from_natural(self, natural: FloatArray) -> FloatArray:
        """Map natural coordinates, (n_samples, n_params), to a_1 .. C_N, I_min, I_max, (n_samples, 6 N + 2)."""

    @abstractmethod
    def natural_from_theta(self, theta: FloatArray) -> FloatArray:
        """Map a_1 .. C_N, I_min, I_max to natural coordinates: the inverse of `theta_from_natural`."""

    @property
    def starts(self) -> FloatArray:
        """One starting point: 0 in the coordinates z, the centre of the prior, (1, n_params)."""
        return np.zeros((1, self.n_params))

    @property
    def nuisance_names(self) -> tuple[str, ...]:
        """Empty: all its parameters belong to the sensor."""
        return ()

    @property
    def least_readings(self) -> int:
        """Fewest usable readings for a verdict."""
        return LEAST_READINGS

    def admits(self, effect: NamedEffect[Any]) -> bool:
        """Return True: every effect can act on a sensor."""
        return True

    def theta(self, z: FloatArray) -> FloatArray:
        """Map coordinates z, (n_samples, n_params), to a_1 .. C_N, I_min, I_max, (n_samples, 6 N + 2)."""
        return self.theta_from_natural(self._natural_from_z(z))

    def z(self, theta: FloatArray) -> FloatArray:
        """Map a_1 .. C_N, I_min, I_max to coordinates z: the inverse of `theta`."""
        return self._z_from_natural(self.natural_from_theta(theta))

    def _natural_from_z(self, z: FloatArray) -> FloatArray:
        return self.center + z @ self.factor.T

    def _z_from_natural(self, natural: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.solve(self.factor, (natural - self.center).T).T)

    def chain(self, plan: Plan, effects: Sequence[NamedEffect[Any]], *, n_nodes: int) -> Chain:
        """Build the chain (sensor, effects, scene) over the plan's patterns; `n_nodes` for curved edges."""
        return self.chain_over(cached_known_scene(plan), effects, n_nodes=n_nodes)

    def chain_over(self, scene: Scene, effects: Sequence[NamedEffect[Any]], *, n_nodes: int) -> Chain:
        """Build the chain (sensor, effects, scene) over any scene; `n_nodes` for curved edges."""
        return Chain(
            FreeMixture(self.n_gaussians),
            FreeLevels(),
            scene,
            tuple(effects),
            n_nodes=n_nodes,
            calibrated_height_mm=self.calibrated_height_mm,
        )


@dataclass(frozen=True, eq=False)
class GaussianMixtureSensor(CalibratedSensor):
    """A sensor whose SSF is a mixture: 6 n_gaussians + 1 coordinates, one less than the paper's parameters.

    Only ratios of amplitudes matter. The evidence counts the permutations of exchangeable Gaussians.
    """

    n_gaussians: int
    center: FloatArray
    factor: FloatArray
    has_exchangeable_gaussians: bool = True
    calibrated_height_mm: float | None = field(default=None, kw_only=True)

    @property
    def n_params(self) -> int:
        """Number of coordinates."""
        return 6 * self.n_gaussians + 1

    @property
    def effective_n_gaussians(self) -> int:
        """Number of Gaussians."""
        return self.n_gaussians

    @property
    def ssf_in_words(self) -> str:
        """Number of Gaussians of the SSF, in words."""
        return f"an SSF of {self.n_gaussians} Gaussians" if self.n_gaussians > 1 else "an SSF of one Gaussian"

    def theta_from_natural(self, natural: FloatArray) -> FloatArray:
        """Map natural coordinates, (n_samples, n_params), to a_1 .. C_N, I_min, I_max, (n_samples, n_params + 1)."""
        return natural_to_theta(natural, self.n_gaussians)

    def natural_from_theta(self, theta: FloatArray) -> FloatArray:
        """Map a_1 .. C_N, I_min, I_max to natural coordinates: the inverse of `theta_from_natural`."""
        return theta_to_natural(theta, self.n_gaussians)

    def permuted(self, z: FloatArray, order: Sequence[int]) -> FloatArray:
        """Return the coordinates, (n_samples, n_params), of the same SSF with its Gaussians in another order."""
        n, natural = self.n_gaussians, self._natural_from_z(z)
        logits = np.pad(natural[:, : n - 1], ((0, 0), (1, 0)))[:, list(order)]
        blocks = natural[:, n - 1 : -2].reshape(len(z), n, 5)[:, list(order)]
        parts = [logits[:, 1:] - logits[:, :1], blocks.reshape(len(z), 5 * n), natural[:, -2:]]
        return self._z_from_natural(np.concatenate(parts, axis=1))


@lru_cache(maxsize=32)
def cached_known_scene(plan: Plan) -> KnownScene:
    """Build the scene of a plan's patterns, cached for all models."""
    return KnownScene(plan.patterns)


def natural_to_theta(natural: FloatArray, n_gaussians: int) -> FloatArray:
    """Map natural coordinates (n_samples, 6 N + 1) to the paper's parameters (n_samples, 6 N + 2)."""
    n_logits = n_gaussians - 1
    logits = np.concatenate([np.zeros((len(natural), 1)), natural[:, :n_logits]], axis=1)
    shares = np.exp(logits - logits.max(axis=1, keepdims=True))
    shares /= shares.sum(axis=1, keepdims=True)
    blocks = natural[:, n_logits:-2].reshape(len(natural), n_gaussians, 5)
    u, v, log_sd_u, log_sd_v, turn = (blocks[..., k] for k in range(5))
    rho = np.tanh(turn)
    rest = 2 * (1 - rho**2)
    a_uu = np.exp(-2 * log_sd_u) / rest  # [[A, C], [C, B]] is half the inverse of the covariance
    b_vv = np.exp(-2 * log_sd_v) / rest
    c_uv = -rho * np.exp(-log_sd_u - log_sd_v) / rest
    amplitude = shares * np.sqrt(a_uu * b_vv - c_uv**2) / math.pi  # mass_n = a_n pi / sqrt(AB - C^2) = share
    columns = np.stack([amplitude, u, v, a_uu, b_vv, c_uv], axis=-1).reshape(len(natural), 6 * n_gaussians)
    return np.concatenate([columns, natural[:, -2:]], axis=1)


def theta_to_natural(theta: FloatArray, n_gaussians: int) -> FloatArray:
    """Invert `natural_to_theta`; the amplitudes may carry any common factor."""
    blocks = theta[:, : 6 * n_gaussians].reshape(len(theta), n_gaussians, 6)
    amplitude, u, v, a_uu, b_vv, c_uv = (blocks[..., k] for k in range(6))
    det = a_uu * b_vv - c_uv**2
    log_mass = np.log(amplitude) - 0.5 * np.log(det)
    rho = -c_uv / np.sqrt(a_uu * b_vv)
    rest = 2 * (1 - rho**2)
    parts = np.stack([u, v, -0.5 * np.log(a_uu * rest), -0.5 * np.log(b_vv * rest), np.arctanh(rho)], axis=-1)
    logits = log_mass[:, 1:] - log_mass[:, :1]
    return np.concatenate([logits, parts.reshape(len(theta), 5 * n_gaussians), theta[:, -2:]], axis=1)


def default_sensor(extent: Extent, n_gaussians: int) -> GaussianMixtureSensor:
    """Return `n_gaussians` with the default prior: sds a fourteenth of the longest scan, to a factor of two."""
    length = extent.length_mm
    one_center = [0.0, 0.0, math.log(length / 14), math.log(length / 14), 0.0]
    one_sd = [length / 10, length / 10, 0.8, 0.8, 0.7]
    center = np.array([0.0] * (n_gaussians - 1) + one_center * n_gaussians + [extent.low, extent.high])
    sd = np.array([1.5] * (n_gaussians - 1) + one_sd * n_gaussians + [extent.span / 2] * 2)
    return GaussianMixtureSensor(n_gaussians, center, np.diag(sd))


def effect_values(effect: NamedEffect[Any], z: FloatArray) -> FloatArray:
    """Map standard-normal coordinates to values of the effect's own parameters, (n_samples, n_params) both."""
    return effect.prior.from_unit_cube(ndtr(z))


def effect_coordinates(effect: NamedEffect[Any], values: FloatArray) -> FloatArray:
    """Invert `effect_values`, with coordinates clipped to 5.5 on either side of 0."""
    return np.clip(ndtri(effect.prior.to_unit_cube(values)), -FARTHEST + 0.5, FARTHEST - 0.5)
