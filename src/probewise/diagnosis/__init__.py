"""Diagnosis of physics that a model leaves out: from recordings to verdict, repaired model and next measurement.

The paper, section "Efficacy of Sensor Model", shows that a better likelihood makes better inferences; this package
finds a poor likelihood: it tests and locates residuals, explains them by named effects, repairs the model, and measures
the gain on held-out readings.

Reading order: the input (`prepared.prepare` of recordings, `diagnose_simulator.prepare_system` of a table), `fit` and
`noise` (the model), `search` (evidences), `verdict`, `best_repair` (which may withdraw it), `samples` and `posterior`
(draws), `locate`, `advice`; `diagnosis.diagnose_prepared` calls them. `apparatus` is what
they ask of a light sensor (`light_sensor`) or of a simulator (`simulator_rows`).
"""

from __future__ import annotations

from probewise.diagnosis.advice import Alias, NextMeasurement
from probewise.diagnosis.apparatus import MOST_ADVISED_READINGS, SETTLED, PriorOdds
from probewise.diagnosis.audit import (
    CURE_PLAN,
    Cure,
    DetectableSize,
    EffectAudit,
    PlanAudit,
    audit_json,
    audit_plan,
    audit_system,
)
from probewise.diagnosis.best_repair import Improvement
from probewise.diagnosis.diagnose_simulator import diagnose_system, notes_on_calls
from probewise.diagnosis.diagnosis import (
    NEXT_PLAN,
    Diagnosis,
    PredictionAndResiduals,
    Thorough,
    diagnose,
    diagnosis_json,
    diagnosis_schema,
    generators_of_diagnosis,
    model_with,
)
from probewise.diagnosis.findings import EffectFound, Formula, NoiseFound, ParameterFound, Remainder
from probewise.diagnosis.fit import Null
from probewise.diagnosis.fit_simulator import Evidence, SystemFit, calibrated_of, fit_json, fit_simulator, repaired_of
from probewise.diagnosis.locate import ALARM, Place
from probewise.diagnosis.prepared import join
from probewise.diagnosis.samples import ModelSamples
from probewise.diagnosis.search.thorough import Weighing, weigh_thoroughly
from probewise.diagnosis.sensors import SensorAndShape, SensorPrior
from probewise.diagnosis.verdict import TO_SEPARATE, Hypothesis, Judged, Verdict
from probewise.diagnosis.words import p_in_words

__all__ = [
    "ALARM",
    "CURE_PLAN",
    "MOST_ADVISED_READINGS",
    "NEXT_PLAN",
    "SETTLED",
    "TO_SEPARATE",
    "Alias",
    "Cure",
    "DetectableSize",
    "Diagnosis",
    "EffectAudit",
    "EffectFound",
    "Evidence",
    "Formula",
    "Hypothesis",
    "Improvement",
    "Judged",
    "ModelSamples",
    "NextMeasurement",
    "NoiseFound",
    "Null",
    "ParameterFound",
    "Place",
    "PlanAudit",
    "PredictionAndResiduals",
    "PriorOdds",
    "Remainder",
    "SensorAndShape",
    "SensorPrior",
    "SystemFit",
    "Thorough",
    "Verdict",
    "Weighing",
    "audit_json",
    "audit_plan",
    "audit_system",
    "calibrated_of",
    "diagnose",
    "diagnose_system",
    "diagnosis_json",
    "diagnosis_schema",
    "fit_json",
    "fit_simulator",
    "generators_of_diagnosis",
    "join",
    "model_with",
    "notes_on_calls",
    "p_in_words",
    "repaired_of",
    "weigh_thoroughly",
]
