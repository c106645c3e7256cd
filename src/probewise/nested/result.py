"""The result of a run of nested sampling, with everything needed to judge it."""

from __future__ import annotations

import io
import json
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from probewise._arrays import FloatArray, IntArray, frozen_int
from probewise._kinds import checked_path
from probewise._version import __version__
from probewise.errors import FileError
from probewise.nested import conversions
from probewise.nested.dead_points import COUNTS, PER_POINT, DeadPoints, checked_array_of_length
from probewise.nested.weights import weighted_quantiles
from probewise.recordings.atomic import write_bytes_atomically

_FORMAT = "nested-result/4"
# Lineage variance above which the run descends from too few lineages to estimate its own error.
_MOST_MEMORY = 10.0
_FEWEST_STEPS = 30.0  # between floating-point numbers, from quartile to quartile
_PER_INSERTION = ("insertion_rank", "insertion_n_ranked")
_ARRAYS = ("theta", *PER_POINT, *COUNTS, *_PER_INSERTION)


def software_versions() -> dict[str, str]:
    """Return the versions of the software on which a run's numbers depend, by name."""
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
    def log_z_sd(self) -> float:
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


def warning_of_few_possible_draws(log_start: float, log_start_error: float, n_live: int) -> str | None:
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


def warning_of_coarse_coordinates(names: Sequence[str], u: FloatArray, weight: FloatArray) -> str | None:
    """Return a warning if the posterior is too narrow in the sampling coordinates for floating-point numbers, or None.

    Just below 1 numbers are 1e-16 apart, so this is the case about 8 sds above the mean of a normal prior. Below the
    mean, near 0, there are numbers enough.

    Parameters
    ----------
    names
        Names of the parameters.
    u, weight
        Points in the sampling coordinates, (n, n_params), and their posterior weights, (n,), sum 1.
    """
    low, high = weighted_quantiles(u, weight, [0.25, 0.75])
    steps = (high - low) / np.spacing(np.abs(low))
    narrowest = int(np.argmin(steps))
    if steps[narrowest] >= _FEWEST_STEPS:
        return None
    return (
        f"half of the posterior of {names[narrowest]} lies within {steps[narrowest]:.0f} steps between floating-point "
        "numbers, where its prior is mapped to 0 to 1: log Z and samples may be far off; take a prior with more "
        "probability there"
    )


def warning_of_few_lineages(memory: float) -> str | None:
    """Return a warning if the lineage variance exceeds 10, so that the error from it is uncertain; else None."""
    if memory <= _MOST_MEMORY:
        return None
    return (
        f"memory is {memory:.0f}: so few lineages lead to the posterior that the error is itself uncertain; "
        "use more steps_per_param or more n_live"
    )


@dataclass(frozen=True, eq=False)
class NestedResult(DeadPoints):
    """The evidence, the weighted samples and the record of the run.

    The samples, their means and quantiles, are those of `DeadPoints`, whose attributes come first.

    Attributes
    ----------
    log_start_error
        Standard error of `log_start`.
    log_z, log_z_error
        Natural log of the evidence, and its standard error: from simulated shrinkages, times the root of `memory`.
    memory
        Lineage variance: variance of log Z relative to independent points, 1 or more; see
        `probewise.nested.relative_lineage_variance`.
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
        super().__post_init__()
        for name in _PER_INSERTION:
            values = checked_array_of_length(
                name, frozen_int(getattr(self, name)), np.size(self.insertion_rank), "inserted point"
            )
            object.__setattr__(self, name, values)

    @property
    def calls_per_live_point_and_nat(self) -> float:
        """Likelihood evaluations per live point and nat of information; infinite without information.

        With the default `n_replaced`, 0.72 n_live deaths compress the volume by one nat (n_live if points are replaced
        one at a time), and each dead point is replaced. The excess is the cost of drawing above a bound, of the first
        live points, and of the check.
        """
        return self.n_calls / (self.n_live * self.information) if self.information > 0 else math.inf

    def summary(self) -> str:
        """Describe the run and its posterior in plain text."""
        lines = [
            f"log Z        {self.log_z:.2f} ± {self.log_z_error:.2f}",
            f"information  {self.information:.2f} nats",
            f"samples      {self.n_dead}, effective sample size {self.n_eff:.0f}",
            f"cost         {self.n_calls} likelihood evaluations, {self.n_live} live points"
            f"{self._efficiency_in_words()}",
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

    def _efficiency_in_words(self) -> str:
        each = self.calls_per_live_point_and_nat
        return f", {each:.3g} for each live point and nat" if math.isfinite(each) else ""

    def to_anesthetic(self) -> Any:
        """Convert to `anesthetic.NestedSamples`; see `probewise.nested.conversions.to_anesthetic`."""
        return conversions.to_anesthetic(self)

    def to_arviz(self, *, rng: np.random.Generator, n: int | None = None) -> Any:
        """Convert to ArviZ's container of `n` samples; see `probewise.nested.conversions.to_arviz`.

        By default as many as the effective sample size, so that few are repeated.
        """
        attributes = {
            "inference_library": "probewise",
            "inference_library_version": self.versions["probewise"],
            "log_z": self.log_z,
            "log_z_error": self.log_z_error,
            "information_nats": self.information,
            "n_eff": self.n_eff,
            "n_calls": self.n_calls,
            "n_live": self.n_live,
            "stop_reason": self.stop_reason,
            "warnings": json.dumps(self.warnings),
        }
        return conversions.to_arviz(self, attributes, rng=rng, n=max(1, int(self.n_eff)) if n is None else n)

    def save(self, path: str | Path) -> None:
        """Write the result to one .npz file, atomically; FileError if it cannot be written."""
        path = checked_path("path", path)
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
            If there is no such file, or it is damaged, or not a result in this version of the format.
        """
        path = checked_path("path", path)
        try:
            # Opened here, since np.load leaves a damaged file open.
            with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
                head = json.loads(str(file["head"]))
                found = head.pop("format", None) if isinstance(head, dict) else None
                # Check before reading the arrays, which another version may store under other names.
                arrays = {name: file[name] for name in _ARRAYS} if found == _FORMAT else {}
        except FileNotFoundError as error:
            raise FileError(path, "there is no such file", "a file written by NestedResult.save") from error
        except Exception as error:  # a damaged archive can raise whatever its parts do
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
