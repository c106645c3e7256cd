"""What a run of nested sampling found, with everything needed to judge it."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from probewise._arrays import FloatArray, IntArray, frozen, frozen_int
from probewise._display import ShowsItself
from probewise.errors import FileError, ParameterError, ShapeError
from probewise.recordings.atomic import write_bytes_atomically

__all__ = ["NestedResult"]

_FORMAT = "nested-result/1"
_ARRAYS = ("theta", "log_likelihood", "log_weight", "log_birth", "insertion_rank")


@dataclass(frozen=True, eq=False)
class NestedResult(ShowsItself):
    """Hold the evidence, the weighted samples and the record of how they came about.

    Attributes
    ----------
    names
        Parameters, one a column of theta.
    theta
        Dead points in order of death, the last live ones behind them, (n_dead, n_params).
    log_likelihood, log_weight, log_birth
        Of each: log likelihood, log posterior weight (the weights sum to one), and the log
        likelihood level above which it was drawn, all (n_dead,).
    log_z, log_z_error
        Natural log of the evidence, and its standard error from simulated shrinkages.
    information
        Kullback-Leibler divergence of posterior from prior, nats.
    n_eff
        Kish's effective number of samples.
    n_calls, n_live
        Likelihood evaluations and live points.
    stop_reason
        Why the run ended.
    insertion_rank, insertion_p_value
        Rank of each new point among those alive, and the probability that ranks of a right
        sampler look as uneven as these.
    seed_state
        State of the random generator at the start, as JSON.
    version
        The package's.
    warnings
        Why the result should not be trusted blindly; empty for a sound run.
    """

    names: tuple[str, ...]
    theta: FloatArray
    log_likelihood: FloatArray
    log_weight: FloatArray
    log_birth: FloatArray
    log_z: float
    log_z_error: float
    information: float
    n_eff: float
    n_calls: int
    n_live: int
    stop_reason: str
    insertion_rank: IntArray
    insertion_p_value: float
    seed_state: str
    version: str
    warnings: tuple[str, ...]

    def __post_init__(self) -> None:
        theta = frozen(self.theta)
        if theta.ndim != 2 or theta.shape[1] != len(self.names):
            raise ShapeError(f"theta has shape {theta.shape}; allowed: (n_dead, {len(self.names)}) for {self.names}")
        object.__setattr__(self, "theta", theta)
        for name in ("log_likelihood", "log_weight", "log_birth"):
            values = frozen(getattr(self, name))
            if values.shape != (len(theta),):
                raise ShapeError(f"{name} has shape {values.shape}; allowed: ({len(theta)},), one a row of theta")
            object.__setattr__(self, name, values)
        object.__setattr__(self, "insertion_rank", frozen_int(self.insertion_rank))

    @property
    def weight(self) -> FloatArray:
        """Posterior weights, summing to one, (n_dead,)."""
        return np.asarray(np.exp(self.log_weight))

    @property
    def n_dead(self) -> int:
        """Number of weighted samples."""
        return len(self.theta)

    def samples(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw `n` equally weighted posterior samples, (n, n_params), in random order.

        Systematic resampling: a point of weight w occurs n w times, rounded up or down, so
        replications occur only where a weight exceeds 1 / n; `diversify` breaks them.
        """
        if n < 1:
            raise ParameterError("n", n, "1 or more")
        ladder = np.cumsum(self.weight)
        rows = np.searchsorted(ladder / ladder[-1], (np.arange(n) + rng.random()) / n, side="right")
        return np.asarray(self.theta[rng.permutation(np.minimum(rows, len(ladder) - 1))])

    def mean(self, f: Callable[[FloatArray], FloatArray] | None = None) -> FloatArray:
        """Posterior mean of the parameters, (n_params,), or of `f(theta)` (n_dead, ...), of the trailing shape."""
        values = self.theta if f is None else np.asarray(f(self.theta))
        if len(values) != self.n_dead:
            raise ShapeError(f"f(theta) has {len(values)} rows; allowed: {self.n_dead}, one a row of theta")
        return np.asarray(np.tensordot(self.weight, values, axes=(0, 0)))

    def covariance(self) -> FloatArray:
        """Posterior covariance of the parameters, (n_params, n_params)."""
        centred = self.theta - self.mean()
        return np.asarray((centred * self.weight[:, None]).T @ centred)

    def sd(self) -> FloatArray:
        """Posterior standard deviation of the parameters, (n_params,)."""
        return np.asarray(np.sqrt(self.weight @ (self.theta - self.mean()) ** 2))

    def quantiles(self, q: FloatArray | list[float] | tuple[float, ...]) -> FloatArray:
        """Weighted quantiles of each parameter, (n_q,) -> (n_q, n_params)."""
        levels = np.asarray(q, dtype=np.float64)
        if levels.ndim != 1 or not ((levels >= 0) & (levels <= 1)).all():
            raise ParameterError("q", q, "a list of numbers from 0 to 1")
        out = np.empty((levels.size, len(self.names)))
        for i in range(len(self.names)):
            order = np.argsort(self.theta[:, i])
            weight = self.weight[order]
            ladder = (np.cumsum(weight) - 0.5 * weight) / weight.sum()
            out[:, i] = np.interp(levels, ladder, self.theta[order, i])
        return out

    def interval(self, mass: float = 0.95) -> FloatArray:
        """Central interval of each parameter that holds `mass`, (2, n_params): lower, upper."""
        if not 0 < mass < 1:
            raise ParameterError("mass", mass, "greater than 0, less than 1")
        return self.quantiles([0.5 - mass / 2, 0.5 + mass / 2])

    def best(self) -> FloatArray:
        """Parameters of the greatest likelihood, (n_params,)."""
        return np.asarray(self.theta[int(np.argmax(self.log_likelihood))])

    def summary(self) -> str:
        """Describe the run and its posterior in plain text."""
        lines = [
            f"log Z        {self.log_z:.2f} ± {self.log_z_error:.2f}",
            f"information  {self.information:.2f} nats",
            f"samples      {self.n_dead}, worth {self.n_eff:.0f} independent ones",
            f"cost         {self.n_calls} likelihood evaluations, {self.n_live} live points",
            f"stopped      {self.stop_reason}",
            f"insertion    p = {self.insertion_p_value:.2g}",
        ]
        if self.names:
            width = max(9, *(len(name) for name in self.names))
            low, high = self.interval(0.95)
            lines.append(f"{'parameter':<{width}}  {'mean':>11}  {'sd':>11}  95 % interval")
            lines += [
                f"{name:<{width}}  {mean:>11.5g}  {sd:>11.3g}  {a:.5g} to {b:.5g}"
                for name, mean, sd, a, b in zip(self.names, self.mean(), self.sd(), low, high, strict=True)
            ]
        return "\n".join([*lines, *(f"doubtful: {note}" for note in self.warnings)])

    def save(self, path: str | Path) -> None:
        """Write everything to one .npz file, in one piece or not at all."""
        head = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _ARRAYS}
        arrays = {name: np.asarray(getattr(self, name)) for name in _ARRAYS}
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer, allow_pickle=False, head=np.array(json.dumps({"format": _FORMAT, **head})), **arrays
        )
        write_bytes_atomically(path, buffer.getvalue())

    @classmethod
    def load(cls, path: str | Path) -> NestedResult:
        """Read what `save` wrote.

        Raises
        ------
        FileError
            If the file is damaged, or no result of this version of the format.
        """
        try:
            # Opened here, since np.load leaves a damaged file open.
            with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
                head = json.loads(str(file["head"]))
                arrays = {name: file[name] for name in _ARRAYS}
        except FileNotFoundError:
            raise
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise FileError(path, f"unreadable ({error})", "a file written by NestedResult.save") from error
        found = head.pop("format", None) if isinstance(head, dict) else None
        if found != _FORMAT:
            raise FileError(path, f"format {found!r}", f"{_FORMAT!r}; make the file anew with this version")
        missing = {f.name for f in fields(cls)} - set(head) - set(_ARRAYS)
        if missing:
            raise FileError(path, f"without {', '.join(sorted(missing))}", "every field that NestedResult.save writes")
        head["names"], head["warnings"] = tuple(head["names"]), tuple(head["warnings"])
        return cls(**head, **arrays)
