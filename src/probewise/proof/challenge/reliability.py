"""Calibration of stated probabilities: of the answers stated with 0.8, eight in ten should be right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.proof.challenge.estimates import Estimate, estimated_share, estimated_statistic
from probewise.proof.challenge.scoring import leading_probability_and_correctness

_EDGES = np.linspace(0, 1, 11)


@dataclass(frozen=True)
class Bin:
    """Cases of similar stated probability: its mean, and the share of right answers."""

    stated: float
    right: Estimate


def reliability_bins(results: Sequence[Mapping[str, Any]]) -> tuple[Bin, ...]:
    """Bin cases by the probability of their leading hypothesis into ten equal bins, ascending, without empty bins."""
    said = [leading_probability_and_correctness(result) for result in results]
    of_case = _bin_numbers(np.array([p for p, _ in said]))
    return tuple(
        Bin(
            float(np.mean([p for (p, _), at in zip(said, of_case, strict=True) if at == k])),
            estimated_share([right for (_, right), at in zip(said, of_case, strict=True) if at == k]),
        )
        for k in np.unique(of_case)
    )


def calibration_error(results: Sequence[Mapping[str, Any]]) -> Estimate:
    """Estimate the expected calibration error: abs(mean stated - share right) of each bin, averaged over the cases."""
    found = estimated_statistic(
        np.array([leading_probability_and_correctness(result) for result in results], dtype=np.float64).reshape(-1, 2),
        _calibration_error_of_rows,
    )
    return replace(found, low=max(found.low, 0.0), high=max(found.high, 0.0)) if found.n else found


def _calibration_error_of_rows(said: FloatArray) -> float:
    """Return the calibration error of rows (probability, 1 if right or 0), (n, 2)."""
    off = np.bincount(_bin_numbers(said[:, 0]), said[:, 0] - said[:, 1])
    return float(np.abs(off).sum()) / len(said)


def _bin_numbers(probability: FloatArray) -> IntArray:
    return np.clip(np.searchsorted(_EDGES, probability, side="right") - 1, 0, len(_EDGES) - 2)
