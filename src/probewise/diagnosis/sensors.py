"""Calibrated sensors as nulls: mixtures of Gaussians and a free form of the SSF, their priors; over an unknown shape.

The sensor's natural coordinates are the logits of the Gaussians' shares, their means, the logs of their widths, the
inverse hyperbolic tangents of their correlations, and the two levels: all unbounded, with a normal prior. (They are not
the natural parameters of an exponential family.) In coordinates z every prior is a standard normal, so that fits and
evidences need no special case.

The misfit of a few Gaussians to a real SSF looks like physics, and the evidence favours another Gaussian only if it
gains ten nats or more. A free form (`probewise.sensor.ssf`) absorbs this misfit: small weights at many places,
each with a normal prior, so that the evidence penalises only those used.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Protocol, Self

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray, IntArray, read_only_floats
from probewise._kinds import require_like
from probewise.calibration import FittedSensor, mixture_moments
from probewise.diagnosis.fit import FARTHEST, Model, Null
from probewise.diagnosis.noise import SAME_SD, SdPrior
from probewise.effects import Effect, Extent
from probewise.effects.noise import noise_sd, quantisation
from probewise.errors import ParameterError, require
from probewise.recordings.plan import Plan, Recording
from probewise.scene import AnyOf, HypothesisScene, KnownScene, Region, Scene, Shape
from probewise.sensor import (
    FAST_NODES,
    N_BENDS,
    N_FREE_FORM,
    Chain,
    FreeLevels,
    FreeMixture,
    bend_coefficients,
    footprint_of,
    free_form_theta,
    is_free_form,
    mixture_parameter_names,
)

LEAST_READINGS = 24  # fewest usable readings for a verdict on a sensor


@dataclass(frozen=True, eq=False)
class CalibratedSensor:
    """A sensor over known patterns as a `Null`, with a normal prior of the natural coordinates of SSF and levels.

    Its SSF is a mixture, of 6 n_gaussians + 1 coordinates: one less than the paper's parameters, since only ratios of
    amplitudes matter. Or it has a free form (`is_free_form`): coordinates of one Gaussian and the two levels, then
    N_BENDS weights.

    `center` (n_params,) is the prior's mean, `factor` a square root of its covariance. `calibrated_height_mm` is the
    height of an earlier calibration; None: the height that a plan declares. `sd_prior` is that of its noise; None: not
    known.
    """

    n_gaussians: int
    center: FloatArray
    factor: FloatArray
    has_exchangeable_gaussians: bool = True
    is_free_form: bool = False
    calibrated_height_mm: float | None = None
    sd_prior: SdPrior | None = None
    predicts_in_bulk = predicts_dearly = may_be_far_off = False
    part_that_predicts = Null.part_that_predicts

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", read_only_floats(self.center))
        object.__setattr__(self, "factor", read_only_floats(self.factor))

    @property
    def n_params(self) -> int:
        return len(self.center)

    @property
    def effective_n_gaussians(self) -> int:
        return 2 if self.is_free_form else self.n_gaussians  # the free form counts as one Gaussian more than one

    @property
    def ssf_in_words(self) -> str:
        if self.is_free_form:
            return "an SSF of free form"
        return f"an SSF of {self.n_gaussians} Gaussians" if self.n_gaussians > 1 else "an SSF of one Gaussian"

    @property
    def nuisance_names(self) -> tuple[str, ...]:
        return ()

    @property
    def least_readings(self) -> int:
        return LEAST_READINGS

    @property
    def starts(self) -> FloatArray:
        return np.zeros((1, self.n_params))

    def admits(self, effect: Effect) -> bool:
        return self.sd_prior is not None or effect.name != noise_sd.name

    def theta(self, z: FloatArray) -> FloatArray:
        """Map coordinates z, (n_samples, n_params), to a_1 .. C_N, I_min, I_max, (n_samples, 6 N + 2)."""
        natural = self._natural_from_z(z)
        return free_form_to_theta(natural) if self.is_free_form else natural_to_theta(natural, self.n_gaussians)

    def z(self, theta: FloatArray) -> FloatArray:
        """Invert `theta`."""
        natural = theta_to_free_form(theta) if self.is_free_form else theta_to_natural(theta, self.n_gaussians)
        return self._z_from_natural(natural)

    def _natural_from_z(self, z: FloatArray) -> FloatArray:
        return self.center + z @ self.factor.T

    def _z_from_natural(self, natural: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.solve(self.factor, (natural - self.center).T).T)

    def chain(self, plan: Plan, effects: Sequence[Effect], *, n_nodes: int) -> Chain:
        return self.chain_over(cached_known_scene(plan), effects, n_nodes=n_nodes)

    def chain_over(self, scene: Scene, effects: Sequence[Effect], *, n_nodes: int) -> Chain:
        """Build the chain (sensor, effects, scene) over any scene; `n_nodes` for curved edges."""
        ssf, effects, height_mm = FreeMixture(self.n_gaussians), tuple(effects), self.calibrated_height_mm
        return Chain(ssf, FreeLevels(), scene, effects, n_nodes=n_nodes, calibrated_height_mm=height_mm)

    def permuted(self, z: FloatArray, order: Sequence[int]) -> FloatArray:
        """Return the coordinates, (n_samples, n_params), of the same mixture with its Gaussians in another order."""
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
    logits = np.pad(natural[:, :n_logits], ((0, 0), (1, 0)))
    shares = np.exp(logits - logits.max(axis=1, keepdims=True))
    shares /= shares.sum(axis=1, keepdims=True)
    blocks = natural[:, n_logits:-2].reshape(len(natural), n_gaussians, 5)
    u, v, log_sd_u, log_sd_v, turn = np.moveaxis(blocks, -1, 0)
    rho = np.tanh(turn)
    rest = 2 * (1 - rho**2)
    # [[A, C], [C, B]] is half the inverse of the covariance.
    a_uu, b_vv = np.exp(-2 * log_sd_u) / rest, np.exp(-2 * log_sd_v) / rest
    c_uv = -rho * np.exp(-log_sd_u - log_sd_v) / rest
    amplitude = shares * np.sqrt(a_uu * b_vv - c_uv**2) / math.pi  # mass_n = a_n pi / sqrt(AB - C^2) = share
    columns = np.stack([amplitude, u, v, a_uu, b_vv, c_uv], axis=-1).reshape(len(natural), 6 * n_gaussians)
    return np.concatenate([columns, natural[:, -2:]], axis=1)


def theta_to_natural(theta: FloatArray, n_gaussians: int) -> FloatArray:
    """Invert `natural_to_theta`; the amplitudes may carry any common factor."""
    blocks = theta[:, : 6 * n_gaussians].reshape(len(theta), n_gaussians, 6)
    amplitude, u, v, a_uu, b_vv, c_uv = np.moveaxis(blocks, -1, 0)
    log_mass = np.log(amplitude) - 0.5 * np.log(a_uu * b_vv - c_uv**2)
    rho = -c_uv / np.sqrt(a_uu * b_vv)
    rest = 2 * (1 - rho**2)
    parts = np.stack([u, v, -0.5 * np.log(a_uu * rest), -0.5 * np.log(b_vv * rest), np.arctanh(rho)], axis=-1)
    logits = log_mass[:, 1:] - log_mass[:, :1]
    return np.concatenate([logits, parts.reshape(len(theta), 5 * n_gaussians), theta[:, -2:]], axis=1)


def free_form_to_theta(natural: FloatArray) -> FloatArray:
    """Map a free form's natural coordinates, (n_samples, 7 + N_BENDS), to theta, (n_samples, 6 N_FREE_FORM + 2)."""
    one = natural_to_theta(natural[:, :-N_BENDS], 1)
    return np.concatenate([free_form_theta(one[:, :6], natural[:, -N_BENDS:]), one[:, 6:]], axis=1)


def theta_to_free_form(theta: FloatArray) -> FloatArray:
    """Invert `free_form_to_theta`."""
    # The amplitude of the first does not enter its natural coordinates.
    one = np.concatenate([np.ones((len(theta), 1)), theta[:, 1:6], theta[:, -2:]], axis=1)
    return np.concatenate([theta_to_natural(one, 1), bend_coefficients(theta[:, :-2])], axis=1)


def default_sensor(extent: Extent, n_gaussians: int) -> CalibratedSensor:
    """Return `n_gaussians` with the default prior: sds a fourteenth of the longest scan, to a factor of two."""
    length, n_logits = extent.length_mm, n_gaussians - 1
    one_center = [0.0, 0.0, math.log(length / 14), math.log(length / 14), 0.0]
    one_sd = [length / 10, length / 10, 0.8, 0.8, 0.7]
    center = np.array([0.0] * n_logits + one_center * n_gaussians + [extent.low, extent.high])
    sd = np.array([1.5] * n_logits + one_sd * n_gaussians + [extent.span / 2] * 2)
    return CalibratedSensor(n_gaussians, center, np.diag(sd))


def with_free_form(one: CalibratedSensor) -> CalibratedSensor:
    """Return a sensor of free form: the place and size of one Gaussian, and weights of sd 0.1 of the mass about 0."""
    factor = np.diag(np.concatenate([np.zeros(one.n_params), np.full(N_BENDS, 0.1)]))
    factor[: one.n_params, : one.n_params] = one.factor
    center = np.concatenate([one.center, np.zeros(N_BENDS)])
    return CalibratedSensor(N_FREE_FORM, center, factor, has_exchangeable_gaussians=False, is_free_form=True)


_RIDGE = 1e-8  # of each variance, by which a covariance of samples is sure to be positive


class SensorPrior(Protocol):
    """An earlier posterior of the sensor: a FittedSensor, or anything with its names and samples."""

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names, one per column."""

    @property
    def samples(self) -> FloatArray:
        """Posterior samples, (n_samples, n_params)."""


def require_sensor_prior(sensor: object) -> None:
    """Raise ParameterError unless `sensor` has names and samples."""
    allowed = "a FittedSensor: read_sensor('sensor.json') of probewise.calibration, or the .sensor of a Calibration"
    if hasattr(getattr(sensor, "sensor", None), "samples"):
        allowed = f"a FittedSensor: take its .sensor, this is the {type(sensor).__name__}"
    require_like("sensor", sensor, ("names", "samples"), allowed)


def require_same_unit(sensor: SensorPrior, plan: Plan) -> None:
    """Raise ParameterError if the readings' unit differs from that of the calibration; "" is an unknown unit."""
    unit = plan.instrumentation.unit
    own = sensor.instrumentation.unit if isinstance(sensor, FittedSensor) else ""
    if own and unit and own != unit:
        raise ParameterError("sensor", f"one that reads in {own!r}", f"one in {unit!r}, as the recording")


def sensor_from_samples(sensor: SensorPrior) -> CalibratedSensor:
    """Build a prior from an earlier sensor's posterior samples.

    Only the SSF's and the levels' columns are used; effects of the earlier model are dropped. If the samples average
    several hypotheses, only the most probable is used: a normal prior holds one hypothesis.

    Raises ParameterError if the names are not those of a mixture of Gaussians with two free levels.
    """
    height_mm, sd_prior = None, None
    if isinstance(sensor, FittedSensor):
        sensor, height_mm = sensor.with_leading_effects(), sensor.instrumentation.height_mm
        step = f"{quantisation.name}.step"  # of a rounding that the sd does not include
        of_rounding = sensor.samples[:, sensor.names.index(step)] / math.sqrt(12) if step in sensor.names else 0.0
        log_sd = np.log(np.hypot(sensor.noise_sd, of_rounding))
        sd_prior = SdPrior(float(log_sd.mean()), math.hypot(float(log_sd.std()), SAME_SD))
    names, samples = list(sensor.names), np.asarray(sensor.samples, dtype=np.float64)
    n_gaussians = sum(name.startswith("a_") for name in names)
    wanted = [*mixture_parameter_names(max(n_gaussians, 1)), "I_min", "I_max"]
    if any(name not in names for name in wanted):
        raise ParameterError("sensor.names", tuple(names), "a_1, u_1, v_1, A_1, B_1, C_1, ..., I_min, I_max")
    at = [names.index(name) for name in wanted]
    mean, cov = samples.mean(axis=0)[at], np.cov(samples.T)[np.ix_(at, at)]
    free = is_free_form(mean[None, :-2])
    natural_from_theta = theta_to_free_form if free else partial(theta_to_natural, n_gaussians=n_gaussians)
    center = natural_from_theta(mean[None, :])[0]
    steps = np.maximum(1e-3 * np.sqrt(np.maximum(np.diag(cov), 0.0)), 1e-7 * np.abs(mean) + 1e-12)
    up, down = natural_from_theta(mean + np.diag(steps)), natural_from_theta(mean - np.diag(steps))
    slope = ((up - down) / (2 * steps[:, None])).T
    natural_cov = slope @ cov @ slope.T
    # Coordinates that are the same in all samples have a variance too, in the readings' unit where they are levels.
    size, levels = np.ones(len(center)), slice(5, 7) if free else slice(-2, None)
    size[levels] = np.abs(center[levels]).max() or 1.0
    floor = _RIDGE * np.maximum(np.diag(natural_cov), 1e-16 * size**2)  # a variance relative to the size
    factor = np.linalg.cholesky(natural_cov + np.diag(floor))
    return CalibratedSensor(n_gaussians, center, factor, False, free, height_mm, sd_prior)


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorAndShape(CalibratedSensor):
    """A null model: a calibrated sensor over an unknown shape of known prior, which is every pattern not described.

    `found` (n_starts, n_params of the shape) are coordinates of shapes from which it is fitted; `of` finds them.
    """

    shape: Shape
    found: FloatArray
    may_be_far_off = True  # without a missing effect the shape may be found at another place

    @classmethod
    def over(cls, sensor: CalibratedSensor, shape: Shape, found: FloatArray) -> Self:
        """Build from a calibrated sensor, a shape and the coordinates at which to start."""
        return cls(**vars(sensor), shape=shape, found=read_only_floats(found))

    @classmethod
    def of(cls, sensor: SensorPrior, shape: Shape, recording: Recording, *, rng: np.random.Generator) -> Self:
        """Build from a calibrated sensor's posterior and a shape's prior, and search for shapes that fit the readings.

        Of a set of shapes (`AnyOf`), only the best-fitting one is kept. Raises ParameterError if no reading is usable.
        """
        require(recording.usable.any(), "usable readings", 0, "at least one; the recording holds none")
        known = sensor_from_samples(sensor)
        members = tuple(shape.shapes.values()) if isinstance(shape, AnyOf) else (shape,)
        found = [_search_shapes(cls.over(known, member, np.empty((0, 0))), recording, rng) for member in members]
        best = min(range(len(members)), key=lambda k: found[k][0])
        return cls.over(known, members[best], found[best][1])

    @property
    def n_params(self) -> int:
        return super().n_params + len(self.shape.prior.names)

    @property
    def starts(self) -> FloatArray:
        return np.pad(self.found, ((0, 0), (super().n_params, 0)))

    @property
    def nuisance_names(self) -> tuple[str, ...]:
        return self.shape.prior.names

    @property
    def least_readings(self) -> int:
        return 3 * len(self.shape.prior.names) + 3

    def theta(self, z: FloatArray) -> FloatArray:
        """Map coordinates, (n_samples, n_params), to parameters: the sensor's columns, then the shape's."""
        k = super().n_params
        return np.concatenate([super().theta(z[:, :k]), self.shape.prior.from_unit_cube(ndtr(z[:, k:]))], axis=1)

    def chain(self, plan: Plan, effects: Sequence[Effect], *, n_nodes: int) -> Chain:
        return self.chain_over(_ShapeAmongPatterns(self.shape, plan), effects, n_nodes=n_nodes)


@dataclass(frozen=True, eq=False)
class _ShapeAmongPatterns(HypothesisScene):
    """A scene of a plan's described patterns, and of one unknown shape under every other name."""

    plan: Plan

    def regions(self, theta: FloatArray) -> Mapping[str, Region]:
        """Return the region of each pattern by name, for theta (n_samples, n_params of the shape)."""
        known = cached_known_scene(self.plan).regions(theta)
        unknown = self.shape.region(theta)
        return {name: known.get(name, unknown) for name in self.plan.pattern_names}


_N_DRAWS, _N_ELITE, _N_ROUNDS = 2000, 40, 8


def _search_shapes(null: SensorAndShape, recording: Recording, rng: np.random.Generator) -> tuple[float, FloatArray]:
    """Search for shapes that fit the readings, with the sensor at its prior mean.

    Shapes are drawn from the prior, then repeatedly about the best ones. Returns the least sum of squares, and the
    coordinates of the best shapes.
    """
    usable, chain = recording.usable, null.chain(recording.plan, (), n_nodes=FAST_NODES)
    n_shape = len(null.nuisance_names)

    def sums_of_squares(own: FloatArray) -> FloatArray:
        z = np.pad(own, ((0, 0), (null.n_params - n_shape, 0)))
        predicted = chain.predict(null.theta(z), recording.plan)[:, usable]
        return np.asarray(np.sum((recording.readings[usable] - predicted) ** 2, axis=1))

    own = rng.standard_normal((_N_DRAWS, n_shape))
    values = sums_of_squares(own)
    for shrink in 0.5 ** np.arange(_N_ROUNDS):
        elite = np.argsort(values)[:_N_ELITE]
        near = own[elite[rng.integers(_N_ELITE, size=_N_DRAWS)]]
        near = np.clip(near + 0.5 * shrink * rng.standard_normal(near.shape), -FARTHEST, FARTHEST)
        own, values = np.concatenate([own[elite], near]), np.concatenate([values[elite], sums_of_squares(near)])
    best = np.argsort(values)[:4]
    return float(values[best[0]]), own[best]


def starts_of_one_gaussian(sensor: CalibratedSensor) -> FloatArray:
    """Return coordinates to start from for one Gaussian: typical, narrow and wide, (3, n_params)."""
    out = np.zeros((3, sensor.n_params))
    out[:, 2:4] = [[0.0], [-1.5], [1.5]]
    return out


def starts_with_more_gaussians(found: Null, z: FloatArray, wanted: CalibratedSensor) -> FloatArray:
    """Split the heaviest Gaussian of a fit in three ways, as starts: coordinates of `wanted`, (3, wanted.n_params)."""
    theta, n = found.theta(z[None, : found.n_params])[0], found.n_gaussians
    blocks = theta[: 6 * n].reshape(n, 6)
    at = int(np.argmax(footprint_of(theta[None, : 6 * n], n).weight))
    sd_u, sd_v = 1 / np.sqrt(2 * blocks[at, 3:5])
    # A core and a halo; or side by side, along x' or y'.
    splits = ((0.0, 0.0, (0.65, 1.6)), (0.8, 0.0, (0.9, 0.9)), (0.0, 0.8, (0.9, 0.9)))
    out = []
    for du, dv, widths in splits:
        pair = []
        for sign, widen in zip((1.0, -1.0), widths, strict=True):
            part = blocks[at].copy()
            part[1:3] += sign * du * sd_u, sign * dv * sd_v
            part[3:6] /= widen**2
            part[0] /= 2 * widen**2  # halves the mass
            pair.append(part)
        out.append(np.concatenate([*np.delete(blocks, at, axis=0), *pair, theta[-2:]]))
    return np.clip(wanted.z(np.stack(out)), -FARTHEST + 0.5, FARTHEST - 0.5)


# In sds of the SSF, in its own metric.
_REACH = 2.4
_APART = 0.6
_WIDTH = 0.35
_FINE_SHARE = 0.03  # prior sd of each weight, as a share of the mass
_CELLS = np.stack(np.meshgrid(np.arange(-8, 9), np.arange(-8, 9)), axis=-1).reshape(-1, 2)  # of a hexagonal grid
_PLACES = _APART * np.stack([_CELLS[:, 0] + _CELLS[:, 1] / 2, _CELLS[:, 1] * np.sqrt(3) / 2], axis=-1)
_PLACES = _PLACES[np.hypot(*_PLACES.T) <= _REACH]


def fine_structure_slopes(model: Model, z: FloatArray, usable: IntArray) -> FloatArray:
    """Return the slopes of the readings by fine structure about an SSF, in coordinates with a standard normal prior.

    Structure that is finer than any form fitted to an SSF (a ring, a ridge's shadow, a sharp rim) leaves residuals of
    one to three noise sds in all, which are not physics. Narrow Gaussians of small weight, spread over the footprint,
    absorb them to first order. They are part of no fit: the global test asks whether its alarm persists beside them.

    `z`: its coordinates, (n_params,). Returns slopes, (n_usable, n_places), in reading units.
    """
    sensor = model.sensor
    assert isinstance(sensor, CalibratedSensor)
    theta = sensor.theta(z[None, :])
    of_all = {name: float(values[0]) for name, values in mixture_moments(theta, sensor.n_gaussians).items()}
    sd_u, sd_v = (np.exp(of_all[f"log width along {axis}"]) for axis in ("x'", "y'"))
    cov = of_all["correlation of x' and y'"] * sd_u * sd_v
    covariance = np.array([[sd_u**2, cov], [cov, sd_v**2]])
    center = np.array([of_all["centre x'"], of_all["centre y'"]])
    places = center + _PLACES @ np.linalg.cholesky(covariance).T
    (aa, cc), (_, bb) = np.linalg.inv(_WIDTH**2 * covariance) / 2
    levels = theta[0, 6 * sensor.n_gaussians :]
    narrow = np.array([[1.0, u, v, aa, bb, cc, *levels] for u, v in places])
    chain = replace(sensor.chain(model.plan, (), n_nodes=FAST_NODES), ssf=FreeMixture(1))
    whole = model.predict(z[None, :])[0]  # normalised, so that the total weight is unchanged
    return np.asarray(_FINE_SHARE * (chain.predict(narrow, model.plan) - whole)[:, usable].T)
