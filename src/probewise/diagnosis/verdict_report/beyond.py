"""Findings beyond the verdict: a significant misfit after the repair, and a formula for an unknown effect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise.diagnosis.judgement.judged import Judged
from probewise.diagnosis.repair.best_repair import BestRepair
from probewise.diagnosis.repair.samples import ModelSamples
from probewise.diagnosis.residuals.locate import ALARM, significant_places
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.verdict_report.findings import ParameterFound, parameters_found
from probewise.diagnosis.verdict_report.words import p_in_words
from probewise.effects import is_out_of_vocabulary

_N_DRAWS = 199


@dataclass(frozen=True)
class Remainder:
    """A significant misfit that remains after all named effects.

    `p_value`: of the global test of the repaired model; `share_of_gain`: the share of the total gain in log evidence
    that an unknown effect would add; `where`: the covariate in which the misfit is most significant, or None.
    """

    p_value: float
    share_of_gain: float
    where: str | None
    sentence: str


@dataclass(frozen=True)
class Formula:
    """A formula proposed for an unknown effect, and its gain over the null.

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
    own = best.fit.found.model.sensor.n_gaussians
    value = searched.evidences.unknown.get((own, names, best.noise))
    log_z = best.fit.evidence[best.noise].log_z
    more = 0.0 if value is None else max(value - log_z, 0.0)
    named = max(log_z - searched.evidences.fits[own, ()].evidence[best.noise].log_z, 0.0)
    prepared, covariates = searched.prepared, searched.misfit_templates.covariates
    draws = best.problem.draw_null_residuals(_N_DRAWS, rng=rng)
    found = significant_places(
        best.problem, covariates, prepared.recording.plan.scan_names, best.fit.found.residuals, draws
    )
    where = found[0].covariate if found else None
    shows = "" if where is None else f"; it shows most in {prepared.apparatus.words.covariate_in_words(where)}"
    share = more / (named + more) if named + more > 0 else 0.0
    sentence = f"A smaller misfit remains ({p_in_words(p_value)}, {share:.0%} of the gain in log evidence){shows}."
    return Remainder(p_value, share, where, sentence)


def formula_of(searched: Searched, judged: Judged, best: BestRepair, samples: ModelSamples) -> Formula | None:
    """Return the formula in the repair of an unknown effect; None if there is none."""
    if judged.verdict != "unknown":
        return None
    unit = searched.prepared.recording.plan.instrumentation.unit
    for effect in best.fit.found.model.effects:
        expression = getattr(effect, "expression", "")
        if expression and is_out_of_vocabulary(effect.name):
            _, side, target, _ = effect.name.split(":", 3)
            parameters = parameters_found(effect, samples.effect_samples(effect.name), unit)
            gain = best.improvement
            return Formula(
                expression, side, target, parameters, gain.log_evidence, gain.heldout_log_density_per_reading
            )
    return None
