"""The result of a run of nested sampling, with everything needed to judge it."""

from __future__ import annotations

import io
import json
import math
import platform
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from probewise._arrays import FloatArray, IntArray, frozen, frozen_int
from probewise._display import ShowsItself
from probewise._kinds import require_number, require_path, require_rng, require_whole
from probewise._version import __version__
from probewise.errors import FileError, ParameterError, ShapeError
from probewise.nested import conversions
from probewise.nested.evidence import log_volumes
from probewise.nested.weights import weighted_quantiles
from probewise.recordings.atomic import write_bytes_atomically

__all__ = ["Agreement", "Check", "NestedResult", "few_lineages", "few_possible", "versions"]

_FORMAT = "nested-result/4"
_PER_POINT = ("log_likelihood", "label", "log_weight", "log_birth", "birth_label")
_COUNTS = ("parent", "n_at_death", "insertion_rank", "insertion_n_ranked")
# Lineage variance above which the run descends from too few lineages to estimate its own error.
_MOST_MEMORY = 10.0
_ARRAYS = ("theta", *_PER_POINT, *_COUNTS)


def versions() -> dict[str, str]:
    """Versions of the software that determines a run's numbers."""
    return {
        "probewise": __version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
    }


@dataclass(frozen=True)
class Agreement:
    """A test whether independent runs of one problem agree within their errors.

    Attributes
    ----------
    log_z, log_z_error
        Of each run.
    chi_square
        Sum of the squared deviations from the weighted mean, in units of each run's error.
    p_value
        Probability of a chi-square at least as large if the errors are right (n_runs - 1 degrees of freedom).
    """

    log_z: tuple[float, ...]
    log_z_error: tuple[float, ...]
    chi_square: float
    p_value: float

    @property
    def n_runs(self) -> int:
        """Number of runs."""
        return len(self.log_z)

    @property
    def scatter(self) -> float:
        """Standard deviation of ln Z between the runs."""
        return float(np.std(self.log_z, ddof=1))


@dataclass(frozen=True)
class Check:
    """A second, independent estimate of the evidence; see `probewise.nested.check`.

    Attributes
    ----------
    route
        The method, in words.
    log_z, log_z_error
        Natural log of the evidence by that method, and its standard error.
    distance
        The run's log Z minus this one, in units of the combined error.
    n_calls
        Likelihood evaluations used.
    """

    route: str
    log_z: float
    log_z_error: float
    distance: float
    n_calls: int


def few_possible(log_start: float, log_start_error: float, n_live: int) -> str | None:
    """Return a warning if fewer possible hypotheses than live points were drawn from the prior, else None.

    A share s of the prior, estimated from m possible hypotheses, has the relative error sqrt((1 - s) / m).
    """
    if log_start_error <= 0:
        return None
    share = math.exp(log_start)
    found = round((1.0 - share) / log_start_error**2)
    if found >= n_live:
        return None
    return f"only {found} of {round(found / share)} hypotheses drawn from the prior are possible"


def few_lineages(memory: float) -> str | None:
    """Return a warning if a run's `memory` is so large that the error derived from it is uncertain, else None."""
    if memory <= _MOST_MEMORY:
        return None
    return (
        f"memory is {memory:.0f}: so few lineages lead to the posterior that the error is itself uncertain; "
        "use more steps_per_param or more n_live"
    )


@dataclass(frozen=True, eq=False)
class NestedResult(ShowsItself):
    """The evidence, the weighted samples and the record of the run.

    Attributes
    ----------
    names
        Parameter names, one per column of theta.
    theta
        Dead points in order of death, followed by the last live points, (n_dead, n_params).
    log_likelihood, label, log_weight
        Of each: log likelihood, the number from 0 to 1 that orders points of equal likelihood,
        and log posterior weight (the weights sum to one), all (n_dead,).
    log_birth, birth_label
        Log likelihood and label of the dead point above which each was drawn, (n_dead,);
        minus infinity and 1 for draws from the whole prior.
    parent
        Row of the point at which each point's chain began; -1 for the initial draws from the prior, (n_dead,).
    n_at_death
        Number of points alive when each died, itself included, (n_dead,).
    log_start, log_start_error
        Natural log of the share of the prior with nonzero likelihood, and its standard error.
    log_z, log_z_error
        Natural log of the evidence, and its standard error: from simulated shrinkages, times the root of `memory`.
    memory
        Lineage variance: variance of log Z relative to independent points, 1 or more; see
        `probewise.nested.chain_memory`.
    information
        Kullback-Leibler divergence of posterior from prior, nats.
    n_eff
        Kish's effective sample size.
    n_calls, n_live
        Numbers of likelihood evaluations, those of the check included, and of live points.
    stop_reason
        Why the run ended.
    complete
        Whether its stopping rule ended it, rather than a limit, an interruption or a failure.
    insertion_rank, insertion_n_ranked
        Rank of each new point among those alive, 0 to m, and m, both (n_inserted,).
    insertion_p_value
        p value of the test that the insertion ranks are uniform, as for a correct sampler.
    seed_state
        State of the random generator at the start, as JSON; a list of states for merged runs.
    versions
        Of probewise, numpy, scipy and python.
    warnings
        Reasons to doubt the result; empty for a sound run.
    agreement
        Agreement of the runs that were merged into this result; None for a single run.
    check
        A second estimate of the evidence; None if there is none.
    """

    names: tuple[str, ...]
    theta: FloatArray
    log_likelihood: FloatArray
    label: FloatArray
    log_weight: FloatArray
    log_birth: FloatArray
    birth_label: FloatArray
    parent: IntArray
    n_at_death: IntArray
    log_start: float
    log_start_error: float
    log_z: float
    log_z_error: float
    memory: float
    information: float
    n_eff: float
    n_calls: int
    n_live: int
    stop_reason: str
    complete: bool
    insertion_rank: IntArray
    insertion_n_ranked: IntArray
    insertion_p_value: float
    seed_state: str
    versions: Mapping[str, str]
    warnings: tuple[str, ...]
    agreement: Agreement | None = None
    check: Check | None = None

    def __post_init__(self) -> None:
        theta = frozen(self.theta)
        if theta.ndim != 2 or theta.shape[1] != len(self.names):
            raise ShapeError(f"theta has shape {theta.shape}; allowed: (n_dead, {len(self.names)}) for {self.names}")
        object.__setattr__(self, "theta", theta)
        for name in _PER_POINT:
            self._freeze(name, frozen(getattr(self, name)), len(theta), "row of theta")
        for name in ("parent", "n_at_death"):
            self._freeze(name, frozen_int(getattr(self, name)), len(theta), "row of theta")
        rank = frozen_int(self.insertion_rank)
        self._freeze("insertion_rank", rank, rank.size, "inserted point")
        self._freeze("insertion_n_ranked", frozen_int(self.insertion_n_ranked), rank.size, "inserted point")

    def _freeze(self, name: str, values: FloatArray | IntArray, n: int, one: str) -> None:
        if values.shape != (n,):
            raise ShapeError(f"{name} has shape {values.shape}; allowed: ({n},), one per {one}")
        object.__setattr__(self, name, values)

    @property
    def weight(self) -> FloatArray:
        """Posterior weights, summing to one, (n_dead,)."""
        return np.asarray(np.exp(self.log_weight))

    @property
    def n_dead(self) -> int:
        """Number of weighted samples."""
        return len(self.theta)

    @property
    def log_volume(self) -> FloatArray:
        """Expected natural log of the prior share above each sample, ln X, (n_dead,)."""
        return log_volumes(self.n_at_death, self.log_start)

    @property
    def calls_per_live_point_and_nat(self) -> float:
        """Likelihood evaluations per live point and nat of information.

        At least one: n_live deaths compress the volume by one nat, and each dead point is replaced.
        The excess is the cost of drawing above a bound.
        """
        return self.n_calls / (self.n_live * self.information) if self.information > 0 else math.inf

    def rows(self, n: int, *, rng: np.random.Generator) -> IntArray:
        """Draw the row numbers of `n` equally weighted samples, (n,), in random order; see `samples`."""
        require_rng(rng)
        n = require_whole("n", n)
        ladder = np.cumsum(self.weight)
        rows = np.searchsorted(ladder / ladder[-1], (np.arange(n) + rng.random()) / n, side="right")
        return np.asarray(rng.permutation(np.minimum(rows, len(ladder) - 1)))

    def samples(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw `n` equally weighted posterior samples, (n, n_params), in random order.

        Systematic resampling: a point of weight w occurs n w times, rounded up or down, so points
        repeat only where a weight exceeds 1 / n; `diversify` makes repeated samples distinct.
        """
        return np.asarray(self.theta[self.rows(n, rng=rng)])

    def mean(self, f: Callable[[FloatArray], FloatArray] | None = None, *, block: int | None = None) -> FloatArray:
        """Average the parameters, or any function of them, over the posterior.

        Parameters
        ----------
        f
            Function from rows of theta, (n, n_params), to values, (n, ...), for instance an SSF field
            (n, n_v, n_u); by default the parameters themselves.
        block
            Largest number of rows passed to `f` at a time, to bound memory; by default all.

        Returns
        -------
        The posterior mean, with the shape of one row's value; (n_params,) without `f`.
        """
        if block is not None and block < 1:
            raise ParameterError("block", block, "1 or more")
        if f is None:
            return np.asarray(self.weight @ self.theta)
        size = self.n_dead if block is None else block
        total: FloatArray | None = None
        for first in range(0, self.n_dead, size):
            theta, weight = self.theta[first : first + size], self.weight[first : first + size]
            values = np.asarray(f(theta))
            if values.shape[:1] != (len(theta),):
                raise ShapeError(f"f(theta) has shape {values.shape}; allowed: {len(theta)} rows, as many as theta has")
            part = np.asarray(np.tensordot(weight, values, axes=(0, 0)))
            total = part if total is None else total + part
        return np.zeros(0) if total is None else total

    def covariance(self) -> FloatArray:
        """Posterior covariance of the parameters, (n_params, n_params)."""
        centred = self.theta - self.mean()
        return np.asarray((centred * self.weight[:, None]).T @ centred)

    def sd(self) -> FloatArray:
        """Posterior standard deviation of the parameters, (n_params,)."""
        return np.asarray(np.sqrt(self.weight @ (self.theta - self.mean()) ** 2))

    def quantiles(self, q: FloatArray | list[float] | tuple[float, ...]) -> FloatArray:
        """Weighted quantiles of each parameter, (n_q,) -> (n_q, n_params)."""
        return weighted_quantiles(self.theta, self.weight, q)

    def interval(self, mass: float = 0.95) -> FloatArray:
        """Central interval of each parameter that holds `mass`, (2, n_params): lower, upper."""
        share = "greater than 0, less than 1"
        columns = ", ".join(f"{name} {k}" for k, name in enumerate(self.names))
        if not 0 < require_number("mass", mass, f"a number {share}; columns of the result are {columns}") < 1:
            raise ParameterError("mass", mass, share)
        return self.quantiles([0.5 - mass / 2, 0.5 + mass / 2])

    def best(self) -> FloatArray:
        """Parameters of the greatest likelihood, (n_params,)."""
        return np.asarray(self.theta[int(np.argmax(self.log_likelihood))])

    def summary(self) -> str:
        """Describe the run and its posterior in plain text."""
        lines = [
            f"log Z        {self.log_z:.2f} ± {self.log_z_error:.2f}",
            f"information  {self.information:.2f} nats",
            f"samples      {self.n_dead}, effective sample size {self.n_eff:.0f}",
            f"cost         {self.n_calls} likelihood evaluations, {self.n_live} live points{self._efficiency()}",
            f"memory       {self.memory:.2f} times the variance of independent points",
            f"stopped      {self.stop_reason}",
            f"insertion    p = {self.insertion_p_value:.2g}",
        ]
        if self.agreement is not None:
            p = self.agreement.p_value
            lines.append(f"runs         {self.agreement.n_runs}, ln Z agree with p = {p:.2g}")
        if self.check is not None:
            lines.append(
                f"check        log Z {self.check.log_z:.2f} ± {self.check.log_z_error:.2f} by {self.check.route}, "
                f"{self.check.distance:+.1f} errors from this run, {self.check.n_calls} evaluations"
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

    def _efficiency(self) -> str:
        each = self.calls_per_live_point_and_nat
        return f", {each:.3g} for each live point and nat" if math.isfinite(each) else ""

    def to_anesthetic(self) -> Any:
        """Convert to `anesthetic.NestedSamples`; see `probewise.nested.conversions.to_anesthetic`."""
        return conversions.to_anesthetic(self)

    def to_arviz(self, *, rng: np.random.Generator, n: int | None = None) -> Any:
        """Convert to ArviZ's container of samples; see `probewise.nested.conversions.to_arviz`."""
        return conversions.to_arviz(self, rng=rng, n=n)

    def save(self, path: str | Path) -> None:
        """Write the result to one .npz file, atomically."""
        path = require_path("path", path)
        head = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _ARRAYS}
        head["agreement"] = None if self.agreement is None else asdict(self.agreement)
        head["check"] = None if self.check is None else asdict(self.check)
        arrays = {name: np.asarray(getattr(self, name)) for name in _ARRAYS}
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer, allow_pickle=False, head=np.array(json.dumps({"format": _FORMAT, **head})), **arrays
        )
        write_bytes_atomically(path, buffer.getvalue())

    @classmethod
    def load(cls, path: str | Path) -> NestedResult:
        """Read a file written by `save`.

        Raises
        ------
        FileError
            If the file is damaged, or is not a result in this version of the format.
        """
        path = require_path("path", path)
        try:
            # Opened here, since np.load leaves a damaged file open.
            with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
                head = json.loads(str(file["head"]))
                found = head.pop("format", None) if isinstance(head, dict) else None
                # Check before reading the arrays, which another version may store under other names.
                arrays = {name: file[name] for name in _ARRAYS} if found == _FORMAT else {}
        except FileNotFoundError as error:
            raise FileError(path, "there is no such file", "a file written by NestedResult.save") from error
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            # NumPy takes any other file for a pickle, and its message would advise to load it.
            why = "no NumPy archive" if "pickle" in str(error) else error
            raise FileError(path, f"unreadable ({why})", "a file written by NestedResult.save") from error
        if found != _FORMAT:
            raise FileError(path, f"format {found!r}", f"{_FORMAT!r}; make the file anew with this version")
        wanted = {f.name for f in fields(cls)} - set(_ARRAYS)
        if set(head) != wanted:
            odd = ", ".join(sorted(set(head) ^ wanted))
            raise FileError(path, f"fields {odd} missing or unknown", "the fields that NestedResult.save writes")
        head["names"], head["warnings"] = tuple(head["names"]), tuple(head["warnings"])
        head["check"] = None if head["check"] is None else Check(**head["check"])
        runs = head["agreement"]
        if runs is not None:
            head["agreement"] = Agreement(
                tuple(runs["log_z"]), tuple(runs["log_z_error"]), runs["chi_square"], runs["p_value"]
            )
        return cls(**head, **arrays)
