"""What a sampler is to the benchmark, and this project's own; the peers are in `peers.py`, never imported unasked."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module

import numpy as np
from scipy.special import logsumexp

from nested_sampling.problems import FloatArray, Known
from probewise.errors import DoubtfulResultWarning
from probewise.nested import KernelMove, Move, NestedResult, refine, run


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a sampler says of a problem.

    `theta` (n, n_params) with `log_weight` (n,), normalised or not. `doubts`: what the sampler itself says against its
    result. `n_live`: live points it ran with; None where its live points mean another thing. `compiling_s`: cpu time of
    a compiler, part of the run's.
    """

    log_z: float
    log_z_error: float
    n_evaluations: int
    theta: FloatArray
    log_weight: FloatArray
    n_live: int | None = None
    insertion_p_value: float | None = None
    doubts: tuple[str, ...] = ()
    compiling_s: float = 0.0

    @property
    def n_eff(self) -> float:
        """Kish's effective number of samples."""
        weight = self._weight
        return float(1 / (weight @ weight))

    @property
    def _weight(self) -> FloatArray:
        return np.exp(self.log_weight - logsumexp(self.log_weight))

    def samples(self, n: int, seed: int) -> FloatArray:
        """Draw equally weighted samples, (n, n_params), by systematic resampling."""
        rng = np.random.default_rng(seed)
        ladder = np.cumsum(self._weight)
        rows = np.searchsorted(ladder / ladder[-1], (np.arange(n) + rng.random()) / n, side="right")
        return self.theta[np.minimum(rows, len(ladder) - 1)]

    def mean(self, values: FloatArray) -> tuple[float, float]:
        """Posterior mean of a function given at every theta, (n,), and its sd."""
        weight = self._weight
        mean = float(weight @ values)
        return mean, math.sqrt(float(weight @ (values - mean) ** 2))


class Counted:
    """A problem whose evaluations are counted, also given point by point and from the unit cube."""

    def __init__(self, known: Known) -> None:
        self.known = known
        self.prior = known.prior
        self.n_params = known.n_params
        self.n_evaluations = 0

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Evaluate a batch, (n, n_params) -> (n,)."""
        self.n_evaluations += len(theta)
        return self.known.log_likelihood(theta)

    def batch(self, theta: FloatArray) -> FloatArray:
        """Evaluate a batch of any array type."""
        return self.log_likelihood(np.atleast_2d(np.asarray(theta, dtype=np.float64)))

    def single(self, theta: FloatArray) -> float:
        """Evaluate one point, (n_params,)."""
        return float(self.batch(theta)[0])

    def from_unit(self, u: FloatArray) -> FloatArray:
        """Map the unit cube to parameters, (n_params,) or (n, n_params)."""
        u = np.asarray(u, dtype=np.float64)
        return self.prior.from_unit_cube(u[None])[0] if u.ndim == 1 else self.prior.from_unit_cube(u)


Run = Callable[[Counted, int, "int | None"], Outcome]


@dataclass(frozen=True)
class Sampler:
    """A way to run a problem: `run(problem, seed, n_live)`; its libraries are imported before the clock starts."""

    libraries: tuple[str, ...]
    run: Run
    needs_traceable: bool = False


def ours_result(
    problem: Counted | Known, seed: int, n_live: int | None = None, move: Move | None = None
) -> NestedResult:
    """Run this project's sampler as its users do: every call of it in these benchmarks is here."""
    n_live = n_live or 300
    # A doubtful run is counted, not shouted about.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)
        return run(problem, rng=np.random.default_rng(seed), n_live=n_live, move=move, max_cost=1.0)


def ours(problem: Counted, seed: int, n_live: int | None = None) -> Outcome:
    """Run this project's sampler."""
    return outcome_of(ours_result(problem, seed, n_live), problem.n_evaluations)


def ours_refined(problem: Counted, seed: int, n_live: int | None = None) -> Outcome:
    """Run it and sharpen the result by importance sampling."""
    return _refined(problem, seed, n_live or 300, 10_000)


def ours_quick(problem: Counted, seed: int, n_live: int | None = None) -> Outcome:
    """Run it as for a robot that waits: few live points, proposals in one batch a round, 50 independent draws."""
    least = max(50, 2 * problem.n_params + 10)
    found = _refined(problem, seed, least, 1000, KernelMove(moves=5.0))
    return replace(found, theta=found.samples(50, seed), log_weight=np.zeros(50))


def _refined(problem: Counted, seed: int, n_live: int, n_draws: int, move: Move | None = None) -> Outcome:
    result = ours_result(problem, seed, max(n_live, 2 * problem.n_params + 10), move)
    sharp = refine(result, problem, rng=np.random.default_rng([seed, 1]), n_draws=n_draws)
    found = outcome_of(result, problem.n_evaluations)
    if not sharp.sound:
        return replace(found, doubts=(*found.doubts, f"not refined: Pareto k = {sharp.pareto_k:.2f}"))
    return replace(
        found, log_z=sharp.log_z, log_z_error=sharp.log_z_error, theta=sharp.theta, log_weight=sharp.log_weight
    )


def outcome_of(result: NestedResult, n_evaluations: int) -> Outcome:
    """Read a result of this project."""
    return Outcome(
        log_z=result.log_z,
        log_z_error=result.log_z_error,
        n_evaluations=n_evaluations,
        theta=result.theta,
        log_weight=result.log_weight,
        n_live=result.n_live,
        insertion_p_value=result.insertion_p_value,
        doubts=result.warnings,
    )


OURS: dict[str, Sampler] = {
    "ours": Sampler((), ours),
    "ours-refined": Sampler((), ours_refined),
    "ours-quick": Sampler((), ours_quick),
}
PEERS = (
    "dynesty",
    "dynesty-rslice",
    "dynesty-rwalk",
    "ultranest",
    "ultranest-pop",
    "nautilus",
    "nestle",
    "blackjax",
)
NAMES = (*OURS, *PEERS)


def sampler(name: str) -> Sampler:
    """Find a sampler by its name; the peers' adaptors are imported here.

    Raises
    ------
    ValueError
        If there is none of that name.
    """
    if name in OURS:
        return OURS[name]
    if name not in PEERS:
        raise ValueError(f"sampler is {name!r}; allowed: {', '.join(NAMES)}")
    found: Sampler = import_module("nested_sampling.peers").SAMPLERS[name]
    for library in found.libraries:
        import_module(library)
    return found
