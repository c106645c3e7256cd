"""The result of a diagnosis: verdict, probabilities, places, repair, next measurement; and as diagnosis.json."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from importlib.resources import files
from typing import Any

from probewise._display import ShowsItself
from probewise._kinds import require_kind
from probewise.diagnosis.advice import NextMeasurement
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.best_repair import Improvement
from probewise.diagnosis.findings import EffectFound, Formula, NoiseFound, ParameterFound, Remainder
from probewise.diagnosis.locate import ALARM, Place
from probewise.diagnosis.repair import Repair
from probewise.diagnosis.samples import ModelSamples
from probewise.diagnosis.search.thorough import Weighing
from probewise.diagnosis.verdict import Hypothesis, Judged, Verdict
from probewise.diagnosis.words import hypothesis_in_words, p_in_words
from probewise.effects import name_without_copy_suffix
from probewise.recordings.plan import Recording


@dataclass(frozen=True)
class VerdictReport:
    """The verdict in words and numbers: reason, effects, noise, log evidences, and what named effects do not explain.

    `weighings` are log evidences by Laplace's approximation and by nested sampling, if they were computed. `remainder`
    (a misfit after the repair) and `formula` are None if there is none. `is_settled`: whether one hypothesis on the
    mean has a probability of .95 or more.
    """

    reason: str
    effects: tuple[EffectFound, ...]
    noise: NoiseFound
    weighings: tuple[Weighing, ...] = ()
    remainder: Remainder | None = None
    formula: Formula | None = None
    is_settled: bool = False


@dataclass(frozen=True, eq=False)
class Diagnosis(ShowsItself):
    """The result of a diagnosis: the content of diagnosis.json, and the arrays for its figures.

    `recording` is what was diagnosed (several are joined). `where`: places (ranges of covariates) of the repair's
    effects, largest first, then of other significant residuals. `next_measurement`: None if no question is open, or no
    readings would answer it.
    """

    recording: Recording
    judged: Judged
    repair: Repair
    where: tuple[Place, ...]
    next_measurement: NextMeasurement | None
    report: VerdictReport
    apparatus: Apparatus

    @property
    def verdict(self) -> Verdict:
        """The verdict: clean, named, cannot_tell, unknown or noise."""
        return self.judged.verdict

    @property
    def reason(self) -> str:
        """The verdict and its reason, in a sentence or two."""
        return self.report.reason

    @property
    def p_value(self) -> float:
        """p-value of the global test of the calibrated model: small if an effect on the mean is missing."""
        return self.judged.p_value

    @property
    def combination(self) -> tuple[str, ...]:
        """Most probable set of effects; () if clean or none is named, ("unknown",) if unknown."""
        return self.judged.combination

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """All hypotheses (sets of effects) with their probabilities, most probable first."""
        return self.judged.hypotheses

    @property
    def effects(self) -> tuple[EffectFound, ...]:
        """Findings on the effects of probability above 0.001, most probable first."""
        return self.report.effects

    @property
    def improvement(self) -> Improvement:
        """Gain of the repaired model over the calibrated one."""
        return self.repair.improvement

    @property
    def null(self) -> ModelSamples:
        """Posterior samples of the calibrated model, without effects."""
        return self.repair.null

    @property
    def repaired(self) -> ModelSamples:
        """Posterior samples of the repaired model, with its effects."""
        return self.repair.model

    @property
    def unstated_effects(self) -> tuple[tuple[str, float, str], ...]:
        """Effects in the repaired model that are not in `effects`: name, share of the samples with it, sentence."""
        return self.repair.unstated_effects({effect.name for effect in self.effects})

    def summary(self) -> str:
        """Describe the diagnosis in plain text."""
        lines = [f"{self.verdict}: {self.reason}"]
        if self.verdict != "unknown" or self.p_value <= ALARM:  # otherwise the reason says why it does not count
            odd = "probability of readings at least this odd if nothing is missing from the mean"
            lines.append(f"{p_in_words(self.p_value)} ({odd})")
        lines.append("probability  explanation")
        for h in (h for h in self.hypotheses[:5] if h.probability > 1e-3):
            words, code = hypothesis_in_words(h.effects), h.label
            lines.append(f"  {h.probability:9.3f}  {words if words == code else f'{words} ({code})'}")
        # The reason is not repeated.
        lines += [
            f"{self.apparatus.words.as_sentence(e.sentence)} ({name_without_copy_suffix(e.name)}, probability "
            f"{e.probability:.3f} in all explanations together)"
            for e in self.effects
            if e.probability > 0.05 and e.sentence.lower() not in self.reason.lower()
        ]
        gain, unit = self.improvement, self.recording.plan.instrumentation.unit_after_number
        unit = f"{unit}{self.recording.weighting_in_words}"
        after, model = self.repair.after_in_words, self.apparatus.words.model
        if self.repair.changes_predictions:
            held = f"{gain.heldout_log_density_per_reading:+.4f} ± {gain.heldout_sd:.4f} nats per held-out reading"
            tested = held if gain.heldout_by_scan else "no reading could be held out"
            rms = f"{gain.rms_before:.4g} -> {gain.rms_after:.4g} {unit}".rstrip()
            lines.append(f"{after}: log evidence {gain.log_evidence:+.1f} nats, {tested}, rms of the residuals {rms}")
        elif self.verdict == "noise":
            lines.append(f"repaired noise model: log evidence {gain.log_evidence:+.1f} nats")
        if self.repair.by_rows:
            lines.append(f"the unknown effect is corrected in these readings only: {self.repair.not_in_model(model)}")
        lines += [
            f"in {share:.0%} of the repaired model's samples: {sentence}"
            for _, share, sentence in self.unstated_effects
        ]
        if self.repair.combination_shares:
            lines.append(f"samples of the repaired model contain {self.repair.shares_in_words}")
        return "\n".join(lines)


def require_diagnosis(diagnosis: object) -> None:
    """Raise ParameterError unless `diagnosis` is a Diagnosis."""
    require_kind("diagnosis", diagnosis, Diagnosis, "a Diagnosis, as diagnose and diagnose_system return it")


NEXT_PLAN = "next_plan.csv"


def diagnosis_schema() -> dict[str, Any]:
    """Return the JSON schema of diagnosis.json, format "diagnosis/1"."""
    text = files("probewise.diagnosis").joinpath("diagnosis.schema.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    return schema


def diagnosis_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Convert a diagnosis to the content of diagnosis.json, as strict JSON allows.

    Figures of places (`where`) and the next plan are given by file name; the report and the command line write them.
    """
    require_diagnosis(diagnosis)
    gain, plan = diagnosis.improvement, diagnosis.next_measurement
    document: dict[str, Any] = {
        "format": "diagnosis/1",
        "verdict": diagnosis.verdict,
        "reason": diagnosis.reason,
        "p_value": diagnosis.p_value,
        "combination": _public_names(diagnosis.combination),
        "hypotheses": [
            {"effects": _public_names(h.effects), "probability": h.probability} for h in diagnosis.hypotheses
        ],
        "effects": [
            {
                "name": name_without_copy_suffix(e.name),
                "probability": e.probability,
                "size_lambda": e.size_lambda,
                "sentence": e.sentence,
                "parameters": [_parameter_json(p) for p in e.parameters],
            }
            | ({} if e.formula is None else {"formula": _formula_json(e.formula)})
            for e in diagnosis.effects
        ],
        "unknown_probability": diagnosis.judged.unknown_probability,
        "clean_probability": diagnosis.judged.clean_probability,
        "unknown_candidates": [
            {"name": name, "probability": probability} for name, probability in diagnosis.judged.unknown_candidates
        ],
        "credible_set": list(diagnosis.judged.credible),
        "where": [
            {
                "covariate": place.covariate,
                "scan": place.scan,
                "from": place.start,
                "to": place.end,
                "p_value": place.p_value,
                "witness": place.figure_name,
            }
            for place in diagnosis.where
        ],
        "improvement": {key: value for key, value in asdict(gain).items() if key != "heldout_by_scan"},
        "aliases": [asdict(a) | {"effects": list(a.effects)} for a in diagnosis.judged.aliases],
        "noise": {
            "model": diagnosis.report.noise.model,
            "p_value": diagnosis.report.noise.p_value,
            "parameters": [_parameter_json(p) for p in diagnosis.report.noise.parameters],
        },
        "next_measurement": None
        if plan is None
        else {
            "plan": diagnosis.apparatus.words.next_plan,
            "readings": len(plan.plan),
            "minutes": plan.minutes,
            "expected_log_bayes_factor": plan.expected_log_bayes_factor,
        },
    }
    remainder, formula = diagnosis.report.remainder, diagnosis.report.formula
    if remainder is not None:
        document["remainder"] = {key: value for key, value in asdict(remainder).items() if key != "formula"}
        if remainder.formula is not None:
            document["remainder"]["formula"] = _formula_json(remainder.formula)
    if formula is not None:
        document["formula"] = _formula_json(formula)
    if diagnosis.report.weighings:
        document["thorough"] = [_weighing_json(w) for w in diagnosis.report.weighings]
    return document


def _public_names(effects: Iterable[str]) -> list[str]:
    return sorted(map(name_without_copy_suffix, effects))


def _weighing_json(twice: Weighing) -> dict[str, Any]:
    return {
        "effects": _public_names(twice.effects),
        "n_gaussians": twice.n_gaussians,
        "log_evidence_laplace": twice.laplace,
        "log_evidence_nested": twice.nested,
        "error": twice.error,
        "agree": twice.agree,
        "doubts": list(twice.doubts),
    }


def _formula_json(formula: Formula) -> dict[str, Any]:
    return asdict(formula) | {"parameters": [_parameter_json(p) for p in formula.parameters]}


def _parameter_json(found: ParameterFound) -> dict[str, Any]:
    return asdict(found) | {"interval95": list(found.interval95)}
