"""What physics does the model leave out? From recordings to verdict, cause, repaired model and next measurement.

The paper, section "Efficacy of Sensor Model", shows that a better likelihood makes better inferences; this is
how a poor likelihood is found out: its residuals are tested, located, explained by named effects, repaired, and
the gain is shown on readings kept back.
"""

from probewise.diagnosis.advice.aliases import Alias
from probewise.diagnosis.advice.commands import MOST_READINGS
from probewise.diagnosis.advice.next_scans import NextMeasurement
from probewise.diagnosis.audit.document import CURE_PLAN, audit_json
from probewise.diagnosis.audit.plan_audit import Cure, EffectAudit, PlanAudit, Smallest, audit_plan, audit_recorded
from probewise.diagnosis.engine import Thorough, diagnose
from probewise.diagnosis.fitting.earlier import SensorPrior
from probewise.diagnosis.fitting.null import Null
from probewise.diagnosis.fitting.own_model import OwnModel, Parameters
from probewise.diagnosis.joining import join
from probewise.diagnosis.repair.chosen import model_with
from probewise.diagnosis.repair.mending import Improvement
from probewise.diagnosis.repair.repaired import ModelSamples
from probewise.diagnosis.residuals.locate import ALARM, Place
from probewise.diagnosis.search.odds import PriorOdds
from probewise.diagnosis.search.thorough import weigh_thoroughly
from probewise.diagnosis.search.weighed_twice import Weighing
from probewise.diagnosis.unknown_shape import SensorAndShape
from probewise.diagnosis.verdict_report.document import NEXT_PLAN, diagnosis_json, diagnosis_schema
from probewise.diagnosis.verdict_report.verdict import (
    Diagnosis,
    EffectFound,
    Hypothesis,
    NoiseFound,
    ParameterFound,
    Verdict,
)
from probewise.diagnosis.verdict_report.words import p_in_words

__all__ = [
    "ALARM",
    "CURE_PLAN",
    "MOST_READINGS",
    "NEXT_PLAN",
    "Alias",
    "Cure",
    "Diagnosis",
    "EffectAudit",
    "EffectFound",
    "Hypothesis",
    "Improvement",
    "ModelSamples",
    "NextMeasurement",
    "NoiseFound",
    "Null",
    "OwnModel",
    "ParameterFound",
    "Parameters",
    "Place",
    "PlanAudit",
    "PriorOdds",
    "SensorAndShape",
    "SensorPrior",
    "Smallest",
    "Thorough",
    "Verdict",
    "Weighing",
    "audit_json",
    "audit_plan",
    "audit_recorded",
    "diagnose",
    "diagnosis_json",
    "diagnosis_schema",
    "join",
    "model_with",
    "p_in_words",
    "weigh_thoroughly",
]
