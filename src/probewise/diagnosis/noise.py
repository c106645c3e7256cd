"""The distribution of a recording's noise, and noise models: effects on the noise, discretised to nodes.

A wrong noise model causes false alarms, and a missed effect on the mean looks like correlated or heavy-tailed noise; so
the evidence of every hypothesis on the mean is computed under every noise model. `NoiseLaw` is one distribution, which
whitens residuals; the density of a whitened residual is `Tail`, a mixture of two normals, or `RoundedNormal`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.linalg.lapack import dpbtrf, dpttrf, dpttrs, dtbtrs
from scipy.special import expit

from probewise._arrays import LAST_DIGITS, ROUNDING, TINY, BoolArray, FloatArray, IntArray
from probewise.effects import NoiseEffect
from probewise.effects.noise import FAR, SD_FACTORS, lattice_step, sd_of_rounding
from probewise.effects.noise_distribution import FittedReadings, log_gaussian_mass_between
from probewise.inference import sd_of_numbers
from probewise.recordings.plan import Recording
from probewise.sensor.stages import NoiseParameters, effects_with_columns

MAD_OF_NORMAL = 0.6745  # median absolute deviation of a standard normal, by which a robust sd is estimated

SAME_SD = 0.03
"""Share by which two noise sds may differ and count as equal: weights that differ so little hardly move a fit."""

RUNS_AWAY = 1e100  # prediction or residual whose square overflows: it counts as impossible
LEAST_SCALE = 1e-150  # least sd, for readings that are exactly as predicted

_LOG_ROOT_2_PI = 0.5 * math.log(2 * math.pi)
_SLOWEST = 0.7  # of a step of EM, the share that the next one may be for its limit to be taken


@dataclass(frozen=True, eq=False)
class Tail:
    """A scale mixture of two normals: sd sigma, or with probability `share` `times` sigma; scalars, or k of both (k,).

    All methods take whitened residuals, (n_points, k) or (n_points, 1); `n_points` of them count, lost ones are 0.
    """

    share: float | FloatArray
    times: float | FloatArray

    @cached_property
    def is_normal(self) -> bool:
        """Whether there is no tail."""
        return not np.any(self.share)

    @cached_property
    def fisher_information(self) -> FloatArray:
        """Fisher information about the mean, in units of 1 / sigma^2, (k,) or a number."""
        return np.asarray(np.vectorize(_fisher_information_of_tail, otypes=[np.float64])(self.share, self.times))

    def likeliest_sigma(
        self, whitened: FloatArray, n_points: int, *, floor: float = 0.0, start: FloatArray | None = None
    ) -> FloatArray:
        """Return the most likely sigma, (k,): pairs of steps of EM, each followed to its limit (Aitken's method)."""
        if self.is_normal:
            rms = np.sqrt(np.einsum("ij,ij->j", whitened, whitened) / n_points)
            return np.asarray(np.maximum(rms, max(floor, LEAST_SCALE)))
        squares = whitened**2

        def improved(sigma: FloatArray) -> FloatArray:
            weighed = self._relative_precisions(squares / sigma**2) * squares
            return np.asarray(np.maximum(np.sqrt(weighed.sum(axis=0) / n_points), floor) + LEAST_SCALE)

        sigma = start
        if sigma is None:  # from the interquartile range of the readings not lost, which is robust to the tail
            middle = len(whitened) - n_points // 2 - 1
            median = np.partition(np.abs(whitened), middle, axis=0)[middle]
            sigma = improved(improved(np.maximum(median / MAD_OF_NORMAL, floor) + LEAST_SCALE))
        for _ in range(2 if start is None else 1):
            first = improved(sigma)
            second = improved(first)
            with np.errstate(all="ignore"):  # where nothing changes any more
                before, last = np.log(first / sigma), np.log(second / first)
                rate = np.clip(np.nan_to_num(last / before), 0.0, _SLOWEST)
            sigma = np.maximum(second * np.exp(last * rate / (1 - rate)), floor)
        return np.asarray(sigma)

    def minus_log_likelihood(self, whitened: FloatArray, sigma: FloatArray, n_points: int) -> FloatArray:
        """Return minus the log likelihood at sigma (k,), without n/2 log 2 pi: (k,)."""
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
        """Return minus the second derivative of the log likelihood by log sigma at its peak sigma, (k,), or a least."""
        squares = (whitened / sigma) ** 2
        wide = self.wide_probability(squares)
        less = self._log_odds_and_excess[1] ** 2 * np.sum(squares**2 * wide * (1 - wide), axis=0)
        return np.asarray(np.maximum(2.0 * n_points - less, 0.2 * n_points))

    def wide_probability(self, squares: FloatArray) -> FloatArray:
        """Return the probability that a residual is from the wide component, from its square over sigma^2."""
        return np.asarray(expit(self._log_odds_of_wide(squares)))

    @cached_property
    def _log_odds_and_excess(self) -> tuple[FloatArray, FloatArray]:
        """Log odds of a residual of 0 to be wide, and by how much less than a narrow one's its precision is."""
        share, times = np.asarray(self.share), np.asarray(self.times)
        return np.log(share / (1 - share) / times), 1 - times**-2.0

    def _log_odds_of_wide(self, squares: FloatArray) -> FloatArray:
        log_odds, excess = self._log_odds_and_excess
        return np.asarray(log_odds + 0.5 * excess * squares)

    def _relative_precisions(self, squares: FloatArray) -> FloatArray:
        return np.asarray(1 - self._log_odds_and_excess[1] * self.wide_probability(squares))


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


@dataclass(frozen=True, eq=False)
class RoundedNormal:
    """Normal noise of known sd `sigma` plus a uniform part of half width `half` sigma; scalars, or k of both (k,).

    A rounded reading means that the unrounded one was within half a step: the density has a flat top, within which a
    residual carries no information, and never exceeds one over the step. The methods are those of `Tail`.

    Readings of unequal declared sds have no such noise: there the floor of the sd stands for the rounding.
    """

    half: float | FloatArray
    sigma: float | FloatArray

    is_normal = False

    @cached_property
    def fisher_information(self) -> FloatArray:
        """As of `Tail`."""
        return np.asarray(np.vectorize(_fisher_information_of_rounded, otypes=[np.float64])(self.half))

    def likeliest_sigma(
        self, whitened: FloatArray, n_points: int, *, floor: float = 0.0, start: FloatArray | None = None
    ) -> FloatArray:
        """Return the known sigma, (k,)."""
        k = max(whitened.shape[1], np.size(self.sigma))
        return np.broadcast_to(np.asarray(self.sigma, dtype=np.float64), (k,)).copy()

    def minus_log_likelihood(self, whitened: FloatArray, sigma: FloatArray, n_points: int) -> FloatArray:
        """As of `Tail`."""
        half = np.asarray(self.half)
        density = _log_density_of_rounded(whitened / sigma, half) + _LOG_ROOT_2_PI
        at_zero = _log_density_of_rounded(np.zeros((1, 1)), half)[0] + _LOG_ROOT_2_PI
        of_kept = density.sum(axis=0) - (len(whitened) - n_points) * at_zero
        return np.asarray(n_points * np.log(sigma) - of_kept)

    def normal_pseudo_residuals(self, whitened: FloatArray, sigma: FloatArray) -> FloatArray:
        """As of `Tail`."""
        return np.asarray(sigma * _score(whitened / sigma, np.asarray(self.half)) / self.fisher_information)

    def log_sigma_curvature(self, whitened: FloatArray, sigma: FloatArray, n_points: int) -> FloatArray:
        """Return 2 pi, (k,): Laplace's integral over log sigma is then 1, since sigma is known."""
        return np.full(sigma.shape, 2 * math.pi)


def _log_density_of_rounded(x: FloatArray, half: FloatArray) -> FloatArray:
    away = np.abs(x)
    return np.asarray(log_gaussian_mass_between(-half - away, half - away) - np.log(2 * half))


def _score(x: FloatArray, half: FloatArray) -> FloatArray:
    log_mass = _log_density_of_rounded(x, half) + np.log(2 * half) + _LOG_ROOT_2_PI
    return np.asarray(np.exp(-0.5 * (x - half) ** 2 - log_mass) - np.exp(-0.5 * (x + half) ** 2 - log_mass))


@lru_cache(maxsize=64)
def _fisher_information_of_rounded(half: float) -> float:
    width, x = np.asarray(half), np.linspace(-half - 8, half + 8, 8001)[:, None]
    density = np.exp(_log_density_of_rounded(x, width))
    return float(np.sum(_score(x, width) ** 2 * density) * (x[1, 0] - x[0, 0]))


@dataclass(frozen=True, eq=False)
class NoiseLaw:
    """The joint distribution of all readings' noise, up to its overall sd; all arrays are (n_points,).

    Whitening, a linear map, makes residuals independent with one scale sigma; each is then normal, optionally with a
    heavy tail (`times` as wide with probability `share`) or rounded (flat-topped). Beside a random walk the tail is of
    each reading's own noise: given the probabilities of readings to be `wide`, which a fit's residuals tell
    (`with_known_wide_readings`), the noise is normal, with sds that include them.

    `sd`: sds relative to the overall one; `carry`: correlation with the previous reading, 0 for the first of a scan;
    `lost`: mask of lost readings, which carry no information; `share`, `times`: the heavy tail; `log_extra`: log
    probability of the lost readings; `flat`, `sigma`: rounding, without a tail: a uniform part of half width `flat`
    times a known sigma; `least`: least sd of a reading, given those before
    it; not used if sigma is known; `walk`: variance of the increments of a random walk of the offset from row to row,
    also between runs, relative to the overall variance; empty without one, and without another correlation with one;
    `before`: number of the reading with which each has the correlation `carry`, where that is not 0; empty: the reading
    above, unless the rows of scans are interleaved; `wide`: probability to be wide, where `sd` includes it; else empty;
    `censored`: mask of the readings at an end of the instrument's range; empty without one. The prediction there is
    limited to the end, so that the likelihood is 1 where the signal is beyond it. They do not count in the sd.
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

    @cached_property
    def kept(self) -> FloatArray:
        """1 where a reading is not lost, else 0, (n_points,)."""
        return np.where(self.lost, 0.0, 1.0)

    @property
    def is_censored(self) -> BoolArray:
        """Mask of the readings at an end of the instrument's range, (n_points,), also without one."""
        return self.censored if self.censored.size else np.zeros(len(self.sd), dtype=np.bool_)

    @property
    def _counted(self) -> BoolArray:
        return ~(self.lost | self.is_censored)

    @cached_property
    def n_kept(self) -> int:
        """Number of readings that are neither lost nor censored."""
        return int(self._counted.sum())

    @cached_property
    def whitening_key(self) -> tuple[bytes, ...]:
        """Key of the whitening: distributions with the same key differ only in tails or rounding."""
        arrays = self.sd, self.carry, self.lost, self.walk, self.before
        return tuple(values.tobytes() for values in arrays)

    def is_practically_equal(self, other: NoiseLaw) -> bool:
        """Return whether another one is equal, to 3 % of sd, .03 of correlation, 20 % of the walk's variance."""
        return (
            (self.share, self.times, self.flat, self.sigma) == (other.share, other.times, other.flat, other.sigma)
            and np.array_equal(self.lost, other.lost)
            and np.array_equal(self.before, other.before)
            and np.allclose(self.sd, other.sd, rtol=SAME_SD)
            and np.allclose(self.carry, other.carry, atol=0.03)
            and self.walk.shape == other.walk.shape
            and np.allclose(self.walk, other.walk, rtol=0.2)
        )

    @property
    def has_memory(self) -> bool:
        """Whether successive readings have some of their noise in common."""
        return bool(self.walk.size or np.any(self.carry))

    def take_readings(self, rows: BoolArray) -> NoiseLaw:
        """Return the distribution of the readings in a mask, (n_points,), whatever the others read."""
        # Along a chain of correlations that of two readings is the product of those in between.
        number, nearest, carry = np.cumsum(rows) - 1, np.full(len(rows), -1), np.zeros(len(rows))
        for k in np.flatnonzero(self.carry).tolist():  # a reading comes after the one before it
            above = self.before[k] if self.before.size else k - 1
            if rows[above]:
                nearest[k], carry[k] = number[above], self.carry[k]
            elif nearest[above] >= 0:
                nearest[k], carry[k] = nearest[above], self.carry[k] * carry[above]
        some = ("sd", "lost", "wide", "censored")
        taken = {name: own[rows] for name in some if (own := getattr(self, name)).size}
        return replace(
            self,
            carry=carry[rows],
            walk=np.diff(np.cumsum(self.walk)[rows], prepend=0.0) if self.walk.size else self.walk,
            before=np.maximum(nearest[rows], 0) if self.before.size else self.before,
            **taken,
        )

    def __call__(self, columns: FloatArray) -> FloatArray:
        """Whiten columns, shape (n_points,) or (n_points, n_columns); rows of lost readings become 0."""
        return self(columns[:, None])[:, 0] if columns.ndim == 1 else whiten_under_each([self], columns)[0]

    @cached_property
    def _own_and_before(self) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return the factors by which whitening without a walk takes each reading, and off it the one `before` it."""
        before = self.before if self.before.size else np.maximum(np.arange(len(self.sd)) - 1, 0)
        weight, free = self.kept / self.sd, np.sqrt(1 - self.carry**2)
        return weight / free, self.carry / free * weight[before], before

    def adjoint(self, columns: FloatArray) -> FloatArray:
        """Return the transpose of whitening applied to columns (n_points, k), of the same shape."""
        if self.walk.size:
            there = self.kept > 0
            solved, _ = dtbtrs(self._difference_covariance_root, columns[there], uplo="L", trans="T")
            solved[:-1] -= solved[1:]
            out = np.zeros(columns.shape)
            out[there] = solved
            return out
        own, off, before = self._own_and_before
        out = own[:, None] * columns
        np.subtract.at(out, before, off[:, None] * columns)
        return out

    @property
    def precision(self) -> list[tuple[IntArray | None, FloatArray]]:
        """Inverse covariance without a walk: its diagonal, and what is off it, if any, by the reading `before` each.

        Each part is (n_points,); None stands before the diagonal.
        """
        own, off, before = self._own_and_before
        diagonal = own**2 + np.bincount(before, off**2, minlength=len(own))
        return [(None, diagonal), *([(before, -own * off)] if np.any(off) else [])]

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
        root, failed = dpbtrf(bands, lower=1)  # scipy's own wrapper takes longer than the factor of a hundred rows
        if failed:
            raise np.linalg.LinAlgError("the covariance of a random walk is not definite")
        return np.asarray(root)

    def half_log_det(self) -> float:
        """Return half the log determinant of the relative covariance."""
        if self.walk.size:
            return float(np.log(self._difference_covariance_root[0]).sum())
        counted = self._counted
        return float(np.log(self.sd[counted]).sum() + 0.5 * np.log1p(-(self.carry[counted] ** 2)).sum())

    @cached_property
    def whitened_density(self) -> Tail | RoundedNormal:
        """Density of one whitened reading."""
        return stacked_density([self])

    @property
    def fisher_information(self) -> float:
        """Fisher information of one whitened reading about its mean, in units of 1 / sigma^2."""
        return float(self.whitened_density.fisher_information)

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

        On the steep flank of a flat-topped density the score over the Fisher information would exceed it.
        """
        normal = self.normal_pseudo_residuals(whitened, sigma)
        return np.clip(normal, -np.abs(whitened), np.abs(whitened)) if self.flat else normal

    def draw_pseudo_residuals(self, n_draws: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw pseudo-residuals of noise alone, in units of their sd, (n_points, n_draws); 0 for lost readings."""
        eps, density = rng.standard_normal((len(self.sd), n_draws)), self.whitened_density
        if not density.is_normal:
            eps *= np.where(rng.random(eps.shape) < self.share, self.times, 1.0)
            if isinstance(density, RoundedNormal):
                eps = np.asarray(eps + density.half * rng.uniform(-1.0, 1.0, eps.shape))
            eps = self.bounded_pseudo_residuals(eps, np.ones(n_draws)) * math.sqrt(self.fisher_information)
        return eps * self._counted[:, None]


def stacked_density(laws: Sequence[NoiseLaw]) -> Tail | RoundedNormal:
    """Return one density, with parameters (k,), for k distributions that whiten alike, all with a tail or all rounded.

    Which readings are wide beside a walk is in their sds.
    """
    if any(law.wide.size for law in laws):
        return Tail(0.0, 1.0)
    pairs = [(law.flat, law.sigma) if laws[0].flat else (law.share, law.times) for law in laws]
    first, second = pairs[0] if len(laws) == 1 else np.array(pairs).T
    return RoundedNormal(first, second) if laws[0].flat else Tail(first, second)


def whiten_under_each(laws: Sequence[NoiseLaw], columns: FloatArray) -> FloatArray:
    """Whiten columns (n_points, n_columns) under each of some distributions, (n_laws, n_points, n_columns).

    All of them have a random walk, or none has one. Rows of lost readings become 0.
    """
    kept = np.stack([law.kept for law in laws])
    if laws[0].walk.size:
        there = kept > 0
        own = columns if len(laws) == 1 else np.tile(columns, (len(laws), 1))
        own = own if there.all() else own[there.ravel()]
        # Differences of successive readings correlate only with their neighbours. Those under all distributions are
        # solved in one call: between their blocks the bands are 0.
        steps, first = np.array(own, dtype=np.float64, order="F"), np.cumsum(there.sum(axis=1))[:-1]
        steps[1:] -= own[:-1]
        steps[first] = own[first]
        roots = np.concatenate([law._difference_covariance_root for law in laws], axis=1)
        solved, _ = dtbtrs(roots, steps, uplo="L", overwrite_b=1)
        if there.all():
            return np.reshape(solved, (len(laws), *columns.shape))
        out = np.zeros((len(laws), *columns.shape))
        out[there] = solved
        return out
    y = columns * (kept / np.stack([law.sd for law in laws]))[:, :, None]
    carry = np.stack([law.carry for law in laws])[:, :, None]
    if np.any(carry):
        before = max((law.before for law in laws), key=len)
        if before.size:
            y -= carry * y[:, before]
        else:  # a view: an indexed copy of thousands of columns takes longer than the rest
            y[:, 1:] -= carry[:, 1:] * y[:, :-1]
        y /= np.sqrt(1 - carry**2)
    return np.asarray(y)


def white_noise(n_points: int, *, least: float = 0.0) -> NoiseLaw:
    """Return white noise of `n_points` readings; `least` is the smallest conditional sd, as in `NoiseLaw`."""
    return NoiseLaw(np.ones(n_points), np.zeros(n_points), np.zeros(n_points, dtype=np.bool_), least=least)


def white_noise_of_recording(recording: Recording, *, least: float = 0.0) -> NoiseLaw:
    """Return independent noise of the usable readings, of their declared relative sds; an sd is at least `least`."""
    usable, censored = recording.usable, recording.censored
    return replace(
        white_noise(int(usable.sum()), least=max(least, sd_of_numbers(recording))),
        sd=recording.relative_sd[usable],
        censored=censored[usable & censored.any()],
    )


def noise_statistics(residuals: FloatArray, previous: IntArray, level: FloatArray) -> FloatArray:
    """Return statistics that vanish for white normal noise.

    `residuals`: whitened residuals, (n_points, n_draws); `previous`: number of the reading in the row before of the
    scan, -1 if there is none, (n_points,); `level`: predicted readings, (n_points,). Returns lag-1 autocorrelation,
    excess kurtosis, and projection of the squares on the level, (3, n_draws).
    """
    r = residuals / np.sqrt(np.maximum(np.mean(residuals**2, axis=0), TINY))
    neighbours = np.flatnonzero(previous >= 0)
    above = previous[neighbours]
    lag_1 = (r[neighbours] * r[above]).mean(axis=0) if neighbours.size else np.zeros(r.shape[1])
    kurtosis = (r**4).mean(axis=0) - 3
    tilt = level - level.mean()
    tilt = tilt / max(float(np.linalg.norm(tilt)), TINY)
    return np.stack([lag_1, kurtosis, tilt @ (r**2)])


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
    return _smoothed_and_variance(_precision_bands_of_walk(law), law.kept / law.sd**2, residuals)[0]


def _precision_bands_of_walk(law: NoiseLaw) -> FloatArray:
    """Return the diagonal and the one below of a random walk's precision, in 1 / sigma^2, (2, n_points)."""
    steps = 1 / law.walk
    return np.stack([steps + np.append(steps[1:], 0.0), np.append(-steps[1:], 0.0)])


_ROUNDS = 20
_SAME = 0.01  # change of a reading's relative precision, and of sigma, at which the rounds end


def with_known_wide_readings(laws: Sequence[NoiseLaw], residuals: FloatArray) -> list[NoiseLaw]:
    """Return random walks' distributions with the tail on each reading's own noise, given the residuals of a fit.

    `laws`: noises with a walk and a tail (`share`, `times`); `residuals`: residuals of the fit, (n_points,). Returns
    Gaussian noises with the probability of each reading to be wide (`wide`), and sds that include it. `log_extra` is
    what the log density of these residuals, averaged over the sets of wide readings, exceeds that of this noise by.
    """
    if not np.abs(residuals).max() < RUNS_AWAY:  # of predictions that ran away: impossible in any case
        return [replace(law, wide=np.zeros(len(residuals))) for law in laws]
    out, going = list(laws), np.arange(len(laws))
    bands = np.stack([_precision_bands_of_walk(law) for law in laws])
    kept, own = np.stack([~law.lost for law in laws]), np.stack([law.sd**2 for law in laws])
    per_law = [(law.share, law.times**2, 1 - law.times**-2) for law in laws]
    share, wider, excess = (np.array(values)[:, None] for values in zip(*per_law, strict=True))
    floor = np.array([max(law.sigma_floor, LEAST_SCALE) for law in laws])
    sigma, precise = np.full(len(laws), math.inf), np.ones(own.shape)  # precision relative to that of a narrow reading
    for k in range(_ROUNDS):
        weight = kept * precise / own
        # Of all distributions at once: between their blocks the bands are 0.
        flat = np.concatenate(list(bands), axis=1), weight.ravel(), np.tile(residuals, len(own))
        smoothed, variance = (values.reshape(own.shape) for values in _smoothed_and_variance(*flat))
        unshared = np.maximum(1 - weight * variance, LAST_DIGITS)
        apart, beside = (residuals - smoothed) / unshared, variance / unshared  # from the walk as the others tell it
        last = sigma
        if k:
            squares = np.sum(weight * (residuals - smoothed) * residuals, axis=1)
            sigma = np.sqrt(np.maximum(squares, 0.0) / kept.sum(axis=1))
        else:  # whatever some outlying readings are
            sizes = np.abs(apart / np.sqrt(beside + own))
            sigma = np.array([np.median(a[b]) for a, b in zip(sizes, kept, strict=True)]) / MAD_OF_NORMAL
        sigma = np.maximum(np.maximum(sigma, floor), ROUNDING * np.abs(apart).max(axis=1))
        apart /= sigma[:, None]
        log_narrow = np.log1p(-share) + _log_normal_density(apart, beside + own)
        log_wide = np.log(share) + _log_normal_density(apart, beside + own * wider)
        wide, used = expit(log_wide - log_narrow), precise
        precise = 1 - excess * wide
        done = np.full(len(own), k == _ROUNDS - 1)
        if k:
            change = np.where(kept, np.abs(precise - used), 0.0).max(axis=1)
            done |= (change < _SAME) & (np.abs(sigma / last - 1) < _SAME)
        if done.any():
            more = np.logaddexp(log_narrow, log_wide) - _log_normal_density(apart, beside + own / used)
            for j in np.flatnonzero(done):
                law = laws[going[j]]
                out[going[j]] = replace(
                    law,
                    sd=np.sqrt(own[j] / used[j]),
                    wide=law.kept * (1 - used[j]) / excess[j],
                    log_extra=law.log_extra + float(np.sum(more[j][kept[j]])),
                )
            if done.all():
                break
            stay = ~done
            going, bands, kept, own, floor = going[stay], bands[stay], kept[stay], own[stay], floor[stay]
            share, wider, excess, sigma, precise = (a[stay] for a in (share, wider, excess, sigma, precise))
    return out


def _smoothed_and_variance(steps: FloatArray, weight: FloatArray, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the expected walk and its variance, in units of sigma^2, given all residuals `seen`: (n_points,) both.

    `steps` are the bands of the walk's precision, (2, n_points); `weight` the precisions of the readings, (n_points,).
    """
    diagonal, below = steps[0] + weight, steps[1, :-1]
    # The inverse's diagonal from the pivots of elimination forwards and backwards.
    forwards, lower, failed = dpttrf(diagonal, below)
    backwards, _, _ = dpttrf(diagonal[::-1], below[::-1])
    if failed:
        raise np.linalg.LinAlgError("the precision of a random walk is not definite")
    smoothed, _ = dpttrs(forwards, lower, weight * seen)
    return np.asarray(smoothed), np.asarray(1 / (forwards + backwards[::-1] - diagonal))


def _log_normal_density(apart: FloatArray, variance: FloatArray) -> FloatArray:
    return np.asarray(-0.5 * np.log(variance) - 0.5 * apart**2 / variance)


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
    """Return the number of rows of the scan back to its previous usable reading, 0 if there is none, (n_usable,).

    Neighbours of a missing reading are two steps apart. Rows of other scans in between do not count.
    """
    scan = recording.plan.scan
    place = np.empty(len(scan), dtype=np.int64)
    place[np.argsort(scan, kind="stable")] = np.arange(len(scan))
    own, before = place[recording.usable], previous_usable(recording)
    return np.where(before >= 0, own - own[before], 0).astype(np.int64)


_APART = 0.3  # initial spacing of nodes in the log of half a step over the noise sd
_WIDEST, _NARROWEST = -6, 9  # range of nodes: noise sds from 3 steps, or the residual rms, to a thirtieth of a step
_UNLIKELY = 15.0  # nats behind the best from which nodes of noise with rounding are dropped
HIDDEN = 0.6  # sd over step from which rounding is negligible (lattice sum 1 + 2 exp(-2 pi^2 0.36) = 1.0016)
_FINE = 0.01  # noise sds: tolerance of a lost reading's value without rounding
_AT_ONCE = 100_000  # readings of nodes whose wide readings are estimated together, to fit a processor's cache


@dataclass(frozen=True)
class SdPrior:
    """Prior of a reading's noise sd beside a given sensor: the sd at the calibration, or that times a factor.

    The log of the first is normal about `log_sd`, with sd `spread`. Of the second it has the density of the factor's
    prior (`SD_FACTORS`), also beyond its bounds: such an sd is not the calibration's either. `log_same`, `log_changed`
    are their log prior odds. By those of a diagnosis, noise that has not changed is called changed in one of 200,000
    recordings of 408 readings, and in one of 2,000 of 24, if the calibration had as many.

    `rounding` is the sd of the rounding to a coarse step, 0 if there is none. The calibration's readings may have been
    rounded as coarsely or not at all: an sd is as at the calibration with that rounding, without it and in between.
    """

    log_sd: float
    spread: float
    rounding: float = 0.0
    log_same: float = 0.0
    log_changed: float = -math.inf

    def log_odds(self, peak: FloatArray) -> FloatArray:
        """Return the log evidence of each relative to a flat prior of log sd, (2, n); `peak` is as in `NoiseEvidence`.

        Given readings, a precision has a gamma distribution, of which the cube root is nearly normal (Wilson & Hilferty
        1931).
        """
        log_sd, variance = peak
        highest = 0.5 * np.logaddexp(2 * self.log_sd, 2 * math.log(self.rounding)) if self.rounding else self.log_sd
        ratio = np.exp(log_sd - np.clip(log_sd, self.log_sd, highest))
        variance = (variance + ratio * self.spread**2) / 1.5**2  # of the root; of the prior's, between both sds
        same = -0.5 * (np.cbrt(ratio**2) - 1) ** 2 / variance - 0.5 * np.log(variance) - math.log(1.5) - _LOG_ROOT_2_PI
        changed = SD_FACTORS.log_prob(np.ones_like(same))  # of its log, which is as dense everywhere as the factor at 1
        return np.stack([self.log_same + same, self.log_changed + changed])

    def log_density(self, peak: FloatArray) -> FloatArray:
        """Return the log evidence of both together relative to a flat prior of log sd: (2, n) -> (n,)."""
        return np.asarray(np.logaddexp(*self.log_odds(peak)))


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
    is no other noise effect, or 0; `least_sd`: least plausible sd of a reading, given those before it; `sd_prior`:
    prior of a reading's sd, flat in its logarithm if None.
    """

    effects: tuple[NoiseEffect, ...]
    recording: Recording
    likely: Mapping[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    rounding: float = 0.0
    least_sd: float = 0.0
    sd_prior: SdPrior | None = None

    def columns_of_effect(self, name: str) -> slice:
        """Return the slice of one effect's parameters in the settings of nodes."""
        return {effect.name: own for effect, own in effects_with_columns(self.effects)}[name]

    def nodes_for_predictions(self, predicted: FloatArray) -> NoiseNodes:
        """Return the product grid of the effects' nodes, with the noise law and log weight at each.

        `predicted` are predictions of the usable rows, (n_usable,). With `rounding`, each node is a noise sd.
        """
        return self._nodes_about(predicted) if self._depends_on_fit else self._nodes_about_every_fit

    @cached_property
    def _nodes_about_every_fit(self) -> NoiseNodes:
        return self._nodes_about(self._readings)

    @cached_property
    def _depends_on_fit(self) -> bool:
        """Whether what a fit predicts changes the nodes or the distributions there."""
        if self.rounding or any(e.nodes_about is not None and e.name not in self.likely for e in self.effects):
            return True
        settings, _ = self._grid(self._readings)
        noise = self._parameters(settings, np.full((1, len(self.recording)), np.nan))
        return bool(np.isnan(noise.sd).any() or noise.lost_share.any() or (noise.walk.any() and noise.wide_share.any()))

    def _grid(self, predicted: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the settings of the parameters at all nodes about a fit, and their log weights."""
        residuals, sd = self._residuals_and_rough_sd(predicted)
        rows = FittedReadings(predicted, sd, self.recording.plan.scan[self.recording.usable], self._readings)
        settings, log_weights = np.zeros((1, 0)), np.zeros(1)
        for effect in self.effects:
            bank, log_each = self.likely.get(effect.name) or effect.weighed_nodes(residuals / sd, rows)
            every = [np.repeat(settings, len(bank), axis=0), np.tile(bank, (len(settings), 1))]
            settings = np.concatenate(every, axis=1)
            log_weights = (log_weights[:, None] + log_each).ravel()
        return settings, log_weights

    def _nodes_about(self, predicted: FloatArray) -> NoiseNodes:
        settings, log_weights = self._grid(predicted)
        laws = self.laws_at(settings, predicted)
        if self.rounding:
            # Sigma is integrated out numerically over its logarithm, as elsewhere in closed form.
            (law,) = laws
            half_step = 0.5 * self.rounding
            halves, log_weights = _sd_nodes_with_rounding(law(self._readings - predicted), half_step, law.n_kept)
            laws = tuple(replace(law, flat=x, sigma=half_step / x) for x in halves)
            settings = np.repeat(settings, len(laws), axis=0)
        return NoiseNodes(settings, laws, log_weights)

    def laws_at(self, settings: FloatArray, predicted: FloatArray) -> tuple[NoiseLaw, ...]:
        """Return the noise distributions at settings of the parameters, (n_nodes, n_params), without rounding.

        `predicted` are predictions of the usable rows, (n_usable,).
        """
        residuals, sd = self._residuals_and_rough_sd(predicted)
        span, seen = float(np.ptp(predicted)) or 1.0, np.zeros((1, len(self.recording)))
        seen[0, self.recording.usable] = np.clip((predicted - predicted.min()) / span, 0.0, 1.0)
        noise = self._parameters(settings, seen)
        far = np.abs(residuals) > FAR * sd
        names = "rho", "walk", "wide_share", "wide_times", "lost_share", "lost_value"
        each = (np.broadcast_to(getattr(noise, name)[:, 0], len(settings)).tolist() for name in names)
        sds = noise.sd if noise.sd.shape[1] == 1 else noise.sd[:, self.recording.usable]
        sds = np.broadcast_to(sds, (len(settings), len(far)))
        laws = tuple(self._law(far, *values) for values in zip(sds, *each, strict=True))
        if not (laws and laws[0].walk.size and laws[0].share):
            return laws
        left, at_once = self._readings - predicted, max(_AT_ONCE // len(predicted), 1)
        parts = [laws[k : k + at_once] for k in range(0, len(laws), at_once)]
        return tuple(law for part in parts for law in with_known_wide_readings(part, left))

    def _parameters(self, settings: FloatArray, seen: FloatArray) -> NoiseParameters:
        noise = NoiseParameters(sd=self.recording.relative_sd[None, :], rho=np.zeros((1, 1)), seen=seen)
        for effect, own in effects_with_columns(self.effects):
            noise = effect.apply(noise, settings[:, own], self.recording.plan)
        return noise

    def _residuals_and_rough_sd(self, predicted: FloatArray) -> tuple[FloatArray, float]:
        """Return the residuals over their declared relative sds, (n_usable,), and a robust estimate of their sd."""
        residuals = (self._readings - predicted) / self.recording.relative_sd[self.recording.usable]
        # Rounded readings can all be as predicted; rounding errors alone are not outliers.
        free = residuals[~self._censored] if self._censored.any() else residuals
        sd = max(float(np.median(np.abs(free))) / MAD_OF_NORMAL, sd_of_rounding(self._rounding_step))
        return residuals, sd or 1.0

    def _law(
        self,
        far: BoolArray,
        sd: FloatArray,
        rho: float,
        walk: float,
        share: float,
        times: float,
        lost_share: float,
        value: float,
    ) -> NoiseLaw:
        lost, log_extra = self._lost_readings(lost_share, value, far) if lost_share > 0 else (np.zeros_like(far), 0.0)
        carry, (n_rows, above, before) = np.zeros(len(far)), self._rows_before
        if rho:
            # The noise of a censored reading is not known: none is correlated with it.
            unknown = lost | self._censored
            alone = (n_rows == 0) | unknown | (above >= 0) & unknown[above]
            carry = np.where(alone, 0.0, rho ** np.maximum(n_rows, 1))
        return NoiseLaw(
            sd,
            carry,
            lost,
            share,
            times,
            log_extra,
            least=self._floor,
            walk=walk**2 * self._n_rows_since_previous if walk else np.zeros(0),
            before=before if rho else before[:0],
            censored=self._censored[: len(far) * self._censored.any()],
        )

    def _lost_readings(self, share: float, value: float, far: BoolArray) -> tuple[BoolArray, float]:
        """Return the mask of the readings lost to a value, (n_usable,), and their log probability."""
        span, resolution = self._span_and_resolution
        lost = far & (np.abs(self._readings - value) <= ROUNDING * span + 1e-14 * abs(value))
        n_lost, cells = int(lost.sum()), max(span / resolution, 1.0)
        # A lost reading has a density, 1 / cell; a censored one has a probability, so the cell cancels.
        log_extra = n_lost * math.log(share / resolution)
        log_extra += int((lost & self._censored).sum()) * math.log(resolution)
        log_extra += log_prior_of_lost_value(value, cells, self.recording.plan.instrumentation.declared_ends)
        return lost, log_extra + (len(lost) - n_lost) * math.log1p(-share)

    @cached_property
    def _readings(self) -> FloatArray:
        return self.recording.readings[self.recording.usable]

    @cached_property
    def _censored(self) -> BoolArray:
        return self.recording.censored[self.recording.usable]

    @cached_property
    def _floor(self) -> float:
        return max(self.least_sd, sd_of_numbers(self.recording))

    @cached_property
    def _rounding_step(self) -> float:
        return lattice_step(self._readings)

    @cached_property
    def _span_and_resolution(self) -> tuple[float, float]:
        """Span of the readings, and to what a lost reading's value is known."""
        return float(np.ptp(self._readings)), self._rounding_step or _FINE * rough_sd(self.recording) or LAST_DIGITS

    @cached_property
    def _rows_before(self) -> tuple[IntArray, IntArray, IntArray]:
        """Numbers of rows and of the reading before each in its scan, and that for `NoiseLaw`, empty if next above."""
        above = previous_usable(self.recording)
        interleaved = np.any((above >= 0) & (above != np.arange(len(above)) - 1))
        before = np.maximum(above, 0) if interleaved else above[:0]
        return n_rows_since_previous_usable(self.recording), above, before

    @cached_property
    def _n_rows_since_previous(self) -> FloatArray:
        """Number of rows back to the previous usable reading, even of another run, (n_usable,)."""
        return np.diff(np.flatnonzero(self.recording.usable), prepend=-1.0)


def log_prior_of_lost_value(value: float, cells: float, ends: Sequence[float]) -> float:
    """Return the log prior probability of the one value that lost readings have.

    Half is for the ends of the declared range, and half for any of `cells` possible values; without ends, all of it.
    """
    if not ends:
        return -math.log(cells)
    at_end = any(abs(value - end) <= ROUNDING * (max(ends) - min(ends) + abs(end)) for end in ends)
    return math.log(0.5 * at_end / len(ends) + 0.5 / cells)


def _sd_nodes_with_rounding(residuals: FloatArray, half_step: float, n_points: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes for the noise sd of rounded readings, as half steps per sd, and log weights, (n,) both.

    Nodes are coarse, and refined about the best to the accuracy of log sigma without rounding. They extend to the
    residual rms, in case the mean is incomplete.
    """

    def log_likelihood(halves: FloatArray) -> FloatArray:
        sigma = half_step / halves
        return -RoundedNormal(halves, sigma).minus_log_likelihood(residuals[:, None], sigma, n_points)

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


def rounding_that_hides_noise(recording: Recording, step: float, sd: float) -> float:
    """Return a rounding step that exceeds the noise sd so far that it shapes the noise, else 0: also of unequal sds."""
    relative_sd = recording.relative_sd[recording.usable]
    return step if sd < HIDDEN * step and np.all(relative_sd == relative_sd[:1]) else 0.0


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
