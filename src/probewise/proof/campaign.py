"""Run many independent tasks on any executor, keep their results in a file, and estimate with 95 % intervals.

A campaign can be resumed after any stop.

Format "campaign/1". The first line holds the settings that determine the results. Every further line is a finished
task: its key and its result, in order of completion. Results are returned in the order of the tasks, so that nothing
depends on the executor. What a finished task leaves in the file, which may have been changed by hand, fits a schema: a
dict of keys, {str: schema} for any keys, [schema] for a list, (schema, ...) for a list of so many, (schema, None) for
null too, or bool, int, float, str.
"""

from __future__ import annotations

import json
import lzma
import math
import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np
from scipy.stats import binom, binomtest, t

from probewise._arrays import FloatArray
from probewise._tasks import results_as_tasks_end
from probewise._writing import write_and_sync
from probewise.errors import FileError, ParameterError, shown
from probewise.progress import Progress, silent
from probewise.recordings import hold_lock, parse_json_file_text, read_bytes, write_text_atomically

__all__ = ["FORMAT", "Campaign", "CampaignContents", "read_campaign"]

FORMAT = "campaign/1"
Result = Mapping[str, Any]
Misfit: TypeAlias = Callable[[Result], tuple[str, str] | None]
K = TypeVar("K")


@dataclass(frozen=True)
class Campaign(Generic[K]):
    """Tasks whose results a file keeps."""

    work: Callable[[K], Result]  # a dict for JSON from a task; defined at module level if workers are processes
    tasks: Mapping[str, K]  # by key, each with its own seed, so that order and worker do not matter
    settings: Mapping[str, Any]  # everything that determines the results, a dict for JSON
    misfit: Misfit = lambda result: None  # what of a result in the file cannot be, and what is allowed, or None
    noun: str = "runs"  # of several tasks

    def run(
        self, *, path: str | os.PathLike[str], executor: Executor | None = None, progress: Progress = silent
    ) -> dict[K, Result]:
        """Run the tasks whose results are not yet in the file; return the results of all by task, in their order.

        `path`: the campaign's file, created or continued: one of other settings is refused; `executor`: any
        `concurrent.futures.Executor`, also of other machines, None for here, one by one; `progress`: called with the
        noun, the number of finished tasks, earlier runs included, and the key of the last.

        Whatever `work` raises ends the campaign; finished results are kept, and the same call continues from there.
        Raises FileError if the file belongs to another campaign, is damaged before its last line, or is being written
        to, or if a result in it is a misfit; NotConvergedError if a worker dies; LinkError if the executor drops its
        tasks, as where a scheduler is killed; ParameterError if a result is not a JSON object of finite numbers.
        """
        path, tasks, settings = Path(path), self.tasks, json.loads(json.dumps(dict(self.settings)))
        with hold_lock(path):
            if not path.exists():
                write_text_atomically(
                    path, json.dumps({"format": FORMAT, "settings": settings}, allow_nan=False) + "\n"
                )
            before = read_campaign(path, misfit=self.misfit)
            if before.settings != settings:
                own = [n for n in {**before.settings, **settings} if before.settings.get(n) != settings.get(n)]
                there, here = (", ".join(f"{n} {shown(of.get(n))}" for n in own) for of in (before.settings, settings))
                raise FileError(
                    path, f"it belongs to a campaign with {there}", f"{here}, as asked now; or another file"
                )
            done = {key: before.results[key] for key in tasks if key in before.results}
            left = {key: task for key, task in tasks.items() if key not in done}
            with path.open("r+b", buffering=0) as file, results_as_tasks_end(self.work, left, executor) as ended:
                file.truncate(file.seek(file.read().rfind(b"\n") + 1))  # without an incomplete last line
                progress(self.noun, len(done), len(tasks))
                for key, result in ended:
                    try:
                        line = json.dumps({"key": key, "result": result}, allow_nan=False)
                    except (TypeError, ValueError) as error:
                        allowed = f"a JSON object of finite numbers ({error})"
                        raise ParameterError(f"the result of {key}", result, allowed) from error
                    write_and_sync(file, path, line.encode() + b"\n")
                    done[key] = json.loads(line)["result"]  # as a later reader will see it
                    progress(self.noun, len(done), len(tasks), key)
        return {task: done[key] for key, task in tasks.items()}


@dataclass(frozen=True)
class CampaignContents:
    """Contents of a campaign's file: its settings, and results by task key in the order in which the tasks ended."""

    settings: Mapping[str, Any]
    results: Mapping[str, Result]


def read_campaign(path: str | os.PathLike[str], *, misfit: Misfit = lambda result: None) -> CampaignContents:
    """Read a campaign's file, packed if its name ends in .xz; an incomplete last line is ignored.

    Raises FileError if it is missing, not a campaign's, or damaged before its last line, or if `misfit` (see
    `Campaign`) finds a result that cannot be.
    """
    content = read_bytes(Path(path), "a campaign's file")
    # After the last line end there is nothing, or an incomplete line.
    *lines, _ = (lzma.decompress(content) if Path(path).suffix == ".xz" else content).split(b"\n")
    rows = [
        parse_json_file_text(path, line, "one JSON object per line", row=k) for k, line in enumerate(lines, start=1)
    ]
    for number, row in enumerate(rows, start=1):
        if not isinstance(row, dict):
            raise FileError(path, "not an object", "one JSON object per line", row=number)
    if not rows or rows[0].get("format") != FORMAT or not isinstance(rows[0].get("settings"), dict):
        raise FileError(path, "this is not a campaign file", f'a first line with "format": "{FORMAT}" and its settings')
    results: dict[str, Result] = {}
    for number, row in enumerate(rows[1:], start=2):
        key, result = row.get("key"), row.get("result")
        if not (isinstance(key, str) and isinstance(result, dict)):
            raise FileError(path, "not a finished task", '"key" and "result"', row=number)
        if key in results:
            raise FileError(path, f"task {shown(key)} a second time", "every task once", row=number)
        if (wrong := misfit(result)) is not None:
            raise FileError(path, *wrong, row=number)
        results[key] = result
    return CampaignContents(rows[0]["settings"], results)


Schema: TypeAlias = Any

_RUN = {
    "readings": int,
    "error_mm": float,  # of the worst length
    "chance_wrong": float,  # posterior probability that a length is off by more than 12 mm
    "held": (bool, bool, bool),  # whether the 95 % interval of each length holds the truth
}
TRIAL: Schema = {
    "reached": bool,  # the target precision
    **_RUN,
    "first_white": (int, None),  # number of the first reading on white
    "bits": float,
    "bits_at_white": (float, None),  # gained up to it
    "arm_s": float,
    "cpu_s": float,  # median of the decisions
    "widest_mm": [float],  # posterior sd after each reading
    "p_value": (float, None),  # null: not tested
}
CONCEALED_TRIAL: Schema = {
    "known": bool,  # to the target precision
    **_RUN,
    "p_truth": float,  # probability of the right answer
    "credible": [str],  # names in the credible set
    "noticed": bool,  # a fault is reported
    "cpu_s": (float, float),  # median and 95 % quantile of the decisions
}

_FAILURE = {"kind": str, "size": float, "other_noise": bool, "failed": str, "at": str}
_STATEMENTS = {
    "verdict": str,
    "p_value": float,
    "combination": [str],
    "hypotheses": [([str], float)],  # names, and their probability
    "credible_set": [str],
}
_HIDDEN = {
    "name": str,
    "size_lambda": float,
    "on_noise": bool,
    "in_vocabulary": bool,
    "shows_in": [str],
    "cosines": {str: float},  # after the refit, with effects that are like it
}
_CASE = {
    "kind": str,
    "size": float,
    "other_noise": bool,
    "noise_model": str,
    "readings": int,
    "truth": [str],
    "hidden": [_HIDDEN],
    "cosine": (float, None),
    "cpu_s": float,
    **_STATEMENTS,
}
_SETTLED = {"readings": int, **_STATEMENTS}  # of readings that were advised
_INTERVALS = {str: (float, float, float)}  # by parameter: truth, and the ends of the 95 % interval
_LOG_DENSITIES = {str: float}  # of held-out readings, by model ("null", "repaired", "right"), nats

SENSOR_CASE: Schema = {
    **_CASE,
    "plan": str,
    "ssf": str,
    "noise_level": str,
    "alias": (str, None),
    "where": [str],
    "overlap": (float, None),  # of the place with the region of a local effect
    "parameters": {str: _INTERVALS},
    "sensor": _INTERVALS,
    "held_out": dict.fromkeys(("angle", "pattern", "direction"), _LOG_DENSITIES),
    "settled": (_SETTLED, None),
}
ROUNDS_CASE: Schema = {**_CASE, "rounds": [{"settled": bool, **_SETTLED}]}  # what is said is that of the last
SYSTEM_CASE: Schema = {
    **_CASE,
    "system": str,
    "law": bool,
    "hidden": [{**_HIDDEN, "rival_nats": {str: float}}],  # what rivals lose
    "where": [str],
    "parameters": {str: _INTERVALS},
    "held_out": dict.fromkeys(("inside", "beyond"), _LOG_DENSITIES),
}

_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}


def misfit(value: Any, schema: Schema, name: str = "result") -> tuple[str, str] | None:
    """Return what of a JSON value does not fit a schema, and what is allowed; None if it fits."""
    if isinstance(schema, tuple) and schema[-1] is None:
        return None if value is None else misfit(value, schema[0], name)
    children: list[tuple[Any, Schema, str]] = []
    if isinstance(schema, dict):
        fits, allowed = isinstance(value, dict), "an object"
        if fits:
            each = dict.fromkeys(value, schema[str]) if str in schema else schema
            if missing := sorted(key for key in each if key not in value):
                return f"{name}.{missing[0]} is missing", ", ".join(sorted(each))
            children = [(value[key], own, f"{name}.{key}") for key, own in each.items()]
    elif isinstance(schema, list | tuple):
        n = len(schema)
        fits = isinstance(value, list) and (isinstance(schema, list) or len(value) == n)
        allowed = "a list" if isinstance(schema, list) else f"a list of {n}"
        if fits:
            children = [(own, schema[k % n], f"{name}[{k}]") for k, own in enumerate(value)]
    else:
        kinds = (int, float) if schema is float else schema
        fits, allowed = isinstance(value, kinds) and isinstance(value, bool) is (schema is bool), _WORDS[schema]
    if not fits:
        return f"{name} is {shown(value)}", allowed
    return next(filter(None, (misfit(*child) for child in children)), None)


def misfit_of_case(result: Mapping[str, Any], schema: Schema) -> tuple[str, str] | None:
    """Return as `misfit` for a case of a challenge, whose kind says how many effects it conceals."""
    if "failed" in result:
        return misfit(result, _FAILURE)
    if (found := misfit(result, schema)) is not None:
        return found
    n_hidden = {"clean": 0, "pair": 2}.get(result["kind"], 1)
    if len(result["hidden"]) != n_hidden:
        return f"result.hidden has {len(result['hidden'])} of them", f"{n_hidden} where the kind is {result['kind']}"
    if result["kind"] == "alias" and result["cosine"] is None:
        return "result.cosine is null", "a number where the kind is alias"
    return None


LEAST_FOR_MEDIAN = 6
"""Smallest number of values whose range covers the median with 95 %: 1 - 2 / 2^6 is 97 %."""

_DRAWS = 400
V = TypeVar("V")


@dataclass(frozen=True)
class Estimate:
    """An estimate, the ends of its 95 % interval (or one standard error to either side), and the sample size if known.

    NaN for an empty sample.
    """

    value: float
    low: float
    high: float
    n: int = 0

    @property
    def half_width(self) -> float:
        """Half the length of the interval."""
        return 0.5 * (self.high - self.low)

    def __str__(self) -> str:
        return f"{self.value:.3g} ± {self.half_width:.2g}"


_NOTHING = Estimate(math.nan, math.nan, math.nan)


def grouped(pairs: Iterable[tuple[K, V]]) -> dict[K, list[V]]:
    """Return the values of each key, in order."""
    out: dict[K, list[V]] = {}
    for key, value in pairs:
        out.setdefault(key, []).append(value)
    return out


def estimated_share(hits: Iterable[bool]) -> Estimate:
    """Estimate a proportion, with Wilson's interval."""
    n_hits, n = sum(each := list(hits)), len(each)
    if not n:
        return _NOTHING
    found = binomtest(n_hits, n).proportion_ci(method="wilson")
    return Estimate(n_hits / n, float(found.low), float(found.high), n)


def estimated_mean(values: Iterable[float]) -> Estimate:
    """Estimate a mean, with Student's interval (infinite for one value)."""
    each = list(values)
    if not each:
        return _NOTHING
    center, n = float(np.mean(each)), len(each)
    half = float(t.ppf(0.975, n - 1) * np.std(each, ddof=1) / math.sqrt(n)) if n > 1 else math.inf
    return Estimate(center, center - half, center + half, n)


def estimated_statistic(rows: FloatArray, statistic: Callable[[FloatArray], float]) -> Estimate:
    """Estimate a statistic of rows (n, ...), with the basic bootstrap interval from random draws with a fixed seed.

    The basic interval reflects the draws about the estimate, which corrects the bias of small samples (Davison and
    Hinkley 1997, section 5.2). It is infinite for one row.
    """
    if not len(rows):
        return _NOTHING
    if len(rows) == 1:
        return Estimate(statistic(rows), -math.inf, math.inf, 1)
    rng = np.random.default_rng(len(rows))
    draws = [statistic(rows[rng.integers(len(rows), size=len(rows))]) for _ in range(_DRAWS)]
    value, (low, high) = statistic(rows), np.quantile(draws, [0.025, 0.975])
    return Estimate(value, float(2 * value - high), float(2 * value - low), len(rows))


def mean_with_error(values: Iterable[float]) -> Estimate:
    """Estimate a mean with its standard error to either side; NaN for fewer than two values."""
    each = np.array([*values], dtype=np.float64)
    if each.size < 2:
        return _NOTHING
    mean, error = float(each.mean()), float(each.std(ddof=1)) / math.sqrt(each.size)
    return Estimate(mean, mean - error, mean + error, each.size)


def median_with_interval(values: Iterable[float]) -> Estimate:
    """Estimate a median with a distribution-free 95 % interval of order statistics, NaN bounds below six values."""
    ordered = np.sort(np.array([*values], dtype=np.float64))
    if (n := ordered.size) < LEAST_FOR_MEDIAN:
        return Estimate(float(np.median(ordered)), math.nan, math.nan, n) if n else _NOTHING
    below = max(int(binom.ppf(0.025, n, 0.5)) - 1, 0)
    return Estimate(float(np.median(ordered)), float(ordered[below]), float(ordered[n - 1 - below]), n)
