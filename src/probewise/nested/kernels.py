"""Independence Metropolis-Hastings with kernel density proposals, evaluated in batches (Hastings 1970; Tierney 1994).

A random walk needs one likelihood after another; for a robot that infers after every reading the overhead
per call exceeds the cost of the likelihood. Proposals that do not depend on a chain's position can be drawn
and evaluated in one batch, before the chain accepts or rejects them in turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.errors import ParameterError
from probewise.nested.evaluate import Bound, Evaluator, Points
from probewise.nested.moves import SliceMove, Tally

_BLOCK = 4096  # proposals evaluated at a time: their predictions stay in the cache
_DENSITY_BLOCK = 1024
_MOST_KERNELS = 100


@dataclass(frozen=True, eq=False)
class Kernels:
    """A kernel density of Gaussians about points: half of the mass with sd `width`, half with a third of it.

    `centre_rows` are the points whitened by their `mean` and the Cholesky `root` of their covariance, (n_kernels,
    n_params); `width` is in that frame. The wide kernels lead to other modes and into corners without points, the
    narrow ones follow a thin or curved region.
    """

    mean: FloatArray
    root: FloatArray
    centre_rows: FloatArray
    width: float

    @classmethod
    def at_points(cls, points: FloatArray, *, rng: np.random.Generator) -> Kernels:
        """Place kernels at up to a hundred of the points, (n_points, n_params), whitened by the covariance of all."""
        n_points, n_params = points.shape
        mean = points.mean(axis=0)
        covariance = np.atleast_2d(np.cov(points, rowvar=False))
        scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        correlation = covariance / np.outer(scale, scale)
        root = scale[:, None] * np.linalg.cholesky(correlation + 1e-9 * np.eye(n_params))
        rows = rng.permutation(n_points)[:_MOST_KERNELS]
        centre_rows = np.linalg.solve(root, (points[rows] - mean).T).T
        # Silverman's rule: the optimal width for Gaussian points.
        return cls(mean, root, centre_rows, (4 / (n_params + 2) / len(rows)) ** (1 / (n_params + 4)))

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw points, (n, n_params)."""
        rows = rng.integers(len(self.centre_rows), size=n)
        width = np.where(rng.random(n) < 0.5, self.width, self.width / 3)
        white = self.centre_rows[rows] + width[:, None] * rng.standard_normal((n, self.root.shape[0]))
        return np.asarray(self.mean + white @ self.root.T)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Natural log of the density up to a constant, (n, n_params) -> (n,)."""
        white = np.linalg.solve(self.root, (points - self.mean).T).T / (math.sqrt(2) * self.width)
        blocks = np.array_split(white, max(1, -(-len(white) // _DENSITY_BLOCK)))
        return np.concatenate([self._log_density_of_block(block) for block in blocks])

    def _log_density_of_block(self, white: FloatArray) -> FloatArray:
        # Single precision (1e-5, enough for a proposal) halves the time of the exponentials.
        centres = (self.centre_rows / (math.sqrt(2) * self.width)).astype(np.float32)
        rows = white.astype(np.float32)
        square = (rows * rows).sum(axis=1)[:, None] + (centres * centres).sum(axis=1) - 2.0 * rows @ centres.T
        nearest = np.maximum(square.min(axis=1), 0.0)
        # Relative to the nearest kernel, so that far points do not underflow.
        wide = np.exp(nearest[:, None] - square)
        power = np.square(np.square(np.square(wide)))  # the ninth power is a kernel a third as wide
        power *= wide
        fall = nearest.astype(np.float64)
        narrow = power.sum(axis=1).astype(np.float64) * 3.0 ** len(self.mean)
        return np.asarray(np.log(wide.sum(axis=1).astype(np.float64) + narrow * np.exp(-8.0 * fall)) - fall)


@dataclass(frozen=True)
class KernelMove:
    """A move that draws above a bound by independent proposals from kernels about the live points.

    Every chain starts at a live point and accepts or rejects its proposals in turn (independence Metropolis-Hastings;
    Tierney 1994), so the prior above the bound is left invariant; with `moves` accepted on average it forgets its
    start. Suited to few parameters, where many proposals lie above the bound. Where fewer than one in `patience` is
    accepted, the chains of `otherwise` go on from the ends.

    Parameters
    ----------
    moves
        Target number of accepted proposals per chain, on average. A chain with none stays at its start, which is valid;
        about exp(-moves) of the chains do.
    n_proposals
        Number of proposals per chain, tuned to that target.
    patience
        Largest number of proposals per acceptance.
    otherwise
        The move used where kernels are inefficient.
    """

    moves: float = 10.0
    n_proposals: int = 16
    patience: float = 60.0
    otherwise: SliceMove = field(default_factory=SliceMove)

    def __post_init__(self) -> None:
        if not self.moves > 0:
            raise ParameterError("moves", self.moves, "greater than 0")
        if not self.n_proposals >= 1:
            raise ParameterError("n_proposals", self.n_proposals, "1 or more")
        if not self.patience >= 1:
            raise ParameterError("patience", self.patience, "1 or more")

    def draw(
        self, start: Points, bound: Bound, live: FloatArray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        """Return the ends of one chain from each start, and the tally; see `Move`."""
        n_chains = len(start)
        space = evaluate.space
        kernels = Kernels.at_points(live, rng=rng)
        n_tries = n_chains * self.n_proposals
        u = kernels.draw(n_tries, rng=rng)
        log_target = -kernels.log_density(u)
        inside = np.flatnonzero(((u >= space.low) & (u <= space.high)).all(axis=1))
        admitted = np.zeros(n_tries, dtype=bool)
        parts = [evaluate(u[rows], rng) for rows in np.array_split(inside, max(1, -(-inside.size // _BLOCK)))]
        tried = Points.join(*parts)
        log_target[inside] += tried.log_density
        admitted[inside] = bound.mask_above(tried.log_likelihood, tried.label)
        log_odds = np.log(rng.random((self.n_proposals, n_chains)))
        last = _accept_in_turn(admitted, log_target, start.log_density - kernels.log_density(start.u), log_odds)
        where = np.empty(n_tries, dtype=np.int64)
        where[inside] = np.arange(inside.size)
        moved = last.index >= 0
        ends = start.copy()
        ends.overwrite_rows(moved, tried, where[last.index[moved]])
        tally = Tally(inside.size, last.n_accepted)
        if last.n_accepted * self.patience < n_tries:
            ends, more = self.otherwise.draw(ends, bound, live, evaluate, rng)
            tally = Tally(inside.size + more.n_evaluated, last.n_accepted, more.n_stuck)
        return ends, tally

    def adapted(self, tally: Tally) -> KernelMove:
        """Return the move with its number of proposals adapted towards `moves` accepted ones."""
        share = max(tally.n_accepted, 1) / max(tally.n_evaluated, 1)
        wanted = min(self.moves / share, 2.0 * self.n_proposals, 2.0 * self.patience)
        return replace(self, n_proposals=max(8, math.ceil(wanted)))


@dataclass(frozen=True, eq=False)
class _LastAcceptedProposals:
    """Index of the proposal each chain accepted last, -1 for none, (n_chains,), and the number of acceptances."""

    index: IntArray
    n_accepted: int


def _accept_in_turn(
    possible: BoolArray, log_target: FloatArray, log_now: FloatArray, log_odds: FloatArray
) -> _LastAcceptedProposals:
    """Let every chain accept or reject its proposals in turn; return the last one that each accepted.

    Metropolis-Hastings with independent proposals. `possible`, whether each proposal lies above the bound, and
    `log_target`, the log of target over proposal density, are (n_steps * n_chains,), steps first; `log_now` is that log
    at the starts, (n_chains,). `log_odds`: logs of uniform numbers, (n_steps, n_chains).
    """
    n_steps, n_chains = log_odds.shape
    log_target = np.where(possible, log_target, -np.inf).reshape(n_steps, n_chains)
    now, index, n_accepted = log_now.copy(), np.full(n_chains, -1), 0
    for k in range(n_steps):
        accept = log_odds[k] < log_target[k] - now
        now[accept] = log_target[k][accept]
        index[accept] = k * n_chains + np.flatnonzero(accept)
        n_accepted += int(accept.sum())
    return _LastAcceptedProposals(index, n_accepted)
