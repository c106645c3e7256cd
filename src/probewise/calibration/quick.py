"""The quick way to evidence and posterior of each order: from a density near the posterior instead of the prior.

Evidence and posterior depend only on the product of prior and likelihood, so any density may take the prior's place if
the likelihood makes up for it (Chen, Hobson, Das & Gelderblom 2019). Readings determine place and size of the whole
footprint and the levels to a few percent, whatever its form, and the peaks of the likelihood show where. So here these
seven numbers lie about the peaks, in a wide Student-t; all else is as in the prior. Nested sampling starts from this
density, and its errors hold. Where the readings need all Gaussians, importance sampling about the peaks suffices.

Orders are fitted upwards until the evidence has clearly fallen. A search of the whole prior with few live points then
vouches for the order that is chosen.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.calibration.paper import OrderPosterior, ProblemsByOrder, Progress, Search
from probewise.calibration.peaks import (
    MOST_RELABELLED,
    climb,
    distinct_peaks,
    laplace,
    starts_of_climbs,
    weigh_draws_about_peaks,
)
from probewise.calibration.priors import SSFPrior, view_by_kind_and_gaussian
from probewise.errors import DoubtfulResultWarning
from probewise.inference import SensorProblem
from probewise.nested import NestedResult, Samplable, Weighted, least_live, run
from probewise.nested.importance import Repartitioned
from probewise.nested.weights import student_t_draws, student_t_log_norm
from probewise.priors import Uniform

# With fewer the posterior may lie along the bounds of the prior, far from any peak; and a search costs little.
_LEAST_READINGS = 80
_LOWER = 12.0  # ln L below the highest peak, up to which peaks shape the density
_LEAST_EFFECTIVE, _GAINED = 200, 3.0  # draws about peaks, and nats over the orders below, from which they suffice
_DEGREES_OF_FREEDOM, _WIDENED = 4.0, 2.0
_N_LIVE = 200
# The evidence has clearly fallen by so many errors and nats, unless the next order's peak is higher by much.
_N_ERRORS, _FALLEN, _MUCH_HIGHER = 3.0, 2.0, 10.0
# The search that vouches: live points; it disagrees beyond so many errors, one false alarm in 30,000, or where many of
# its samples have weights above all others.
_VOUCHING_LIVE, _VOUCHING_PER_PARAM, _DISAGREE = 50, 4, 4.0
_N_VOUCHING, _MISSED, _HIGHER = 300, 0.2, 2.0
_WHOLE = np.r_[1:6, -2, -1]  # columns of place and size of the whole footprint and levels
# Times as wide as the footprint as a Gaussian that counts half; and least share of the variances' product that is real.
_TAPER, _LEAST = 3.0, 1e-12
_UNIT = np.array([[1.0], [1.0], [0.0]])


@dataclass(frozen=True)
class WholeFootprintCoordinates:
    """`MomentCoordinates`, with the whole's centre, log variances and correlation in place of the first Gaussian's.

    The readings do not depend on light far out. So a Gaussian that is k times as wide, or as far out, as the footprint
    (`size_mm2`) counts with 1 / (1 + (k / 3)^4) of its light.

    `centre_mm`: approximate centre of the footprint, (x', y'); `size_mm2`: approximate trace of its covariance.
    """

    prior: SSFPrior
    centre_mm: tuple[float, float]
    size_mm2: float

    @classmethod
    def about(cls, prior: SSFPrior, one: FloatArray) -> WholeFootprintCoordinates:
        """Take centre and size from the parameters of an SSF of one Gaussian, (8,)."""
        _, u, v, a, b, c = one[:6]
        return cls(prior, (float(u), float(v)), float(0.5 * (a + b) / (a * b - c * c)))

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters to coordinates, both (n, 6 N + 2)."""
        x = self.prior.coordinates.enter(theta)
        g = view_by_kind_and_gaussian(x)
        ratio = np.exp(g[0, 1:])
        g[1:3, 0] += (ratio * (g[1:3, :1] - g[1:3, 1:])).sum(axis=1)
        mean, first = self._centre_contribution_of_others_and_first_share(g)
        covariance = _covariance_from_logs(g[3:6, 0])
        whole_mean = mean + first * g[1:3, 0]
        off = g[1:3, 0] - whole_mean
        others = self._covariance_contribution_of_others(g, whole_mean)
        whole = first * (covariance + _squares_and_product(off)) + others
        g[1:3, 0] = whole_mean
        g[3:6, 0] = _logs_from_covariance(whole)
        return x

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters, (n, 6 N + 2); also return the log prior density in the coordinates, (n,).

        It is -inf where the Gaussians are not sorted, or no parameters have these coordinates.
        """
        y = x.copy()
        g = view_by_kind_and_gaussian(y)
        # Sorted by mass; a clipped ratio must not pass for one that is.
        sorted_by_mass = (g[0, 1:2] <= 0.0).all(axis=0) & (g[0, 2:] <= g[0, 1:-1]).all(axis=0)
        g[0, 1:] = g[0, 1:].clip(-100.0, 0.0)
        g[3:5] = g[3:5].clip(-100.0, 100.0)
        ratio = np.exp(g[0, 1:])
        mean, first = self._centre_contribution_of_others_and_first_share(g)
        whole_mean, whole = g[1:3, 0].copy(), _covariance_from_logs(g[3:6, 0])
        # An extreme correlation is one in its last digit.
        real = _positive_definite_mask(whole)
        whole[:, ~real] = _UNIT
        g[1:3, 0] = (whole_mean - mean) / first
        off = g[1:3, 0] - whole_mean
        own = (whole - self._covariance_contribution_of_others(g, whole_mean)) / first - _squares_and_product(off)
        real &= _positive_definite_mask(own)
        own[:, ~real] = _UNIT
        g[3:6, 0] = _logs_from_covariance(own)
        heaviest = 1.0 / (1.0 + ratio.sum(axis=0))
        g[1:3, 0] = heaviest * (g[1:3, 0] + (ratio * g[1:3, 1:]).sum(axis=1))
        theta, log_density = self.prior.coordinates.leave(y)
        log_density += 2.0 * np.log(heaviest) - 5.0 * np.log(first) + _log_volume_ratio(whole) - _log_volume_ratio(own)
        real &= sorted_by_mass & np.isfinite(log_density)
        return theta, np.where(real, log_density, -np.inf)

    def _tapered_light_shares(self, g: FloatArray) -> FloatArray:
        """Share of the light of each Gaussian but the first, reduced for wide or distant Gaussians, (N - 1, n)."""
        x, y = self.centre_mm
        variance = np.exp(g[3:5, 1:].clip(-100.0, 100.0))
        reach = ((g[1, 1:] - x) ** 2 + (g[2, 1:] - y) ** 2 + variance[0] + variance[1]) / self.size_mm2
        light = np.exp(g[0, 1:]) / (1.0 + (reach / _TAPER**2) ** 2)
        return np.asarray(light / (1.0 + light.sum(axis=0)))

    def _centre_contribution_of_others_and_first_share(self, g: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the sum over all but the first of centre times tapered share, (2, n); and the first's share, (n,)."""
        light = self._tapered_light_shares(g)
        return (light * g[1:3, 1:]).sum(axis=1), 1.0 - light.sum(axis=0)

    def _covariance_contribution_of_others(self, g: FloatArray, mean: FloatArray) -> FloatArray:
        """Return the contribution of all but the first to the covariance of the whole: xx, yy, xy, (3, n)."""
        own = _covariance_from_logs(g[3:6, 1:]) + _squares_and_product(g[1:3, 1:] - mean[:, None])
        return np.asarray((self._tapered_light_shares(g) * own).sum(axis=1))


def _covariance_from_logs(logs: FloatArray) -> FloatArray:
    """Compute variances and covariance from log variances and arctanh of the correlation, (3, ...) -> (3, ...)."""
    variance = np.exp(logs[:2])
    return np.stack([*variance, np.tanh(logs[2]) * np.sqrt(variance[0] * variance[1])])


def _positive_definite_mask(covariance: FloatArray) -> BoolArray:
    """Return a mask of variances and covariance that are positive definite, (3, ...) -> (...)."""
    xx, yy, xy = covariance
    return np.asarray((xx > 0.0) & (yy > 0.0) & (xy**2 < (1.0 - _LEAST) * xx * yy))


def _logs_from_covariance(covariance: FloatArray) -> FloatArray:
    """Compute log variances and arctanh of the correlation, the inverse of `_covariance_from_logs`."""
    xx, yy, xy = covariance
    return np.stack([np.log(xx), np.log(yy), np.arctanh(xy / np.sqrt(xx * yy))])


def _squares_and_product(off: FloatArray) -> FloatArray:
    """Compute x^2, y^2 and x y, (2, ...) -> (3, ...)."""
    return np.stack([off[0] ** 2, off[1] ** 2, off[0] * off[1]])


def _log_volume_ratio(covariance: FloatArray) -> FloatArray:
    """Log of the volume ratio of `_covariance_from_logs`, up to a constant, (3, ...) -> (...)."""
    xx, yy, xy = covariance
    product = xx * yy
    return np.asarray(0.5 * np.log(product) + np.log(product - xy**2))


@dataclass(frozen=True, eq=False)
class _NearPosterior:
    """A prior near the posterior: a Student-t of place, size and levels about each peak; the rest as in the prior.

    `centres`: of the peaks in the columns `_WHOLE` of the coordinates `space`, (n_peaks, 7); `root`: of the scale
    matrix of all, (7, 7).
    """

    prior: SSFPrior
    space: WholeFootprintCoordinates
    centres: FloatArray
    root: FloatArray

    @property
    def names(self) -> tuple[str, ...]:
        return self.prior.names

    @property
    def coordinates(self) -> _NearPosterior:
        return self

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        return self.prior.from_unit_cube(u)  # of the prior; samplers use `draw`

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw coordinates, (n, 6 N + 2); some match no possible parameters."""
        n_gaussians = self.prior.n_gaussians
        x = np.empty((n, len(self.names)))
        both = x, self.prior.from_unit_cube(rng.random(x.shape))
        g, drawn = map(view_by_kind_and_gaussian, both)
        det = drawn[3] * drawn[4] - drawn[5] ** 2
        g[1:3], g[3:5] = drawn[1:3], np.log(0.5 * drawn[4:2:-1] / det)
        g[5] = np.arctanh(-drawn[5] / np.sqrt(drawn[3] * drawn[4]))
        g[0, 0] = np.log(rng.random(n)) / n_gaussians
        g[0, 1:] = np.log(-np.sort(-rng.random((n_gaussians - 1, n)), axis=0))
        white = student_t_draws(n, 7, _DEGREES_OF_FREEDOM, rng=rng)
        x[:, _WHOLE] = self.centres[rng.integers(len(self.centres), size=n)] + white @ self.root.T
        return x

    @cached_property
    def _inverse_root(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.root))

    def log_density(self, x: FloatArray) -> FloatArray:
        """Natural log of the density in the coordinates, (n, 6 N + 2) -> (n,)."""
        nu, n_gaussians = _DEGREES_OF_FREEDOM, self.prior.n_gaussians
        white = (x[:, None, _WHOLE] - self.centres) @ self._inverse_root.T
        norm = student_t_log_norm(7, nu) - math.log(len(self.centres)) - float(np.log(np.diag(self.root)).sum())
        near = -0.5 * (nu + 7) * np.log1p(np.einsum("npk,npk->np", white, white) / nu)
        # The heaviest one's light is the greatest of N; those of the others are uniform below it, in falling order.
        g = view_by_kind_and_gaussian(x)
        rest = 1.0 - np.tanh(g[5, 1:]) ** 2
        each = g[0, 1:] + np.log(rest / (2 * self.prior.max_correlation))
        for place, log_variance in zip(g[1:3, 1:], g[3:5, 1:], strict=True):
            precision = 0.5 * np.exp(-log_variance) / rest
            each += self.prior.offset_mm.log_prob(place) + self.prior.precision.log_prob(precision) + np.log(precision)
        light = n_gaussians * g[0, 0] + math.lgamma(n_gaussians + 1)
        return np.asarray(norm + np.logaddexp.reduce(near, axis=1) + light + each.sum(axis=0))

    def enter(self, theta: FloatArray) -> FloatArray:
        return self.space.enter(theta)

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters; also return the log density, -inf outside the prior's support."""
        theta, log_prior = self.space.leave(x)
        inside = np.isfinite(log_prior)
        log_density = np.full(len(x), -np.inf)
        log_density[inside] = self.log_density(x[inside])
        return theta, log_density

    def log_prior_ratio(self, theta: FloatArray) -> FloatArray:
        """Log of the original prior's density over this one's, (n, n_params) -> (n,)."""
        x = self.space.enter(theta)
        return self.space.leave(x)[1] - self.log_density(x)


def _nearby(problem: SensorProblem, alone: SensorProblem, one: FloatArray, peaks: FloatArray) -> Repartitioned:
    """Make the density of N Gaussians from the highest peak of one Gaussian, (8,), and the `peaks` of N."""
    prior = problem.prior
    assert isinstance(prior, SSFPrior)
    assert isinstance(alone.prior, SSFPrior)
    space = WholeFootprintCoordinates.about(prior, one)
    covariance = laplace(alone, replace(space, prior=alone.prior), one)[1][np.ix_(_WHOLE, _WHOLE)]
    centres = space.enter(peaks)[:, _WHOLE]
    off = centres - centres.mean(axis=0)
    root = np.linalg.cholesky(_WIDENED**2 * covariance + off.T @ off / len(off))
    return Repartitioned(problem, _NearPosterior(prior, space, centres, np.asarray(root)))


def _sample(nearby: Repartitioned, n_live: int, rng: np.random.Generator, progress: Progress | None) -> Weighted:
    """Estimate evidence and posterior by nested sampling from the density near the posterior."""
    found = _run_silently(nearby, n_live, rng, progress)
    rows = np.flatnonzero(found.log_weight > -math.inf)
    theta = found.theta[rows]
    return Weighted(
        found.names,
        theta,
        log_likelihood=found.log_likelihood[rows] - nearby.prior.log_prior_ratio(theta),
        log_weight=found.log_weight[rows],
        log_z=found.log_z,
        log_z_error=found.log_z_error,
        n_eff=found.n_eff,
        n_calls=found.n_calls,
        pareto_k=-math.inf,
        warnings=found.warnings,
    )


def _run_silently(problem: Samplable, n_live: int, rng: np.random.Generator, progress: Progress | None) -> NestedResult:
    report = None if progress is None else partial(progress, len(problem.prior.names) // 6)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)  # they are in the result
        return run(problem, rng=rng, n_live=n_live, progress=report, max_cost=1.0)


def fit_orders_quickly(
    problems: ProblemsByOrder,
    orders: Sequence[int],
    *,
    search: Search,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> tuple[dict[int, OrderPosterior], str]:
    """Fit the orders upwards until the evidence has clearly fallen; `search` fits what is doubtful.

    Return the posteriors by order, and a note: which orders were left out, or why none is here and all must be searched
    in full.
    """
    n_usable = int(problems.recording.usable.sum())
    if n_usable < _LEAST_READINGS:
        return {}, f"searched in full: {n_usable} usable readings, fewer than {_LEAST_READINGS}"
    priors = [problems.prior_of(n) for n in range(1, max(orders) + 1)]
    if any(prior.unit_mass_mm2 is None or prior.amplitude != Uniform(0.0, 1.0) for prior in priors):
        return (
            {},
            "searched in full: the prior of a Gaussian's light is not uniform from 0",
        )  # as draws about peaks need
    alone = problems.problem(1)
    found: dict[int, Weighted] = {}
    log_weight_at: dict[int, Callable[[FloatArray], FloatArray]] = {}
    peaks, one = np.empty((0, 8)), np.empty(8)
    last, fallen, note = -math.inf, False, ""
    for n in range(1, max(orders) + 1):
        problem = problems.problem(n)
        ends, high = climb(problem, alone, starts_of_climbs(problem, peaks, rng))
        peaks, gain, last = ends[high > high[0] - _LOWER], float(high[0]) - last, float(high[0])
        one = peaks[0] if n == 1 else one
        if fallen and gain < _MUCH_HIGHER:
            left = sorted(m for m in orders if m >= n)
            which = f"order{'s' * (len(left) > 1)} {' and '.join(map(str, left))}"
            note = f"{which} not tried: the evidence has clearly fallen before" if left else ""
            break
        if n not in orders:
            continue
        best = max((made.log_z for made in found.values()), default=-math.inf)
        if n <= MOST_RELABELLED:
            found[n], log_weight_at[n] = weigh_draws_about_peaks(problem, distinct_peaks(problem, peaks), rng=rng)
        # Where a Gaussian more gains little, most of the posterior is far from the peaks: there it is faint.
        made = found.get(n)
        if made is None or not (made.sound and made.n_eff > _LEAST_EFFECTIVE and made.log_z > best + _GAINED):
            nearby = _nearby(problem, alone, one, peaks)
            found[n] = _sample(nearby, max(_N_LIVE, least_live(len(problem.prior.names))), rng, progress)
            log_weight_at[n] = nearby.log_likelihood
        fallen = best - found[n].log_z > max(_FALLEN, _N_ERRORS * found[n].log_z_error)
    posteriors = {n: OrderPosterior(made, None) for n, made in found.items()}
    vouched: set[int] = set()
    while (chosen := max(posteriors, key=lambda n: posteriors[n].evidence_result.log_z)) in found.keys() - vouched:
        vouched.add(chosen)
        why = _missed_part_in_words(problems.problem(chosen), found[chosen], log_weight_at[chosen], rng, progress)
        for n in [n for n in posteriors if why and n >= chosen]:
            found.pop(n, None)
            full = search(n, rng)
            words = f"order {n} was searched in full, since the quick way missed a peak of order {chosen}: {why}"
            posteriors[n] = replace(full, notes=(*full.notes, words))
    return posteriors, note


def _missed_part_in_words(
    problem: SensorProblem,
    made: Weighted,
    log_weight_at: Callable[[FloatArray], FloatArray],
    rng: np.random.Generator,
    progress: Progress | None,
) -> str:
    """Search the whole prior with few live points; describe in words what `made` missed, "" if nothing.

    Where the density that `made` was drawn from has left out a part, that part's samples outweigh all others.
    """
    seen = _run_silently(problem, max(_VOUCHING_LIVE, _VOUCHING_PER_PARAM * len(made.names)), rng, progress)
    if seen.log_z - made.log_z > _DISAGREE * math.hypot(seen.log_z_error, made.log_z_error):
        return (
            f"ln Z is {seen.log_z:.2f} ± {seen.log_z_error:.2f} by a search of the whole prior, "
            f"{made.log_z:.2f} ± {made.log_z_error:.2f} by the quick way"
        )
    highest = log_weight_at(made.theta).max()
    share = float((log_weight_at(seen.samples(_N_VOUCHING, rng=rng)) > highest + _HIGHER).mean())
    if share > _MISSED:
        return f"{share:.0%} of the samples of a search of the whole prior lie apart from those of the quick way"
    return ""
