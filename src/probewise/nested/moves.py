"""Draw new points uniformly from the part of the prior above a likelihood bound."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.nested.evaluate import Bound, Evaluator, Points

__all__ = ["Move", "PriorRejection", "SliceMove", "Tally"]


@dataclass(frozen=True)
class Tally:
    """Count what a move did: likelihood evaluations, accepted ones, chains that could not move."""

    n_evaluated: int
    n_accepted: int
    n_stuck: int = 0


class Move(Protocol):
    """Diversify inside the bound."""

    def draw(
        self, start: Points, bound: Bound, live: FloatArray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        """Return as many new points as `start` has, each distributed uniformly above `bound`.

        Parameters
        ----------
        start
            Points that satisfy the bound, where chains may begin.
        bound
            The level and label that new points must exceed.
        live
            All points known to satisfy the bound, in the unit cube, (n, n_params).
        evaluate
            The problem.
        rng
            Source of randomness.
        """
        ...

    def adapted(self, tally: Tally) -> Move:
        """Return the move to use next, tuned by what this one did."""
        ...


@dataclass(frozen=True)
class PriorRejection:
    """Draw from the whole prior until enough points lie above the bound: exact, and dear once the volume is small.

    `volume` is the share of the prior above the bound as far as known; it only sets the size of batches.
    """

    volume: float

    def draw(
        self, start: Points, bound: Bound, live: FloatArray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        """Return `len(start)` points; see `Move`."""
        wanted, found, parts, n_evaluated = len(start), 0, [], 0
        while found < wanted:
            batch = int(1.1 * (wanted - found) / self.volume) + 1
            tried = evaluate(rng.random((batch, live.shape[1])), rng)
            kept = tried.take(bound.admits(tried.log_likelihood, tried.label))
            parts.append(kept)
            found += len(kept)
            n_evaluated += batch
        return Points.join(*parts).take(slice(wanted)), Tally(n_evaluated, wanted)

    def adapted(self, tally: Tally) -> PriorRejection:
        """Return itself: nothing to tune."""
        return self


@dataclass(frozen=True)
class SliceMove:
    """Walk chains of slice-sampling steps (Neal 2003), all chains advancing together.

    A step draws a line through the chain's point, a bracket of fixed width placed at random about
    the point, and candidates within it; a refused candidate becomes the bracket's new end. The
    bracket is not stepped out: with a width that does not depend on the point the step is
    reversible without it (Neal's limit m = 1), and evaluations are saved. Each chain goes to its
    next step when its own bracket has delivered, so the batches stay full.

    Lines follow random orthogonal frames in the metric of the live points, so that n_params
    successive steps cover every direction; a share of them follows differences of two live
    points, which lead from one mode to another.

    Parameters
    ----------
    steps_per_param
        Steps of a chain for each parameter.
    width
        Bracket width in units of the live points' sd along the line.
    differences
        Share of the steps that follow differences of live points.
    target
        Candidates a step should need on average; the width is tuned to it.
    """

    steps_per_param: float = 2.0
    width: float = 5.0
    differences: float = 0.1
    target: float = 2.5

    def __post_init__(self) -> None:
        if not self.steps_per_param > 0:
            raise ParameterError("steps_per_param", self.steps_per_param, "greater than 0")
        if not 0 <= self.differences <= 1:
            raise ParameterError("differences", self.differences, "0 to 1")

    def draw(
        self, start: Points, bound: Bound, live: FloatArray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        """Return the ends of one chain from each start; see `Move`."""
        n_chains, n_params = start.u.shape
        n_steps = max(2, math.ceil(self.steps_per_param * n_params))
        lines = self._lines(n_chains, n_steps, live, rng)
        u, theta = start.u.copy(), start.theta.copy()
        log_likelihood, label = start.log_likelihood.copy(), start.label.copy()
        step = np.zeros(n_chains, dtype=np.int64)
        moved = np.zeros(n_chains, dtype=bool)
        active = np.arange(n_chains)
        low, high = np.empty(n_chains), np.empty(n_chains)
        low[:], high[:] = _bracket(u, lines[:, 0], rng)
        n_evaluated = n_accepted = 0
        while active.size:
            a, b = low[active], high[active]
            t = a + (b - a) * rng.random(active.size)
            line = lines[active, step[active]]
            tried = evaluate(np.clip(u[active] + t[:, None] * line, 0.0, 1.0), rng)
            n_evaluated += active.size
            ok = bound.admits(tried.log_likelihood, tried.label)
            high[active] = np.where(t > 0, t, b)
            low[active] = np.where(t > 0, a, t)
            taken = active[ok]
            u[taken], theta[taken] = tried.u[ok], tried.theta[ok]
            log_likelihood[taken], label[taken] = tried.log_likelihood[ok], tried.label[ok]
            moved[taken] = True
            n_accepted += taken.size
            # A bracket that has shrunk to nothing (a point alone on its line) ends the step where it began.
            done = active[ok | (high[active] - low[active] < 1e-13)]
            step[done] += 1
            if done.size:
                ended = step[done] >= n_steps
                if ended.any():
                    active = active[step[active] < n_steps]
                    done = done[~ended]
                low[done], high[done] = _bracket(u[done], lines[done, step[done]], rng)
        return Points(u, theta, log_likelihood, label), Tally(n_evaluated, n_accepted, int((~moved).sum()))

    def adapted(self, tally: Tally) -> SliceMove:
        """Widen or narrow the bracket towards `target` candidates a step."""
        excess = math.log(tally.n_evaluated / max(tally.n_accepted, 1) / self.target)
        return replace(self, width=min(max(self.width * math.exp(-0.5 * excess), 0.05), 20.0))

    def _lines(self, n_chains: int, n_steps: int, live: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Draw directions whose length is the bracket's width, (n_chains, n_steps, n_params)."""
        n_params = live.shape[1]
        n_frames = -(-n_steps // n_params)
        frames = np.linalg.qr(rng.standard_normal((n_chains * n_frames, n_params, n_params)))[0]
        frames = frames.reshape(n_chains, n_frames * n_params, n_params)[:, :n_steps]
        lines = np.asarray(frames @ _root_covariance(live).T) * self.width
        follow = rng.random((n_chains, n_steps)) < self.differences
        n_follow = int(follow.sum())
        if n_follow:
            first = rng.integers(len(live), size=n_follow)
            second = (first + rng.integers(1, len(live), size=n_follow)) % len(live)
            lines[follow] = 2.0 * (live[first] - live[second])
        return lines


def _root_covariance(live: FloatArray) -> FloatArray:
    """Cholesky root of the live points' covariance, (n_params, n_params)."""
    n_params = live.shape[1]
    covariance = np.atleast_2d(np.cov(live, rowvar=False))
    ridge = 1e-10 * np.diag(covariance) + 1e-30
    return np.linalg.cholesky(covariance + np.diag(ridge)) if n_params > 1 else np.sqrt(covariance + ridge)


def _bracket(u: FloatArray, line: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Place a bracket of length one at random about each point, cut where the line leaves the unit cube."""
    low = -rng.random(len(u))
    with np.errstate(divide="ignore", invalid="ignore"):
        to_zero, to_one = -u / line, (1.0 - u) / line
    entry = np.where(line == 0, -np.inf, np.minimum(to_zero, to_one)).max(axis=1)
    leave = np.where(line == 0, np.inf, np.maximum(to_zero, to_one)).min(axis=1)
    return np.maximum(low, entry), np.minimum(low + 1.0, leave)
