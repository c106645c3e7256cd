"""Calls of a user's functions, for all samples at once if they broadcast, else one at a time; and their errors."""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import itertools
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import MOST_NUMBERS, FloatArray, IntArray, floats, nearly_equal
from probewise.errors import FileError, NotConvergedError, ParameterError, ShapeError, message_of, require, shown
from probewise.progress import Progress
from probewise.recordings.cells import first_cell_without_number
from probewise.recordings.io import EndedByFile, in_this_directory
from probewise.systems.simulator import Columns, Simulate, Simulator, Values, read_simulator

_N_NODES = 5  # interpolation nodes for a parameter that cannot vary by row
_NODES = 0.5 * (1 - np.cos(np.pi * np.arange(_N_NODES) / (_N_NODES - 1)))  # in its range
_WAY_OUT_BY_WORDS = {  # of Python's and NumPy's messages
    "output operand": "k = k * x in place of k *= x: an array changed in place keeps its shape",
    "converted to Python scalar": "np.sin(x) in place of math.sin(x), and so on: states and columns are arrays",
    "truth value of an array": "np.where(condition, a, b) in place of if: states and columns are arrays",
}


def call_on_read_only(function: Callable[..., Any], *given: Values) -> Any:
    """Call a user's function with dicts of read-only arrays by name; with copies instead, if it writes into one.

    To a user a parameter is a number, so `k = p["k"]; k /= 60` must leave p["k"], and the engine's own, as they are.
    Copies at every call would cost every law a fifth of its time.
    """
    try:
        return function(*map(dict, given))
    except ValueError as error:
        if "read-only" not in str(error):
            raise
    return function(*(_CopyingDict({name: _copied(v) for name, v in values.items()}) for values in given))


def call_on_views(function: Callable[..., Any], *given: Values) -> Any:
    """Call a user's function with values by name, of which it gets read-only views."""
    views = [dict(values) for values in given]
    for own in views:
        for name, value in own.items():
            if isinstance(value, np.ndarray) and value.flags.writeable:
                own[name] = view = value.view()
                view.setflags(write=False)
    return call_on_read_only(function, *views)


class _CopyingDict(dict[str, Any]):
    """A dict of arrays and numbers that returns a new copy of an array whenever it is asked for one."""

    def __getitem__(self, name: str) -> Any:
        return _copied(super().__getitem__(name))

    def get(self, name: str, default: Any = None) -> Any:
        return _copied(super().get(name, default))


def _copied(value: Any) -> Any:
    return value.copy() if isinstance(value, np.ndarray) else value


MOST_CALLS = 10_000
"""Expected limit of calls in a diagnosis, for a `simulate` that takes one sample at a time; it is not enforced."""


@dataclass(eq=False)
class Caller:
    """Caller of a user's `simulate` for many samples; it counts the calls, and the samples that fail or are not finite.

    The function `broadcasts` if it takes parameters (n_samples, 1) with columns (n_points,); else it is called for one
    sample at a time, and takes the parameters `by_row` as arrays (n_points,). `cut_short` is set if work was skipped
    because of too many calls. `interpolated` collects the parameters that vary by row though the function takes a
    number: its readings are interpolated between calls at five values of such a parameter.
    """

    simulate: Simulate
    broadcasts: bool
    by_row: frozenset[str] = frozenset()
    n_calls: int = 0
    n_failed: int = 0
    n_not_finite: int = 0
    interpolated: set[str] = field(default_factory=set)
    cut_short: bool = False
    on_call: Callable[[], None] | None = None
    _known: dict[bytes, FloatArray] = field(default_factory=dict, repr=False)
    _taken_together: dict[frozenset[str], bool] = field(default_factory=dict, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "on_call": None}  # progress is of this process

    @classmethod
    def from_trial_calls(
        cls, simulate: Simulate, samples: Values, columns: Columns, *, per_run: tuple[str, ...], broadcasts: bool
    ) -> Caller:
        """Find by trial calls the fastest way to call a function for many samples; return a caller that uses it.

        `samples` are parameters by name, (n_samples, 1 or n_points) each. Raises the function's own exception if it
        raises one at a trial call and no other gives a finite reading, ParameterError if none is finite or another call
        with the same parameters returns others, and ShapeError unless it returns one number per row.
        """
        together, taken = cls(simulate, broadcasts=True), set(per_run)
        if broadcasts:
            readings = together(samples, columns)
            if not np.isfinite(readings).any():
                together(samples, columns, strict=True)  # raises its own error, if there is one
            return together._if_finite_and_repeatable(readings, samples, columns)
        one = cls(simulate, broadcasts=False, by_row=frozenset(per_run))
        alone = one(samples, columns, strict=True)
        one._if_finite_and_repeatable(alone, samples, columns)
        if together._returns(alone, samples, columns):
            return together
        for own in (own for own in samples if own not in per_run):  # may it be (n_points,) in a call for one sample?
            by_row = {**samples, own: np.broadcast_to(samples[own], alone.shape)}
            if cls(simulate, broadcasts=False, by_row=frozenset({*per_run, own}))._returns(alone, by_row, columns):
                taken.add(own)
        return cls(simulate, broadcasts=False, by_row=frozenset(taken))

    def _returns(self, readings: FloatArray, samples: Values, columns: Columns) -> bool:
        try:
            return nearly_equal(self(samples, columns, strict=True), readings)
        except Exception:
            return False

    def _if_finite_and_repeatable(self, readings: FloatArray, samples: Values, columns: Columns) -> Caller:
        """Return this caller; raise ParameterError if no reading is finite, or another call returns another one."""
        sound = np.isfinite(readings).any(axis=1)
        found = f"not finite at any of the {sound.size} points of the prior that were tried"
        allowed = "finite readings: look for empty cells, divisions by 0 and priors that are too wide"
        require(sound.any(), "simulate", found, allowed)
        at, again = int(np.argmax(sound)), Caller(self.simulate, self.broadcasts, self.by_row)
        same = nearly_equal(again(*_of_sample(samples, columns, at), strict=True), readings[[at]])
        no_state = "no random numbers (declare the noise instead), no state kept between calls"
        found = "different when it is called again with the same parameters"
        require(same, "simulate", found, f"the same readings each time: {no_state}")
        return self

    def __call__(self, parameters: Values, columns: Columns, *, strict: bool = False) -> FloatArray:
        """Simulate parameters (n_samples, 1 or n_points) over columns (n_points,) or (n_samples, n_points).

        A sample at which `simulate` raises an error gives NaN; with `strict`, the first error is raised if all fail.
        """
        n_samples = number_of_samples(parameters, columns)
        n_points = max(np.shape(v)[-1] for v in columns.values())
        each = (_of_sample(parameters, columns, k) for k in range(n_samples))
        with np.errstate(all="ignore"):
            if self.broadcasts and self._takes_changed_columns_together(parameters, columns):
                return self._call_all(parameters, columns, (n_samples, n_points), strict=strict)
            if self.broadcasts:
                return np.concatenate([self._call_all(*own, (1, n_points), strict=strict) for own in each])
            out, first_error = np.full((n_samples, n_points), np.nan), None
            by_row = self.by_row if n_points == 1 else ()  # arrays even if there is only one row in the table
            samples = [
                ({n: float(v[0, 0]) if v.shape == (1, 1) and n not in by_row else v[0] for n, v in own.items()}, table)
                for own, table in each
            ]
            for first in range(0, n_samples, step := max(MOST_NUMBERS // (2 * _N_NODES * n_points), 1)):
                self._call_ahead(samples[first : first + step], n_points)
                for k, (own, table) in enumerate(samples[first : first + step], start=first):
                    try:
                        readings: Any = 0.0
                        for share, fixed in self._interpolation(own, n_points):
                            self.interpolated.update(name for name in own if np.ndim(own[name]) != np.ndim(fixed[name]))
                            called = self._cached_call(fixed, table, n_points)
                            readings = called if share is None else readings + share * called
                        out[k] = readings
                        self.n_not_finite += not np.isfinite(out[k]).all()
                    except (ShapeError, KeyboardInterrupt):
                        raise
                    except Exception as error:
                        self.n_failed += 1
                        first_error = first_error or error
            if strict and first_error is not None and not np.isfinite(out).any():
                raise first_error
        return out

    def _call_all(self, parameters: Values, columns: Columns, shape: tuple[int, int], *, strict: bool) -> FloatArray:
        """Call a broadcasting `simulate` once; if it raises, halve the samples until failing ones are alone: NaN."""
        n_samples, n_points = shape
        self._count_call()
        try:
            readings = self._simulated(parameters, columns)
        except Exception:
            if strict:
                raise
            if n_samples == 1:
                self.n_failed += 1
                return np.full(shape, np.nan)
            parts = []
            for low, high in ((0, n_samples // 2), (n_samples // 2, n_samples)):
                p, u = (take_samples(values, slice(low, high)) for values in (parameters, columns))
                parts.append(self._call_all(p, u, (high - low, n_points), strict=False))
            return np.concatenate(parts)
        readings = _readings_broadcast_to_shape(readings, shape)
        self.n_not_finite += int(np.count_nonzero(~np.isfinite(readings).all(axis=1)))
        return readings

    def _takes_changed_columns_together(self, parameters: Values, columns: Columns) -> bool:
        """Return whether samples may be simulated together if some columns, (n_samples, n_points), differ among them.

        A `simulate` that takes a column's mean, sum or first row means that of one sample. Two samples are tried with
        each set of changed columns, together and apart.
        """
        changed = frozenset(name for name, values in columns.items() if np.ndim(values) == 2)
        if changed and changed not in self._taken_together:
            own = {name: values[[0, -1]] for name, values in parameters.items()}
            given = dict(columns)
            for name in changed:  # a column, and a copy raised by about 1 % of its size
                size = float(np.nanmax(np.abs(columns[name][0]), initial=0.0)) or 1.0
                given[name] = np.stack([columns[name][0], 1.01 * columns[name][0] + 0.01 * size])
            trial = Caller(self.simulate, broadcasts=True, _taken_together={changed: True})
            try:
                apart = [trial(*_of_sample(own, given, k), strict=True) for k in range(2)]
                self._taken_together[changed] = trial._returns(np.concatenate(apart), own, given)
            except Exception:
                self._taken_together[changed] = False
        return not changed or self._taken_together[changed]

    def _cached_call(self, own: Values, columns: Columns, n_points: int) -> FloatArray:
        known = self._known.pop(key := _digest_of_arguments(own, columns), None)
        if known is None:
            self._count_call()
            known = _readings_broadcast_to_shape(self._simulated(own, columns), (n_points,)).copy()
        self._known[key] = known
        while len(self._known) * n_points > MOST_NUMBERS and len(self._known) > 1:
            self._known.pop(next(iter(self._known)))
        return known

    def _call_ahead(self, samples: Sequence[tuple[Values, Columns]], n_points: int) -> None:
        """Make the calls for some samples at once where `simulate` is a `SpreadCalls`; those that fail are left."""
        if not isinstance(self.simulate, SpreadCalls):
            return
        asked = {}
        for own, columns in samples:
            for _, fixed in self._interpolation(own, n_points):
                asked[_digest_of_arguments(fixed, columns)] = fixed, columns
        unknown = {key: given for key, given in asked.items() if key not in self._known}
        for key, readings in zip(unknown, self.simulate.many([*unknown.values()]), strict=True):
            if readings is not None and readings.shape == (n_points,):
                self._count_call()
                self._known[key] = readings

    def _simulated(self, parameters: Values, columns: Columns) -> Any:
        with in_this_directory():
            return call_on_views(self.simulate, parameters, columns)

    def _count_call(self) -> None:
        self.n_calls += 1
        if self.on_call is not None:
            self.on_call()

    def _interpolation(self, own: Values, n_points: int) -> Iterator[tuple[FloatArray | None, Values]]:
        """Yield each share, by Lagrange, in the readings of a sample, None of a single call, and the call's values."""
        vary = [name for name, v in own.items() if np.ndim(v) == 1 and name not in self.by_row]
        if not vary:
            yield None, own
            return
        nodes = []
        for name in vary:  # Chebyshev's, with both ends
            low, high = float(np.min(own[name])), float(np.max(own[name]))
            nodes.append(low + (high - low) * _NODES if low < high else np.array([low]))
        for at in itertools.product(*(range(len(each)) for each in nodes)):
            share = np.ones(n_points)
            for name, each, i in zip(vary, nodes, at, strict=True):
                others = np.delete(each, i)
                share = share * np.prod((own[name][:, None] - others) / (each[i] - others), axis=1)
            yield share, {**own, **{name: float(each[i]) for name, each, i in zip(vary, nodes, at, strict=True)}}


class SpreadCalls:
    """A user's `simulate` whose calls for many samples are made in other processes, which run its file themselves."""

    def __init__(self, simulate: Simulate, path: Path, executor: Executor, n_workers: int) -> None:
        self.__wrapped__, self._path, self._executor, self._n_chunks = simulate, path, executor, 4 * n_workers

    def __call__(self, parameters: Values, columns: Values) -> Any:
        """Call it here."""
        return self.__wrapped__(parameters, columns)

    def many(self, given: Sequence[tuple[Values, Values]]) -> Iterator[FloatArray | None]:
        """Yield what it returns for each parameters and columns, in this order; None where it raises an error.

        NotConvergedError if a process ends, for a call that ended it could end this one too.
        """
        each, chunk = partial(_readings_or_none, self._path), max(len(given) // self._n_chunks, 1)
        try:
            yield from self._executor.map(each, given, chunksize=chunk)
        except BrokenExecutor as error:
            why = f"a worker process that called simulate has died, by a signal or for want of memory ({error})"
            raise NotConvergedError(f"{why}; without --workers the calls are made one by one") from error


_simulate_of_file: Callable[[Path], Any] = cache(lambda path: read_simulator(path).simulate)


def _readings_or_none(path: Path, given: tuple[Values, Values]) -> FloatArray | None:
    try:
        with np.errstate(all="ignore"):
            return floats(call_on_views(_simulate_of_file(path), *given)).copy()
    except Exception:
        return None


def _digest_of_arguments(own: Values, columns: Columns) -> bytes:
    digest = hashlib.blake2b(digest_size=16)
    for name, values in (*own.items(), *columns.items()):
        digest.update(name.encode(errors="surrogatepass"))
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.digest()


def progress_with_call_count(progress: Progress, caller: Caller | None) -> Progress:
    """Return a progress function that adds the number of calls of `simulate`, if any, at every stage and every call."""
    if caller is None:
        return progress
    now: list[Any] = ["calling simulate", 0, 0, ""]
    of = "" if caller.broadcasts else f" of about {MOST_CALLS:,}"

    def report(stage: str, done: int = 0, total: int = 0, note: str = "") -> None:
        now[:] = stage, done, total, note
        progress(stage, done, total, f"{note}, " * bool(note) + f"{caller.n_calls:,}{of} calls of simulate")

    caller.on_call = lambda: report(*now)
    return report


def number_of_samples(*values: Values) -> int:
    """Return the number of samples of values by name, of which those of two axes have one row for each, or one row."""
    return max((len(v) for each in values for v in each.values() if np.ndim(v) == 2), default=1)


def take_samples(values: Values, samples: slice | IntArray) -> dict[str, Any]:
    """Select some samples of values by name; arrays of one axis, or of one sample, apply to all and are kept."""
    return {name: v[samples] if np.ndim(v) == 2 and len(v) > 1 else v for name, v in values.items()}


def _of_sample(parameters: Values, columns: Columns, k: int) -> tuple[dict[str, FloatArray], dict[str, NDArray[Any]]]:
    """Return the parameters of sample k, (1, 1 or n_points) each, and its columns, (n_points,) each."""
    own, table = (take_samples(each, slice(k, k + 1)) for each in (parameters, columns))
    return own, {name: v[0] if np.ndim(v) == 2 else v for name, v in table.items()}


def _readings_broadcast_to_shape(returned: Any, wanted: tuple[int, ...]) -> FloatArray:
    """Return readings broadcast to the wanted shape; raise ShapeError if they do not fit it, or are no real numbers."""
    try:
        readings = floats(returned)  # what is masked is NaN
    except ParameterError:
        raise ShapeError(f"simulate returns {shown(returned)}; allowed: real numbers of shape {wanted}") from None
    if readings.shape == wanted:
        return readings
    if readings.ndim == len(wanted):
        with contextlib.suppress(ValueError):
            return np.array(np.broadcast_to(readings, wanted))
    together = "for each sample and row: it is called with parameters (n_samples, 1), as vectorized = True says"
    one = together if len(wanted) > 1 else "for each row"
    raise ShapeError(f"simulate returns an array of shape {readings.shape}; allowed: {wanted}, one number {one}")


def user_function_error(what: str, error: Exception, simulator: Simulator, columns: Columns) -> FileError:
    """Return a FileError for an exception that the function `what` raises at every call with these columns."""
    law = simulator.law
    functions: list[Any] = [simulator.simulate] if law is None else [law.rates, law.observe]
    codes = [getattr(inspect.unwrap(each), "__code__", None) for each in functions if each is not None]
    where = {code.co_filename for code in codes if code is not None}
    if law is not None and law.observe is not None:
        raised_in = {frame.f_code for frame, _ in traceback.walk_tb(error.__traceback__)}
        what = "observe" if codes[1] in raised_in else what
    frames, name = traceback.extract_tb(error.__traceback__), simulator.source or what
    lines = [f.lineno for f in frames if f.filename in where]
    said, states = message_of(error, kind=False), "" if law is None else ", ".join(law.states)
    if law is not None and (not frames or frames[-1].filename not in where):
        by_name = f"a dict with a rate for each state, under its name: {states}"
        if isinstance(error, KeyError) and error.args and error.args[0] in law.states:
            return FileError(name, f"rates returns no {error.args[0]!r}", by_name)
        if isinstance(error, TypeError) and ("list indices" in said or "tuple indices" in said):
            return FileError(name, "rates returns a list or a tuple", by_name)
    is_of_values = isinstance(error, TypeError | ValueError)
    way_out = next((out for words, out in _WAY_OUT_BY_WORDS.items() if words in said), "")
    texts = {name: values.tolist() for name, values in columns.items() if values.dtype != np.float64}
    if isinstance(error, KeyError):
        parameters, of_law = ", ".join((*simulator.parameters, *simulator.extra)), f", states {states}" if law else ""
        allowed = f"columns {', '.join(columns) or 'none'}, parameters {parameters}{of_law}"
    elif is_of_values and way_out:
        allowed = way_out
    elif is_of_values and texts:
        some = list(texts.items())[:4]
        cells = ", ".join(f"{column} ({v[first_cell_without_number(v) or 0]!r})" for column, v in some)
        allowed = f"calculations with numeric columns; these contain text: {cells}"
    elif law is not None and what == "rates":
        allowed = f"a function that returns a rate for each state somewhere in the prior: {states}"
    else:
        n_rows = max((np.shape(values)[-1] for values in columns.values()), default=0)
        allowed = f"a function that returns a reading for each of the {n_rows} rows somewhere in the prior"
    found = f"{what} raises {said if isinstance(error, EndedByFile) else message_of(error)}"
    return FileError(name, found, allowed, row=lines[-1] if lines else None)
