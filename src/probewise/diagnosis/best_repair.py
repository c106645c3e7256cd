"""The refitted hypothesis that repairs the model, its gain over the null, and a correction where it has no name.

The correction, by basis functions, is a Gaussian process of finite rank: amplitudes have normal priors, and the model's
own parameters are refitted along with the amplitudes. It applies to the recording's rows and covariates only, and names
no physics, so sensor.json does not contain it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.diagnosis.apparatus import SETTLED
from probewise.diagnosis.evidence import (
    SCALES,
    HeldOutGain,
    Linearised,
    Parts,
    held_out_gain,
    mean_gain_over_parts,
    partition_into_blocks,
    predictive_log_densities,
)
from probewise.diagnosis.fit import Fit, fit_each_start
from probewise.diagnosis.locate import ALARM, bayes_factor_p_value
from probewise.diagnosis.noise import NoiseLaw, walk_given_readings
from probewise.diagnosis.outlying import FAR_OUT
from probewise.diagnosis.search.hypotheses import Searched, WeighedFit
from probewise.diagnosis.templates import TemplateBank
from probewise.diagnosis.verdict import GlobalTest, Judged, judge
from probewise.diagnosis.words import Names
from probewise.recordings.plan import Recording


def fit_under_noise(candidate: WeighedFit, law: NoiseLaw, recording: Recording) -> Fit:
    """Return a candidate's fit, repeated under a noise distribution if that or its own contains a random walk.

    A walk begins at 0 before the first row: it ties the mean to the first readings and leaves it far from the others.
    So a fit with a walk shows no model without one, and other noise hardly moves a fit. Without a walk, the null's
    starts are tried too.
    """
    found, own = candidate.found, candidate.law
    if not (law.walk.size or own.walk.size) or law.is_practically_equal(own):
        return found
    sensor, starts = found.model.sensor, [found.z]
    if not law.walk.size:
        starts += [np.concatenate([start, found.z[sensor.n_params :]]) for start in sensor.starts]
    again = min(fit_each_start(found.model, recording, starts, law), key=lambda each: each.objective)
    return again if np.isfinite(again.objective) else found


def rms_beside_walk(residuals: FloatArray, law: NoiseLaw, recording: Recording) -> float:
    """Return the rms of residuals without the random walk that they all together show, if the noise has one."""
    return recording.rms(residuals - walk_given_readings(law, residuals))


N_DRAWS = 499


@dataclass(frozen=True)
class Improvement:
    """The gain of the repaired model over the null.

    `log_evidence` in nats; `heldout_log_density_per_reading` and its sd in nats per held-out reading,
    `heldout_by_scan` the mean by part; rms residuals (`Recording.rms`) in the unit of the readings, beside a random
    walk if the noise has one; `p_value_after` of the global test of the repaired model; `comes_next` the gain on the
    last fifth of each run, each reading given the rest, where rows have a time.
    """

    log_evidence: float
    heldout_log_density_per_reading: float
    heldout_sd: float
    heldout_by_scan: tuple[tuple[str, float], ...]
    rms_before: float
    rms_after: float
    p_value_after: float
    comes_next: HeldOutGain | None = None


def p_value_after(searched: Searched, fit: WeighedFit, after: Linearised, *, rng: np.random.Generator) -> float:
    """Return the p-value of the global test of a repaired model, linearised as `after`."""
    draws = after.draw_null_residuals(N_DRAWS, rng=rng)
    return bayes_factor_p_value(after, searched.template_banks_for_global_test(fit.found), draws)


@dataclass(frozen=True, eq=False)
class BestRepair:
    """The fit that repairs the model, or the null's, with its noise effects, linearisation and gain over the null."""

    fit: WeighedFit
    noise: Names
    problem: Linearised
    improvement: Improvement
    calibrated: Fit  # the null, refitted under the noise of the verdict; figures show it
    repaired: Fit  # `fit` likewise

    @classmethod
    def of(
        cls, searched: Searched, test: GlobalTest, fit: WeighedFit, noise: Names, *, rng: np.random.Generator
    ) -> BestRepair:
        """Measure the gain of a fit over the null: in evidence and, under one noise, on held-out parts, in rms."""
        noise, null, apparatus = fit.possible_noise(noise), test.null, searched.prepared.apparatus
        law, recording = fit.evidence[noise].likeliest_law, searched.prepared.recording
        repaired = fit_under_noise(fit, law, recording)
        calibrated = repaired if fit is null else fit_under_noise(null, law, recording)
        after = Linearised.of(repaired, law)
        rms, rms_after = (rms_beside_walk(found.residuals, law, recording) for found in (calibrated, repaired))
        held, p_after, comes_next = HeldOutGain(0.0, 0.0, 0, ()), test.p_value, None
        if fit is not null:
            # What the mean leaves out looks like memory of the noise: each model has as much as is likeliest about it.
            own = null.evidence[null.possible_noise(noise)].likeliest_law
            own = own if law.has_memory and np.array_equal(own.lost, law.lost) else law
            gain_on = partial(held_out_gain, calibrated, repaired, recording, law, law_of_null=own)
            held, later = gain_on(apparatus.held_out_parts(recording)), apparatus.what_comes_next(recording)
            comes_next = None if later is None else gain_on(later, each_alone=True)
            p_after = p_value_after(searched, fit, after, rng=rng)
        log_evidence = fit.evidence[noise].log_z - null.evidence[searched.certain].log_z
        gain = Improvement(log_evidence, held.per_reading, held.sd, held.by_scan, rms, rms_after, p_after, comes_next)
        return cls(fit, noise, after, gain, calibrated, repaired)


def predicts_far_worse(gain: Improvement) -> bool:
    """Return whether a repair predicts held-out readings worse than the null by over one nat per reading."""
    return gain.heldout_log_density_per_reading < -1.0


def judged_and_best_repair(
    searched: Searched, test: GlobalTest, judged: Judged, *, rng: np.random.Generator
) -> tuple[Judged, BestRepair]:
    """Choose the fit that belongs to a verdict; the null if nothing was found.

    Returns the verdict, withdrawn if the named effects predict held-out readings far worse; and the fit. A formula that
    does not predict them better than the null is dropped. If no correction by an unknown effect does either, and no
    effect on the mean is credible, the unknown gets its prior odds against that.
    """
    null, noise, on_noise = test.null, test.noise, searched.prepared.noise_effect_names
    if judged.verdict == "unknown":
        leading = searched.leading_combination_out_of_vocabulary()
        fit = searched.best_refit_of(leading, noise) if leading else None
        if fit is not None:
            best = BestRepair.of(searched, test, fit, noise, rng=rng)
            if best.improvement.heldout_log_density_per_reading > 0:
                return judged, best
        best = BestRepair.of(searched, test, searched.likeliest_fit_beside_unknown(noise) or null, noise, rng=rng)
        # Outlying readings that cluster change no mean: there is nothing of them to predict.
        clusters = sum(share for form, share in judged.unknown_shares.items() if form.endswith(FAR_OUT))
        if clusters < 0.5 and not best_correction(searched, best)[0].held_out.per_reading > 0:
            mean_is_right = sum(h.probability for h in judged.hypotheses if {*h.effects} <= on_noise)
            if mean_is_right > 1 - SETTLED:
                prior_odds = searched.prior.unknown / searched.prior.clean_mean
                odds = prior_odds * mean_is_right / judged.unknown_probability
                judged = judge(searched, test, unknown_weight=min(odds, 1.0))
        if judged.verdict == "unknown":
            return judged, best
    if judged.verdict in ("named", "noise", "clean"):
        noise = searched.posterior.likeliest_noise(tuple(name for name in judged.repaired_by if name in on_noise))
    on_mean = tuple(name for name in judged.repaired_by if name not in on_noise)
    best = BestRepair.of(searched, test, searched.best_refit_of(on_mean, noise) or null, noise, rng=rng)
    if judged.verdict == "named" and predicts_far_worse(best.improvement):  # it is no repair
        judged = replace(judged, verdict="cannot_tell", combination=(), withdrawn=True, shared=(), leader=())
        best = BestRepair.of(searched, test, null, noise, rng=rng)
    return judged, best


@dataclass(frozen=True, eq=False)
class Correction:
    """A correction: `change` of the readings (n_usable,), by basis `columns` (n_usable, k), and gain when held out."""

    change: FloatArray
    columns: FloatArray
    held_out: HeldOutGain

    @property
    def gains_nothing(self) -> bool:
        """Whether the correction fails to improve predictions of held-out readings, where there are any."""
        return bool(self.held_out.by_scan) and self.held_out.per_reading <= 0


def correct_by_best_basis(found: Fit, problem: Linearised, bases: TemplateBank, part: IntArray) -> Correction:
    """Return the correction of a fit by one basis, with its gain on held-out parts.

    Of the bases whose evidence is within 5 nats of the best, that of the fewest columns is taken: a basis with one
    amplitude per scan cannot predict the next scan.

    `part`: number of the part of each usable row, to hold parts out in turn, (n_usable,).
    """
    scores = bases.log_bayes_factors(problem)[:, 0]
    rivals = np.flatnonzero(scores > scores.max() - 5.0)
    columns = bases[min(map(int, rivals), key=lambda i: (int(bases.widths[i]), -float(scores[i])))]
    norms = np.sqrt(np.mean(columns**2, axis=0))
    columns = columns[:, norms > 0] / norms[norms > 0]
    amount, _ = _amounts_and_covariance(found, problem, columns, np.ones(len(columns), dtype=np.bool_))
    change = np.concatenate([found.slopes, columns], axis=1) @ amount

    law = problem.law.without_tail_or_rounding()

    def log_densities(columns: FloatArray, out: BoolArray) -> FloatArray:
        amount, covariance = _amounts_and_covariance(found, problem, columns, ~out)
        design, rest = np.concatenate([found.slopes, columns], axis=1), law.take_readings(~out)
        kept_miss = rest((found.residuals - design @ amount)[~out])
        sigma_2 = float(kept_miss @ kept_miss) / max(rest.n_kept - design.shape[1], 1)
        given = (law, out, found.residuals, design, amount, covariance, sigma_2)
        return predictive_log_densities(*given, sequential=law.has_memory)

    held = mean_gain_over_parts(part, lambda out: log_densities(columns, out) - log_densities(columns[:, :0], out))
    return Correction(change, columns, held)


def best_correction(searched: Searched, best: BestRepair) -> tuple[Correction, Parts]:
    """Return the correction of the best fit by one basis, and the parts held out.

    If it gains nothing on other scans, these are blocks within scans, for residuals that are local in time.
    """
    prepared, bases = searched.prepared, searched.misfit_templates.unknown_bases
    parts = prepared.apparatus.held_out_parts(prepared.recording)
    fixed = correct_by_best_basis(best.repaired, best.problem, bases, parts[0])
    if not fixed.gains_nothing:
        return fixed, parts
    parts = partition_into_blocks(prepared.recording)
    return correct_by_best_basis(best.repaired, best.problem, bases, parts[0]), parts


def improvement_and_correction(
    searched: Searched, test: GlobalTest, best: BestRepair, *, rng: np.random.Generator
) -> tuple[Improvement, FloatArray]:
    """Correct the residuals of the best fit by basis functions, if this improves held-out predictions.

    Bases are added one at a time, at most six, until the global test finds nothing or the next one gains less than the
    gain's sd. Where nothing can be held out, one basis is added without that check.

    Returns `improvement, change`: the improvement of `best` including the correction, and the correction of the usable
    readings, (n_usable,).
    """
    recording, problem, found, gain = searched.prepared.recording, best.problem, best.repaired, best.improvement
    fixed, (parts, part_names) = best_correction(searched, best)
    change = np.zeros(len(fixed.change))
    if fixed.gains_nothing:
        return gain, change
    plain_z = test.null.evidence[test.null.possible_noise(best.noise)].log_z
    key = (best.fit.n_gaussians, best.fit.names, best.noise)
    log_evidence = searched.evidences.unknown.get(key, plain_z) - plain_z
    for step in range(6):
        if step:
            fixed = correct_by_best_basis(found, problem, searched.misfit_templates.unknown_bases, parts)
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
        before = dict(gain.heldout_by_scan)  # of blocks, none
        by_scan = ((part_names[int(k)], gained) for k, gained in held.by_scan)
        gain = replace(
            gain,
            log_evidence=log_evidence,
            heldout_log_density_per_reading=gain.heldout_log_density_per_reading + held.per_reading,
            heldout_sd=math.hypot(gain.heldout_sd, held.sd),
            heldout_by_scan=tuple((name, gained + before.get(name, 0.0)) for name, gained in by_scan),
            rms_after=rms_beside_walk(found.residuals, problem.law, recording),
            p_value_after=p_value_after(searched, best.fit, problem, rng=rng),
        )
        if gain.p_value_after >= ALARM or not held.by_scan:
            break
    return gain, change


def _amounts_and_covariance(
    found: Fit, problem: Linearised, columns: FloatArray, kept: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Fit shifts of the parameters, and amplitudes, to the `kept` readings; return means and covariance of both."""
    sd, p, law = problem.sd, found.slopes.shape[1], problem.law.take_readings(kept)
    design = law(np.concatenate([found.slopes, columns], axis=1)[kept])
    left = law(found.residuals[kept])
    center = np.concatenate([-found.z, np.zeros(columns.shape[1])])
    # Amplitudes first have a wide prior, then one with their own common size as scale (empirical Bayes): the
    # uncertainty for a new scan equals the scatter of the known ones.
    size = sd * SCALES[5]
    for _ in range(3):
        precision = np.concatenate([np.ones(p), np.full(columns.shape[1], size**-2)])
        covariance = np.linalg.inv(design.T @ design / sd**2 + np.diag(precision))
        amount = covariance @ (design.T @ left / sd**2 + precision * center)
        if columns.shape[1] > 1:
            size = max(float(np.sqrt(np.mean(amount[p:] ** 2))), 1e-3 * sd)
    return np.asarray(amount), np.asarray(covariance)
