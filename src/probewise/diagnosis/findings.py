"""The findings on each effect, the noise, a misfit after the repair, and a formula for an unknown effect."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np

from probewise._arrays import LAST_DIGITS, FloatArray
from probewise.diagnosis.apparatus import ENOUGH_NATS
from probewise.diagnosis.best_repair import BestRepair
from probewise.diagnosis.evidence import held_out_gain, linearised_sizes
from probewise.diagnosis.fit import fit
from probewise.diagnosis.locate import ALARM, significant_places
from probewise.diagnosis.noise import n_rows_since_previous_usable, noise_statistics, previous_usable
from probewise.diagnosis.samples import N_SAMPLES, ModelSamples, noise_effect_samples, sample_model
from probewise.diagnosis.search.hypotheses import Searched, WeighedFit, noise_effects_in_vocabulary
from probewise.diagnosis.templates import TemplateCache, log_mean_exp
from probewise.diagnosis.verdict import N_DRAWS, NEGLIGIBLE, Hypothesis, Judged
from probewise.diagnosis.words import UNKNOWN, Names, p_in_words, substitute_reading_unit
from probewise.effects import Effect, NoiseEffect, is_out_of_vocabulary
from probewise.effects.effect import mean_and_sd_of_samples, sentence_from_samples
from probewise.effects.noise import sd_of_rounding

_LIKELY = 0.5  # probability of an unknown effect from which others beside it count, and of these given that


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
    error, step / sqrt(12), over all readings. `formula` is the one that fits best in place of a curve.
    """

    name: str
    probability: float
    size_lambda: float
    sentence: str
    parameters: tuple[ParameterFound, ...]
    scans: tuple[str, ...] = ()
    formula: Formula | None = None


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

    `best`, `samples`: the repair and its posterior samples, which give size and parameters of its effects; those of
    other effects are from the most probable fit that contains them or, if there is none, from the prior.
    """
    prepared, out, plan = searched.prepared, [], searched.prepared.everything.plan
    unknown = sum(h.probability for h in hypotheses if h.effects == UNKNOWN)
    beside = {}
    if unknown >= _LIKELY:
        beside = searched.effect_probabilities_given_unknown() | searched.noise_probabilities_given_unknown()
    unit = plan.instrumentation.unit
    ranked = sorted(searched.posterior.probabilities.items(), key=lambda item: -item[1])
    drawn: dict[tuple[WeighedFit, Names], ModelSamples] = {}

    def likeliest_with(name: str) -> tuple[WeighedFit | None, Names]:
        fits = ((searched.best_refit_of(*key), key[1]) for key, p in ranked if p > 0 and name in (*key[0], *key[1]))
        return next(((fit, noise) for fit, noise in fits if fit is not None), (None, ()))

    for name, effect in prepared.effects.items():
        p = sum(h.probability for h in hypotheses if name in h.effects)
        if beside.get(name, 0.0) >= _LIKELY and not is_out_of_vocabulary(name):
            p += unknown * beside[name]
        if p <= NEGLIGIBLE or not noise_effects_in_vocabulary((name,)):
            continue
        holder, noise = (best.fit, best.noise) if name in samples.effects else likeliest_with(name)
        if holder is None:
            effect, size = effect.variants()[0], 0.0
            values = effect.prior.from_unit_cube(rng.random((N_SAMPLES, len(effect.prior.names))))
        else:
            effect = next((e for e in holder.found.model.effects if e.name == name), effect)
            own = samples if name in samples.effects else drawn.get((holder, noise))
            if own is None:
                own = drawn[holder, noise] = _samples_about(searched, holder, noise, rng=rng)
            values, size = own.effect_samples(name), _lambda_of(searched, holder, name, noise)
        of_curve = name.startswith("curve:") and name in samples.effects
        formula, said = _formula_of_curve(searched, best, name, rng=rng) if of_curve else (None, "")
        parameters, said = parameters_found(effect, values, unit), sentence_from_samples(effect, values) + said
        numbers = np.flatnonzero([scan in effect.scans for scan in plan.scan_names]).astype(np.float64)
        if numbers.size:  # from 0, of the scans to which it is bound
            parameters = (*parameters, _parameter_found("scans", "scan", numbers))
        out.append(EffectFound(name, min(p, 1.0), size, said, parameters, effect.scans, formula))
    return tuple(sorted(out, key=lambda e: -e.probability))


def _samples_about(searched: Searched, fit: WeighedFit, noise: Names, *, rng: np.random.Generator) -> ModelSamples:
    evidence, recording = fit.evidence[noise], searched.prepared.recording
    return sample_model(fit.found, evidence, recording, weights=fit.weights, rng=rng, laplace_only=True)


def _lambda_of(searched: Searched, holder: WeighedFit, name: str, noise: Names) -> float:
    """Return an effect's lambda: the residual norm, in noise sds, of a refit without it to noise-free readings.

    An effect on the noise has the lambda of an effect on the mean with equal evidence; rounding, and a noise effect
    that also changes the mean, the norm of the change in noise sds.
    """
    law = holder.evidence[noise].likeliest_law
    found, prepared = holder.found, searched.prepared
    effect = prepared.effects[name]
    if isinstance(effect, NoiseEffect) and effect.change_of_readings is not None:
        everywhere = found.model.predict(found.z[None, :])[0]
        return float(np.linalg.norm(effect.change_of_readings(everywhere))) / found.sd
    if isinstance(effect, NoiseEffect) and effect.distance:
        return effect.distance
    if name in searched.certain:
        own = holder.evidence[noise]
        step = float(own.nodes.settings[0, own.noise.columns_of_effect(name)][0])
        return sd_of_rounding(step) / found.sd * math.sqrt(law.n_kept)
    if name in prepared.noise_effect_names:
        # For noise effects: the size of an effect on the mean with equal evidence.
        without = [e.log_z for names, e in holder.evidence.items() if set(names) <= set(noise) - {name}]
        gain = holder.evidence[noise].log_z - max(without)
        return math.sqrt(2 * max(gain, 0.0))
    model, stay = found.model.model_and_mask_without(name)
    readings = prepared.expand_usable_to_all_rows(found.predicted)
    noise_free = prepared.recording.with_readings(readings).without_declared_range()
    # With the noise sd as floor, the refit balances readings and priors as the real one did.
    sigma = law.likeliest_sigma_of(found.residuals)
    refit = fit(model, noise_free, found.z[stay], law.with_least_sigma(sigma), max_steps=12, tolerance=0.02)
    if not math.isfinite(refit.objective):
        return next(linearised_sizes(found, law, prepared.usable_rows, [name]))
    return float(np.linalg.norm(law(refit.residuals))) / sigma * math.sqrt(law.fisher_information)


def noise_found(searched: Searched, best: BestRepair, samples: ModelSamples, *, rng: np.random.Generator) -> NoiseFound:
    """Describe the noise of the repaired model, and test its residuals for deviations from this noise."""
    prepared, after = searched.prepared, best.problem
    steps, usable = n_rows_since_previous_usable(prepared.recording), previous_usable(prepared.recording)
    own = after.residual[: after.n_points, None]
    null = after.draw_null_residuals(N_DRAWS, rng=rng)[: after.n_points]
    previous, level = np.where(steps == 1, usable, -1), best.fit.found.predicted
    joined = noise_statistics(np.concatenate([own, null], axis=1), previous, level)
    center, spread = joined[:, 1:].mean(axis=1), joined[:, 1:].std(axis=1)
    worst = np.max(np.abs(joined - center[:, None]) / np.maximum(spread, LAST_DIGITS)[:, None], axis=0)
    p_value = (1 + int(np.sum(worst[1:] >= worst[0]))) / (1 + N_DRAWS)
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


def parameters_found(effect: Effect, values: FloatArray, unit: str) -> tuple[ParameterFound, ...]:
    """Summarise an effect's parameter samples, (n_samples, n_params), without fixed ones; `unit` is a reading's."""
    return tuple(
        _parameter_found(name, substitute_reading_unit(own, unit), values[:, k])
        for k, (name, own) in enumerate(zip(effect.prior.names, effect.units, strict=True))
        if name not in effect.fixed
    )


def _parameter_found(name: str, unit: str, values: FloatArray) -> ParameterFound:
    low, high = np.quantile(values, [0.025, 0.975])
    mean, sd = mean_and_sd_of_samples(values[:, None])
    return ParameterFound(name, unit, float(mean[0]), float(sd[0]), (float(low), float(high)))


@dataclass(frozen=True)
class Remainder:
    """A significant misfit that remains after all named effects.

    `p_value`: of the global test of the repaired model; `share_of_gain`: the share of the total gain in log evidence
    that an unknown effect or a formula would add; `where`: the covariate in which the misfit is most significant, or
    None; `formula`: one that was found beside the named effects, or None.
    """

    p_value: float
    share_of_gain: float
    where: str | None
    sentence: str
    formula: Formula | None = None


@dataclass(frozen=True)
class Formula:
    """A formula proposed for an unknown effect, and its gain over the null, or over the effects that it stands beside.

    The `expression` is added to the reading (`side` "reading") or to the rate of the state `target` ("rate").
    `log_evidence` is the gain in nats, `heldout_log_density_per_reading` that in nats per held-out reading.
    """

    expression: str
    side: str
    target: str
    parameters: tuple[ParameterFound, ...]
    log_evidence: float
    heldout_log_density_per_reading: float


def remainder_of(searched: Searched, judged: Judged, best: BestRepair, *, rng: np.random.Generator) -> Remainder | None:
    """Return the misfit that remains, with p below .01, after a repair by effects; None if there is neither."""
    p_value, names = best.improvement.p_value_after, best.fit.names
    if judged.verdict not in ("named", "cannot_tell") or not names or p_value >= ALARM:
        return None
    own, log_z = best.fit.n_gaussians, best.fit.evidence[best.noise].log_z
    value = searched.evidences.unknown.get((own, names, best.noise), log_z)
    fit = searched.evidences.best_formula_beside(best.fit, best.noise)
    with_formula = -math.inf if fit is None else fit.evidence[best.noise].log_z
    more = max(value - log_z, with_formula - log_z, 0.0)
    named = max(log_z - searched.evidences.fits[own, ()].evidence[best.noise].log_z, 0.0)
    prepared, residuals = searched.prepared, best.fit.found.residuals
    draws = best.problem.draw_null_residuals(199, rng=rng)
    covariates, scans = searched.misfit_templates.covariates, prepared.recording.plan.scan_names
    found = significant_places(best.problem, covariates, scans, residuals, draws)
    where = found[0].covariate if found else None
    shows = "" if where is None else f"; it shows most in {prepared.apparatus.words.covariate_in_words(where)}"
    share = more / (named + more) if named + more > 0 else 0.0
    formula, said = None, ""
    if fit is not None and with_formula > max(value, log_z + ENOUGH_NATS):
        formula, said = _formula_beside(searched, best, fit, rng=rng)
    smaller = "A smaller misfit" if share < 0.5 else "A misfit"
    gain = f"what has no name would add {share:.0%} of the whole gain in log evidence"
    sentence = f"{smaller} remains ({p_in_words(p_value)}; {gain}){shows}{said}."
    return Remainder(p_value, share, where, sentence, formula)


def _formula_beside(
    searched: Searched, best: BestRepair, fit: WeighedFit, *, rng: np.random.Generator
) -> tuple[Formula, str]:
    """Return the formula that a fit adds to the best repair, with its gain over that, and a clause that tells it."""
    recording, law = searched.prepared.recording, fit.evidence[best.noise].likeliest_law
    effect = next(e for e in fit.found.model.effects if e.name not in best.fit.names)
    values = _samples_about(searched, fit, best.noise, rng=rng).effect_samples(effect.name)
    parts, own = searched.prepared.apparatus.held_out_parts(recording), best.fit.evidence[best.noise]
    held = held_out_gain(best.fit.found, fit.found, recording, law, parts, law_of_null=own.likeliest_law)
    unit, gained = recording.plan.instrumentation.unit, fit.evidence[best.noise].log_z - own.log_z
    formula = _formula_of(effect, values, unit, gained, held.per_reading)
    return formula, f"; a formula describes it: {sentence_from_samples(effect, values)}"


def _formula_of_curve(
    searched: Searched, best: BestRepair, name: str, *, rng: np.random.Generator
) -> tuple[Formula | None, str]:
    """Return the formula of the column alone that fits best in place of a curve, and a clause on what it gains."""
    prepared = searched.prepared
    parent = searched.best_refit_of(tuple(own for own in best.fit.names if own != name), best.noise)
    curve, every = prepared.effects[name], prepared.apparatus.proposed_formulas()
    formulas = [form for form in every.values() if (form.covariates, form.stage) == (curve.covariates, curve.stage)]
    if parent is None or not formulas:
        return None, ""
    bank = TemplateCache(prepared.usable_rows).coarse_bank(parent.found, formulas)
    scores = bank.log_bayes_factors_by_label(parent.found, best.fit.evidence[best.noise].likeliest_law)
    chosen = max(formulas, key=lambda form: log_mean_exp(scores[form.name]))
    fit, _ = searched.refits.refit_with_effect(parent, chosen)
    formula, _ = _formula_beside(searched, best, fit, rng=rng)
    gains = "gains" if formula.log_evidence > 0 else "loses"
    return formula, f"; {formula.expression}, the formula that fits best, {gains} {abs(formula.log_evidence):.1f} nats"


def formula_of(searched: Searched, judged: Judged, best: BestRepair, samples: ModelSamples) -> Formula | None:
    """Return the formula in the repair of an unknown effect; None if there is none."""
    if judged.verdict != "unknown":
        return None
    unit, gain = searched.prepared.recording.plan.instrumentation.unit, best.improvement
    for effect in best.fit.found.model.effects:
        if effect.expression and is_out_of_vocabulary(effect.name):
            values = samples.effect_samples(effect.name)
            return _formula_of(effect, values, unit, gain.log_evidence, gain.heldout_log_density_per_reading)
    return None


def _formula_of(effect: Effect, values: FloatArray, unit: str, log_evidence: float, per_reading: float) -> Formula:
    _, side, target, _ = effect.name.split(":", 3)
    return Formula(effect.expression, side, target, parameters_found(effect, values, unit), log_evidence, per_reading)
