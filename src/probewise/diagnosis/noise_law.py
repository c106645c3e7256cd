"""The distribution of a recording's noise, and test statistics of residuals.

A wrong noise model causes false alarms, and a missed effect on the mean looks like correlated or heavy-tailed noise; so
the evidence of every hypothesis on the mean is computed under every noise model.

Rounded readings have the sum of a normal and a uniform part, with a flat-topped density: a rounded reading means that
the unrounded one was within half a step. Within the flat top a residual carries no information. The density never
exceeds one over the (known) step, however small the noise. All readings are rounded to one step, so the flat top of a
reading with a smaller noise sd is wider in units of that sd.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache

import numpy as np
from scipy.linalg import cholesky_banded
from scipy.linalg.lapack import dtbtrs
from scipy.special import expit

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.effects.noise_distribution import log_gaussian_mass_between
from probewise.recordings.plan import Recording

_LOG_ROOT_2_PI = 0.5 * math.log(2 * math.pi)
_LOG_HALVES = np.linspace(math.log(0.01), math.log(1000.0), 116)  # at which the information is tabulated


@dataclass(frozen=True, eq=False)
class RoundedNormal:
    """Normal noise of known sd `sigma` plus a uniform part of half width `half` sigma; scalars, or k of both (k,).

    The methods are those of `Tail`, with residuals (n_points, k) or (n_points, 1); pass this `sigma` to each.

    `half`, `sigma`: the noise of a reading of relative sd 1; `sd`: sds of the readings relative to that one, (n_points,
    1), 1 for lost readings; 1.0 if all are equal. Residuals are whitened by `whitening_sd`, so that each tells as much
    of the mean as one of relative sd 1.
    """

    half: float | FloatArray
    sigma: float | FloatArray
    sd: float | FloatArray = 1.0

    is_normal = False

    @cached_property
    def normal_sd(self) -> float | FloatArray:
        """Sd of the normal part of each whitened residual, in sigma, (n_points, k); 1.0 if all sds are equal."""
        if np.ndim(self.sd) == 0:
            return 1.0
        log_information = _log_fisher_information(self._half_by_reading) - _log_fisher_information(self.half)
        return np.asarray(np.exp(0.5 * log_information))

    @property
    def whitening_sd(self) -> float | FloatArray:
        """Relative sd by which the residual of each reading is divided, (n_points, k); 1.0 if all are equal."""
        return self.sd / self.normal_sd

    @cached_property
    def _half_by_reading(self) -> FloatArray:
        return np.asarray(self.half / self.sd)

    @cached_property
    def fisher_information(self) -> FloatArray:
        """Fisher information about the mean, in units of 1 / sigma^2, (k,) or a number."""
        return np.asarray(np.vectorize(_fisher_information_of_rounded, otypes=[np.float64])(self.half))

    def likeliest_sigma(
        self, whitened: FloatArray, n_points: int, *, floor: float = 0.0, start: FloatArray | None = None
    ) -> FloatArray:
        """Return the known sigma, (k,)."""
        k = max(whitened.shape[1], np.size(self.sigma))
        return np.broadcast_to(np.asarray(self.sigma, dtype=np.float64), (k,)).copy()

    def minus_log_likelihood(self, whitened: FloatArray, sigma: FloatArray, n_points: int) -> FloatArray:
        """Return minus the log likelihood of `n_points` readings at sigma (k,), without n/2 log 2 pi: (k,).

        It is that of the readings over their relative sds, whatever the whitening.
        """
        density = _log_density(whitened / sigma / self.normal_sd, self._half_by_reading) + _LOG_ROOT_2_PI
        at_zero = _log_density(np.zeros((1, 1)), np.asarray(self.half))[0] + _LOG_ROOT_2_PI
        of_kept = density.sum(axis=0) - (len(whitened) - n_points) * at_zero
        return np.asarray(n_points * np.log(sigma) - of_kept)

    def normal_pseudo_residuals(self, whitened: FloatArray, sigma: FloatArray) -> FloatArray:
        """Convert residuals to equally informative normal ones, of sd sigma / sqrt(information) and the same shape."""
        score = _score(whitened / sigma / self.normal_sd, self._half_by_reading) / self.normal_sd
        return np.asarray(sigma * score / self.fisher_information)

    def add_rounding(self, normal: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Turn standard normal noise into that of whitened readings in units of sigma, (n_points, n_draws) both."""
        uniform = rng.uniform(-1.0, 1.0, normal.shape)
        return np.asarray(normal * self.normal_sd + self.half / self.whitening_sd * uniform)

    def log_sigma_curvature(self, whitened: FloatArray, sigma: FloatArray, n_points: int) -> FloatArray:
        """Return 2 pi, (k,): Laplace's integral over log sigma is then 1, since sigma is known."""
        return np.full(sigma.shape, 2 * math.pi)


def _log_density(x: FloatArray, half: FloatArray) -> FloatArray:
    away = np.abs(x)
    return np.asarray(log_gaussian_mass_between(-half - away, half - away) - np.log(2 * half))


def _score(x: FloatArray, half: FloatArray) -> FloatArray:
    log_mass = _log_density(x, half) + np.log(2 * half) + _LOG_ROOT_2_PI
    return np.asarray(np.exp(-0.5 * (x - half) ** 2 - log_mass) - np.exp(-0.5 * (x + half) ** 2 - log_mass))


@lru_cache(maxsize=64)
def _fisher_information_of_rounded(half: float) -> float:
    width, x = np.asarray(half), np.linspace(-half - 8, half + 8, 8001)[:, None]
    density = np.exp(_log_density(x, width))
    return float(np.sum(_score(x, width) ** 2 * density) * (x[1, 0] - x[0, 0]))


def _log_fisher_information(half: float | FloatArray) -> FloatArray:
    log_half = np.log(half)
    beyond = np.maximum(log_half - _LOG_HALVES[-1], 0.0)
    return np.asarray(np.interp(log_half, _LOG_HALVES, _tabulated_log_information()) - beyond)


@cache
def _tabulated_log_information() -> FloatArray:
    return np.log([_fisher_information_of_rounded(half) for half in np.exp(_LOG_HALVES).tolist()])


_EM_STEPS = 12
MAD_OF_NORMAL = 0.6745
"""Median absolute deviation of a standard normal, by which a robust sd is estimated."""

LEAST_SCALE = 1e-150
"""Least sd, for readings that are exactly as predicted."""


def order_by_scan(recording: Recording) -> IntArray:
    """Return the numbers of the usable readings, those of each scan together, in their order, (n_usable,)."""
    return np.argsort(recording.plan.scan[recording.usable], kind="stable")


def previous_usable(recording: Recording) -> IntArray:
    """Return the number of the usable reading before each in its scan, -1 for the first of a scan, (n_usable,)."""
    order = order_by_scan(recording)
    same = np.diff(recording.plan.scan[recording.usable][order], prepend=-1) == 0
    out = np.full(len(order), -1)
    out[order[same]] = order[np.flatnonzero(same) - 1]
    return out


def n_rows_since_previous_usable(recording: Recording) -> IntArray:
    """Return the number of rows of the scan back to its previous usable reading, 0 if there is none.

    Shape (n_usable,): neighbours of a missing reading are two steps apart. Rows of other scans in between do not count.
    """
    scan = recording.plan.scan
    order = np.argsort(scan, kind="stable")
    place = np.empty(len(scan), dtype=np.int64)
    place[order] = np.arange(len(scan))
    own, before = place[recording.usable], previous_usable(recording)
    return np.where(before >= 0, own - own[before], 0).astype(np.int64)


@dataclass(frozen=True, eq=False)
class NoiseLaw:
    """The joint distribution of all readings' noise, up to its overall sd.

    Whitening, a linear map, makes residuals independent with one scale sigma; each is then normal, optionally with a
    heavy tail (`times` as wide with probability `share`) or rounded (flat-topped). Lost readings carry no information.
    Beside a random walk the tail is of each reading's own noise: given the probabilities of readings to be `wide`,
    which a fit's residuals tell (`wide_readings`), the noise is normal, with sds that include them.

    `sd`: sd of each reading relative to the overall one, (n_points,); `carry`: correlation with the previous reading, 0
    for the first of a scan, (n_points,); `lost`: mask of lost readings, which do not depend on the target, (n_points,);
    `share`, `times`: parameters of the heavy tail; none by default; `log_extra`: log probability of the lost readings;
    `flat`, `sigma`: rounding, if there is no tail: a uniform part of half width `flat` sigma, with known sigma, in
    every reading whatever its relative sd; `least`: least sd of a reading, given those before it; not used if sigma is
    known; `walk`: increments in variance of a random walk of the offset from row to row, also between runs, relative to
    the overall variance, (n_points,); empty without one. Then there is no other correlation. `before`: number of the
    reading with which each has the correlation `carry`, (n_points,), arbitrary where that is 0. Empty: the reading
    above, as always unless the rows of scans are interleaved. `wide`: probability of each reading to be wide,
    (n_points,), where `sd` includes it; empty without or if unknown; `censored`: mask of the readings at an end of the
    instrument's range, (n_points,); empty without one. The prediction there is limited to the end, so that the
    likelihood is 1 where the signal is beyond it. They do not count in the sd.
    """

    sd: FloatArray
    carry: FloatArray
    lost: BoolArray
    share: float = 0.0
    times: float = 1.0
    log_extra: float = 0.0
    flat: float = 0.0
    sigma: float = 1.0
    least: float = 0.0
    walk: FloatArray = field(default_factory=lambda: np.zeros(0))
    before: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    wide: FloatArray = field(default_factory=lambda: np.zeros(0))
    censored: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    kept: FloatArray = field(init=False)  # 1 where not lost, (n_points,)

    def __post_init__(self) -> None:
        object.__setattr__(self, "kept", 1.0 - self.lost)

    @property
    def n_kept(self) -> int:
        """Number of readings that are neither lost nor censored."""
        return int(self._counted.sum())

    @property
    def _counted(self) -> BoolArray:
        return ~(self.lost | self.is_censored)

    @property
    def is_censored(self) -> BoolArray:
        """Mask of the readings at an end of the instrument's range, (n_points,), also without one."""
        return self.censored if self.censored.size else np.zeros(len(self.sd), dtype=np.bool_)

    def without_readings_beyond_end(self, residuals: FloatArray) -> NoiseLaw:
        """Return the distribution without the censored readings that a fit with these residuals predicts beyond.

        Such a reading tells nothing, whatever small change is added to the prediction.
        """
        beyond = self.is_censored & (residuals == 0)
        return replace(self, lost=self.lost | beyond) if beyond.any() else self

    @property
    def whitening_key(self) -> tuple[bytes, ...]:
        """Key of the whitening: distributions with the same key differ only in tails or rounding."""
        arrays = self._whitening_sd, self.carry, self.lost, self.walk, self.before
        return tuple(values.tobytes() for values in arrays)

    def is_practically_equal(self, other: NoiseLaw) -> bool:
        """Return whether another distribution is equal, to 3 % of sd, 0.03 of correlation, and 20 % of the walk.

        That of the walk is a variance, which few readings determine to better than 20 %.
        """
        return (
            (self.share, self.times, self.flat, self.sigma) == (other.share, other.times, other.flat, other.sigma)
            and np.array_equal(self.lost, other.lost)
            and np.array_equal(self.before, other.before)
            and np.allclose(self.sd, other.sd, rtol=0.03)
            and np.allclose(self.carry, other.carry, atol=0.03)
            and self.walk.shape == other.walk.shape
            and np.allclose(self.walk, other.walk, rtol=0.2)
        )

    @property
    def has_memory(self) -> bool:
        """Whether successive readings have some of their noise in common."""
        return bool(self.walk.size or np.any(self.carry))

    @property
    def fisher_information(self) -> float:
        """Fisher information of one whitened reading about its mean, in units of 1 / sigma^2."""
        return float(self.whitened_density.fisher_information)

    def take_readings(self, rows: BoolArray) -> NoiseLaw:
        """Return the distribution of the readings in a mask, (n_points,), whatever the others read."""
        walk = np.diff(np.cumsum(self.walk)[rows], prepend=0.0) if self.walk.size else self.walk
        above, carry = self._nearest_taken_before(rows)
        before = np.maximum(above, 0) if self.before.size else self.before
        some = ("sd", "lost", "wide", "censored")
        taken = {name: own[rows] for name in some if (own := getattr(self, name)).size}
        return replace(self, carry=carry, walk=walk, before=before, **taken)

    def _nearest_taken_before(self, rows: BoolArray) -> tuple[IntArray, FloatArray]:
        """Return for each reading taken the nearest taken before it, and its correlation with that: (n_taken,) both.

        The readings taken are numbered; -1 and 0 where none before it is correlated. Along a chain of correlations that
        of two readings is the product of those in between.
        """
        number, nearest, carry = np.cumsum(rows) - 1, np.full(len(rows), -1), np.zeros(len(rows))
        for k in np.flatnonzero(self.carry).tolist():  # a reading comes after the one before it
            above = self.before[k] if self.before.size else k - 1
            if rows[above]:
                nearest[k], carry[k] = number[above], self.carry[k]
            elif nearest[above] >= 0:
                nearest[k], carry[k] = nearest[above], self.carry[k] * carry[above]
        return nearest[rows], carry[rows]

    def __call__(self, columns: FloatArray) -> FloatArray:
        """Whiten columns, shape (n_points,) or (n_points, n_columns); rows of lost readings become 0."""
        flat = columns.ndim == 1
        y = columns[:, None] if flat else columns
        if self.walk.size:
            y = self._whiten_with_walk(y)
            return y[:, 0] if flat else y
        y = y * (self.kept / self._whitening_sd)[:, None]
        if np.any(self.carry):
            carry, told = self.carry[:, None], np.zeros_like(y)
            if self.before.size:
                told = carry * y[self.before]
            else:  # a view: an indexed copy of thousands of columns takes longer than the rest
                np.multiply(carry[1:], y[:-1], out=told[1:])
            y = np.subtract(y, told, out=told)
            y /= np.sqrt(1 - carry**2)
        return y[:, 0] if flat else y

    def _whiten_with_walk(self, columns: FloatArray) -> FloatArray:
        """Whiten columns (n_points, n_columns) with a random walk: differences correlate only with their neighbours."""
        kept = ~self.lost
        own = columns if kept.all() else columns[kept]
        steps = np.array(own, dtype=np.float64, order="F")
        steps[1:] -= own[:-1]
        solved, _ = dtbtrs(self._difference_covariance_root, steps, uplo="L", overwrite_b=1)
        if own is columns:
            return np.asarray(solved)
        out = np.zeros(columns.shape)
        out[kept] = solved
        return out

    @cached_property
    def _difference_covariance_root(self) -> FloatArray:
        """Banded Cholesky factor of the covariance of successive differences, (2, n_kept)."""
        kept = ~self.lost
        variance = self.sd[kept] ** 2
        gained = np.diff(np.cumsum(self.walk)[kept], prepend=0.0)
        bands = np.zeros((2, len(variance)))
        bands[0] = gained + variance
        bands[0, 1:] += variance[:-1]
        bands[1, :-1] = -variance[:-1]
        return np.asarray(cholesky_banded(bands, lower=True))

    def half_log_det(self) -> float:
        """Return half the log determinant of the relative covariance."""
        if self.walk.size:
            return float(np.log(self._difference_covariance_root[0]).sum())
        counted = self._counted
        return float(np.log(self.sd[counted]).sum() + 0.5 * np.log1p(-(self.carry[counted] ** 2)).sum())

    @cached_property
    def whitened_density(self) -> Tail | RoundedNormal:
        """Density of one whitened reading: a mixture of two normals (`Tail`) or a rounded normal (`RoundedNormal`)."""
        return stacked_density([self])

    @cached_property
    def sd_beside_rounding(self) -> float | FloatArray:
        """Relative sds as `RoundedNormal` takes them: (n_points, 1), 1 where none counts; 1.0 if all are equal."""
        return np.where(self._counted, self.sd, 1.0)[:, None] if np.any(self.sd != 1) else 1.0

    @cached_property
    def _whitening_sd(self) -> FloatArray:
        density = self.whitened_density
        if isinstance(density, RoundedNormal) and np.ndim(density.sd):
            return np.asarray(density.whitening_sd)[:, 0]
        return self.sd

    @cached_property
    def sigma_floor(self) -> float:
        """Least sigma for which every reading's sd, given those before it, is at least `least`."""
        return self.least / self._smallest_innovation_sd if self.least else 0.0

    @cached_property
    def _smallest_innovation_sd(self) -> float:
        """Smallest sd of a reading given those before it, in units of sigma; 1 if all are lost."""
        if not self.n_kept:
            return 1.0
        if self.walk.size:
            return float(self._difference_covariance_root[0].min())
        return float(np.min((self.sd * np.sqrt(1 - self.carry**2))[~self.lost]))

    def with_least_sigma(self, sigma: float) -> NoiseLaw:
        """Return the distribution with this lower bound on sigma."""
        return replace(self, least=sigma * self._smallest_innovation_sd)

    @property
    def sd_factor_of_rounding(self) -> float:
        """Sd of a reading of relative sd 1 in units of sigma, including rounding but not a tail."""
        return math.sqrt(1 + self.flat**2 / 3)

    @property
    def sd_with_rounding(self) -> FloatArray:
        """Sd of each reading in units of sigma, including rounding but not a tail, (n_points,)."""
        return np.asarray(np.sqrt(self.sd**2 + self.flat**2 / 3))

    def without_tail_or_rounding(self) -> NoiseLaw:
        """Return normal noise with the same whitening, its sd free, without tail or rounding; no reading is wide."""
        plain = replace(self, share=0.0, times=1.0, flat=0.0, sigma=1.0, least=0.0 if self.flat else self.least)
        if not self.wide.size:
            return plain
        return replace(plain, sd=self.sd * np.sqrt(self.relative_precision), wide=np.zeros(0))

    @property
    def relative_precision(self) -> FloatArray:
        """Expected precision of each reading's own noise relative to that of a narrow one, (n_points,)."""
        return np.asarray(1 - (1 - self.times**-2) * self.wide) if self.wide.size else np.ones(len(self.sd))

    def likeliest_sigma(self, whitened: FloatArray) -> FloatArray:
        """Return the known or most likely sigma of whitened residuals, at least the floor, (n_points, k) -> (k,)."""
        return self.whitened_density.likeliest_sigma(whitened, self.n_kept, floor=self.sigma_floor)

    def likeliest_sigma_of(self, residuals: FloatArray) -> float:
        """Return the same for residuals that are not yet whitened, (n_points,)."""
        return float(self.likeliest_sigma(self(residuals)[:, None])[0])

    def minus_log_likelihood(self, whitened: FloatArray, sigma: FloatArray) -> FloatArray:
        """Return minus the log likelihood, without n/2 log 2 pi, of whitened residuals (n_points, k) at sigma (k,)."""
        return self.whitened_density.minus_log_likelihood(whitened, sigma, self.n_kept)

    def normal_pseudo_residuals(self, whitened: FloatArray, sigma: FloatArray) -> FloatArray:
        """Convert whitened residuals, (n_points, k), to equally informative normal ones, of the same shape."""
        return self.whitened_density.normal_pseudo_residuals(whitened, sigma)

    def bounded_pseudo_residuals(self, whitened: FloatArray, sigma: FloatArray) -> FloatArray:
        """Return normal pseudo-residuals that, for rounded readings, are never larger than the residual.

        A rounded reading has a flat-topped density. On its steep flank, the score over the Fisher information would
        exceed the residual.
        """
        normal = self.normal_pseudo_residuals(whitened, sigma)
        return np.clip(normal, -np.abs(whitened), np.abs(whitened)) if self.flat else normal

    def draw_pseudo_residuals(self, n_draws: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw pseudo-residuals of noise alone, in units of their sd, (n_points, n_draws); 0 for lost readings."""
        eps = rng.standard_normal((len(self.sd), n_draws))
        if not self.whitened_density.is_normal:
            eps *= np.where(rng.random(eps.shape) < self.share, self.times, 1.0)
            if isinstance(self.whitened_density, RoundedNormal):
                eps = self.whitened_density.add_rounding(eps, rng=rng)
            eps = self.bounded_pseudo_residuals(eps, np.ones(n_draws)) * math.sqrt(self.fisher_information)
        return eps * self._counted[:, None]


@dataclass(frozen=True, eq=False)
class Tail:
    """A scale mixture of two normals: sd sigma, or with probability `share` `times` sigma; scalars, or k of both (k,).

    All methods take whitened residuals, (n_points, k) or (n_points, 1).
    """

    share: float | FloatArray
    times: float | FloatArray

    @cached_property
    def is_normal(self) -> bool:
        """Whether there is no tail."""
        return bool(np.all(np.asarray(self.share) == 0))

    @cached_property
    def fisher_information(self) -> FloatArray:
        """Fisher information about the mean, in units of 1 / sigma^2, (k,) or a number."""
        return np.asarray(np.vectorize(_fisher_information_of_tail, otypes=[np.float64])(self.share, self.times))

    def likeliest_sigma(
        self, whitened: FloatArray, n_points: int, *, floor: float = 0.0, start: FloatArray | None = None
    ) -> FloatArray:
        """Return the most likely sigma, (k,), by EM; `n_points` rows count, the others (lost readings) are 0."""
        if self.is_normal:
            rms = np.sqrt(np.einsum("ij,ij->j", whitened, whitened) / n_points)
            return np.asarray(np.maximum(rms, max(floor, LEAST_SCALE)))
        squares, sigma = whitened**2, start
        if sigma is None:  # from the interquartile range of the readings not lost, which is robust to the tail
            middle = len(whitened) - n_points // 2 - 1
            median = np.partition(np.abs(whitened), middle, axis=0)[middle]
            sigma = np.maximum(median / MAD_OF_NORMAL, floor) + LEAST_SCALE
        for _ in range(_EM_STEPS if start is None else 3):
            weighed = self._relative_precisions(squares / sigma**2) * squares
            sigma = np.maximum(np.sqrt(weighed.sum(axis=0) / n_points), floor) + LEAST_SCALE
        return np.asarray(sigma)

    def minus_log_likelihood(self, whitened: FloatArray, sigma: FloatArray, n_points: int) -> FloatArray:
        """Return minus the log likelihood of `n_points` readings at sigma (k,), without n/2 log 2 pi: (k,)."""
        if self.is_normal:
            return np.asarray(n_points * np.log(sigma) + 0.5 * np.einsum("ij,ij->j", whitened, whitened) / sigma**2)
        squares = (whitened / sigma) ** 2
        log_density = -0.5 * squares + np.logaddexp(0.0, self._log_odds_of_wide(squares))
        at_zero = np.logaddexp(0.0, self._log_odds_of_wide(np.zeros((1, 1))))[0]
        of_kept = log_density.sum(axis=0) - (len(whitened) - n_points) * at_zero
        return np.asarray(n_points * (np.log(sigma) - np.log1p(-self.share)) - of_kept)

    def normal_pseudo_residuals(self, whitened: FloatArray, sigma: FloatArray) -> FloatArray:
        """Convert residuals to equally informative normal ones, of sd sigma / sqrt(information) and the same shape.

        Each is the score of the density over its Fisher information; outlying residuals have little weight (Huber 1981,
        section 6.7).
        """
        if self.is_normal:
            return whitened
        return np.asarray(whitened * self._relative_precisions((whitened / sigma) ** 2) / self.fisher_information)

    def log_sigma_curvature(self, whitened: FloatArray, sigma: FloatArray, n_points: int) -> FloatArray:
        """Return minus the second derivative of the log likelihood by log sigma at its peak, (k,).

        `sigma` must be the likeliest one; the result is at least 0.2 per reading.
        """
        squares = (whitened / sigma) ** 2
        wide = self.wide_probability(squares)
        less = (1 - np.asarray(self.times) ** -2) ** 2 * np.sum(squares**2 * wide * (1 - wide), axis=0)
        return np.asarray(np.maximum(2.0 * n_points - less, 0.2 * n_points))

    def wide_probability(self, squares: FloatArray) -> FloatArray:
        """Return the probability that a residual is from the wide component, from its square over sigma^2."""
        return np.asarray(expit(self._log_odds_of_wide(squares)))

    def _log_odds_of_wide(self, squares: FloatArray) -> FloatArray:
        share, times = np.asarray(self.share), np.asarray(self.times)
        return np.asarray(np.log(share / (1 - share) / times) + 0.5 * (1 - times**-2) * squares)

    def _relative_precisions(self, squares: FloatArray) -> FloatArray:
        return np.asarray(1 - (1 - np.asarray(self.times) ** -2) * self.wide_probability(squares))


def stacked_density(laws: Sequence[NoiseLaw]) -> Tail | RoundedNormal:
    """Return one density for the k distributions that whiten alike, all with a tail or all rounded.

    Its parameters are (k,).
    """
    if any(law.wide.size for law in laws):  # which readings are wide is in their sds
        return Tail(0.0, 1.0)
    pairs = [(law.flat, law.sigma) if laws[0].flat else (law.share, law.times) for law in laws]
    first, second = pairs[0] if len(laws) == 1 else np.array(pairs).T
    return RoundedNormal(first, second, laws[0].sd_beside_rounding) if laws[0].flat else Tail(first, second)


@lru_cache(maxsize=256)
def _fisher_information_of_tail(share: float, times: float) -> float:
    if share == 0:
        return 1.0
    # The integrand extends as far as the wide component.
    z = np.linspace(-6 * times, 6 * times, 4001)
    narrow = (1 - share) * np.exp(-0.5 * z * z)
    wide = share / times * np.exp(-0.5 * (z / times) ** 2)
    score = z * (narrow + wide / times**2) / (narrow + wide)
    return float(np.sum(score**2 * (narrow + wide)) * (z[1] - z[0]) / math.sqrt(2 * math.pi))


def white_noise(n_points: int, *, least: float = 0.0) -> NoiseLaw:
    """Return white noise of `n_points` readings; `least` is the smallest conditional sd, as in `NoiseLaw`."""
    return NoiseLaw(np.ones(n_points), np.zeros(n_points), np.zeros(n_points, dtype=np.bool_), least=least)


def white_noise_of_recording(recording: Recording, *, least: float = 0.0) -> NoiseLaw:
    """Return independent noise of a recording's usable readings, with its declared relative sds."""
    usable, censored = recording.usable, recording.censored
    return replace(
        white_noise(int(usable.sum()), least=least),
        sd=recording.relative_sd[usable],
        censored=censored[usable] if censored.any() else np.zeros(0, dtype=np.bool_),
    )


def noise_statistics(
    residuals: FloatArray, steps: IntArray, level: FloatArray, *, before: IntArray | None = None
) -> FloatArray:
    """Return statistics that vanish for white normal noise.

    `residuals`: whitened residuals, shape (n_points, n_draws); `steps`: rows back to the previous reading of the scan,
    0 for none, shape (n_points,); `level`: predicted readings, shape (n_points,); `before`: number of the previous
    reading of the scan, shape (n_points,); None where it is the one above. Returns lag-1 autocorrelation, excess
    kurtosis, and projection of the squares on the level, (3, n_draws).
    """
    r = residuals / np.sqrt(np.maximum(np.mean(residuals**2, axis=0), 1e-300))
    neighbours = np.flatnonzero(steps == 1)
    above = neighbours - 1 if before is None else before[neighbours]
    lag_1 = (r[neighbours] * r[above]).mean(axis=0) if neighbours.size else np.zeros(r.shape[1])
    kurtosis = (r**4).mean(axis=0) - 3
    tilt = level - level.mean()
    tilt = tilt / max(float(np.linalg.norm(tilt)), 1e-300)
    return np.stack([lag_1, kurtosis, tilt @ (r**2)])
