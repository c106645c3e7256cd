"""Noise models: effects on the noise, discretised to nodes under which the evidence of a fit is computed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded, solveh_banded
from scipy.special import expit

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.diagnosis.noise_law import (
    LEAST_SCALE,
    MAD_OF_NORMAL,
    NoiseLaw,
    RoundedNormal,
    n_rows_since_previous_usable,
    order_by_scan,
    previous_usable,
)
from probewise.effects import NoiseEffect
from probewise.effects.noise import lattice_step
from probewise.effects.noise_distribution import FittedReadings
from probewise.inference import sd_floor
from probewise.recordings.plan import Recording
from probewise.sensor.stages import NoiseParameters, effects_with_columns


def innovations_given_rest(
    law: NoiseLaw, columns: FloatArray, asked: BoolArray, *, each_alone: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Whiten the noise of some readings given that of all others: what the others and earlier ones do not tell of each.

    `columns`: residuals, or slopes, of all readings, (n_points, n_columns); `asked`: mask of the readings to whiten,
    (n_points,); those that are lost are neither whitened nor given. Returns `innovations, sd`: whitened columns of the
    readings asked for, (n_asked, n_columns), of sd sigma each and independent, 0 where lost; and the sd of each reading
    in units of sigma, given the other readings and those asked for before it, (n_asked,), 1 where lost. With
    `each_alone`, none is given those asked for before it, and they are not independent.
    """
    law, there = replace(law, flat=0.0), ~law.lost[asked]
    if not law.has_memory:
        return law(columns)[asked], np.where(there, law.sd[asked], 1.0)
    # A whitening w of all readings has w^T w for their precision; a part of it is that of some given all others.
    own = law(np.eye(len(columns))[:, asked & ~law.lost])
    precision, told = own.T @ own, own.T @ law(columns)
    innovations, sd = np.zeros((len(there), columns.shape[1])), np.ones(len(there))
    if each_alone:
        covariance = np.linalg.inv(precision)
        sd[there] = np.sqrt(np.diag(covariance))
        innovations[there] = covariance @ told / sd[there, None]
    else:
        root = np.linalg.cholesky(precision[::-1, ::-1])[::-1, ::-1]  # upper: root root^T is the precision
        innovations[there], sd[there] = np.linalg.solve(root, told), 1 / np.diag(root)
    return innovations, sd


def walk_given_readings(law: NoiseLaw, residuals: FloatArray) -> FloatArray:
    """Return the expected random walk in residuals, given all of them, (n_points,); 0 without a walk."""
    if not law.walk.size:
        return np.zeros(len(residuals))
    weight = law.kept / law.sd**2
    bands = precision_bands_of_walk(law)
    bands[0] += weight
    return np.asarray(solveh_banded(bands, weight * residuals, lower=True, check_finite=False))


def precision_bands_of_walk(law: NoiseLaw) -> FloatArray:
    """Return the diagonal and the one below of a random walk's precision, in 1 / sigma^2, (2, n_points)."""
    steps = 1 / law.walk
    return np.stack([steps + np.append(steps[1:], 0.0), np.append(-steps[1:], 0.0)])


_ROUNDS = 20
_SAME = 0.01  # change of a reading's relative precision, and of sigma, at which the rounds end
_SMALLEST = 1e-9  # sigma, of the largest residual: most readings may be exactly as predicted
_FARTHEST = 1e100  # residual whose square is a number


def with_known_wide_readings(law: NoiseLaw, residuals: FloatArray) -> NoiseLaw:
    """Return a random walk's distribution with the tail on each reading's own noise, given the residuals of a fit.

    `law`: noise with a walk and a tail (`share`, `times`); `residuals`: residuals of the fit, (n_points,). Returns
    Gaussian noise with the probability of each reading to be wide (`wide`), and sds that include it. Its `log_extra` is
    what the log density of these residuals, averaged over the sets of wide readings, exceeds that of this noise by.
    """
    if not np.abs(residuals).max() < _FARTHEST:  # of predictions that ran away: impossible in any case
        return replace(law, wide=np.zeros(len(residuals)))
    kept, excess = ~law.lost, 1 - law.times**-2
    own, bands = law.sd**2, precision_bands_of_walk(law)
    sigma = math.inf
    precise = np.ones(len(own))  # expected precision of each reading, relative to a narrow one
    for k in range(_ROUNDS):
        weight = law.kept * precise / own
        smoothed, variance = _smoothed_and_variance(bands, weight, residuals)
        unshared = np.maximum(1 - weight * variance, 1e-12)
        apart, beside = (residuals - smoothed) / unshared, variance / unshared  # from the walk as the others tell it
        last = sigma
        if k:
            sigma = math.sqrt(max(float(np.mean((weight * (residuals - smoothed) * residuals)[kept])), 0.0))
        else:  # whatever some outlying readings are
            sigma = float(np.median(np.abs(apart / np.sqrt(beside + own))[kept])) / MAD_OF_NORMAL
        sigma = max(sigma, law.sigma_floor, _SMALLEST * float(np.abs(apart).max()), LEAST_SCALE)
        apart /= sigma
        log_narrow = np.log1p(-law.share) + _log_density(apart, beside + own)
        log_wide = np.log(law.share) + _log_density(apart, beside + own * law.times**2)
        wide, used = expit(log_wide - log_narrow), precise
        precise = 1 - excess * wide
        if k and np.abs(precise - used)[kept].max() < _SAME and abs(sigma / last - 1) < _SAME:
            break
    log_mixed = np.logaddexp(log_narrow, log_wide)
    log_extra = float(np.sum((log_mixed - _log_density(apart, beside + own / used))[kept]))
    return replace(
        law, sd=np.sqrt(own / used), wide=law.kept * (1 - used) / excess, log_extra=law.log_extra + log_extra
    )


def _smoothed_and_variance(
    steps: FloatArray, weight: FloatArray, residuals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the expected walk and its variance, in units of sigma^2, given all residuals: (n_points,) both.

    `steps` are the bands of the walk's precision, (2, n_points); `weight` the precisions of the readings, (n_points,).
    """
    bands = steps.copy()
    bands[0] += weight
    root = cholesky_banded(bands, lower=True, check_finite=False)
    # The inverse's diagonal from the pivots of elimination forwards and backwards.
    backwards = np.stack([bands[0, ::-1], np.append(bands[1, -2::-1], 0.0)])
    pivots = cholesky_banded(backwards, lower=True, check_finite=False)[0, ::-1] ** 2
    smoothed = cho_solve_banded((root, True), weight * residuals, check_finite=False)
    return np.asarray(smoothed), np.asarray(1 / (root[0] ** 2 + pivots - bands[0]))


def _log_density(apart: FloatArray, variance: FloatArray) -> FloatArray:
    return np.asarray(-0.5 * np.log(variance) - 0.5 * apart**2 / variance)


_FAR = 4.0  # noise sds from its prediction beyond which a reading counts as lost
_APART = 0.3  # initial spacing of nodes in the log of half a step over the noise sd
_WIDEST, _NARROWEST = -6, 9  # range of nodes: noise sds from 3 steps, or the residual rms, to a thirtieth of a step
_UNLIKELY = 15.0  # nats behind the best from which nodes of noise with rounding are dropped
HIDDEN = 0.6  # sd over step from which rounding is negligible (lattice sum 1 + 2 exp(-2 pi^2 0.36) = 1.0016)

_FINE = 0.01  # noise sds: tolerance of a lost reading's value without rounding


@dataclass(frozen=True, eq=False)
class NoiseNodes:
    """The nodes of a noise model about a fit: parameters (n_nodes, n_params), distributions and log prior weights."""

    settings: FloatArray
    laws: tuple[NoiseLaw, ...]
    log_weights: FloatArray


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """A set of effects on the noise.

    `effects`: the effects; empty for white noise; `recording`: what was read; `likely`: for some effects by name, the
    nodes to use, (n_nodes, n_params), and their log prior weights; `rounding`: rounding step of all readings, if there
    is no other noise effect, or 0; `least_sd`: least plausible sd of a reading, given those before it.
    """

    effects: tuple[NoiseEffect, ...]
    recording: Recording
    likely: Mapping[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    rounding: float = 0.0
    least_sd: float = 0.0

    def columns_of_effect(self, name: str) -> slice:
        """Return the slice of one effect's parameters in the settings of nodes."""
        return {effect.name: own for effect, own in effects_with_columns(self.effects)}[name]

    def nodes_for_predictions(self, predicted: FloatArray) -> NoiseNodes:
        """Return the product grid of the effects' nodes, with the noise law and log weight at each.

        `predicted` are predictions of the usable rows, (n_usable,). With `rounding`, each node is a noise sd.
        """
        residuals, sd = self._residuals_and_rough_sd(predicted)
        rows = FittedReadings(predicted, sd, self.recording.plan.scan[self.recording.usable], self._usable_readings)
        whitened = residuals / sd
        banks = [self.likely.get(e.name) or e.weighed_nodes(whitened, rows) for e in self.effects]
        settings, log_weights = np.zeros((1, 0)), np.zeros(1)
        for bank, log_each in banks:
            every = [np.repeat(settings, len(bank), axis=0), np.tile(bank, (len(settings), 1))]
            settings = np.concatenate(every, axis=1)
            log_weights = (log_weights[:, None] + log_each).ravel()
        laws = self.laws_at(settings, predicted)
        if self.rounding:
            # Sigma is integrated out numerically over its logarithm, as elsewhere in closed form.
            (law,) = laws
            halves, beside = _sd_nodes_with_rounding(
                law(self._usable_readings - predicted), 0.5 * self.rounding, law.n_kept, law.sd_beside_rounding
            )
            laws = tuple(replace(law, flat=x, sigma=0.5 * self.rounding / x) for x in halves)
            return NoiseNodes(np.repeat(settings, len(laws), axis=0), laws, beside)
        return NoiseNodes(settings, laws, log_weights)

    def laws_at(self, settings: FloatArray, predicted: FloatArray) -> tuple[NoiseLaw, ...]:
        """Return the noise distributions at settings of the parameters, (n_nodes, n_params), without rounding.

        `predicted` are predictions of the usable rows, (n_usable,).
        """
        residuals, sd = self._residuals_and_rough_sd(predicted)
        plan, span, seen = self.recording.plan, float(np.ptp(predicted)) or 1.0, np.zeros((1, len(self.recording)))
        seen[0, self.recording.usable] = np.clip((predicted - predicted.min()) / span, 0.0, 1.0)
        noise = NoiseParameters(sd=self.recording.relative_sd[None, :], rho=np.zeros((1, 1)), seen=seen)
        for effect, own in effects_with_columns(self.effects):
            noise = effect.apply(noise, settings[:, own], plan)
        far = np.abs(residuals) > _FAR * sd
        laws = (self._law_at_node(noise, k, far) for k in range(len(settings)))
        left = self._usable_readings - predicted
        return tuple(with_known_wide_readings(law, left) if law.walk.size and law.share else law for law in laws)

    def _residuals_and_rough_sd(self, predicted: FloatArray) -> tuple[FloatArray, float]:
        """Return the residuals over their declared relative sds, (n_usable,), and a robust estimate of their sd."""
        residuals = (self._usable_readings - predicted) / self.recording.relative_sd[self.recording.usable]
        # Rounded readings can all be as predicted; rounding errors alone are not outliers.
        free = residuals[~self._censored] if self._censored.any() else residuals
        sd = max(float(np.median(np.abs(free))) / MAD_OF_NORMAL, self._rounding_step / math.sqrt(12))
        return residuals, sd or 1.0

    def _law_at_node(self, noise: NoiseParameters, node: int, far: BoolArray) -> NoiseLaw:
        def value_at_node(values: FloatArray) -> float:
            return float(values[min(node, len(values) - 1), 0])

        sd = noise.sd[min(node, len(noise.sd) - 1)]
        sd = np.full(len(far), sd[0]) if len(sd) == 1 else sd[self.recording.usable]
        lost_share, value, lost = value_at_node(noise.lost_share), value_at_node(noise.lost_value), np.zeros_like(far)
        log_extra = 0.0
        if lost_share > 0:
            lost = far & (np.abs(self._usable_readings - value) <= 1e-9 * self._span + 1e-14 * abs(value))
            n_lost, cells = int(lost.sum()), max(self._span / self._lost_value_resolution, 1.0)
            # A lost reading has a density, 1 / cell; a censored one has a probability, so the cell cancels.
            log_extra = n_lost * math.log(lost_share / self._lost_value_resolution)
            log_extra += int((lost & self._censored).sum()) * math.log(self._lost_value_resolution)
            log_extra += log_prior_of_lost_value(value, cells, self.recording.plan.instrumentation.declared_ends)
            log_extra += (len(lost) - n_lost) * math.log1p(-lost_share)
        rho, carry = value_at_node(noise.rho), np.zeros(len(far))
        if rho:
            n_rows, above = self._n_rows_since_previous_in_scan, self._previous_in_scan
            # The noise of a censored reading is not known: none is correlated with it.
            unknown = lost | self._censored
            alone = (n_rows == 0) | unknown | (above >= 0) & unknown[above]
            carry = np.where(alone, 0.0, rho ** np.maximum(n_rows, 1))
        step = value_at_node(noise.walk)
        return NoiseLaw(
            sd,
            carry,
            lost,
            value_at_node(noise.wide_share),
            value_at_node(noise.wide_times),
            log_extra,
            least=self.least_sd,
            walk=step**2 * self._n_rows_since_previous if step else np.zeros(0),
            before=self._before_if_interleaved if rho else np.zeros(0, dtype=np.int64),
            censored=self._censored if self._censored.any() else np.zeros(0, dtype=np.bool_),
        )

    @cached_property
    def _censored(self) -> BoolArray:
        return self.recording.censored[self.recording.usable]

    @cached_property
    def _previous_in_scan(self) -> IntArray:
        return previous_usable(self.recording)

    @cached_property
    def _before_if_interleaved(self) -> IntArray:
        above = self._previous_in_scan
        return np.maximum(above, 0) if np.any((above >= 0) & (above != np.arange(len(above)) - 1)) else above[:0]

    @cached_property
    def _usable_readings(self) -> FloatArray:
        return self.recording.readings[self.recording.usable]

    @cached_property
    def _span(self) -> float:
        return float(np.ptp(self._usable_readings))

    @cached_property
    def _n_rows_since_previous(self) -> FloatArray:
        """Number of rows back to the previous usable reading, even of another run, (n_usable,)."""
        return np.diff(np.flatnonzero(self.recording.usable), prepend=-1.0)

    @cached_property
    def _n_rows_since_previous_in_scan(self) -> IntArray:
        return n_rows_since_previous_usable(self.recording)

    @cached_property
    def _lost_value_resolution(self) -> float:
        return self._rounding_step or _FINE * rough_sd(self.recording) or 1e-12

    @cached_property
    def _rounding_step(self) -> float:
        return lattice_step(self._usable_readings)


def log_prior_of_lost_value(value: float, cells: float, ends: Sequence[float]) -> float:
    """Return the log prior probability of the one value that lost readings have.

    Half is for the ends of the declared range, and half for any of `cells` possible values; without ends, all of it.
    """
    if not ends:
        return -math.log(cells)
    at_end = any(abs(value - end) <= 1e-9 * (max(ends) - min(ends) + abs(end)) for end in ends)
    return math.log(0.5 * at_end / len(ends) + 0.5 / cells)


def _sd_nodes_with_rounding(
    residuals: FloatArray, half_step: float, n_points: int, sd: float | FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return nodes for the noise sd of rounded readings, as half steps per sd, and log weights, (n,) both.

    `residuals` are over the relative sds, (n_readings,), and `sd` those sds as `RoundedNormal` takes them.
    Nodes are coarse, and refined about the best to the accuracy of log sigma without rounding. They extend to the
    residual rms, in case the mean is incomplete.
    """

    def log_likelihood(halves: FloatArray) -> FloatArray:
        sigma = half_step / halves
        density = RoundedNormal(halves, sigma, sd)
        return -density.minus_log_likelihood(residuals[:, None] * density.normal_sd, sigma, n_points)

    rms = math.sqrt(float(residuals @ residuals) / n_points)
    widest = math.floor(math.log(half_step / (2 * rms)) / _APART) if rms > 0 else _NARROWEST
    x = _APART * np.arange(min(widest, _WIDEST), _NARROWEST + 1)
    height, apart = log_likelihood(np.exp(x)), _APART
    while apart > 1 / math.sqrt(2 * n_points):
        apart /= 4
        between = x[np.argmax(height)] + apart * np.array([-5, -3, -2, -1, 1, 2, 3, 5])
        order = np.argsort(np.append(x, between))
        x = np.append(x, between)[order]
        height = np.append(height, log_likelihood(np.exp(between)))[order]
    log_weights = np.log(np.gradient(x))
    likely = height > height.max() - _UNLIKELY
    return np.exp(x[likely]), log_weights[likely]


def least_sd_given_rounding(recording: Recording) -> float:
    """Return the least sd of a normal density of the readings: the usual floor, and at least 0.6 of a rounding step."""
    # On a coarse lattice, a smaller sd would favour models whose levels fall on the lattice.
    return max(sd_floor(recording), HIDDEN * lattice_step(recording.readings[recording.usable]))


def rough_sd(recording: Recording) -> float:
    """Estimate the noise sd without a model, from second differences within scans, few of which are at an edge.

    The estimate includes rounding; equal readings are spread over a step, so that the median is not one of few values.
    It is 0 if no three usable readings are successive.
    """
    order = order_by_scan(recording)
    readings, steps = recording.readings[recording.usable][order], n_rows_since_previous_usable(recording)[order]
    free = ~recording.censored[recording.usable][order]  # a meter that stands at its end does not scatter
    inner = np.flatnonzero((steps[1:-1] == 1) & (steps[2:] == 1) & free[:-2] & free[1:-1] & free[2:]) + 1
    bends = np.sort(readings[inner - 1] - 2 * readings[inner] + readings[inner + 1])
    step = lattice_step(readings)
    if step:
        bends = np.round(bends / step) * step
        first, last = np.searchsorted(bends, bends, "left"), np.searchsorted(bends, bends, "right")
        bends = bends + step * ((np.arange(len(bends)) - first + 0.5) / (last - first) - 0.5)
    return float(np.median(np.abs(bends))) / (MAD_OF_NORMAL * math.sqrt(6)) if inner.size else 0.0
