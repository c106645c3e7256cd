"""Diagnosis of physics that a model leaves out: from recordings to verdict, repaired model and next measurement.

The paper, section "Efficacy of Sensor Model", shows that a better likelihood makes better inferences; this package
finds a poor likelihood: it tests and locates residuals, explains them by named effects, repairs the model, and measures
the gain on held-out readings.
"""

from probewise.diagnosis.advice.aliases import Alias
from probewise.diagnosis.advice.next_scans import NextMeasurement
from probewise.diagnosis.audit.document import CURE_PLAN, audit_json
from probewise.diagnosis.audit.plan_audit import (
    Cure,
    DetectableSize,
    EffectAudit,
    PlanAudit,
    audit_plan,
    audit_plan_of_diagnosis,
)
from probewise.diagnosis.engine import Thorough, diagnose
from probewise.diagnosis.fitting.null import Null
from probewise.diagnosis.fitting.sensor_prior import SensorPrior
from probewise.diagnosis.joining import join
from probewise.diagnosis.judgement.judged import Hypothesis, Judged, Verdict
from probewise.diagnosis.model_with import model_with
from probewise.diagnosis.prior_odds import PriorOdds
from probewise.diagnosis.repair.improvement import Improvement
from probewise.diagnosis.repair.repair import PredictionAndResiduals, Repair
from probewise.diagnosis.repair.samples import ModelSamples
from probewise.diagnosis.residuals.locate import ALARM, Place
from probewise.diagnosis.scheduling import MOST_READINGS, SETTLED
from probewise.diagnosis.search.thorough import weigh_thoroughly
from probewise.diagnosis.search.weighed_twice import Weighing
from probewise.diagnosis.system.audit import audit_system
from probewise.diagnosis.system.diagnose import diagnose_system, notes_on_calls
from probewise.diagnosis.system.fit import Evidence, SystemFit, fit_json, fit_simulator
from probewise.diagnosis.system.fitted import calibrated_of, repaired_of
from probewise.diagnosis.unknown_shape import SensorAndShape
from probewise.diagnosis.verdict_report.beyond import Formula, Remainder
from probewise.diagnosis.verdict_report.diagnosis import Diagnosis, VerdictReport
from probewise.diagnosis.verdict_report.document import NEXT_PLAN, diagnosis_json, diagnosis_schema
from probewise.diagnosis.verdict_report.findings import EffectFound, NoiseFound, ParameterFound
from probewise.diagnosis.verdict_report.reason import TO_SEPARATE
from probewise.diagnosis.verdict_report.words import p_in_words

__all__ = [
    "ALARM",
    "CURE_PLAN",
    "MOST_READINGS",
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
    "Repair",
    "SensorAndShape",
    "SensorPrior",
    "SystemFit",
    "Thorough",
    "Verdict",
    "VerdictReport",
    "Weighing",
    "audit_json",
    "audit_plan",
    "audit_plan_of_diagnosis",
    "audit_system",
    "calibrated_of",
    "diagnose",
    "diagnose_system",
    "diagnosis_json",
    "diagnosis_schema",
    "fit_json",
    "fit_simulator",
    "join",
    "model_with",
    "notes_on_calls",
    "p_in_words",
    "repaired_of",
    "weigh_thoroughly",
]
