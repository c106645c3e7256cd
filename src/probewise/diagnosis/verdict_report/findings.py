"""The findings on each effect (probability, size, parameters, sentence), and on the noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.detectable import linearised_sizes
from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.fitting.fit import fit, fit_each_start
from probewise.diagnosis.judgement.judged import Hypothesis
from probewise.diagnosis.names import Names
from probewise.diagnosis.noise.law import n_rows_since_previous_usable, noise_statistics, previous_usable
from probewise.diagnosis.repair.best_repair import BestRepair
from probewise.diagnosis.repair.samples import N_SAMPLES, ModelSamples, noise_effect_samples, sample_model
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.search.weighed_fit import WeighedFit, noise_effects_in_vocabulary
from probewise.diagnosis.verdict_report.words import substitute_reading_unit
from probewise.effects import Dropouts, NamedEffect, NoiseEffect, is_out_of_vocabulary
from probewise.effects.effect import mean_and_sd_of_samples, sentence_from_samples
from probewise.recordings.plan import Plan

_LEAST_PROBABILITY = 1e-3
_IS_UNKNOWN = 0.5  # probability of an unknown effect from which effects beside it are listed
_STANDS_BESIDE = 0.5  # conditional probability from which an effect counts as beside the unknown one
_N_DRAWS = 999


@dataclass(frozen=True)
class ParameterFound:
    """One parameter of an effect or of the noise: posterior mean, sd and central 95 % interval, in `unit`."""

    name: str
    unit: str
    mean: float
    sd: float
    interval95: tuple[float, float]


@dataclass(frozen=True)
class EffectFound:
    """One effect: probability in any hypothesis, size, sentence, parameters, and the scans to which it is bound.

    `size_lambda` is the norm of the effect's change of the readings in noise sds, after a refit of all else. Of a noise
    effect it is that of an effect on the mean with equal evidence; of rounding that is certain, that of the rounding
    error, step / sqrt(12), over all readings.
    """

    name: str
    probability: float
    size_lambda: float
    sentence: str
    parameters: tuple[ParameterFound, ...]
    scans: tuple[str, ...] = ()


@dataclass(frozen=True)
class NoiseFound:
    """The noise `model` ("white", or effects joined by "+"), the p-value of deviations from it, and its parameters.

    `nuisances` are sentences on effects of the model that no combination and no repaired model holds.
    """

    model: str
    p_value: float
    parameters: tuple[ParameterFound, ...]
    nuisances: tuple[str, ...] = ()


def effects_found(
    searched: Searched,
    hypotheses: tuple[Hypothesis, ...],
    best: BestRepair,
    samples: ModelSamples,
    *,
    rng: np.random.Generator,
) -> tuple[EffectFound, ...]:
    """Return the findings on every effect with a name and a probability above 0.001, most probable first.

    Parameters
    ----------
    searched
        Result of the search.
    hypotheses
        All hypotheses with their probabilities.
    best, samples
        The repair and its posterior samples, which give size and parameters of its effects; those of other effects are
        from the most probable fit that contains them or, if there is none, from the linearised null.
    rng
        Source of randomness.
    """
    prepared = searched.prepared
    out, plan = [], prepared.everything.plan
    unknown = sum(h.probability for h in hypotheses if h.effects == ("unknown",))
    beside = {}
    if unknown >= _IS_UNKNOWN:
        beside = searched.effect_probabilities_given_unknown() | searched.noise_probabilities_given_unknown()
    unit = plan.instrumentation.unit
    drawn: dict[tuple[WeighedFit, Names], ModelSamples] = {}
    for name, effect in prepared.effects.items():
        p = sum(h.probability for h in hypotheses if name in h.effects)
        if beside.get(name, 0.0) >= _STANDS_BESIDE and not is_out_of_vocabulary(name):
            p += unknown * beside[name]
        if p <= _LEAST_PROBABILITY or not noise_effects_in_vocabulary((name,)):
            continue
        holder, noise = (best.fit, best.noise) if name in samples.effects else _likeliest_candidate_with(searched, name)
        if holder is None:
            effect, values, size = _samples_of_insignificant(searched, effect, rng=rng)
        else:
            effect = next((e for e in holder.found.model.effects if e.name == name), effect)
            own = samples if name in samples.effects else drawn.get((holder, noise))
            if own is None:
                evidence, weights = holder.evidence[noise], holder.weights
                own = sample_model(holder.found, evidence, prepared.recording, weights=weights, rng=rng, annealed=False)
                drawn[holder, noise] = own
            values, size = own.effect_samples(name), _lambda_of(searched, holder, name, noise)
        out.append(
            EffectFound(
                name,
                min(p, 1.0),
                size,
                sentence_from_samples(effect, values),
                (*parameters_found(effect, values, unit), *_scan_numbers_found(effect, plan)),
                effect.scans,
            )
        )
    return tuple(sorted(out, key=lambda e: -e.probability))


def _likeliest_candidate_with(searched: Searched, name: str) -> tuple[WeighedFit | None, Names]:
    """Return the most probable refit that contains an effect, and its noise effects; None, () if there is none."""
    ranked = sorted(searched.posterior.probabilities.items(), key=lambda item: -item[1])
    for (mean, noise), p in ranked:
        if p > 0 and name in (*mean, *noise):
            candidate = searched.best_refit_of(mean, noise)
            if candidate is not None:
                return candidate, noise
    return None, ()


def _samples_of_insignificant(
    searched: Searched, effect: NamedEffect[Any], *, rng: np.random.Generator
) -> tuple[NamedEffect[Any], FloatArray, float]:
    """Draw parameters of an effect that no refit contains: amplitudes by the linearised null, others from the prior.

    Returns
    -------
    The middle one of its variants (discrete choices), the samples, (N_SAMPLES, n_params), and lambda at the best.
    """
    null, misfit_templates = searched.null, searched.misfit_templates
    best = max(null.evidence.values(), key=lambda e: e.log_z)
    problem = Linearised.of(null.found, best.likeliest_law)
    templates = misfit_templates.templates.templates_of(misfit_templates.about, effect.with_fewer_variants())
    middle = len(templates.columns) // 2
    effect = templates.variant_of_entry(middle)
    values = effect.prior.from_unit_cube(rng.random((N_SAMPLES, len(effect.prior.names))))
    if not effect.amplitudes:
        return effect, values, 0.0
    projected = problem.project(templates.columns[middle])
    # A ridge of one prior scale keeps undetectable amplitudes finite.
    precision = projected.T @ projected + np.eye(projected.shape[1])
    amount = np.linalg.solve(precision, projected.T @ problem.residual)
    spread = np.linalg.cholesky(np.linalg.inv(precision))
    draws = amount + rng.standard_normal((N_SAMPLES, len(amount))) @ spread.T
    for k in effect.amplitudes:
        values[:, k] = draws @ templates.settings[middle][:, k]
    # Amplitudes of an excluded sign are reflected.
    inside = np.isfinite(effect.prior.log_prob(values))
    values[~inside] = np.abs(values[~inside])
    return effect, values, float(np.linalg.norm(projected @ amount))


def _lambda_of(searched: Searched, holder: WeighedFit, name: str, noise: Names) -> float:
    """Return an effect's lambda: the residual norm, in noise sds, of a refit without it to noise-free readings.

    An effect on the noise has the lambda of an effect on the mean with equal evidence; rounding, and a noise effect
    that also changes the mean, the norm of the change in noise sds.
    """
    law = holder.evidence[noise].likeliest_law
    found, prepared = holder.found, searched.prepared
    effect = prepared.effects[name]
    if name in prepared.noise_effect_names and cast(NoiseEffect, effect).changes_the_mean:
        everywhere = found.model.predict(found.z[None, :])[0]
        return float(np.linalg.norm(cast(NoiseEffect, effect).change_of_readings(everywhere))) / found.sd
    if isinstance(effect, Dropouts) and effect.lost:
        return effect.distance
    if name in searched.certain:
        step = holder.evidence[noise].nodes.settings[0, holder.evidence[noise].noise.columns_of_effect(name)]
        return float(step[0]) / math.sqrt(12) / found.sd * math.sqrt(law.n_kept)
    if name in prepared.noise_effect_names:
        # For noise effects: the size of an effect on the mean with equal evidence.
        without = [e.log_z for names, e in holder.evidence.items() if set(names) <= set(noise) - {name}]
        gain = holder.evidence[noise].log_z - max(without)
        return math.sqrt(2 * max(gain, 0.0))
    model, stay = found.model.model_and_mask_without(name)
    noise_free = prepared.recording.with_readings(
        prepared.expand_usable_to_all_rows(found.predicted)
    ).without_declared_range()
    # With the noise sd as floor, the refit balances readings and priors as the real one did.
    sigma = float(law.likeliest_sigma(law(found.residuals)[:, None])[0])
    refit = fit(model, noise_free, found.z[stay], law.with_least_sigma(sigma), max_steps=12, tolerance=0.02)
    if not math.isfinite(refit.objective):
        # Without the effect these parameters predict no readings to start from; those of the null do.
        null = searched.evidences.fits[holder.n_gaussians, ()].found.z
        others = found.z[stay][len(null) :]
        starts = [np.concatenate([null, share * others]) for share in (1.0, 0.0)]
        again = fit_each_start(model, noise_free, starts, law.with_least_sigma(sigma), tolerance=0.02)
        refit = min(again, key=lambda one: one.objective)
    if not math.isfinite(refit.objective):
        return next(linearised_sizes(found, law, prepared.usable_rows, [name]))
    return float(np.linalg.norm(law(refit.residuals))) / sigma * math.sqrt(law.fisher_information)


def noise_found(searched: Searched, best: BestRepair, samples: ModelSamples, *, rng: np.random.Generator) -> NoiseFound:
    """Describe the noise of the repaired model, and test its residuals for deviations from this noise.

    Deviations are autocorrelation, heavy tails, or a spread that depends on the level.
    """
    prepared, after = searched.prepared, best.problem
    steps, before = n_rows_since_previous_usable(prepared.recording), previous_usable(prepared.recording)
    own = after.residual[: after.n_points, None]
    null = after.draw_null_residuals(_N_DRAWS, rng=rng)[: after.n_points]
    joined = noise_statistics(np.concatenate([own, null], axis=1), steps, best.fit.found.predicted, before=before)
    center, spread = joined[:, 1:].mean(axis=1), joined[:, 1:].std(axis=1)
    worst = np.max(np.abs(joined - center[:, None]) / np.maximum(spread, 1e-12)[:, None], axis=0)
    p_value = (1 + int(np.sum(worst[1:] >= worst[0]))) / (1 + _N_DRAWS)
    unit = prepared.recording.plan.instrumentation.unit
    parameters = [_parameter_found("sd", unit, samples.noise_sd)]
    nuisances = []
    for name in best.noise:
        effect = cast(NoiseEffect, prepared.effects[name])
        if name in samples.effects:
            values = samples.effect_samples(name)
        else:
            values = noise_effect_samples(effect, best.fit.evidence[best.noise], rng=rng)
            nuisances.append(sentence_from_samples(effect, values))
        parameters += parameters_found(effect, values, unit)
    return NoiseFound("+".join(best.noise) or "white", p_value, tuple(parameters), tuple(nuisances))


def parameters_found(effect: NamedEffect[Any], values: FloatArray, unit: str) -> tuple[ParameterFound, ...]:
    """Summarise an effect's parameter samples, (n_samples, n_params), without fixed ones; `unit` is a reading's."""
    fixed = getattr(effect, "fixed", ())
    return tuple(
        _parameter_found(name, substitute_reading_unit(own, unit), values[:, k])
        for k, (name, own) in enumerate(zip(effect.prior.names, effect.units, strict=True))
        if name not in fixed
    )


def _scan_numbers_found(effect: NamedEffect[Any], plan: Plan) -> tuple[ParameterFound, ...]:
    """Return one parameter `scans`, of the numbers, from 0, of the scans to which an effect is bound, if any."""
    numbers = np.flatnonzero([name in effect.scans for name in plan.scan_names]).astype(np.float64)
    return (_parameter_found("scans", "scan", numbers),) if numbers.size else ()


def _parameter_found(name: str, unit: str, values: FloatArray) -> ParameterFound:
    low, high = np.quantile(values, [0.025, 0.975])
    mean, sd = mean_and_sd_of_samples(values[:, None])
    return ParameterFound(name, unit, float(mean[0]), float(sd[0]), (float(low), float(high)))
