"""The content of diagnosis.json, and its schema."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from importlib.resources import files
from typing import Any

from probewise.diagnosis.search.weighed_twice import Weighing
from probewise.diagnosis.verdict_report.beyond import Formula
from probewise.diagnosis.verdict_report.diagnosis import Diagnosis, require_diagnosis
from probewise.diagnosis.verdict_report.findings import ParameterFound
from probewise.effects import name_without_copy_suffix

NEXT_PLAN = "next_plan.csv"


def diagnosis_schema() -> dict[str, Any]:
    """Return the JSON schema of diagnosis.json, format "diagnosis/1"."""
    text = files("probewise.diagnosis.verdict_report").joinpath("diagnosis.schema.json").read_text(encoding="utf-8")
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
        "improvement": {
            "log_evidence": gain.log_evidence,
            "heldout_log_density_per_reading": gain.heldout_log_density_per_reading,
            "heldout_sd": gain.heldout_sd,
            "rms_before": gain.rms_before,
            "rms_after": gain.rms_after,
            "p_value_after": gain.p_value_after,
        },
        "aliases": [
            {"effects": list(a.effects), "cosine": a.cosine, "settle_by": a.settle_by, "readings": a.readings}
            for a in diagnosis.judged.aliases
        ],
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
    return document | (
        {"thorough": [_weighing_json(w) for w in diagnosis.report.weighings]} if diagnosis.report.weighings else {}
    )


def _public_names(effects: Iterable[str]) -> list[str]:
    """Return the public names of effects, sorted; an effect that occurs twice is listed twice."""
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
    return {
        "name": found.name,
        "unit": found.unit,
        "mean": found.mean,
        "sd": found.sd,
        "interval95": list(found.interval95),
    }
