"""Merge independent runs of one problem into one result, and test whether they agree (Higson et al. 2019)."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.special import chdtrc

from probewise._arrays import FloatArray, IntArray, own_arithmetic
from probewise._kinds import require_rng
from probewise.errors import DoubtfulResultWarning, ParameterError, require
from probewise.nested.check import DISAGREE
from probewise.nested.evidence import DOUBTFUL_P_VALUE, birth_rows, integrate, n_independent
from probewise.nested.result import Agreement, Check, NestedResult, software_versions

# p value below which runs disagree: one false alarm in 1000 merges.
_DISAGREE = 1e-3
_LEVELS = ("log_likelihood", "label", "log_birth", "birth_label")


@own_arithmetic
def merge(results: Iterable[NestedResult], *, rng: np.random.Generator) -> NestedResult:
    """Merge independent runs of the same problem, two or more, into one run with the live points of all.

    A point is alive between the level above which it was drawn and its own. Sorted by level, the points of all runs
    form a run whose number of live points at each level is the sum over the runs (Higson, Handley, Hobson & Lasenby
    2019, section 4). The runs may differ in their numbers of live points and in where they stop. The labels make the
    count exact on plateaus. Merged runs may be merged again. The error of ln Z, for which `rng` draws, falls as one
    over the root of the number of runs.

    The result has an `agreement`, and a combined `check` if every run has one. If the runs' evidences differ by more
    than their errors allow (p < 0.001), a warning is added and the error is at least their scatter. If the combined
    second estimates disagree with the combined runs, as they do if all runs share a bias, a warning is added too.

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
    log_z, error = evidence.log_z, math.hypot(math.sqrt(remembered) * evidence.spread, log_start_error)
    # Fisher's method combines independent p values.
    fisher = -2.0 * float(np.log(np.maximum([r.insertion_p_value for r in parts], 1e-300)).sum())
    p_value = float(chdtrc(2 * len(parts), fisher))
    agreement, check, widened, doubts = agreement_of(parts), None, error, list[str]()
    checks = [r.check for r in parts if r.check is not None]
    if len(checks) == len(parts):  # the runs' second estimates, weighted by their errors
        mean, mean_error = weighted_mean_and_error([c.log_z for c in checks], [c.log_z_error for c in checks])
        route = checks[0].route if len({c.route for c in checks}) == 1 else "the runs' second routes"
        distance = (log_z - mean) / max(math.hypot(error, mean_error), 1e-12)
        check = Check(route, mean, mean_error, distance, sum(c.n_calls for c in checks))
    if agreement.p_value < _DISAGREE:
        widened = max(error, agreement.log_z_sd)
        doubts.append(
            f"the {agreement.n_runs} runs disagree more than their errors: ln Z from {min(agreement.log_z):.2f} to "
            f"{max(agreement.log_z):.2f} (p = {agreement.p_value:.1g}): some missed a part of the posterior; "
            "the error is widened to their scatter; use more n_live or longer chains"
        )
    if p_value < DOUBTFUL_P_VALUE:
        doubts.append(f"insertion ranks of the runs together are not uniform (p = {p_value:.1g})")
    if check is not None and abs(check.distance) > DISAGREE:
        doubts.append(
            f"{check.route} gives log Z = {check.log_z:.2f} ± {check.log_z_error:.2f}, the runs together "
            f"{log_z:.2f} ± {widened:.2f}: {abs(check.distance):.1f} errors apart; a bias shared by all runs "
            "does not average out; use longer chains"
        )
    for doubt in doubts:
        warnings.warn(doubt, DoubtfulResultWarning, stacklevel=2)
    inherited = [f"run {i} of {len(parts)}: {note}" for i, r in enumerate(parts, start=1) for note in r.warnings]
    return NestedResult(
        names=parts[0].names,
        **joined,
        log_weight=evidence.log_weight,
        parent=parent,
        n_at_death=n_at_death,
        log_start=log_start,
        log_start_error=log_start_error,
        log_z=log_z,
        log_z_error=widened,
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
        agreement=agreement,
        check=check,
    )


def agreement_of(results: Iterable[NestedResult]) -> Agreement:
    """Compare the evidences of independent runs by chi-square; a merged run counts as its single runs."""
    log_z, log_z_error = list[float](), list[float]()
    for result in results:
        runs = result.agreement
        log_z += [result.log_z] if runs is None else runs.log_z
        log_z_error += [result.log_z_error] if runs is None else runs.log_z_error
    middle, _ = weighted_mean_and_error(log_z, log_z_error)
    weight: FloatArray = np.maximum(log_z_error, 1e-12) ** -2.0
    chi_square = float(weight @ np.square(np.asarray(log_z) - middle))
    return Agreement(tuple(log_z), tuple(log_z_error), chi_square, float(chdtrc(len(log_z) - 1, chi_square)))


def n_alive_at_death(
    log_likelihood: FloatArray, label: FloatArray, log_birth: FloatArray, birth_label: FloatArray
) -> IntArray:
    """Count the points alive at each death, itself included, from the levels of birth and death, all (n_dead,).

    Deaths are in order of level. A point is alive from the deaths on that lie strictly above its birth.
    """
    birth, death = birth_rows(log_likelihood, label, log_birth, birth_label), np.arange(len(label))
    return np.asarray(np.searchsorted(np.sort(birth), death) - death)


def weighted_mean_and_error(log_z: Sequence[float], log_z_error: Sequence[float]) -> tuple[float, float]:
    """Return the inverse-variance weighted mean of independent estimates of log Z, and its error."""
    # A constant likelihood has an exact evidence: the error is nought, or a last digit.
    weight: FloatArray = np.maximum(log_z_error, 1e-12) ** -2.0
    return float(weight @ np.asarray(log_z) / weight.sum()), float(weight.sum() ** -0.5)


def _seed_states_of_mergeable_runs(parts: Sequence[NestedResult]) -> list[object]:
    if len(parts) < 2:
        raise ParameterError("results", f"{len(parts)} runs", "two runs or more")
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
