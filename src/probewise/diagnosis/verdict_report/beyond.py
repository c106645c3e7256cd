"""Findings beyond the verdict: a significant misfit after the repair, and a formula for an unknown effect."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.held_out import held_out_gain
from probewise.diagnosis.judgement.judged import Judged
from probewise.diagnosis.repair.best_repair import BestRepair
from probewise.diagnosis.repair.samples import ModelSamples, sample_model
from probewise.diagnosis.residuals.locate import ALARM, significant_places
from probewise.diagnosis.search.constants import ALIASED_NATS
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.search.weighed_fit import WeighedFit
from probewise.diagnosis.verdict_report.findings import ParameterFound, parameters_found
from probewise.diagnosis.verdict_report.words import p_in_words
from probewise.effects import NamedEffect, is_out_of_vocabulary
from probewise.effects.effect import sentence_from_samples

_N_DRAWS = 199


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
    prepared, covariates = searched.prepared, searched.misfit_templates.covariates
    draws = best.problem.draw_null_residuals(_N_DRAWS, rng=rng)
    found = significant_places(
        best.problem, covariates, prepared.recording.plan.scan_names, best.fit.found.residuals, draws
    )
    where = found[0].covariate if found else None
    shows = "" if where is None else f"; it shows most in {prepared.apparatus.words.covariate_in_words(where)}"
    share = more / (named + more) if named + more > 0 else 0.0
    formula, said = None, ""
    if fit is not None and with_formula > max(value, log_z + ALIASED_NATS):
        formula, said = _formula_beside(searched, best, fit, rng=rng)
    smaller = "A smaller misfit" if share < 0.5 else "A misfit"
    gain = f"what has no name would add {share:.0%} of the whole gain in log evidence"
    sentence = f"{smaller} remains ({p_in_words(p_value)}; {gain}){shows}{said}."
    return Remainder(p_value, share, where, sentence, formula)


def _formula_beside(
    searched: Searched, best: BestRepair, fit: WeighedFit, *, rng: np.random.Generator
) -> tuple[Formula, str]:
    """Return the formula that a fit adds to the best repair, with its gain over that, and a clause that tells it."""
    prepared, evidence = searched.prepared, fit.evidence[best.noise]
    effect = next(e for e in fit.found.model.effects if e.name not in best.fit.names)
    values = sample_model(
        fit.found, evidence, prepared.recording, weights=fit.weights, rng=rng, annealed=False
    ).effect_samples(effect.name)
    parts = prepared.apparatus.held_out_parts(prepared.recording)
    law, law_without = evidence.likeliest_law, best.fit.evidence[best.noise].likeliest_law
    held = held_out_gain(best.fit.found, fit.found, prepared.recording, law, parts, law_of_null=law_without)
    gained = evidence.log_z - best.fit.evidence[best.noise].log_z
    unit = prepared.recording.plan.instrumentation.unit
    formula = _formula_from_samples(effect, values, unit, gained, held.per_reading)
    return formula, f"; a formula describes it: {sentence_from_samples(effect, values)}"


def formula_of(searched: Searched, judged: Judged, best: BestRepair, samples: ModelSamples) -> Formula | None:
    """Return the formula in the repair of an unknown effect; None if there is none."""
    if judged.verdict != "unknown":
        return None
    unit, gain = searched.prepared.recording.plan.instrumentation.unit, best.improvement
    for effect in best.fit.found.model.effects:
        if getattr(effect, "expression", "") and is_out_of_vocabulary(effect.name):
            values = samples.effect_samples(effect.name)
            return _formula_from_samples(effect, values, unit, gain.log_evidence, gain.heldout_log_density_per_reading)
    return None


def _formula_from_samples(
    effect: NamedEffect[Any], values: FloatArray, unit: str, log_evidence: float, per_reading: float
) -> Formula:
    """Describe an effect with an `expression` by samples of its parameters, (n_samples, n_params), and its gain."""
    _, side, target, _ = effect.name.split(":", 3)
    expression = str(getattr(effect, "expression", ""))
    return Formula(expression, side, target, parameters_found(effect, values, unit), log_evidence, per_reading)
