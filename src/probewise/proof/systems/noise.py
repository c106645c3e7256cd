"""Kinds of noise, most of them not white; of some, the strength follows from a requested detectability."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.optimize import brentq

from probewise._arrays import FloatArray
from probewise.proof.systems.kinds import SystemTable

OTHER_NOISE = (
    "correlated_noise",
    "outliers",
    "signal_dependent_noise",
    "t4",
    "random_walk",
    "quantised",
    "noise_per_run",
    "dropouts",
)
"""Kinds of noise of a clean recording, besides white; "t4" and "quantised" are not in the vocabulary."""


@dataclass(frozen=True, eq=False)
class SystemNoise:
    """A noise model of a case."""

    name: str  # "white" or one of OTHER_NOISE
    # Readings with noise, (n_points,), from noise-free ones, table and a generator.
    draw: Callable[[FloatArray, SystemTable, np.random.Generator], FloatArray]
    parameters: Mapping[str, object] = field(default_factory=dict)  # by name, as in the vocabulary
    size_lambda: float = 0.0  # root of twice the expected gain in log likelihood over white noise; 0: fixed strength
    step: float | None = None  # to which this noise asks to round readings


def noise_of_size(
    name: str, wanted: float, readings: FloatArray, rows: SystemTable, sd: float, *, rng: np.random.Generator
) -> SystemNoise:
    """Return the noise `name` at the strength at which it is as detectable as an effect of lambda `wanted`.

    If none suffices, at the largest. "white", "outliers", "dropouts", "t4" and "quantised" have a fixed strength.
    """
    n = len(rows)

    def of(in_sds: Callable[..., FloatArray], size_lambda: float = 0.0, **parameters: Any) -> SystemNoise:
        return SystemNoise(name, lambda y, rows, rng: y + sd * in_sds(y, rows, rng), parameters, size_lambda)

    def white(y: FloatArray, rows: SystemTable, rng: np.random.Generator) -> FloatArray:
        return rng.standard_normal(len(y))

    match name:
        case "white":
            return of(white)
        case "correlated_noise":
            rho = math.sqrt(1 - math.exp(-(wanted**2) / (n - len(rows.rows_by_run))))

            def correlated(y: FloatArray, rows: SystemTable, rng: np.random.Generator) -> FloatArray:
                """Draw AR(1) noise of sd 1, which starts afresh in each run."""
                out = rng.standard_normal(len(rows))
                for run in rows.rows_by_run:
                    for before, row in pairwise(run):
                        out[row] = rho * out[before] + math.sqrt(1 - rho**2) * out[row]
                return out

            return of(correlated, wanted, rho=rho)
        case "random_walk":
            # Eigenvalues of the covariance of n steps of a centred unit-step walk, without that of the mean.
            count = np.arange(1.0, n + 1)
            walk = np.minimum(count[:, None], count)
            centered = walk - walk.mean(axis=0) - walk.mean(axis=1)[:, None] + walk.mean()
            spectrum = np.maximum(np.linalg.eigvalsh(centered)[1:], 0.0)
            q, size = _strength_and_size(lambda a: 1 + a**2 * spectrum, wanted, 1e-4, 1.0)
            steps = lambda y, rows, rng: white(y, rows, rng) + q * np.cumsum(white(y, rows, rng))  # noqa: E731
            return of(steps, size, sd_per_row=q * sd)
        case "signal_dependent_noise":
            low, span = float(readings.min()), float(np.ptp(readings))

            def variance(y: FloatArray, ratio: float) -> FloatArray:
                return 1 + ratio * np.clip((y - low) / span, 0, None)

            ratio, size = _strength_and_size(lambda a: variance(readings, a), wanted, 1e-3, 1e4)
            return of(lambda y, rows, rng: np.sqrt(variance(y, ratio)) * white(y, rows, rng), size, ratio=ratio)
        case "noise_per_run":
            logs = rng.standard_normal(rows.n_runs)
            power, size = _strength_and_size(lambda a: np.exp(2 * a * logs)[rows.run], wanted, 1e-2, 3.0)
            each = np.exp(power * logs)
            return of(lambda y, rows, rng: each[rows.run] * white(y, rows, rng), size, values=(sd * each).tolist())
        case "outliers":
            share, wide = 0.03, 7.0

            def outlying(y: FloatArray, rows: SystemTable, rng: np.random.Generator) -> FloatArray:
                return white(y, rows, rng) + np.where(rng.random(len(y)) < share, wide * white(y, rows, rng), 0.0)

            return of(outlying, share=share, size=wide)
        case "dropouts":
            share, value = 0.02, 0.0

            def lost(y: FloatArray, rows: SystemTable, rng: np.random.Generator) -> FloatArray:
                return np.where(rng.random(len(y)) < share, value, y + sd * white(y, rows, rng))

            return SystemNoise(name, lost, {"share": share, "value": value})
        case "t4":  # its scale is the sd of the normal that matches its centre
            return of(lambda y, rows, rng: rng.standard_t(4.0, len(y)), freedom=4.0)
        case _:  # quantised, to that of 1, 2 and 5 times powers of ten which is nearest on a logarithmic scale
            power = 10.0 ** math.floor(math.log10(2.0 * sd))
            step = min((m * power for m in (1.0, 2.0, 5.0, 10.0)), key=lambda m: abs(math.log(m / (2.0 * sd))))
            return replace(of(white, step=step), step=step)


def _strength_and_size(
    variances: Callable[[float], FloatArray], wanted: float, low: float, high: float
) -> tuple[float, float]:
    """Return (strength, `wanted`) where noise of the `variances` has lambda `wanted` against noise of their mean.

    That is (`high`, its lambda) if it is less there.
    """

    def size(strength: float) -> float:
        each = variances(strength)
        return math.sqrt(max(len(each) * math.log(each.mean()) - float(np.log(each).sum()), 0.0))

    if (largest := size(high)) <= wanted:
        return high, largest
    return float(np.exp(brentq(lambda a: size(math.exp(a)) - wanted, math.log(low), math.log(high), xtol=1e-4))), wanted
