"""Integrate a law between the rows of each run, for all samples and runs at once: by steps, or all steps at once.

A trajectory of a fixed-step method satisfies s[k + 1] = step(s[k]) for every k: a system of equations whose only
solution is what stepping gives. Newton's method solves it from a trajectory nearby. Its Jacobian is block bidiagonal,
so an iteration is one evaluation of all steps together and one banded triangular solve. Samples near a known trajectory
share its Jacobian (chord iterations), the others have their own; those that do not converge are left to be stepped.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.linalg.lapack import dtbtrs

from probewise._arrays import LAST_DIGITS, TINY, FloatArray, IntArray
from probewise.systems.calls import number_of_samples
from probewise.systems.law import LawWithEffects, Method, StepInputs, Steps, of_columns, rosenbrock_step, values_at_rows
from probewise.systems.simulator import Columns, Law, Values

_MANY_COLUMNS = 64  # of the states' arrays, from which steps to be split are taken out of the others
_CHORDS = 4  # iterations with the Jacobian of a known trajectory
_NEWTONS = 8  # iterations with a sample's own Jacobian
_HOPELESS = 4  # of these, after which a sample that still changes by a tenth is left to be stepped
_SLOW = 0.1  # change of a chord iteration, in that of the one before, from which a sample needs its own Jacobian
_CONVERGED = 1e-8  # largest change of a state by an iteration, in that state's largest value
_NUDGE = 1e-7  # of each state's largest value, for the Jacobian
_FAR = 1e-3  # change from a known trajectory, in a state's largest value, from which another one is remembered
_MOST_NEW = 8  # trajectories remembered of one batch
_MOST_KNOWN = 48  # trajectories remembered
_REFUSALS = 3  # errors in a row of all steps together after which a law is only stepped; one may be of a sample far off
_WORTH_A_STEP = 350  # steps of one sample in one run, evaluated together, at the cost of a step of all of them
# Samples times runs up to which all steps at once cost less than one after another: near known trajectories, where two
# evaluations of all steps suffice, and far from them, where a dozen are needed.
_FEW_NEAR, _FEW_FAR = 300, 40


def integrate_states(
    motion: LawWithEffects | Law, steps: Steps, parameters: Values, columns: Columns
) -> dict[str, FloatArray]:
    """Integrate a law step by step; return every state at every row, by name, (n_samples, n_points).

    Parameters are (n_samples, 1), or (n_samples, n_points) if they vary by row; columns (n_points,), or
    (n_samples, n_points) if an effect changes them.
    """
    motion, known = LawWithEffects(motion) if isinstance(motion, Law) else motion, {*steps.n_before.tolist()}
    kept = [s for k, s in enumerate(states_by_step(motion, steps, parameters, columns)) if k in known]
    return dict(zip(motion.law.states, np.stack(kept, axis=2)[:, :, steps.place, steps.table.scan], strict=True))


def states_by_step(motion: LawWithEffects, steps: Steps, parameters: Values, columns: Columns) -> Iterator[FloatArray]:
    """Integrate the law: yield all states, (n_states, n_samples, n_runs), at the start and after each step."""
    s = initial_states(motion, steps, parameters, number_of_samples(parameters, columns))
    with np.errstate(all="ignore"):
        given = StepInputs.over_table(motion.law, steps, parameters, columns)
        yield s
        for k, n in enumerate(steps.n_steps.tolist()):
            stepper = Stepper(motion, steps.method, given.of_gaps(slice(k, k + 1), 1))
            for i in range(n):
                yield (s := stepper.step(s, i / n, 1 / n))


def evaluations_per_step(motion: LawWithEffects, method: Method) -> int:
    """Return about how often a step of a law evaluates its rates, of all samples together.

    Friction asks for the direction of motion, and splits steps in which a state comes to rest or breaks loose: by half
    as much again, where samples of a search do so at different times.
    """
    n_stages = 9 + 2 * len(motion.law.states) if method is rosenbrock_step else 4  # with its linear algebra
    return n_stages + n_stages // 2 if motion.friction else n_stages


def initial_states(motion: LawWithEffects, steps: Steps, parameters: Values, n_samples: int) -> FloatArray:
    """Return the states in which the runs start, within their bounds, (n_states, n_samples, n_runs)."""
    starts, first = motion.law.states.values(), steps.rows[:1]
    start = np.empty((len(starts), n_samples, first.shape[1]))
    for state, at in zip(start, starts, strict=True):
        state[:] = values_at_rows(parameters[at], first)[:, 0] if isinstance(at, str) else float(at)
    return motion.clip_and_stop_states({}, start)


@dataclass(frozen=True, eq=False)
class Stepper:
    """Steps of a law by a method, with its inputs `between` two rows.

    States are (n_states, n_samples, n_columns). In the methods `begin` and `length` are shares of the gap: numbers, or
    one for each column.
    """

    motion: LawWithEffects
    method: Method
    between: StepInputs

    def step(self, s: FloatArray, begin: Any, length: Any) -> FloatArray:
        """Return the states after a step; it is split where friction brings a state to rest or lets it go."""
        motion = self.motion
        ways = motion.directions_of_motion(s, self.between(begin))
        after = self._step_without_split(s, begin, length, ways)
        for state, way in ways.items():
            after, ways = self._split_at_transitions(state, way, s, after, begin, length, ways)
        return motion.clip_and_stop_states(ways, after)

    def _split_at_transitions(
        self, state: int, way: Any, s: FloatArray, after: FloatArray, begin: Any, length: Any, ways: dict[int, Any]
    ) -> tuple[FloatArray, dict[int, Any]]:
        """Split steps from `s` to `after` where friction brings a state to rest or lets it go.

        The state begins them in the direction `way`; `ways` are the directions of all states that `after` results from.
        Returns the states after the steps, and the directions of motion at their end.
        """
        motion, between, at_rest = self.motion, self.between, way == 0

        def margin_to_transition(at: FloatArray, share: Any) -> Any:
            """Return the margin, negative after the transition, until the state comes to rest or breaks loose."""
            moving = way * at[state]
            if not at_rest.any():
                return moving
            pull = np.abs(motion.rates(at, between(share))[state])
            return np.where(at_rest, motion.friction_of[state] - pull, moving)

        last = margin_to_transition(after, begin + length)
        ends = last < 0
        if not ends.any():
            return after, ways
        n_columns, some = ends.shape[1], np.flatnonzero(ends.any(axis=0))
        if n_columns > _MANY_COLUMNS and 2 * len(some) <= n_columns:
            few, ends_of = replace(self, between=between.of_columns(some)), {k: v[:, some] for k, v in ways.items()}
            begin, length = of_columns(begin, some), of_columns(length, some)
            own = (state, way[:, some], s[:, :, some], after[:, :, some], begin, length, ends_of)
            out, ways = after.copy(), {k: v.copy() for k, v in ways.items()}
            out[:, :, some], changed = few._split_at_transitions(*own)
            for k, new in changed.items():
                ways[k][:, some] = new
            return out, ways
        first = margin_to_transition(s, begin)
        until = np.where(ends, _zero_of_straight_line(0.0, first, 1.0, last), 1.0)
        left = margin_to_transition(self._step_without_split(s, begin, until * length, ways), begin + until * length)
        later, earlier = (until, left, 1.0, last), (0.0, first, until, left)
        closer = np.where(left > 0, _zero_of_straight_line(*later), _zero_of_straight_line(*earlier))
        until = np.where(ends, closer, 1.0)
        there = self._step_without_split(s, begin, until * length, ways)
        there[state] = np.where(ends, 0.0, there[state])
        anew = motion.directions_of_motion(there, between(begin + until * length))
        free = motion.rates(after, between(begin + length))[state]
        anew[state] = np.where(ends & at_rest, np.sign(free), anew[state])
        return self._step_without_split(there, begin + until * length, (1 - until) * length, anew), anew

    def _step_without_split(self, s: FloatArray, begin: Any, length: Any, ways: dict[int, Any]) -> FloatArray:
        rates, between = self.motion.rates, self.between
        return self.method(lambda at, given: rates(at, given, ways), between, s, begin, length, between.gap)


def _zero_of_straight_line(low: Any, at_low: Any, high: Any, at_high: Any) -> Any:
    """Return where a straight line through (low, at_low) and (high, at_high) is 0; `low` if it does not fall."""
    apart = at_low - at_high
    return low + (high - low) * np.where(apart > 0, at_low / np.where(apart > 0, apart, 1.0), 0.0)


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

    def add(self, more: Sequence[KnownTrajectory]) -> None:
        """Add trajectories of the same steps and effects; beyond 48 in all, drop the first."""
        of = [(each.steps, each.effects) for each in more[:1]]
        others, again = ([e for e in self.known if ((e.steps, e.effects) in of) is same] for same in (False, True))
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
    n_samples, n_runs = len(theta), steps.gaps.shape[1]
    motion, *given = law_and_inputs(np.arange(n_samples))
    evaluations = evaluations_per_step(motion, steps.method)
    n_steps = int(steps.n_steps.sum())
    if n_samples * n_runs > _FEW_NEAR or memory.n_refused >= _REFUSALS:
        memory.n_evaluations += n_steps * evaluations
        return integrate_states(motion, steps, *given)
    states, left, cost, refused = np.zeros(0), np.arange(n_samples), 0, False
    every = [each for each in memory.known if each.steps == steps]
    known, width = [each for each in every if each.effects == effects], theta.shape[1]
    if not known:  # those of other effects, compared by the system's parameters
        known, width = every, n_own
    if known:
        there = np.stack([each.theta[:width] for each in known])
        apart = (theta[:, None, :width] - there) / np.maximum(np.abs(there).max(axis=0), TINY)
        nearest = np.argmin(np.einsum("skp,skp->sk", apart, apart), axis=1)
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
        motion, *given = law_and_inputs(left)
        stepped = np.stack([*states_by_step(motion, steps, *given)], axis=2)
        memory.n_refused += refused
        if len(left) == n_samples:
            states = stepped
        else:
            states[:, left] = stepped
        cost += n_steps
        finite = np.flatnonzero(np.isfinite(stepped).all(axis=(0, 2, 3)))[:_MOST_NEW].tolist()
        memory.add([KnownTrajectory(steps, effects, theta[left[k]], stepped[:, k]) for k in finite])
    memory.n_evaluations += cost * evaluations
    at_rows = states[:, :, steps.n_before[steps.place], steps.table.scan]
    return dict(zip(motion.law.states, at_rows, strict=True))


def _solve_all_steps(
    law_and_inputs: LawAndInputs, steps: Steps, known: Sequence[KnownTrajectory], nearest: IntArray
) -> tuple[_NewtonState, dict[int, list[FloatArray]]]:
    """Solve for the states at the end of every step, each sample from the `nearest`, (n_samples,), of those known.

    With the solution come up to eight converged samples that are far from the trajectories they began from, each with
    its last Jacobian, as of `bands_and_residuals`, where one was computed.
    """
    guess = np.stack([each.states for each in known], axis=1)[:, nearest]
    search = _NewtonState(law_and_inputs, steps, guess.copy())
    for _ in range(_CHORDS):  # each sample with the Jacobian of the known trajectory nearest to it
        samples = np.flatnonzero(search.active & ((search.rate < _SLOW) | ~np.isfinite(search.change)))
        if not samples.size:
            break
        now = search.states[:, samples]
        missed = search.states_at_step_ends(samples, now) - now[:, :, 1:]  # 0 where a step is solved
        correction = np.empty_like(missed)
        for number in np.unique(nearest[samples]).tolist():
            own = nearest[samples] == number
            if not known[number].bands:
                at = known[number].states[:, None]
                known[number].bands.extend(search.bands_and_residuals(samples[own][:1], at)[0])
            correction[:, own] = _solved_corrections(known[number].bands[0], missed[:, own], shared=True)
        search.apply_correction(samples, correction)
        far = ~(search.change < _FAR)
        if samples.size == len(nearest) and far.sum() * steps.gaps.shape[1] > _FEW_FAR:
            search.active &= ~far
    # A chord that led away is no better a start than the trajectory that it began from.
    astray = search.active & ~(search.rate < 1)
    search.states[:, astray, 1:] = guess[:, astray, 1:]
    search.change[~search.done] = np.inf
    last: dict[int, FloatArray] = {}
    for k in range(_NEWTONS):  # each sample with its own Jacobian
        if k == _HOPELESS:
            search.active &= search.change < _SLOW
        samples = np.flatnonzero(search.active)
        if not samples.size:
            break
        bands, missed = search.bands_and_residuals(samples, search.states[:, samples])
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
        self.done, self.active = np.zeros(n_samples, dtype=np.bool_), np.ones(n_samples, dtype=np.bool_)
        self._chosen = np.zeros(0, dtype=np.int64)
        motion, parameters, _ = self.law_and_inputs(np.arange(n_samples))
        self.states[:, :, 0] = initial_states(motion, self.steps, parameters, n_samples)

    def states_at_step_ends(self, samples: IntArray, states: FloatArray) -> FloatArray:
        """Take each step from the state before it; return the states after it, (n_states, n, n_steps, n_runs)."""
        steps, begins = self.steps, states[:, :, :-1]
        if not np.array_equal(samples, self._chosen):
            motion, parameters, columns = self.law_and_inputs(samples)
            inputs = StepInputs.over_table(motion.law, steps, parameters, columns).of_gaps(steps.gap, len(steps.gap))
            self._chosen, self._stepper = samples, Stepper(motion, steps.method, inputs)
        self.n_evaluated += len(samples) * len(steps.begin)
        after = self._stepper.step(begins.reshape(len(begins), len(samples), -1), steps.begin, steps.length)
        return after.reshape(begins.shape)

    def bands_and_residuals(self, samples: IntArray, states: FloatArray) -> tuple[list[FloatArray], FloatArray]:
        """Return samples' Jacobians of the equations of all steps, and each step's end minus the trajectory there.

        They are those at states (n_states, n, n_steps + 1, n_runs), the latter (n_states, n, n_steps, n_runs). A
        Jacobian is its bands, (n_unknowns, 2 n_states): column k holds the k-th subdiagonal; the diagonal is 1
        throughout, and column 0 is not used. Unknowns are ordered by run, then by step, then by state.
        """
        n_states, n, _, n_runs = states.shape
        nudge = _NUDGE * np.maximum(np.abs(states).max(axis=(2, 3), keepdims=True), TINY)
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
        self.done[samples] = (change < _CONVERGED) & (np.where(first, 1.0, rate) * change < LAST_DIGITS)
        self.active[samples] = np.isfinite(change) & ~self.done[samples]
        self.change[samples], self.rate[samples] = change, rate


def _largest_relative_change(change: FloatArray, states: FloatArray) -> FloatArray:
    """Return each sample's largest change of a state, relative to that state's largest absolute value, (n_samples,)."""
    size = np.maximum(np.abs(states).max(axis=(2, 3)), TINY)
    return np.asarray((np.abs(change).max(axis=(2, 3)) / size).max(axis=0))


def _solved_corrections(bands: FloatArray, missed: FloatArray, *, shared: bool) -> FloatArray:
    """Return corrections for residuals `missed`, (n_states, n_samples, n_steps, n_runs); `shared`: by one Jacobian."""
    n_states, n_samples, n_steps, n_runs = missed.shape
    right = missed.transpose(1, 3, 2, 0).reshape((n_samples, -1) if shared else (1, -1))
    solved, _ = dtbtrs(bands.T, right.T, uplo="L", diag="U")
    return np.asarray(solved.T.reshape(n_samples, n_runs, n_steps, n_states).transpose(3, 0, 2, 1))
