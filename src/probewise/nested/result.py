"""Weighted posterior samples, and the result of a run of nested sampling with everything needed to judge it.

Independent runs of one problem merge into one result (Higson, Handley, Hobson & Lasenby 2019).
"""

from __future__ import annotations

import importlib
import inspect
import io
import json
import math
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.special import chdtrc

from probewise._arrays import FloatArray, IntArray, data_frame, frozen_int, own_arithmetic, read_only_floats
from probewise._display import ShowsItself
from probewise._kinds import checked_number, checked_path, checked_whole, require_rng
from probewise._version import __version__
from probewise._writing import write_bytes_atomically
from probewise.errors import (
    DoubtfulResultWarning,
    FileError,
    ParameterError,
    ShapeError,
    message_of,
    require,
    shown,
    warn,
)
from probewise.nested.evidence import DOUBTFUL_P_VALUE, birth_rows, integrate, log_volumes, n_independent
from probewise.nested.weights import resampled_rows, weighted_quantiles

_FORMAT = "nested-result/4"
# How an array is kept, by the annotation of its field.
_READ_ONLY: Mapping[object, Callable[[Any], NDArray[Any]]] = {"FloatArray": read_only_floats, "IntArray": frozen_int}
_OF_RANKS = ("insertion_rank", "insertion_n_ranked")
# p value below which runs disagree: one false alarm in 1000 merges.
_DISAGREE = 1e-3
_LEVELS = ("log_likelihood", "label", "log_birth", "birth_label")


@dataclass(frozen=True, eq=False)
class Samples(ShowsItself):
    """Weighted samples of a posterior, with weights that sum to one, and the evidence: base of all results.

    `theta` (n, n_params) are the parameters of each sample; `log_likelihood` and `log_weight`, (n,), its own; `log_z`
    and `log_z_error` the natural log of the evidence and its standard error; `n_eff` is the effective sample size, of a
    nested run that of the parameter whose mean is least certain; `n_calls` the number of likelihood evaluations.
    """

    names: tuple[str, ...]
    theta: FloatArray
    log_likelihood: FloatArray
    log_weight: FloatArray
    log_z: float
    log_z_error: float
    n_eff: float
    n_calls: int

    def __post_init__(self) -> None:
        for field in fields(self):
            if field.type in _READ_ONLY:
                object.__setattr__(self, field.name, _READ_ONLY[field.type](getattr(self, field.name)))

    @property
    @own_arithmetic
    def weight(self) -> FloatArray:
        """Posterior weights, summing to one, (n,)."""
        return np.asarray(np.exp(self.log_weight))

    def to_frame(self) -> Any:
        """Return a pandas DataFrame: a row per sample; columns `weight`, `log_likelihood` and one per parameter."""
        columns = {name: self.theta[:, k] for k, name in enumerate(self.names)}
        return data_frame({"weight": self.weight, "log_likelihood": self.log_likelihood, **columns})

    @own_arithmetic
    def draw_rows(self, n: int, *, rng: np.random.Generator) -> IntArray:
        """Draw the row numbers of `n` equally weighted samples, (n,), in random order; see `samples`."""
        require_rng(rng)
        n = checked_whole("n", n)
        return np.asarray(rng.permutation(resampled_rows(self.weight, n, rng)))

    def samples(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw `n` equally weighted posterior samples, (n, n_params), in random order.

        Systematic resampling: a point of weight w occurs n w times, rounded up or down, so points
        repeat only where a weight exceeds 1 / n; `diversify` makes repeated samples distinct.
        """
        return np.asarray(self.theta[self.draw_rows(n, rng=rng)])

    @own_arithmetic
    def mean(self, f: Callable[[FloatArray], FloatArray] | None = None) -> FloatArray:
        """Average the parameters, (n_params,), or any function of them, over the posterior.

        `f`: from theta, (n, n_params), to values (n, ...), for instance sensitivity fields; the mean has the trailing
        shape. ShapeError for another number of rows.
        """
        values = self.theta if f is None else np.asarray(f(self.theta))
        if values.shape[:1] != (len(self.theta),):
            rows = f"{len(self.theta)} rows, as many as theta has"
            raise ShapeError(f"f(theta) has shape {values.shape}; allowed: {rows}")
        return np.asarray(np.tensordot(self.weight, values, axes=(0, 0)))

    @own_arithmetic
    def sd(self) -> FloatArray:
        """Posterior standard deviation of the parameters, (n_params,)."""
        return np.asarray(np.sqrt(self.weight @ (self.theta - self.mean()) ** 2))

    @own_arithmetic
    def covariance(self) -> FloatArray:
        """Posterior covariance of the parameters, (n_params, n_params)."""
        centred = self.theta - self.mean()
        return np.asarray((centred * self.weight[:, None]).T @ centred)

    @own_arithmetic
    def quantiles(self, q: FloatArray | list[float] | tuple[float, ...]) -> FloatArray:
        """Weighted quantiles of each parameter at levels 0 to 1, (n_q,) -> (n_q, n_params); ParameterError outside."""
        return weighted_quantiles(self.theta, self.weight, q)

    def interval(self, mass: float = 0.95) -> FloatArray:
        """Central interval of each parameter that holds `mass`, (2, n_params): lower, upper.

        ParameterError unless 0 < mass < 1.
        """
        share = "greater than 0, less than 1"
        columns = ", ".join(f"{name} {k}" for k, name in enumerate(self.names))
        number = checked_number("mass", mass, f"a number {share}; columns of the result are {columns}")
        require(0 < number < 1, "mass", mass, share)
        return self.quantiles([0.5 - mass / 2, 0.5 + mass / 2])


@dataclass(frozen=True)
class Check:
    """A second, independent estimate of the evidence by a method, the `route`; see `probewise.nested.check`.

    `distance` is the run's log Z minus this one, in units of the combined error.
    """

    route: str
    log_z: float
    log_z_error: float
    distance: float
    n_calls: int


@dataclass(frozen=True, eq=False, kw_only=True)
class NestedResult(Samples):
    """The evidence, the weighted samples and the record of a run of nested sampling; see also `Samples`.

    `theta` holds the dead points in order of death, followed by the last live points, (n_dead, n_params); the arrays of
    births and deaths are (n_dead,).
    """

    label: FloatArray  # number from 0 to 1 that orders points of equal likelihood
    log_birth: FloatArray  # log likelihood and label of the dead point above which each was drawn; of draws from the
    birth_label: FloatArray  # whole prior minus infinity and 1
    parent: IntArray  # row of the point at which each point's chain began, -1 for draws from the prior
    n_at_death: IntArray  # number of points alive when each died, itself included
    log_start: float  # natural log of the share of the prior with nonzero likelihood
    log_start_error: float
    memory: float  # variance of log Z relative to independent points (`evidence.relative_lineage_variance`)
    information: float  # Kullback-Leibler divergence of posterior from prior, nats
    n_live: int
    stop_reason: str
    complete: bool  # whether the stopping rule ended the run, rather than a limit, an interruption or a failure
    insertion_rank: IntArray  # of each new point among those alive, 0 to m, (n_inserted,)
    insertion_n_ranked: IntArray  # m
    insertion_p_value: float  # of the test that the ranks are uniform, as for a correct sampler
    seed_state: str  # of the random generator at the start, as JSON, a list of states for merged runs
    versions: Mapping[str, str]  # of the software
    warnings: tuple[str, ...]  # reasons to doubt the result; empty for a sound run
    check: Check | None = None  # a second estimate of the evidence

    @property
    def n_dead(self) -> int:
        """Number of weighted samples."""
        return len(self.theta)

    @property
    def log_volume(self) -> FloatArray:
        """Expected natural log of the prior share (volume X) with a likelihood above each sample's, (n_dead,)."""
        return log_volumes(self.n_at_death, self.log_start)

    def summary(self) -> str:
        """Describe the run and its posterior in plain text."""
        each = self.n_calls / (self.n_live * self.information) if self.information > 0 else math.inf
        lines = [
            f"log Z        {self.log_z:.2f} ± {self.log_z_error:.2f}",
            f"information  {self.information:.2f} nats",
            f"samples      {self.n_dead}, effective sample size {self.n_eff:.0f}",
            f"cost         {self.n_calls} likelihood evaluations, {self.n_live} live points"
            + (f", {each:.3g} for each live point and nat" if math.isfinite(each) else ""),
            f"memory       {self.memory:.2f} times the variance of independent points",
            f"stopped      {self.stop_reason}",
            f"insertion    p = {self.insertion_p_value:.2g}",
        ]
        if self.check is not None:
            lines.append(
                f"check        log Z {self.check.log_z:.2f} ± {self.check.log_z_error:.2f} by {self.check.route}, "
                f"this run {abs(self.check.distance):.1f} errors {'above' if self.check.distance > 0 else 'below'} it, "
                f"{self.check.n_calls} evaluations"
            )
        if self.log_start < 0:
            share = math.exp(self.log_start)
            lines.append(f"possible     {share:.3g} ± {share * self.log_start_error:.1g} of the prior")
        lines.append("made with    " + ", ".join(f"{name} {number}" for name, number in self.versions.items()))
        if self.names:
            width = max(9, *(len(name) for name in self.names))
            low, high = self.interval(0.95)
            lines.append(f"{'parameter':<{width}}  {'mean':>11}  {'sd':>11}  95 % interval")
            lines += [
                f"{name:<{width}}  {mean:>11.5g}  {sd:>11.3g}  {a:.5g} to {b:.5g}"
                for name, mean, sd, a, b in zip(self.names, self.mean(), self.sd(), low, high, strict=True)
            ]
        return "\n".join([*lines, *(f"doubtful: {note}" for note in self.warnings)])

    def to_anesthetic(self) -> Any:
        """Convert to `anesthetic.NestedSamples`: parameters, `logL` and `logL_birth` of every dead point.

        anesthetic knows neither labels nor impossible hypotheses. So the levels of a plateau are made distinct by
        single units in the last place, in the order of the labels, and `log_start` (log of the possible share of the
        prior) is added to every level. ImportError if anesthetic is not installed.
        """
        anesthetic = _import_optional("anesthetic")
        death, birth = self._log_likelihoods_without_ties()
        return anesthetic.NestedSamples(
            data=np.array(self.theta), columns=list(self.names), logL=death, logL_birth=birth, label="probewise"
        )

    def to_arviz(self, *, rng: np.random.Generator, n: int | None = None) -> Any:
        """Convert to ArviZ's container (`arviz.InferenceData`; `xarray.DataTree` from ArviZ 1.0 on).

        It holds one chain of `n` equally weighted samples, by default as many as the effective sample size, so that few
        are repeated. Group `posterior` has a variable for each parameter; `sample_stats` has each sample's log
        likelihood `log_l`, the level `log_l_birth` above which it was drawn, and its `row` in the result. Attributes
        are those of the run. ImportError if arviz is not installed; ParameterError if there are no parameters.
        """
        require(self.names, "names", self.names, "one parameter or more; without any there are no samples")
        arviz = _import_optional("arviz")
        told = ("log_z", "log_z_error", "n_eff", "n_calls", "n_live", "stop_reason")
        attributes = {
            "inference_library": "probewise",
            "inference_library_version": self.versions["probewise"],
            "information_nats": self.information,
            "warnings": json.dumps(self.warnings),
            **{name: getattr(self, name) for name in told},
        }
        rows = self.draw_rows(max(1, int(self.n_eff)) if n is None else n, rng=rng)
        stats = {"log_l": self.log_likelihood[rows], "log_l_birth": self.log_birth[rows], "row": rows}
        groups = {
            "posterior": {name: self.theta[None, rows, i] for i, name in enumerate(self.names)},
            "sample_stats": {name: values[None, :] for name, values in stats.items()},
        }
        # ArviZ 1.0 takes all groups as one mapping, earlier versions one argument per group.
        if "data" in inspect.signature(arviz.from_dict).parameters:
            return arviz.from_dict(groups, attrs={"/": attributes})
        return arviz.from_dict(**groups, attrs=attributes)

    def _log_likelihoods_without_ties(self) -> tuple[FloatArray, FloatArray]:
        """Return log likelihoods at death and birth, (n_dead,) each, plus `log_start`; ties are broken by label."""
        strict = self.log_likelihood + self.log_start  # deaths are in order, ties by label
        for i in range(1, len(strict)):
            if strict[i] <= strict[i - 1]:
                strict[i] = np.nextafter(strict[i - 1], np.inf)
        born = birth_rows(self.log_likelihood, self.label, self.log_birth, self.birth_label)
        return strict, np.where(born >= 0, strict[born], -np.inf)

    def save(self, path: str | Path) -> None:
        """Write the result to one .npz file, atomically; FileError if it cannot be written."""
        path = checked_path("path", path)
        arrays = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self) if f.type in _READ_ONLY}
        head = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in arrays}
        head["check"] = self.check and asdict(self.check)
        write_bytes_atomically(path, archive_bytes({"format": _FORMAT, **head}, arrays, compressed=True))

    @classmethod
    def load(cls, path: str | Path) -> NestedResult:
        """Read a file written by `save`; FileError if there is none, or it is damaged or of another format."""
        path = checked_path("path", path)
        wanted, cure = "a file written by NestedResult.save", "make the file anew with this version"
        head, arrays = read_archive(path, _FORMAT, wanted, cure=cure)
        head.pop("agreement", None)  # of earlier versions
        if odd := {*head, *arrays} ^ {f.name for f in fields(cls)}:
            names = ", ".join(sorted(odd))
            raise FileError(path, f"fields {names} missing or unknown", "the fields that NestedResult.save writes")
        try:
            head |= {name: tuple(head[name]) for name in ("names", "warnings")}
            head["check"] = head["check"] and Check(**head["check"])
            n_dead, n_ranks = (arrays[name].size for name in ("log_weight", "insertion_rank"))
            shapes = {"theta": (n_dead, len(head["names"])), **dict.fromkeys(_OF_RANKS, (n_ranks,))}
            for name, array in arrays.items():
                sound = array.shape == shapes.get(name, (n_dead,)) and not np.isnan(array.astype(np.float64)).any()
                require(sound and array.dtype.kind in "biuf", name, array, f"numbers, {shapes.get(name, (n_dead,))}")
            return cls(**(head | arrays))
        except (KeyError, TypeError, ValueError) as error:
            raise FileError(path, f"unusable: {message_of(error, kind=False)}", wanted) from error


def archive_bytes(head: Mapping[str, object], arrays: Mapping[str, NDArray[Any]], *, compressed: bool = False) -> bytes:
    """Return the bytes of an .npz of arrays and of a JSON object, `head`; its zip format holds a checksum of each."""
    buffer = io.BytesIO()
    write = np.savez_compressed if compressed else np.savez
    write(buffer, allow_pickle=False, head=np.array(json.dumps(head, default=as_json)), **arrays)
    return buffer.getvalue()


def read_archive(path: Path, form: str, wanted: str, *, cure: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Read the JSON object, without its "format", and the arrays of a file of `archive_bytes`.

    FileError if it is missing or not what is `wanted`, or its format is not `form` (`cure`: the way out).
    """
    try:
        # Opened here, since np.load leaves a damaged file open.
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            content = {name: file[name] for name in file.files if name != "sha256"}  # which earlier files have
        head = json.loads(str(content.pop("head")))
        found = head.pop("format", None) if isinstance(head, dict) else None
    except FileNotFoundError as error:
        raise FileError(path, "there is no such file", wanted) from error
    except Exception as error:  # a damaged archive can raise whatever its parts do
        # NumPy takes any other file for a pickle, and its message would advise to load it.
        why = "no NumPy archive" if "pickle" in str(error) else message_of(error, kind=False)
        raise FileError(path, f"unreadable ({why})", wanted) from error
    if found != form:
        raise FileError(path, f"format {shown(found)}", f"{form!r}; {cure}")
    return head, content


def as_json(value: object) -> object:
    """Convert what `json` cannot: arrays to lists, anything else to text."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


def software_versions() -> dict[str, str]:
    """Return the versions of the software on which a run's numbers depend, by name."""
    return {
        "probewise": __version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
    }


def _import_optional(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            f"{name} is an optional package that cannot be imported ({error}); install it with: pip install {name}"
        ) from error


@own_arithmetic
def merge(results: Iterable[NestedResult], *, rng: np.random.Generator) -> NestedResult:
    """Merge independent runs of the same problem, two or more, into one run with the live points of all.

    A point is alive between the level above which it was drawn and its own. Sorted by level, the points of all runs
    form a run whose number of live points at each level is the sum over the runs (Higson, Handley, Hobson & Lasenby
    2019, section 4). The runs may differ in their numbers of live points and in where they stop. The labels make the
    count exact on plateaus. Merged runs may be merged again. The error of ln Z, for which `rng` draws, falls as one
    over the root of the number of runs.

    If the runs' evidences differ by more than their errors allow (chi-square, p < 0.001), a warning is added and the
    error is at least their scatter.

    Raises ParameterError if there are fewer than two runs, or their parameters differ, or they share a seed or lack a
    complete record of births and deaths.
    """
    require_rng(rng)
    parts = tuple(results)
    seeds = _seed_states_of_mergeable_runs(parts)
    order = np.lexsort([np.concatenate([getattr(r, name) for r in parts]) for name in _LEVELS[1::-1]])
    joined = {name: np.concatenate([getattr(r, name) for r in parts])[order] for name in ("theta", *_LEVELS)}
    n_at_death = n_alive_at_death(*(joined[name] for name in _LEVELS))
    first = np.cumsum([0, *(r.n_dead for r in parts[:-1])])
    parent = np.concatenate([np.where(r.parent >= 0, r.parent + n, -1) for r, n in zip(parts, first, strict=True)])
    parent = np.where(parent >= 0, np.argsort(order)[parent], -1)[order]
    # Each run has its own estimate: in the joined record a run is never complete between two rounds.
    remembered = float(np.average([r.memory for r in parts], weights=[r.n_live for r in parts]))
    log_start, log_start_error = _pooled_log_possible_share(parts)
    evidence = integrate(joined["log_likelihood"], n_at_death, rng=rng, log_start=log_start)
    error = math.hypot(math.sqrt(remembered) * evidence.spread, log_start_error)
    # Fisher's method combines independent p values.
    fisher = -2.0 * float(np.log(np.maximum([r.insertion_p_value for r in parts], 1e-300)).sum())
    p_value = float(chdtrc(2 * len(parts), fisher))
    doubts = list[str]()
    # A constant likelihood has an exact evidence: the error is nought, or a last digit.
    each, own = np.array([[r.log_z, max(r.log_z_error, 1e-12)] for r in parts]).T
    chi_square = float((((each - np.average(each, weights=own**-2)) / own) ** 2).sum())
    if (p := float(chdtrc(len(parts) - 1, chi_square))) < _DISAGREE:
        error = max(error, float(np.std(each, ddof=1)))
        doubts.append(
            f"the {len(parts)} runs disagree more than their errors: ln Z from {each.min():.2f} to {each.max():.2f} "
            f"(p = {p:.1g}): some missed a part of the posterior; the error is widened to their scatter; use more "
            "n_live or longer chains"
        )
    if p_value < DOUBTFUL_P_VALUE:
        doubts.append(f"insertion ranks of the runs together are not uniform (p = {p_value:.1g})")
    for doubt in doubts:
        warn(doubt, DoubtfulResultWarning)
    inherited = [f"run {i} of {len(parts)}: {note}" for i, r in enumerate(parts, start=1) for note in r.warnings]
    return NestedResult(
        names=parts[0].names,
        **joined,
        log_weight=evidence.log_weight,
        parent=parent,
        n_at_death=n_at_death,
        log_start=log_start,
        log_start_error=log_start_error,
        log_z=evidence.log_z,
        log_z_error=error,
        memory=remembered,
        information=evidence.information,
        n_eff=n_independent(joined["theta"], np.exp(evidence.log_weight), parent),
        n_calls=sum(r.n_calls for r in parts),
        n_live=sum(r.n_live for r in parts),
        stop_reason=f"merged {len(parts)} runs: " + "; ".join(dict.fromkeys(r.stop_reason for r in parts)),
        complete=all(r.complete for r in parts),
        insertion_rank=np.concatenate([r.insertion_rank for r in parts]),
        insertion_n_ranked=np.concatenate([r.insertion_n_ranked for r in parts]),
        insertion_p_value=p_value,
        seed_state=json.dumps(seeds),
        versions=software_versions(),
        warnings=(*doubts, *inherited),
        check=None,
    )


def n_alive_at_death(
    log_likelihood: FloatArray, label: FloatArray, log_birth: FloatArray, birth_label: FloatArray
) -> IntArray:
    """Count the points alive at each death, itself included, from the levels of birth and death, all (n_dead,).

    Deaths are in order of level. A point is alive from the deaths on that lie strictly above its birth.
    """
    birth, death = birth_rows(log_likelihood, label, log_birth, birth_label), np.arange(len(label))
    return np.asarray(np.searchsorted(np.sort(birth), death) - death)


def _seed_states_of_mergeable_runs(parts: Sequence[NestedResult]) -> list[object]:
    require(len(parts) >= 2, "results", f"{len(parts)} runs", "two runs or more")
    names, seeds = parts[0].names, list[object]()
    require(names, "results", "runs without parameters", "runs with some; the evidence is exact without")
    for number, result in enumerate(parts, start=1):
        require(result.names == names, f"names of run {number}", result.names, f"those of the first run, {names}")
        if not np.array_equal(n_alive_at_death(*(getattr(result, name) for name in _LEVELS)), result.n_at_death):
            allowed = "complete runs of nested sampling, in the order of log likelihood and label"
            raise ParameterError(f"n_at_death of run {number}", "not what births and deaths give", allowed)
        state = json.loads(result.seed_state)
        for one in state if isinstance(state, list) else [state]:
            if one in seeds:
                allowed = "independent runs: give each its own generator, `rng.spawn(n_runs)`"
                raise ParameterError(f"seed_state of run {number}", "that of a run before it", allowed)
            seeds.append(one)
    return seeds


def _pooled_log_possible_share(parts: Sequence[NestedResult]) -> tuple[float, float]:
    """Pool the shares of the prior with nonzero likelihood; return the log of the pooled share and its error.

    A share s = m / n has the relative error sqrt((1 - s) / m), from which m follows; if all were possible, m is the
    number of live points.
    """
    found = drawn = 0.0
    for result in parts:
        share = math.exp(result.log_start)
        possible = (1.0 - share) / result.log_start_error**2 if result.log_start_error > 0 else float(result.n_live)
        found += possible
        drawn += possible / share
    share = found / drawn
    return math.log(share), math.sqrt(max(1.0 - share, 0.0) / found)
