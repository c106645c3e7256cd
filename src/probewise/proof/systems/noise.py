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
    """A noise model of a case.

    `name`: "white" or one of OTHER_NOISE; `draw`: function of noise-free readings, table and a generator; returns
    readings with noise, (n_points,); `parameters`: its parameters by name, as in the vocabulary; `size_lambda`: square
    root of twice the expected gain in log likelihood over white noise; 0 if its strength is fixed; `step`: step to
    which this noise asks to round readings; None: no rounding.
    """

    name: str
    draw: Callable[[FloatArray, SystemTable, np.random.Generator], FloatArray]
    parameters: Mapping[str, object] = field(default_factory=dict)
    size_lambda: float = 0.0
    step: float | None = None


def noise_of_size(
    name: str, wanted: float, readings: FloatArray, rows: SystemTable, sd: float, *, rng: np.random.Generator
) -> SystemNoise:
    """Return the noise `name` at the strength at which it is as detectable as an effect of lambda `wanted`.

    If none suffices, at the largest. "white", "outliers", "dropouts", "t4" and "quantised" have a fixed strength.
    """
    n = len(rows)

    def of(in_sds: Callable[..., FloatArray], **parameters: Any) -> SystemNoise:
        """Return noise that is added, of a fixed strength; `in_sds`: function of readings, table and generator."""
        return SystemNoise(name, lambda y, rows, rng: y + sd * in_sds(y, rows, rng), parameters)

    def white(y: FloatArray, rows: SystemTable, rng: np.random.Generator) -> FloatArray:
        return rng.standard_normal(len(y))

    match name:
        case "white":
            return of(white)
        case "correlated_noise":
            rho = math.sqrt(1 - math.exp(-(wanted**2) / (n - len(rows.rows_by_run))))
            return replace(of(lambda y, rows, rng: _ar1_noise(rows, rho, rng), rho=rho), size_lambda=wanted)
        case "random_walk":
            spectrum = _walk_covariance_eigenvalues(n)
            q, size = _strength_and_size(lambda a: _lambda_of_variances(1 + a**2 * spectrum), wanted, 1e-4, 1.0)
            walk = of(lambda y, rows, rng: white(y, rows, rng) + q * np.cumsum(white(y, rows, rng)), sd_per_row=q * sd)
            return replace(walk, size_lambda=size)
        case "signal_dependent_noise":
            low, span = float(readings.min()), float(np.ptp(readings))

            def variance(y: FloatArray, ratio: float) -> FloatArray:
                return 1 + ratio * np.clip((y - low) / span, 0, None)

            ratio, size = _strength_and_size(lambda a: _lambda_of_variances(variance(readings, a)), wanted, 1e-3, 1e4)
            own = of(lambda y, rows, rng: np.sqrt(variance(y, ratio)) * white(y, rows, rng), ratio=ratio)
            return replace(own, size_lambda=size)
        case "noise_per_run":
            logs = rng.standard_normal(rows.n_runs)
            power, size = _strength_and_size(
                lambda a: _lambda_of_variances(np.exp(2 * a * logs)[rows.run]), wanted, 1e-2, 3.0
            )
            each = np.exp(power * logs)
            per_run = of(lambda y, rows, rng: each[rows.run] * white(y, rows, rng), values=(sd * each).tolist())
            return replace(per_run, size_lambda=size)
        case "outliers":
            share, wide = 0.03, 7.0
            return of(
                lambda y, rows, rng: (
                    white(y, rows, rng) + np.where(rng.random(len(y)) < share, wide * white(y, rows, rng), 0.0)
                ),
                share=share,
                size=wide,
            )
        case "dropouts":
            share, value = 0.02, 0.0
            return SystemNoise(
                name,
                lambda y, rows, rng: np.where(rng.random(len(y)) < share, value, y + sd * white(y, rows, rng)),
                {"share": share, "value": value},
            )
        case "t4":  # its scale is the sd of the normal that matches its centre
            return of(lambda y, rows, rng: rng.standard_t(4.0, len(y)), freedom=4.0)
        case _:
            step = _nearest_preferred_number(2.0 * sd)
            return replace(of(white, step=step), step=step)


def _ar1_noise(rows: SystemTable, rho: float, rng: np.random.Generator) -> FloatArray:
    """Draw AR(1) noise of sd 1 and correlation `rho`, which starts anew in each run, (n_points,)."""
    own = rng.standard_normal(len(rows))
    for run in rows.rows_by_run:
        for before, row in pairwise(run):
            own[row] = rho * own[before] + math.sqrt(1 - rho**2) * own[row]
    return own


def _walk_covariance_eigenvalues(n: int) -> FloatArray:
    """Return the eigenvalues of the covariance of n steps of a centred unit-step random walk, ascending, (n - 1,)."""
    count = np.arange(1.0, n + 1)
    walk = np.minimum(count[:, None], count)
    centered = walk - walk.mean(axis=0) - walk.mean(axis=1)[:, None] + walk.mean()
    return np.asarray(np.maximum(np.linalg.eigvalsh(centered)[1:], 0.0))


def _lambda_of_variances(variances: FloatArray) -> float:
    """Return lambda (see `SystemNoise.size_lambda`) of noise with these variances against their mean."""
    n = len(variances)
    return math.sqrt(max(n * math.log(variances.mean()) - float(np.log(variances).sum()), 0.0))


def _strength_and_size(size: Callable[[float], float], wanted: float, low: float, high: float) -> tuple[float, float]:
    """Return (strength, `wanted`) where `size(strength)` is `wanted`, or (`high`, its size) if that is less."""
    largest = size(high)
    if largest <= wanted:
        return high, largest
    strength = float(np.exp(brentq(lambda a: size(math.exp(a)) - wanted, math.log(low), math.log(high), xtol=1e-4)))
    return strength, wanted


def _nearest_preferred_number(value: float) -> float:
    """Return that of 1, 2 and 5 times powers of ten which is nearest on a logarithmic scale."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(min((m * power for m in (1.0, 2.0, 5.0, 10.0)), key=lambda m: abs(math.log(m / value))))
