"""Integrate a law by solving for all its steps at once, by Newton's method from a trajectory nearby.

A trajectory of a fixed-step method satisfies s[k + 1] = step(s[k]) for every k: a system of equations whose only
solution is what stepping gives. Its Jacobian is block bidiagonal, so an iteration is one evaluation of all steps
together and one banded triangular solve. Samples near a known trajectory share its Jacobian (chord iterations), the
others have their own; those that do not converge are left to be stepped.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.linalg.lapack import dtbtrs

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.systems.integrate import (
    evaluations_per_step,
    initial_states,
    integrate_states,
    n_parts_of_steps,
    states_by_step,
    step_in_part,
)
from probewise.systems.law import LawInputs, LawWithEffects, StepPart
from probewise.systems.simulator import Columns, Values
from probewise.systems.step import Steps

_CHORDS = 4  # iterations with the Jacobian of a known trajectory
_NEWTONS = 8  # iterations with a sample's own Jacobian
_HOPELESS = 4  # of these, after which a sample that still changes by a tenth is left to be stepped
_SLOW = 0.1  # change of a chord iteration, in that of the one before, from which a sample needs its own Jacobian
_CONVERGED = 1e-8  # largest change of a state by an iteration, in that state's largest value
_SETTLED = 1e-12  # and by the next
_NUDGE = 1e-7  # of each state's largest value, for the Jacobian
_FAR = 1e-3  # change from a known trajectory, in a state's largest value, from which another one is remembered
_MOST_NEW = 8  # trajectories remembered of one batch
_MOST_KNOWN = 48  # trajectories remembered
_REFUSALS = 3  # errors in a row of all steps together after which a law is only stepped; one may be of a sample far off
_WORTH_A_STEP = 350  # steps of one sample in one run, evaluated together, at the cost of a step of all of them
# Samples times runs up to which all steps at once cost less than one after another: near known trajectories, where two
# evaluations of all steps suffice, and far from them, where a dozen are needed.
_FEW_NEAR, _FEW_FAR = 300, 40

LawAndInputs = Callable[[IntArray], tuple[LawWithEffects, Values, Columns]]
"""Function of the numbers of some samples: their law with its effects, their parameters, and the columns."""


@dataclass(frozen=True, eq=False)
class KnownTrajectory:
    """A trajectory solved over some steps, with some effects.

    It has theta (n_params,), states (n_states, n_steps + 1, n_runs), and `bands`, its Jacobian, if known.
    """

    steps: Hashable
    effects: Hashable
    theta: FloatArray
    states: FloatArray
    bands: list[FloatArray] = field(default_factory=list)


@dataclass(eq=False)
class Integrations:
    """Memory of a law's integrations: counts, and solved trajectories, those of the last steps and effects last.

    An evaluation is one of the rates of all samples and runs together. `n_failed` samples raised an error; `n_refused`
    counts how often in a row the law raised one for all steps together, and none step by step. `cut_short` if work was
    skipped; `too_stiff` if parameters that may fit the readings would need more integration steps than are taken.
    """

    known: list[KnownTrajectory] = field(default_factory=list, repr=False)
    n_evaluations: int = 0
    n_failed: int = 0
    n_refused: int = 0
    cut_short: bool = False
    too_stiff: bool = False

    def known_and_nearest_indices(
        self, steps: Hashable, effects: Hashable, theta: FloatArray, n_own: int
    ) -> tuple[list[KnownTrajectory], IntArray]:
        """Return the cached trajectories of these steps and effects, and the index of the nearest to each sample.

        Samples are theta, (n_samples, n_params); the indices are (n_samples,). Without a trajectory of these effects,
        those of others are returned, compared by the first `n_own` parameters; without any, both results are empty.
        """
        every = [each for each in self.known if each.steps == steps]
        own, width = [each for each in every if each.effects == effects], theta.shape[1]
        if not own:
            own, width = every, n_own
        if not own:
            return [], np.zeros(0, dtype=np.int64)
        there = np.stack([each.theta[:width] for each in own])
        apart = (theta[:, None, :width] - there) / np.maximum(np.abs(there).max(axis=0), 1e-300)
        return own, np.argmin(np.einsum("skp,skp->sk", apart, apart), axis=1)

    def add(self, more: Sequence[KnownTrajectory]) -> None:
        """Add trajectories of the same steps and effects; beyond 48 in all, drop the first."""
        of = [(each.steps, each.effects) for each in more[:1]]
        others = [each for each in self.known if (each.steps, each.effects) not in of]
        again = [each for each in self.known if (each.steps, each.effects) in of]
        self.known = [*others, *again, *more][-_MOST_KNOWN:]


def integrate_from_known_trajectories(
    law_and_inputs: LawAndInputs,
    steps: Steps,
    memory: Integrations,
    *,
    effects: Hashable,
    theta: FloatArray,
    n_own: int,
) -> dict[str, FloatArray]:
    """Integrate a law for samples, theta (n_samples, n_params); return states at the rows, (n_samples, n_points) each.

    Up to 300 samples times runs are solved for all steps at once, from the trajectories in `memory` nearest to them;
    the others, and those for which that does not converge, step by step. More trajectories are added to the memory, and
    the evaluations that this takes. `effects` is what distinguishes the law with its effects from the same law with
    others; the first `n_own` parameters are the system's.
    """
    n_samples = len(theta)
    if n_samples * steps.n_runs > _FEW_NEAR or memory.n_refused >= _REFUSALS:
        motion, parameters, columns = law_and_inputs(np.arange(n_samples))
        memory.n_evaluations += n_parts_of_steps(motion, steps) * evaluations_per_step(motion, steps.method)
        return integrate_states(motion, steps, parameters, columns)
    states, left, cost = None, np.arange(n_samples), 0
    known, nearest = memory.known_and_nearest_indices(steps, effects, theta, n_own)
    refused = False
    if known:
        try:
            with np.errstate(all="ignore"):
                solved, new = _solve_all_steps(law_and_inputs, steps, known, nearest)
            states, left = solved.states, np.flatnonzero(~solved.done)
            cost = -(-solved.n_evaluated // _WORTH_A_STEP)
            own = ((theta[k].copy(), states[:, k].copy(), bands) for k, bands in new.items())
            memory.add([KnownTrajectory(steps, effects, *each) for each in own])
            memory.n_refused = 0
        except Exception:  # of the law: for these samples, or for more columns than there are runs
            refused = True
    if left.size:
        motion, parameters, columns = law_and_inputs(left)
        every = states_by_step(motion, steps, parameters, columns)
        there = np.stack([[*s.values()] for s in every], axis=2)
        memory.n_refused += refused
        if states is None:
            states = there
        else:
            states[:, left] = there
        cost += n_parts_of_steps(motion, steps)
        finite = np.flatnonzero(np.isfinite(there).all(axis=(0, 2, 3)))[:_MOST_NEW].tolist()
        memory.add([KnownTrajectory(steps, effects, theta[left[k]], there[:, k]) for k in finite])
    assert states is not None
    motion = law_and_inputs(np.arange(1))[0]
    memory.n_evaluations += cost * evaluations_per_step(motion, steps.method)
    at_rows = states[:, :, steps.n_steps_before_position[steps.position_by_row], steps.table.scan]
    return dict(zip(motion.law.states, at_rows, strict=True))


def _solve_all_steps(
    law_and_inputs: LawAndInputs, steps: Steps, known: Sequence[KnownTrajectory], nearest: IntArray
) -> tuple[_NewtonState, dict[int, list[FloatArray]]]:
    """Solve for the states at the end of every step, each sample from the `nearest`, (n_samples,), of those known.

    With the solution come up to eight converged samples that are far from the trajectories they began from, each with
    its last Jacobian, as of `jacobian_bands_and_residuals`, where one was computed.
    """
    guess = np.stack([each.states for each in known], axis=1)[:, nearest]
    search = _NewtonState(law_and_inputs, steps, guess.copy())
    for _ in range(_CHORDS):  # each sample with the Jacobian of the known trajectory nearest to it
        active = search.active_mask & ((search.rate < _SLOW) | ~np.isfinite(search.change))
        samples = np.flatnonzero(active)
        if not samples.size:
            break
        missed = search.step_residuals(samples)
        correction = np.empty_like(missed)
        for number in np.unique(nearest[samples]).tolist():
            own = nearest[samples] == number
            if not known[number].bands:
                at = known[number].states[:, None]
                known[number].bands.extend(search.jacobian_bands_and_residuals(samples[own][:1], at)[0])
            correction[:, own] = _solved_corrections(known[number].bands[0], missed[:, own], shared=True)
        search.apply_correction(samples, correction)
        far = ~(search.change < _FAR)
        if samples.size == len(nearest) and far.sum() * steps.n_runs > _FEW_FAR:
            search.possible &= ~far
    # A chord that led away is no better a start than the trajectory that it began from.
    astray = search.active_mask & ~(search.rate < 1)
    search.states[:, astray, 1:] = guess[:, astray, 1:]
    search.change[~search.done] = np.inf
    last: dict[int, FloatArray] = {}
    for k in range(_NEWTONS):  # each sample with its own Jacobian
        if k == _HOPELESS:
            search.possible &= search.change < _SLOW
        samples = np.flatnonzero(search.active_mask)
        if not samples.size:
            break
        bands, missed = search.jacobian_bands_and_residuals(samples, search.states[:, samples])
        correction = _solved_corrections(np.concatenate(bands), missed, shared=False)
        last |= dict(zip(samples.tolist(), bands, strict=True))
        search.apply_correction(samples, correction)
    far = search.done & (_largest_relative_change(search.states - guess, guess) > _FAR)
    return search, {k: [last[k]] if k in last else [] for k in np.flatnonzero(far)[:_MOST_NEW].tolist()}


@dataclass(eq=False)
class _NewtonState:
    """State of the Newton iteration: all samples' states at every step, and the convergence of each sample."""

    law_and_inputs: LawAndInputs
    steps: Steps
    states: FloatArray
    n_evaluated: int = 0

    def __post_init__(self) -> None:
        n_samples = self.states.shape[1]
        self.change, self.rate = np.full(n_samples, np.inf), np.zeros(n_samples)
        self.done, self.possible = np.zeros(n_samples, dtype=np.bool_), np.ones(n_samples, dtype=np.bool_)
        self._chosen, self._parts = np.zeros(0, dtype=np.int64), list[StepPart]()
        self._motion, parameters, _ = self.law_and_inputs(np.arange(n_samples))
        self.states[:, :, 0] = [*initial_states(self._motion, self.steps, parameters, n_samples).values()]

    @property
    def active_mask(self) -> BoolArray:
        """Mask of the samples that have not converged and may yet, (n_samples,)."""
        return self.possible & ~self.done

    def states_at_step_ends(self, samples: IntArray, states: FloatArray) -> FloatArray:
        """Take each step from the state before it; return the states after it, (n_states, n, n_steps, n_runs)."""
        gap, begins = self.steps.gap_of_step, states[:, :, :-1]
        if not np.array_equal(samples, self._chosen):
            self._motion, parameters, columns = self.law_and_inputs(samples)
            given = LawInputs(self._motion, self.steps, parameters, columns)
            whole = given.parts_of_steps(given.of_gaps(gap, len(gap)), gap, *self.steps.begin_and_length, whole=False)
            self._chosen, self._parts = samples, list(whole)
        s = dict(zip(self._motion.law.states, begins.reshape(len(begins), len(samples), -1), strict=True))
        after: dict[str, Any] = s
        for part in self._parts:
            columns_of_part = part[0]
            n_columns = len(gap) * self.steps.n_runs if columns_of_part is None else len(columns_of_part)
            self.n_evaluated += len(samples) * n_columns
            after = step_in_part(self._motion, self.steps.method, part, after)
        return np.stack([np.broadcast_to(after[state], s[state].shape) for state in s]).reshape(begins.shape)

    def step_residuals(self, samples: IntArray) -> FloatArray:
        """Return each step's end minus the trajectory's state there, (n_states, n, n_steps, n_runs); 0 if solved."""
        states = self.states[:, samples]
        return self.states_at_step_ends(samples, states) - states[:, :, 1:]

    def jacobian_bands_and_residuals(
        self, samples: IntArray, states: FloatArray
    ) -> tuple[list[FloatArray], FloatArray]:
        """Return samples' Jacobians of the equations of all steps, and the residuals as of `step_residuals`.

        They are those at states (n_states, n, n_steps + 1, n_runs). A Jacobian is its bands, (n_unknowns, 2 n_states):
        column k holds the k-th subdiagonal; the diagonal is 1 throughout, and column 0 is not used. Unknowns are
        ordered by run, then by step, then by state.
        """
        n_states, n, _, n_runs = states.shape
        nudge = _NUDGE * np.maximum(np.abs(states).max(axis=(2, 3), keepdims=True), 1e-300)
        # As given, and with each state nudged in turn: one evaluation of all takes a third of the time.
        every = np.repeat(states[:, None], n_states + 1, axis=1)
        for j in range(n_states):
            every[j, j + 1] += nudge[j]
        ends = self.states_at_step_ends(np.tile(samples, n_states + 1), every.reshape(n_states, -1, *states.shape[2:]))
        at_end, *nudged = ends.reshape(n_states, n_states + 1, n, -1, n_runs).swapaxes(0, 1)
        out = np.zeros((n, n_runs, at_end.shape[2], n_states, 2 * n_states))
        for j, end in enumerate(nudged):
            slopes = (end - at_end) / nudge[j]
            for i in range(n_states):
                out[:, :, :-1, j, n_states + i - j] = -slopes[i, :, 1:].transpose(0, 2, 1)
        return list(out.reshape(n, -1, 2 * n_states)), at_end - states[:, :, 1:]

    def apply_correction(self, samples: IntArray, correction: FloatArray) -> None:
        """Add a correction (n_states, n, n_steps, n_runs) to samples' states, and mark those that have converged."""
        change = _largest_relative_change(correction, self.states[:, samples])
        self.states[:, samples, 1:] += correction
        with np.errstate(all="ignore"):
            rate = np.where(np.isfinite(self.change[samples]), change / self.change[samples], 0.0)
        first = ~np.isfinite(self.change[samples])
        self.possible[samples] = np.isfinite(change)
        self.done[samples] = (change < _CONVERGED) & (np.where(first, 1.0, rate) * change < _SETTLED)
        self.change[samples], self.rate[samples] = change, rate


def _largest_relative_change(change: FloatArray, states: FloatArray) -> FloatArray:
    """Return each sample's largest change of a state, relative to that state's largest absolute value, (n_samples,)."""
    size = np.maximum(np.abs(states).max(axis=(2, 3)), 1e-300)
    return np.asarray((np.abs(change).max(axis=(2, 3)) / size).max(axis=0))


def _solved_corrections(bands: FloatArray, missed: FloatArray, *, shared: bool) -> FloatArray:
    """Return corrections for residuals `missed`, (n_states, n_samples, n_steps, n_runs); `shared`: by one Jacobian."""
    n_states, n_samples, n_steps, n_runs = missed.shape
    right = missed.transpose(1, 3, 2, 0).reshape((n_samples, -1) if shared else (1, -1))
    solved, _ = dtbtrs(bands.T, right.T, uplo="L", diag="U")
    return np.asarray(solved.T.reshape(n_samples, n_runs, n_steps, n_states).transpose(3, 0, 2, 1))
