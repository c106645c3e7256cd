"""What a repair gains, and how what has no name is repaired by bases."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.held_out import held_out_blocks, held_out_gain, held_out_parts
from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.repair.unknown import correct
from probewise.diagnosis.residuals.locate import ALARM, global_p_value
from probewise.diagnosis.search.weighed_fit import Search, WeighedFit

__all__ = ["Improvement", "corrected", "improvement_of"]

Names = tuple[str, ...]

_N_DRAWS = 499
_MOST_BASES = 6


@dataclass(frozen=True)
class Improvement:
    """What the repaired model gains over the null."""

    log_evidence: float
    heldout_log_density_per_reading: float
    heldout_sd: float
    heldout_by_scan: tuple[tuple[str, float], ...]
    rms_before: float
    rms_after: float
    p_value_after: float


def improvement_of(
    search: Search,
    null: WeighedFit,
    best: WeighedFit,
    noise: Names,
    after: Linearised,
    p_value: float,
    *,
    rng: np.random.Generator,
) -> Improvement:
    """Measure what the best candidate gains over the null: in evidence, on scans kept back, in what is left.

    Parameters
    ----------
    search
        What was weighed.
    null, best, noise
        The candidates, and the noise model of the best.
    after
        The best as a linear problem.
    p_value
        That nothing is missing from the null.
    rng
        Source of randomness, for the null law of the test of what is left.
    """
    rms = [float(np.sqrt(np.mean(c.found.residuals**2))) for c in (null, best)]
    log_evidence = best.evidence[noise].log_z - null.evidence[search.certain].log_z
    if best is null:
        return Improvement(log_evidence, 0.0, 0.0, (), rms[0], rms[1], p_value)
    law = best.evidence[noise].law
    held = held_out_gain(null.found, best.found, search.recording, law)
    p_after = global_p_value(after, search.looks(best.found), after.draws(_N_DRAWS, rng=rng))
    return Improvement(log_evidence, held.per_reading, held.sd, held.by_scan, rms[0], rms[1], p_after)


def corrected(
    search: Search,
    null: WeighedFit,
    best: WeighedFit,
    problem: Linearised,
    noise: Names,
    plain: Improvement,
    *,
    rng: np.random.Generator,
) -> tuple[Improvement, FloatArray]:
    """Repair what the named effects leave by bases without a name, where that predicts scans kept back.

    One basis at a time, the most telling, until nothing more is missing or the next gains nothing. Where the first
    gains nothing on other scans, blocks within scans are kept back instead: of what is local in time.

    Returns
    -------
    improvement, change
        `plain` with what the correction adds, and the correction of the usable readings, (n_usable,).
    """
    parts, part_names = held_out_parts(search.recording)
    fixed = correct(best.found, problem, search.unknown_bases, parts)
    gain = plain
    if fixed.gains_nothing:
        parts, part_names = held_out_blocks(search.recording)
        fixed = correct(best.found, problem, search.unknown_bases, parts)
        gain = replace(plain, heldout_by_scan=())
    if fixed.gains_nothing:
        return plain, np.zeros(len(fixed.change))
    plain_z = null.evidence[noise].log_z
    log_evidence = search.unknown.get((best.n_gaussians, best.names, noise), plain_z) - plain_z
    found, change = best.found, np.zeros(len(fixed.change))
    for step in range(_MOST_BASES):
        if step:
            fixed = correct(found, problem, search.unknown_bases, parts)
        held = fixed.held_out
        if step and held.per_reading <= held.sd:
            break
        found = replace(
            found,
            residuals=found.residuals - fixed.change,
            slopes=np.concatenate([found.slopes, fixed.columns], axis=1),
            z=np.concatenate([found.z, np.zeros(fixed.columns.shape[1])]),
        )
        change = change + fixed.change
        problem = Linearised.of(found, problem.law)
        before = dict(gain.heldout_by_scan)
        by_scan = ((part_names[int(k)], gained) for k, gained in held.by_scan)
        gain = replace(
            gain,
            log_evidence=log_evidence,
            heldout_log_density_per_reading=gain.heldout_log_density_per_reading + held.per_reading,
            heldout_sd=math.hypot(gain.heldout_sd, held.sd),
            heldout_by_scan=tuple((name, gained + before.get(name, 0.0)) for name, gained in by_scan),
            rms_after=float(np.sqrt(np.mean(found.residuals**2))),
            p_value_after=global_p_value(problem, search.looks(best.found), problem.draws(_N_DRAWS, rng=rng)),
        )
        if gain.p_value_after >= ALARM or not held.by_scan:
            break
    return gain, change
