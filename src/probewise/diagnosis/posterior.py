"""A hypothesis as an inference problem, and draws from its posterior.

The likelihood of exchangeable Gaussians has every mode N! times. Folded onto the order nearest to a point, with the
prior density of all orders summed, the posterior has each mode once, and sampling need not hop between modes.

Draws are by importance resampling from the closest proposal at hand, or by one of two ways where none is close enough.
Where many predictions cost little, adaptive importance sampling: the ridge of a posterior that is narrow and bent is
followed from the mode to where it is unlikely; kernels along it, each of the local shape, are a proposal that covers
all of it (after Cornuet, Marin, Mira & Robert 2012, with local covariances).

Else annealing: the densities between are q^(1 - beta) p^beta (Neal 2001). After each step of beta the samples are
resampled by their weights and moved: each half by differences of the other half (ter Braak 2006), which leaves the
density invariant. A quadratic surrogate of the model's predictions is cheap enough to move thousands of samples. It is
fitted at steps of the size of the approximate posterior, so that it interpolates instead of extrapolating.

Amplitudes of effects on the mean are special. The coordinate of one with a heavy-tailed prior is a steep function of
its value about 0: a normal distribution of the coordinate becomes one of values that is far too wide. Values with one
scale in common lie on arcs in their coordinates. Both priors are mixtures of normal distributions: given their
components, the values are jointly normal; given the values, the components are independent. They are drawn in turn
(Gibbs sampling). A size and a shape, such as a time constant, may have a branch of either sign. A simulator that is
called for each sample is replaced by its tangent there, about which the effect itself stays exact.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TypeAlias, cast

import numpy as np
from scipy.special import logsumexp, ndtr, ndtri

from probewise._arrays import LAST_DIGITS, BoolArray, FloatArray, IntArray
from probewise.diagnosis.evidence import NUMBERS, NoiseEvidence, log_evidence_of
from probewise.diagnosis.fit import FARTHEST, Fit, Model, fit, fit_each_start, with_prior
from probewise.diagnosis.noise import LEAST_SCALE, RUNS_AWAY, NoiseLaw, SdPrior
from probewise.diagnosis.sensors import CalibratedSensor
from probewise.effects import HeavyTailedPrior
from probewise.errors import NotConvergedError
from probewise.nested import Weighted
from probewise.nested.importance import weighted_draws
from probewise.nested.weights import (
    largest_power,
    n_effective,
    resampled_rows,
    student_t_draws,
    student_t_log_norm,
    tempering_power,
)
from probewise.priors import Prior, Product, SharedScalePrior
from probewise.progress import Progress, silent
from probewise.recordings.plan import Recording
from probewise.sensor import Stage
from probewise.sensor.stages import effects_with_columns
from probewise.systems import System

_STRAIGHT = 0.2  # sd of a coordinate within which its value is as good as linear in it
_SWEEPS = 10
_STEP = 1e-6  # of a coordinate, for central differences of priors


@dataclass(frozen=True, eq=False)
class _AmplitudeGroup:
    """Amplitudes with one component of the mixture in common: one alone, or values with one scale."""

    at: list[int]  # their coordinates
    prior: Prior
    typical: float  # the unit of their values here
    sds: FloatArray  # of the components, in typical sizes, (n_components,)

    def values(self, z: FloatArray) -> FloatArray:
        """Return the values, in typical sizes, from coordinates, (n_samples, n) both."""
        return self.prior.from_unit_cube(ndtr(z)) / self.typical

    def coordinates(self, values: FloatArray) -> FloatArray:
        """Return the coordinates of values in typical sizes, (n_samples, n) both."""
        unit = self.prior.to_unit_cube(values * self.typical)
        return np.asarray(np.clip(ndtri(unit), -FARTHEST, FARTHEST))


def _two_sided_amplitude_groups(found: Fit) -> Iterator[_AmplitudeGroup]:
    """List the amplitudes of a fit's effects that may have either sign, values with one scale together."""
    for effect, columns in effects_with_columns(found.model.effects, found.model.sensor.n_params):
        own = effect.prior
        if isinstance(own, SharedScalePrior):
            every = [*range(columns.start, columns.stop)]
            yield _AmplitudeGroup(every, own, own.typical, own.component_sds / own.typical)
        marginals = list(getattr(own, "marginals", {}).values())
        for k in (k for k in effect.amplitudes if k < len(marginals)):
            one = marginals[k]
            if isinstance(one, HeavyTailedPrior) and not one.positive:
                alone = Product({own.names[k]: one})
                yield _AmplitudeGroup([columns.start + k], alone, one.typical, one.component_sds / one.typical)


def draws_of_linear_amplitudes(
    found: Fit, slopes: FloatArray, residual: FloatArray, n_samples: int, *, rng: np.random.Generator
) -> FloatArray | None:
    """Draw coordinates, (n_samples, n_params), from the linearised posterior of a fit, each the end of its own chain.

    None if no amplitude is wide in its coordinate. `slopes`, `residual`: whitened slopes (n_points, n_params) and
    residuals (n_points,), in noise sds. The unknowns x are the values of these amplitudes, in typical sizes, and the
    coordinates of all else.
    """
    z_sd = np.sqrt(np.diag(np.linalg.inv(with_prior(slopes.T @ slopes))))
    groups = [group for group in _two_sided_amplitude_groups(found) if np.any(z_sd[group.at] > _STRAIGHT)]
    if not groups:
        return None
    x, by_x = found.z.copy(), slopes.copy()
    for group in groups:
        at, steps = group.at, _STEP * np.eye(len(group.at))
        x[at] = group.values(found.z[None, at])[0]
        values_by_z = (group.values(found.z[at] + steps) - group.values(found.z[at] - steps)).T / (2 * _STEP)
        by_x[:, at] = np.linalg.solve(values_by_z.T, slopes[:, at].T).T
    curvature, downhill = by_x.T @ by_x, by_x.T @ (residual + by_x @ x)  # the latter at x = 0
    drawn, precision, own = np.tile(x, (n_samples, 1)), np.ones((n_samples, len(x))), np.arange(len(x))
    for _ in range(_SWEEPS):
        for group in groups:
            squares = np.sum(drawn[:, group.at] ** 2, axis=1)
            log_weight = -0.5 * squares[:, None] / group.sds**2 - len(group.at) * np.log(group.sds)
            component = np.argmax(log_weight + rng.gumbel(size=log_weight.shape), axis=1)
            precision[:, group.at] = group.sds[component, None] ** -2
        every = np.repeat(curvature[None], n_samples, axis=0)
        every[:, own, own] += precision + LAST_DIGITS * np.diag(curvature)
        # Of the mean plus a draw of covariance 1 / every: one solution with a right side of covariance `every`.
        noise = np.einsum("nij,nj->ni", np.linalg.cholesky(every), rng.standard_normal(drawn.shape))
        drawn = np.linalg.solve(every, (downhill + noise)[:, :, None])[:, :, 0]
    for group in groups:
        drawn[:, group.at] = group.coordinates(drawn[:, group.at])
    return drawn


def sizes_with_shape(found: Fit) -> list[int]:
    """List the coordinates of sizes of either sign, one of an effect on the readings, beside which it has a shape."""
    sizes, out = {group.at[0] for group in _two_sided_amplitude_groups(found) if len(group.at) == 1}, list[int]()
    for effect, columns in effects_with_columns(found.model.effects, found.model.sensor.n_params):
        own = {columns.start + k for k in effect.amplitudes}
        is_shaped = len(effect.prior.names) > 1 and not effect.has_change_point
        if is_shaped and effect.stage >= Stage.SEEN and len(own) == 1 and own <= sizes:
            out.extend(own)
    return out


_CREDIBLE = 10.0  # nats below the best mode, up to which another one counts


def modes_of_opposite_sign(model: Model | TangentModel, found: Fit, recording: Recording, law: NoiseLaw) -> list[Fit]:
    """Return fits where the size of an effect on the readings has the other sign than in a fit, if about as probable.

    A settling about as slow as what it is added to is an example: its size and time constant lie on a hyperbola, of
    which no walk from one branch finds the other.
    """
    sizes, own = sizes_with_shape(found), np.arange(len(found.z))
    starts = [np.where(own == at, -found.z, found.z) for at in sizes]
    fits = fit_each_start(cast(Model, model), recording, starts, law)
    return [
        other
        for at, other in zip(sizes, fits, strict=True)
        if other.objective < found.objective + _CREDIBLE and other.z[at] * found.z[at] < 0
    ]


class TangentModel:
    """A model of a simulator, with its tangent at a fit in place of what it simulates before effects on the readings.

    The tangent is taken in parameters of the null (the model without effects) and in coordinates of effects: many
    simulations are linear in a parameter, such as a starting level, but not in the coordinate of its uniform prior.
    """

    predicts_in_bulk, predicts_dearly = True, False

    def __init__(self, found: Fit, system: System) -> None:
        self.model, self.system, self.z, self.n_params = found.model, system, found.z, found.model.n_params
        upstream = np.ones(self.n_params, dtype=np.bool_)
        for effect in (effect for effect in self.model.effects if effect.stage >= Stage.SEEN):
            upstream[self.model.coordinate_slice(effect.name)] = False
        points, steps = found.model.difference_points_and_steps(found.z)
        views = self.model.chain.simulated_view(self.model.theta(points[np.append(True, upstream)]), self.model.plan)
        self.view, self.is_finite = views[0], bool(np.isfinite(views).all())
        self.slopes = np.zeros((self.n_params, views.shape[1]))  # 0 for coordinates of effects on the readings
        with np.errstate(invalid="ignore"):
            self.slopes[upstream] = (views[1:] - views[0]) / steps[upstream, None]
        own = found.z[None, : system.n_params]
        self.theta = system.theta(own)
        self.derivatives = (system.theta(own + _STEP) - system.theta(own - _STEP)) / (2 * _STEP)

    @property
    def sensor(self) -> TangentModel:
        """What tells that many predictions cost little: the model itself."""
        return self

    def difference_points_and_steps(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the points and steps of the model itself."""
        return self.model.difference_points_and_steps(z)

    def predict_rows(self, rows: IntArray, z: FloatArray) -> FloatArray:
        """Return approximate readings of some rows, (n_samples, n_params) -> (n_samples, n_rows)."""
        moved, n_own = z - self.z, self.system.n_params
        moved[:, :n_own] = (self.system.theta(z[:, :n_own]) - self.theta) / self.derivatives
        view = self.view + moved @ self.slopes
        return self.model.chain.readings_from_simulated_view(view, self.model.theta(z), self.model.plan)[:, rows]


_HELD = 0.999  # share of the evidence in the noise nodes that are kept; the likelihood is rescaled for the rest


@dataclass(frozen=True, eq=False)
class StandardNormal:
    """The prior of a model's coordinates: independent standard normals, in which chains step directly."""

    n_params: int

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"z_{k + 1}" for k in range(self.n_params))

    @property
    def coordinates(self) -> StandardNormal:
        return self

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        return np.asarray(ndtri(u))

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        return np.asarray(ndtr(theta))

    def log_prob(self, theta: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * np.sum(theta**2 + math.log(2 * math.pi), axis=1))

    def enter(self, theta: FloatArray) -> FloatArray:
        return theta

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return x, self.log_prob(x)


@dataclass(frozen=True, eq=False)
class HypothesisProblem:
    """A model in its coordinates with a recording; noise sd and parameters of the noise model are marginalised.

    Predictions of many samples are made in blocks, to fit in memory. They do not depend on the order of exchangeable
    Gaussians, nor does the evidence.
    """

    model: Model
    recording: Recording
    noise: NoiseEvidence  # of a fit by node of the noise model (its parameters): the probable are averaged over
    near: FloatArray | None = None  # (n_params,), onto the nearest order of whose Gaussians the prior is folded

    @cached_property
    def prior(self) -> StandardNormal:
        """The prior of the model's coordinates, folded only if its sensor has exchangeable Gaussians."""
        sensor, n_params = self.model.sensor, self.model.n_params
        if self.near is None or not sensor.has_exchangeable_gaussians or sensor.n_gaussians < 2:
            return StandardNormal(n_params)
        return FoldedNormal(n_params, cast(CalibratedSensor, sensor), self.near)

    def predict(self, z: FloatArray) -> FloatArray:
        """Return the readings of all rows, (n_samples, n_params) -> (n_samples, n_points)."""
        return self._in_blocks(self.model.predict, z)

    def predict_usable(self, z: FloatArray) -> FloatArray:
        """Return the predictions of the usable readings, (n_samples, n_params) -> (n_samples, n_usable)."""
        return self._in_blocks(partial(self.model.predict_rows, np.flatnonzero(self.recording.usable)), z)

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Return the log likelihood, averaged over the kept noise nodes: (n_samples, n_params) -> (n_samples,)."""
        return self._in_blocks(self._log_likelihood_of_block, theta)

    def _in_blocks(self, function: Callable[[FloatArray], FloatArray], z: FloatArray) -> FloatArray:
        blocks = np.array_split(z, max(-(-len(z) * len(self.recording) // NUMBERS), 1))
        return np.concatenate([function(block) for block in blocks])

    def _log_likelihood_of_block(self, theta: FloatArray) -> FloatArray:
        usable = np.flatnonzero(self.recording.usable)
        predicted = self.model.predict_rows(usable, np.clip(theta, -FARTHEST, FARTHEST))
        nodes, kept = self.noise.nodes, self._kept_node_indices
        laws, log_share = [nodes.laws[node] for node in kept], -math.log(float(self.noise.weights[kept].sum()))
        with np.errstate(all="ignore"):  # of predictions that ran away: impossible below
            residuals = (self.recording.readings[usable] - predicted).T
            terms = [
                log_weight + log_likelihood_marginal_over_sigma(law, law(residuals), self.noise.noise.sd_prior)
                for log_weight, law in zip(nodes.log_weights[kept], laws, strict=True)
            ]
            out = np.asarray(logsumexp(terms, axis=0)) + log_share
        return np.where(np.isfinite(out), out, -np.inf)

    @cached_property
    def _kept_node_indices(self) -> list[int]:
        order = np.argsort(-self.noise.weights)
        n_kept = int(np.searchsorted(np.cumsum(self.noise.weights[order]), _HELD)) + 1
        kept: list[int] = order[:n_kept].tolist()
        return kept


def log_likelihood_marginal_over_sigma(
    law: NoiseLaw, whitened: FloatArray, sd_prior: SdPrior | None = None
) -> FloatArray:
    """Return the log likelihood of whitened residuals (n_points, n_samples) under one noise distribution: (n_samples,).

    Log sigma, with a flat prior unless that of the sd is given, is integrated out by Laplace's method about its peak.
    """
    n_points = law.n_kept
    sigma = law.likeliest_sigma(whitened)
    curvature = (
        law.whitened_density.log_sigma_curvature(whitened, sigma, n_points)
        if not law.whitened_density.is_normal
        else 2.0 * n_points
    )
    peak = -law.minus_log_likelihood(whitened, sigma) - 0.5 * n_points * math.log(2 * math.pi)
    out = peak + 0.5 * np.log(2 * math.pi / curvature) - law.half_log_det() + law.log_extra
    if sd_prior is not None:
        variance = np.broadcast_to(0.0 if law.flat else 1 / curvature, sigma.shape)
        out += sd_prior.log_density(np.stack([np.log(sigma * law.sd_factor_of_rounding), variance]))
    return np.asarray(out)


@dataclass(frozen=True, eq=False)
class FoldedNormal(StandardNormal):
    """A standard normal prior, folded onto the order of a sensor's Gaussians that is nearest to a point.

    The density of a point is the sum of the normal's densities over all orders (permutations of the Gaussians).
    """

    sensor: CalibratedSensor  # with exchangeable Gaussians; its coordinates come first
    near: FloatArray  # the point, (n_params,)

    @cached_property
    def _reordering_maps(self) -> tuple[FloatArray, FloatArray]:
        n_own = self.sensor.n_params
        orders = list(itertools.permutations(range(self.sensor.n_gaussians)))[1:]
        shift = np.stack([self.sensor.permuted(np.zeros((1, n_own)), order) for order in orders])
        return np.stack([self.sensor.permuted(np.eye(n_own), order) for order in orders]) - shift, shift

    def _reordered_with_distances(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z in every order, (n_orders, n_samples, n_params), and distances from the point; as given is first."""
        turn, shift = self._reordering_maps
        images = np.repeat(z[None], len(turn) + 1, axis=0)
        n_own = self.sensor.n_params
        images[1:, :, :n_own] = z[:, :n_own] @ turn + shift
        return images, np.linalg.norm(images - self.near, axis=2)

    def fold(self, z: FloatArray) -> FloatArray:
        """Reorder each sample's Gaussians to be nearest to the point, (n_samples, n_params) both ways."""
        images, far = self._reordered_with_distances(z)
        return np.asarray(images[np.argmin(far, axis=0), np.arange(len(z))])

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        return self.fold(super().from_unit_cube(u))

    def log_prob(self, theta: FloatArray) -> FloatArray:
        images, far = self._reordered_with_distances(theta)
        density = logsumexp([super(FoldedNormal, self).log_prob(image) for image in images], axis=0)
        return np.where(far[0] <= far[1:].min(axis=0), density, -np.inf)


# If many predictions cost little, and else: draws of a round, kernels, rounds, effective draws that suffice.
_SIZES = {True: (2000, 150, 20, 1000.0), False: (400, 20, 4, 250.0)}
_PER_PRIOR = 20  # draws of a proposal for one of the prior
_AS_IT_IS = 0.3  # effective share of the first draws from which no ridge is followed
_UNSURE_K = 0.7  # Pareto k from which the mean of the weights converges too slowly (Vehtari et al. 2024)
_UNIFORM = 0.5  # effective share from which the weights have no tail, whatever k
_SETTLED = 0.03, 0.05  # changes of the log evidence and, in their share, of the sds between two rounds
_MOST_TAILED, _LEAST_TAILED = 2.0, 8.0  # degrees of freedom of the kernels, between them those of the readings
_TEMPERED = 25  # effective draws for each parameter, to which weights are tempered for the next proposal
_STRETCHED = 1.7  # distance of every other anchor from the middle, of a draw's
_WALKERS, _STRIDES, _STARTS = 80, 60, 4
_BELOW = 8.0  # nats, and half a nat for each parameter, below the mode, at which a ridge ends
_FIRM = 9.0  # inverse square of how far, in strides, a walker is drawn back along the ridge
_RETURNS, _PROXIMAL_STEPS = 2, 3  # Gauss-Newton steps to the ridge, of a walker after a stride, and of a kernel
_ROUNDING = 1e-13


@dataclass(frozen=True, eq=False)
class _Kernels:
    """A mixture of Student-t kernels: means (k, n_params), precisions (k, n_params, n_params), shares (k,), tails."""

    mean: FloatArray
    precision: FloatArray
    share: FloatArray
    degrees_of_freedom: float

    @cached_property
    def lower(self) -> FloatArray:
        """Cholesky factors of the precisions, definite but for rounding."""
        scale = np.sqrt(np.einsum("kpp->kp", self.precision))
        unit = self.precision / scale[:, :, None] / scale[:, None] + _ROUNDING * np.eye(self.mean.shape[1])
        return np.asarray(np.linalg.cholesky(unit) * scale[:, :, None])

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        which = rng.choice(len(self.share), n, p=self.share)
        white = student_t_draws(n, self.mean.shape[1], self.degrees_of_freedom, rng=rng)
        root = np.linalg.inv(self.lower).transpose(0, 2, 1)
        return np.asarray(self.mean[which] + np.einsum("nij,nj->ni", root[which], white))

    def log_density(self, z: FloatArray) -> FloatArray:
        n_params, nu = z.shape[1], self.degrees_of_freedom
        norm = student_t_log_norm(n_params, nu) + np.log(self.share)
        norm = norm + np.log(np.einsum("kpp->kp", self.lower)).sum(axis=1)
        blocks = np.array_split(z, max(len(z) * self.mean.size // NUMBERS, 1))
        squares = (np.sum(((block - self.mean[:, None]) @ self.lower) ** 2, axis=2) for block in blocks)
        each = (norm[:, None] - 0.5 * (nu + n_params) * np.log1p(square / nu) for square in squares)
        with np.errstate(over="ignore"):  # beside a kernel where a prediction runs away
            return np.concatenate([logsumexp(densities, axis=0) for densities in each])


def draw_by_importance(
    problem: HypothesisProblem,
    fits: Sequence[Fit],
    law: NoiseLaw,
    *,
    sizes: tuple[int, int, int, float] | None = None,
    rng: np.random.Generator,
    progress: Progress,
) -> tuple[Weighted, bool]:
    """Draw from a posterior by adaptive importance sampling from its modes; return the draws, and whether they settled.

    The first proposal has a kernel at each mode, the second kernels along the ridges from there. Each further one has
    kernels at draws of those before, by their weights, tempered where few have any, and beyond these. All draws count,
    over the mixture of all proposals and a share of the prior.

    `fits`: the modes, the most probable first; `sizes`: draws of a round, kernels, rounds at most, and effective draws
    that suffice; `progress`: called after each round.
    """
    ridge = _Ridge(problem, fits[0], law)
    sensor, n_params = problem.model.sensor, problem.model.n_params
    n_draws, n_kernels, n_rounds, enough = sizes or _SIZES[sensor.predicts_in_bulk]
    kernels, proposals = ridge.kernels_at_modes(fits), list[_Kernels]()
    z, (log_prior, log_likelihood, log_mixture) = np.zeros((0, n_params)), np.zeros((3, 0))
    before, log_share = (math.inf, np.zeros(n_params)), -math.log(_PER_PRIOR)
    for k in range(n_rounds):
        if k:
            log_mixture = np.logaddexp(log_mixture, np.logaddexp(kernels.log_density(z), log_prior + log_share))
        proposals.append(kernels)
        new = np.concatenate([kernels.draw(n_draws, rng=rng), rng.standard_normal((n_draws // _PER_PRIOR, n_params))])
        prior = problem.prior.log_prob(new)
        of_all = [np.logaddexp(own.log_density(new), prior + log_share) for own in proposals]
        z = np.concatenate([z, new])
        log_prior, log_likelihood = np.append(log_prior, prior), np.append(log_likelihood, problem.log_likelihood(new))
        log_mixture = np.append(log_mixture, logsumexp(of_all, axis=0))
        height = np.where((np.abs(z) < FARTHEST).all(axis=1), log_prior + log_likelihood, -np.inf)
        log_ratio = height - log_mixture + math.log((1 + 1 / _PER_PRIOR) * len(proposals))
        draws = weighted_draws(problem.prior.names, z, log_likelihood, log_ratio, len(z))
        weight, now, share = draws.weight, (draws.log_z, draws.sd()), draws.n_eff / len(z)
        is_sound = draws.n_eff >= enough and (draws.pareto_k < _UNSURE_K or share > _UNIFORM)
        is_still = abs(now[0] - before[0]) < _SETTLED[0] and np.allclose(now[1], before[1], rtol=_SETTLED[1])
        if is_sound and (is_still or (not k and share > _AS_IT_IS)):
            return draws, True
        before = now
        progress("sampling the posterior", note=f"{draws.n_eff:.0f} effective draws")
        if share > _UNIFORM:  # more draws of so good a proposal are better than other kernels
            continue
        along = not k and sensor.predicts_in_bulk and not sensor.predicts_dearly
        anchors = rng.permutation(ridge.follow(fits, rng=rng)) if along else z[:0]
        if len(anchors) > n_params:
            spread, anchors = np.cov(anchors.T), anchors[:n_kernels]
        else:  # readings that are met exactly leave a mode from which no stride is likely enough
            weight = weight ** tempering_power(log_ratio, _TEMPERED * n_params)
            anchors = z[np.unique(resampled_rows(weight, n_kernels, rng))]
            middle, spread = np.average(z, axis=0, weights=weight), np.cov(z.T, aweights=weight)
            anchors[1::2] = np.clip(middle + _STRETCHED * (anchors[1::2] - middle), -FARTHEST, FARTHEST)
        kernels = ridge.kernels_beside(anchors, spread.reshape(n_params, n_params))
    return draws, False


class _Ridge:
    """The posterior of a problem, linearised at many points at once; white noise of the sd about its best fit."""

    def __init__(self, problem: HypothesisProblem, best: Fit, law: NoiseLaw) -> None:
        self.problem, self.law, self.best = problem, law, best
        self.free = max(law.n_kept - len(best.z), 1)
        self.degrees_of_freedom = float(np.clip(self.free, _MOST_TAILED, _LEAST_TAILED))
        self.eye = np.eye(len(best.z))

    def _variance(self, found: Fit) -> float:
        return max(found.sd, LEAST_SCALE) ** 2 * self.law.n_kept / self.free / self.law.fisher_information

    def _linearise(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        """Return slopes (k, n_params, n), residuals (k, n), both in noise sds, precisions, and which are possible."""
        usable, (points, steps) = self.problem.recording.usable, self.problem.model.difference_points_and_steps(z)
        predicted = self.problem.predict_usable(points.reshape(-1, z.shape[1]))
        with np.errstate(all="ignore"):
            left = self.law((self.problem.recording.readings[usable] - predicted).T).T
            left = (left / self._variance(self.best) ** 0.5).reshape(*points.shape[:2], -1)
            slopes, residuals = (left[:, :1] - left[:, 1:]) / steps[:, :, None], left[:, 0]
            # A prediction that ran away has squares beyond all numbers.
            possible = np.isfinite(np.sum(slopes**2, axis=(1, 2)) + np.sum(residuals**2, axis=1))
        slopes, residuals = np.where(possible[:, None, None], slopes, 0.0), np.where(possible[:, None], residuals, 0.0)
        return slopes, residuals, with_prior(slopes @ slopes.transpose(0, 2, 1)), possible

    def _drawn_to_ridge(self, anchors: FloatArray, firmness: FloatArray, n_steps: int) -> FloatArray:
        """Return points by Gauss-Newton steps towards the mode, held to anchors by a precision (k or 1, p, p)."""
        z = anchors
        for _ in range(n_steps):
            slopes, residuals, precision, _ = self._linearise(z)
            downhill = np.einsum("kpn,kn->kp", slopes, residuals) - z
            downhill += ((anchors - z)[:, None] @ firmness)[:, 0]
            step = np.linalg.solve(precision + firmness, downhill[:, :, None])[:, :, 0]
            z = np.clip(z + step, -FARTHEST, FARTHEST)
        return z

    def kernels_at_modes(self, fits: Sequence[Fit]) -> _Kernels:
        """Return Laplace's approximation at fits, with shares by their evidence, a tenth of the largest at least."""
        slopes = np.stack([self.law(found.slopes).T / math.sqrt(self._variance(found)) for found in fits])
        log_z = np.array([log_evidence_of(found, self.law) for found in fits])
        share = np.maximum(np.exp(log_z - log_z.max()), 0.1)
        precision = with_prior(slopes @ slopes.transpose(0, 2, 1))
        mean = np.stack([found.z for found in fits])
        return _Kernels(mean, precision, share / share.sum(), self.degrees_of_freedom)

    def kernels_beside(self, anchors: FloatArray, spread: FloatArray) -> _Kernels:
        """Return a kernel on the ridge beside each anchor, (k, n_params), with the local shape.

        Along the ridge a kernel is as wide as Silverman's rule says for draws of the covariance `spread`.
        """
        n, n_params = anchors.shape
        width = (4 / (n_params + 2) / n) ** (1 / (n_params + 4))
        squares, axes = np.linalg.eigh(spread)
        metric = (axes / np.maximum(squares, _ROUNDING * squares.max())) @ axes.T / width**2
        z = self._drawn_to_ridge(anchors, metric[None], _PROXIMAL_STEPS)
        _, _, precision, possible = self._linearise(z)
        share = np.full(int(possible.sum()), 1 / possible.sum())
        return _Kernels(z[possible], precision[possible] + metric, share, self.degrees_of_freedom)

    def follow(self, fits: Sequence[Fit], *, rng: np.random.Generator) -> FloatArray:
        """Return points (n, n_params) along the ridges from modes, to where the density is some nats lower.

        Walkers go a local sd at a time in directions of their own, and return to the ridge after each stride.
        """
        modes = np.stack([found.z for found in fits[:_STARTS]])
        z, out = np.repeat(modes, _WALKERS // len(modes), axis=0), [modes]
        way = rng.standard_normal(z.shape)
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        lowest = -self._heights(self._linearise(modes)[1], modes).max() + _BELOW + 0.5 * z.shape[1]
        _, _, precision, _ = self._linearise(z)
        for _ in range(_STRIDES):
            lengths, axes = np.linalg.eigh(precision)
            stride = np.einsum("kij,kj,klj,kl->ki", axes, np.maximum(lengths, 1.0) ** -0.5, axes, way)
            firmness = _FIRM / np.maximum(np.sum(stride**2, axis=1), LEAST_SCALE)[:, None, None] * self.eye
            z = self._drawn_to_ridge(np.clip(z + stride, -FARTHEST, FARTHEST), firmness, _RETURNS)
            _, residuals, precision, possible = self._linearise(z)
            goes = possible & (-self._heights(residuals, z) < lowest)
            z, way, precision = z[goes], way[goes], precision[goes]
            if not len(z):
                break
            out.append(z)
        return np.concatenate(out)

    def _heights(self, residuals: FloatArray, z: FloatArray) -> FloatArray:
        squares = np.maximum(np.sum(residuals**2, axis=1), LEAST_SCALE)
        return np.asarray(-0.5 * self.law.n_kept * np.log(squares) - 0.5 * np.sum(z**2, axis=1))


_ENOUGH = 0.5  # target effective sample size, as a share of the samples wanted
_LEAST_SHARE = 0.25  # least acceptable effective sample size, likewise
_ALIKE = 0.98  # effective share of a few draws, from which means of all are off by a seventh of an sd at most

Density: TypeAlias = Callable[[FloatArray], FloatArray]
"""Log densities of samples, unnormalised, (n, n_params) -> (n,)."""


def importance_resample(
    first: FloatArray,
    log_q: Density,
    log_p: Density,
    *,
    n_wanted: int,
    rng: np.random.Generator,
    n_tried: int | None = None,
) -> FloatArray | None:
    """Draw from a density by importance resampling: (n_wanted, n_params), in random order.

    `first`: samples of the other density in random order, (n_first, n_params); only as many as needed are evaluated,
    for an effective sample size of half of `n_wanted`. `log_q`, `log_p`: unnormalised log densities of the proposal and
    the target; the latter is minus infinity outside its support. `n_tried`: samples evaluated first; if these are fewer
    than wanted and nearly all effective, so are the others. None if the effective sample size is below a quarter of
    `n_wanted`.
    """
    tried = first[: n_tried or n_wanted]
    gain = log_p(tried) - log_q(tried)
    share = _n_distinct_effective(gain, tried) / len(gain)
    if share * len(first) < _LEAST_SHARE * n_wanted:
        return None
    if len(tried) < n_wanted and share > _ALIKE:
        return first[:n_wanted]
    enough = min(math.ceil(_ENOUGH * n_wanted / share), len(first))
    if enough > len(tried):
        more = first[len(tried) : enough]
        gain = np.append(gain, log_p(more) - log_q(more))
    if _n_distinct_effective(gain, first[: len(gain)]) < _LEAST_SHARE * n_wanted:
        return None
    rows = resampled_rows(np.exp(gain - gain.max()), n_wanted, rng)
    return np.asarray(first[rng.permutation(rows)])


def _n_distinct_effective(log_weight: FloatArray, samples: FloatArray) -> float:
    """Return Kish's effective sample size; samples with an equal first coordinate count as one."""
    _, which = np.unique(samples[:, 0], return_inverse=True)
    if not np.isfinite(log_weight).any():
        return 0.0
    with np.errstate(divide="ignore"):
        return n_effective(np.log(np.bincount(which, np.exp(log_weight - log_weight.max()))))


def draw_by_annealing(
    first: FloatArray,
    log_q: Density,
    log_p: Density,
    *,
    n_moves: int,
    n_wanted: int,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> FloatArray:
    """Draw from a density by sequential Monte Carlo, starting from samples of another one, an even number.

    `n_moves`: moves of each sample after a step of beta, and between collections of samples. The rest, and what is
    returned, is as in `importance_resample`. Raises NotConvergedError if no initial sample is in the support of the
    target.
    """
    n_walkers, beta, scale = len(first), 0.0, 1.0
    z, heights = first, np.stack([log_q(first), log_p(first)])
    if not np.isfinite(heights[1]).any():
        raise NotConvergedError("no sample of the approximate posterior is within the bounds of the prior")

    def move(times: int) -> None:
        """Move one half of the walkers by differences of the other half, then vice versa; adapt the step size."""
        nonlocal z, heights, scale
        for _ in range(times):
            z, heights = z.copy(), heights.copy()
            order, n, accepted = rng.permutation(n_walkers), n_walkers // 2, 0
            for own, other in ((order[:n], order[n:]), (order[n:], order[:n])):
                one, another = (z[rng.choice(other, len(own))] for _ in range(2))
                length = scale * 2.38 / math.sqrt(2 * z.shape[1]) * rng.choice([1.0, 0.3], (len(own), 1))
                to = z[own] + length * (one - another)
                there = np.stack([log_q(to), log_p(to)])
                taken = np.asarray(np.isfinite(there).all(axis=0))
                of_q, of_p = (there - heights[:, own])[:, taken]
                taken[taken] = np.log(rng.random(len(own)))[taken] < (1 - beta) * of_q + beta * of_p
                z[own[taken]], heights[:, own[taken]] = to[taken], there[:, taken]
                accepted += int(taken.sum())
            rate = accepted / n_walkers
            scale = min(max(scale * (1.3 if rate > 0.35 else 0.75 if rate < 0.15 else 1.0), 0.05), 2.0)

    while beta < 1.0:
        gain, before = heights[1] - heights[0], beta
        beta = _next_beta(gain, before)
        kept = resampled_rows(np.exp((beta - before) * (gain - gain.max())), n_walkers, rng)
        z, heights = z[kept], heights[:, kept]
        progress("annealing samples to the posterior", note=f"beta {beta:.2f} of 1")
        move(n_moves if beta < 1.0 else 3 * n_moves)
    harvest = [z]
    while len(harvest) * n_walkers < n_wanted:
        progress("sampling the posterior", len(harvest) * n_walkers, n_wanted)
        move(n_moves)
        harvest.append(z)
    return np.asarray(rng.permutation(np.concatenate(harvest))[:n_wanted])


def _next_beta(gain: FloatArray, beta: float) -> float:
    """Find the largest beta, by bisection, at which half of the finite weights are effective samples."""
    enough = 0.5 * np.count_nonzero(np.isfinite(gain))
    if n_effective((1.0 - beta) * gain) >= enough:
        return 1.0
    low = largest_power(lambda power: (power - beta) * gain, beta, wanted=enough)
    return min(max(low, beta + 1e-3), 1.0)  # a least step, so that it ends


_NEGLIGIBLE = 0.02  # noise sds, over all readings together: smaller changes at one step are neglected


def quadratic_predictions(
    predict: Callable[[FloatArray], FloatArray], n_params: int, sd: float
) -> tuple[FloatArray, Callable[[FloatArray], FloatArray], FloatArray]:
    """Predict readings to second order in steps `e`, as `center` + `coefficients(e)` @ `changes`, which are returned.

    `center` (n_points,) are the predictions at e = 0; `coefficients` maps (n_samples, n_params) -> (n_samples,
    n_changes); `changes` (n_changes, n_points) are orthonormal. This is exact, but for negligible changes, at every
    step, its reverse, and sums of two.

    `predict`: the model as a function of steps, (n_samples, n_params) -> (n_samples, n_points); finite at step 0; `sd`:
    noise sd of a reading: changes by less than 0.02 sd over all readings together are neglected.
    """
    first, second = np.triu_indices(n_params)
    apart, one = first != second, np.eye(n_params)
    y = predict(np.concatenate([np.zeros((1, n_params)), one, -one, one[first[apart]] + one[second[apart]]]))
    y = np.where(np.abs(y) < RUNS_AWAY, y, np.nan)
    up, down, both = y[1 : n_params + 1] - y[0], y[n_params + 1 : 2 * n_params + 1] - y[0], y[2 * n_params + 1 :]
    # Readings impossible on one side are as on the other; on both, they say nothing.
    up, down = (np.nan_to_num(np.where(np.isnan(a), -b, a)) for a, b in ((up, down), (down, up)))
    squares = np.empty((len(first), y.shape[1]))
    squares[~apart] = 0.5 * (up + down)
    squares[apart] = np.nan_to_num(both - y[0] - up[first[apart]] - up[second[apart]])
    terms = np.concatenate([0.5 * (up - down), squares])
    lengths, axes = np.linalg.eigh(terms @ terms.T)
    kept = lengths > (_NEGLIGIBLE * sd) ** 2
    root = np.sqrt(lengths[kept])
    shares = axes[:, kept] * root

    def coefficients(e: FloatArray) -> FloatArray:
        return np.asarray(np.concatenate([e, e[:, first] * e[:, second]], axis=1) @ shares)

    return y[0], coefficients, (axes[:, kept] / root).T @ terms


def surrogate_log_density(
    predict: Callable[[FloatArray], FloatArray],
    center: FloatArray,
    steps: FloatArray,
    readings: FloatArray,
    law: NoiseLaw,
    sd: float,
) -> Density:
    """Return the unnormalised log posterior, as a function of e, of coordinates z = center + e @ steps, approximately.

    It is that of `quadratic_predictions` for the readings (n_usable,) under normal noise: for heavy-tailed noise,
    residuals are replaced by pseudo-residuals. Minus infinity beyond six prior sds. `predict` is the model as a
    function of z.
    """
    middle, coefficients, changes = quadratic_predictions(lambda e: predict(center + e @ steps), len(center), sd)
    residual = law(readings - middle)[:, None]
    residual = law.normal_pseudo_residuals(residual, np.maximum(law.likeliest_sigma(residual), LEAST_SCALE))
    # In orthonormal axes of the space that residual and changes span, or of all readings if these are fewer.
    _, turned = np.linalg.qr(np.concatenate([law(changes.T), residual], axis=1))
    normal = law.without_tail_or_rounding()

    def log_density(e: FloatArray) -> FloatArray:
        z = center + e @ steps
        whitened = turned[:, -1][:, None] - turned[:, :-1] @ coefficients(e).T
        height = log_likelihood_marginal_over_sigma(normal, whitened) - 0.5 * np.sum(z**2, axis=1)
        return np.where((np.abs(z) < FARTHEST).all(axis=1), height, -np.inf)

    return log_density


_MOVES = 6  # of each walker after a step of beta
_N_NEAR, _MOVES_NEAR = 2000, 20  # of the surrogate, which costs next to nothing


def n_tried(model: Model) -> int | None:
    """Return the number of draws that are tried first, 100 where each is a call; None: as many as wanted."""
    return 100 if model.sensor.predicts_dearly and not model.sensor.predicts_in_bulk else None


def posterior_draws(
    found: Fit,
    noise: NoiseEvidence,
    recording: Recording,
    n_samples: int,
    *,
    laplace_only: bool = False,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> FloatArray:
    """Draw coordinates, (n_samples, n_params), from the posterior about a fit, under one noise model.

    In this order: by Laplace's approximation, if `laplace_only`, or by its linear amplitudes where it has any; by
    adaptive importance sampling, if many samples cost little more than one, or if a tangent serves (of a simulator that
    is called for each sample and has an effect with a size and a shape); otherwise by importance resampling, through a
    quadratic surrogate and then under the model, each replaced by annealing where too few draws are effective: with
    several Gaussians the posterior is curved, and Laplace's samples predict new angles far worse. The parameters are
    those of `sample_model`.
    """
    model, law, usable = found.model, noise.likeliest_law, np.flatnonzero(recording.usable)
    # Laplace's approximation: normal, of covariance steps.T @ steps, with `slopes` and `residual` in noise sds.
    whitened = law(found.residuals)[:, None]
    sigma = law.likeliest_sigma(whitened)
    sd = max(float(sigma[0]) / math.sqrt(law.fisher_information), LEAST_SCALE)
    slopes = law(found.slopes)
    curvature = with_prior(slopes.T @ slopes / sd**2)
    slopes = slopes / sd
    residual = law.normal_pseudo_residuals(whitened, np.maximum(sigma, LEAST_SCALE))[:, 0] / sd
    # A step in one coordinate also moves the later ones. With the effects first and the sensor last, most steps leave
    # the SSF's geometry unchanged, which speeds up vectorised predictions.
    order = np.roll(np.arange(len(found.z)), -model.sensor.n_params)
    at, steps = np.ix_(order, order), np.empty_like(curvature)
    steps[at] = np.linalg.inv(np.linalg.cholesky(curvature[at][::-1, ::-1]))[::-1, ::-1]

    def mode() -> FloatArray:
        """Return the mode, one Newton step from the fit, unless that leaves the domain of the formula."""
        downhill = slopes.T @ residual - found.z
        center = np.clip(found.z + np.linalg.solve(with_prior(slopes.T @ slopes), downhill), -FARTHEST, FARTHEST)
        is_possible = np.isfinite(model.predict_rows(usable, center[None, :])).all()
        return np.asarray(center) if is_possible else found.z

    if laplace_only:
        linear = draws_of_linear_amplitudes(found, slopes, residual, n_samples, rng=rng)
        return mode() + rng.standard_normal((n_samples, len(found.z))) @ steps if linear is None else linear
    normal = rng.standard_normal((_N_NEAR, len(found.z)))
    problem = HypothesisProblem(model, recording, noise.with_likeliest_node_alone)

    def log_posterior(z: FloatArray, of: HypothesisProblem = problem) -> FloatArray:
        height = of.prior.log_prob(z) + of.log_likelihood(z)
        return np.where((np.abs(z) < FARTHEST).all(axis=1), height, -np.inf)

    def resampled_or_annealed(
        first: FloatArray, log_q: Density, log_p: Density, n_moves: int, n_wanted: int, tried: int | None = None
    ) -> FloatArray:
        weighed = importance_resample(first, log_q, log_p, n_wanted=n_wanted, rng=rng, n_tried=tried)
        if weighed is not None:
            return weighed
        some = first[:250]
        return draw_by_annealing(some, log_q, log_p, n_moves=n_moves, n_wanted=n_wanted, rng=rng, progress=progress)

    tried, system = n_tried(model), model.sensor
    cheap: Model | TangentModel | None = model if system.predicts_in_bulk else None
    if tried and isinstance(system, System) and sizes_with_shape(found):
        tangent = TangentModel(found, system)
        cheap = tangent if tangent.is_finite else None
    if cheap is not None:
        stand_in = replace(problem, model=cast(Model, cheap))
        # A fit is under the noise that suits it best, which may be another: proposals from there would be far off.
        best = fit(model, recording, found.z, law) if cheap is model else found
        modes = [best, *modes_of_opposite_sign(cheap, best, recording, law)]
        sizes = 1000, 60, 8, 250.0  # draws of a round, kernels, rounds, and enough effective draws: each costs little
        draws, _ = draw_by_importance(stand_in, modes, law, sizes=sizes, rng=rng, progress=progress)
        if draws.n_eff >= _LEAST_SHARE * n_samples:
            if cheap is model:
                return draws.samples(n_samples, rng=rng)
            first = draws.samples(_N_NEAR, rng=rng)
            log_q = partial(log_posterior, of=stand_in)
            drawn = importance_resample(first, log_q, log_posterior, n_wanted=n_samples, rng=rng, n_tried=tried)
            if drawn is not None:
                return drawn
    center, readings = mode(), recording.readings[usable]
    near = surrogate_log_density(partial(model.predict_rows, usable), center, steps, readings, law, sd)
    e = resampled_or_annealed(normal, lambda e: -0.5 * np.sum(e**2, axis=1), near, _MOVES_NEAR, _N_NEAR)
    e = resampled_or_annealed(e, near, lambda e: log_posterior(center + e @ steps), _MOVES, n_samples, tried)
    return center + e @ steps
