"""The quick way to evidence and posterior of each order, from the peaks of the likelihood.

Where the readings need all Gaussians, importance sampling about the peaks gives both within seconds. A Gaussian more
than that can be faint, anywhere; but readings determine the whole footprint's centre and the levels to a few percent,
whatever its form. Evidence and posterior depend only on the product of prior and likelihood, so any density may take
the prior's place if the likelihood makes up for it (Chen, Hobson, Das & Gelderblom 2019): there nested sampling starts
from a density with these four numbers about the peaks, and all else as in the prior.

Orders are fitted upwards until the evidence has clearly fallen. A search of the whole prior with few live points then
vouches for the order that is chosen.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from probewise._arrays import FloatArray
from probewise.calibration.paper import OrderPosterior, ProblemsByOrder, Progress, Search
from probewise.calibration.peaks import (
    MOST_RELABELLED,
    StudentTDensity,
    climb,
    laplace,
    starts_of_climbs,
    weigh_draws_about_peaks,
)
from probewise.calibration.priors import SSFPrior
from probewise.errors import DoubtfulResultWarning
from probewise.inference import SensorProblem
from probewise.nested import NestedResult, Samplable, Weighted, least_live, run
from probewise.nested.importance import Repartitioned, samples_of_run
from probewise.priors import Uniform

# With fewer the posterior may lie along the bounds of the prior, far from any peak; and a search costs little.
_LEAST_READINGS = 80
_LOWER = 12.0  # ln L below the highest peak, up to which peaks shape the density
_WIDENED = 2.0
_LEAST_EFFECTIVE, _GAINED = 200, 3.0  # draws about peaks, and nats over the orders below, from which they suffice
_N_LIVE = 200  # where they do not
_PLACE = np.r_[1:3, -2:0]  # columns of the whole's centre and of the levels
# The evidence has clearly fallen by so many errors and nats, unless the next order's peak is higher by much.
_N_ERRORS, _FALLEN, _MUCH_HIGHER = 3.0, 2.0, 10.0
# The search that vouches: live points; it disagrees beyond so many errors, one false alarm in 30,000, or where many of
# its samples have weights above all others.
_VOUCHING_LIVE, _VOUCHING_PER_PARAM, _DISAGREE = 50, 4, 4.0
_N_VOUCHING, _MISSED, _HIGHER = 300, 0.2, 2.0


@dataclass(frozen=True, eq=False)
class _NearPosterior:
    """A prior near the posterior: centre of the whole and levels from the density `place`; the rest as in the prior."""

    prior: SSFPrior
    place: StudentTDensity  # in the columns `_PLACE` of the prior's coordinates

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
        x = self.enter(self.prior.from_unit_cube(rng.random((n, len(self.names)))))
        x[:, _PLACE] = self.place.draw(n, rng)
        return x

    def enter(self, theta: FloatArray) -> FloatArray:
        return self.prior.coordinates.enter(theta)

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters; also return the log density, -inf outside the prior's support."""
        theta, log_prior = self.prior.coordinates.leave(x)
        inside = np.isfinite(log_prior)
        log_prior[inside] -= self._log_ratio(x[inside], theta[inside])
        return theta, log_prior

    def log_prior_ratio(self, theta: FloatArray) -> FloatArray:
        """Log of the original prior's density over this one's at parameters in the order of `leave`, (n,)."""
        return self._log_ratio(self.enter(theta), theta)

    def _log_ratio(self, x: FloatArray, theta: FloatArray) -> FloatArray:
        prior = self.prior
        log_place = prior.offset_mm.log_prob(theta[:, 1:3]).sum(axis=1) + prior.i_min.log_prob(theta[:, -2])
        log_place += prior.i_max.log_prob(theta[:, -1])
        # The centre of the whole moves by the first one's share of the light as far as the first one's does.
        log_place += 2.0 * np.log1p(np.exp(x[:, 6:-2:6]).sum(axis=1))
        return np.asarray(log_place - self.place.log_density(x[:, _PLACE]))


def _sample_near_peaks(
    problem: SensorProblem,
    alone: SensorProblem,
    one: FloatArray,
    peaks: FloatArray,
    rng: np.random.Generator,
    progress: Progress | None,
) -> tuple[Weighted, Callable[[FloatArray], FloatArray]]:
    """Sample an order by nested sampling from a density near its `peaks`, (n_peaks, 6 N + 2).

    The density is twice as wide as that about the peak of `one` Gaussian, (8,), and as the peaks scatter. Also return
    the log weight as a function of parameters, of which the heaviest Gaussian comes first.
    """
    prior = problem.prior
    assert isinstance(prior, SSFPrior)
    assert isinstance(alone.prior, SSFPrior)
    root = laplace(alone, alone.prior.coordinates, one).root
    centres = prior.coordinates.enter(peaks)[:, _PLACE]
    off = centres - centres.mean(axis=0)
    covariance = _WIDENED**2 * (root @ root.T)[np.ix_(_PLACE, _PLACE)] + off.T @ off / len(off)
    place = StudentTDensity(centres.mean(axis=0), np.asarray(np.linalg.cholesky(covariance)))
    near = Repartitioned(problem, _NearPosterior(prior, place))
    found = _run_silently(near, max(_N_LIVE, least_live(len(prior.names))), rng, progress)
    log_likelihood = found.log_likelihood - near.prior.log_prior_ratio(found.theta)
    return replace(samples_of_run(found), log_likelihood=log_likelihood, run=None), near.log_likelihood


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
        # As draws about peaks need.
        return {}, "searched in full: the prior of a Gaussian's light is not uniform from 0"
    alone = problems.problem(1)
    found: dict[int, OrderPosterior] = {}
    log_weight_at: dict[int, Callable[[FloatArray], FloatArray]] = {}
    peaks, one, last, fallen, note = np.empty((0, 8)), np.empty(8), -math.inf, False, ""
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
        best = max((each.evidence_result.log_z for each in found.values()), default=-math.inf)
        made, weigh = weigh_draws_about_peaks(problem, peaks, rng=rng)
        gains = made.log_z > best + _GAINED
        if gains and (n > MOST_RELABELLED or not made.sound or made.n_eff <= _LEAST_EFFECTIVE):
            found[n] = search(n, rng)
        else:
            # Where a Gaussian more gains little, most of the posterior is far from the peaks: there it is faint.
            made, weigh = (made, weigh) if gains else _sample_near_peaks(problem, alone, one, peaks, rng, progress)
            found[n], log_weight_at[n] = OrderPosterior(made, None), weigh
        now = found[n].evidence_result
        fallen = best - now.log_z > max(_FALLEN, _N_ERRORS * now.log_z_error)
    while (chosen := max(found, key=lambda n: found[n].evidence_result.log_z)) in log_weight_at:
        weigh, quickly = log_weight_at.pop(chosen), found[chosen].result
        n_live = max(_VOUCHING_LIVE, _VOUCHING_PER_PARAM * len(quickly.names))
        seen = _run_silently(problems.problem(chosen), n_live, rng, progress)
        why = _missed_part_in_words(quickly, weigh, seen, rng)
        for n in [n for n in found if why and n >= chosen]:
            log_weight_at.pop(n, None)
            full = search(n, rng)
            words = f"order {n} was searched in full, since the quick way missed a peak of order {chosen}: {why}"
            found[n] = replace(full, notes=(*full.notes, words))
    return found, note


def _missed_part_in_words(
    made: NestedResult | Weighted,
    log_weight_at: Callable[[FloatArray], FloatArray],
    seen: NestedResult,
    rng: np.random.Generator,
) -> str:
    """Describe what draws `made` missed that a search of the whole prior has `seen`; "" if nothing.

    Where the density of the draws has left out a part, that part's samples outweigh all others.
    """
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
