"""Does the repaired model predict readings kept back? Leave one scan out; rows left out at random would leak."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.diagnosis.fit import Fit, fit
from probewise.diagnosis.noise import white
from probewise.recordings.plan import Recording

__all__ = ["HeldOut", "compare_scans", "held_out_gain"]

_LEAST_ROWS = 8
_MOST_SCANS = 10


@dataclass(frozen=True)
class HeldOut:
    """Gain of a model over the null on readings kept back, nats a reading, and the sd of that mean."""

    per_reading: float
    sd: float
    n_readings: int
    by_scan: tuple[tuple[str, float], ...]


def held_out_gain(null: Fit, repaired: Fit, recording: Recording, *, sd_floor: float) -> HeldOut:
    """Refit both models without one scan at a time and compare how they predict it, reading by reading.

    Scans of fewer than eight readings stay in; of more than ten longer ones, ten spread over the
    recording are kept back in turn.
    """
    plan, usable = recording.plan, recording.usable

    def gain(out: BoolArray) -> FloatArray:
        rows = np.zeros(len(plan), dtype=np.bool_)
        rows[np.flatnonzero(usable)[out]] = True
        return _log_density(repaired, recording, rows, sd_floor) - _log_density(null, recording, rows, sd_floor)

    return compare_scans(plan.scan[usable], gain, plan.scan_names)


def compare_scans(scan: IntArray, gain: Callable[[BoolArray], FloatArray], scan_names: Sequence[str] = ()) -> HeldOut:
    """Keep one scan back at a time and gather the gains of its readings.

    Parameters
    ----------
    scan
        Scan of each usable reading, (n_usable,).
    gain
        For a mask of the readings kept back (n_usable,), the gain of each of them, in nats.
    scan_names
        Names of the scans; without, their numbers.
    """
    long_enough = [int(k) for k in np.unique(scan) if np.sum(scan == k) >= _LEAST_ROWS]
    if len(long_enough) < 2:
        return HeldOut(0.0, 0.0, 0, ())
    if len(long_enough) > _MOST_SCANS:
        long_enough = [long_enough[int(i)] for i in np.linspace(0, len(long_enough) - 1, _MOST_SCANS).round()]
    gains = [gain(np.asarray(scan == k)) for k in long_enough]
    by_scan = tuple(
        (scan_names[k] if scan_names else str(k), float(g.mean())) for k, g in zip(long_enough, gains, strict=True)
    )
    joined = np.concatenate(gains)
    sd = float(joined.std(ddof=1)) / math.sqrt(len(joined))
    return HeldOut(float(joined.mean()), sd, len(joined), by_scan)


def _log_density(found: Fit, recording: Recording, out: BoolArray, sd_floor: float) -> FloatArray:
    """Log predictive density of each reading of the rows `out`, by a refit to the others."""
    readings = np.where(out, np.nan, recording.readings)
    kept = Recording(recording.plan, readings, recording.source)
    n_kept = int(kept.usable.sum())
    without = fit(found.model, kept, found.z, white(n_kept), sd_floor=sd_floor, max_steps=4, tolerance=0.05)
    rows = np.flatnonzero(out & recording.usable)
    predicted, slopes = (part[rows] for part in found.model.jacobian(without.z))
    p = slopes.shape[1]
    variance = without.sd**2 * n_kept / max(n_kept - p, 1)
    curvature = without.slopes.T @ without.slopes / variance + np.eye(p)
    spread = np.sum(slopes * np.linalg.solve(curvature, slopes.T).T, axis=1)
    total = variance + spread
    miss = recording.readings[rows] - predicted
    return np.asarray(-0.5 * np.log(2 * np.pi * total) - 0.5 * miss**2 / total)
