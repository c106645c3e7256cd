"""What physics does the model leave out? From recordings to verdict, cause, repaired model and next measurement.

The paper, section "Efficacy of Sensor Model", shows that a better likelihood makes better inferences; this is
how a poor likelihood is found out: its residuals are tested, located, explained by named effects, repaired, and
the gain is shown on readings kept back.
"""

from probewise.diagnosis.audit import Alias, NextMeasurement
from probewise.diagnosis.document import diagnosis_json, diagnosis_schema
from probewise.diagnosis.engine import SensorPrior, diagnose
from probewise.diagnosis.joining import join
from probewise.diagnosis.locate import Place
from probewise.diagnosis.repaired import ModelSamples
from probewise.diagnosis.search import PriorOdds
from probewise.diagnosis.verdict import (
    Diagnosis,
    EffectFound,
    Hypothesis,
    Improvement,
    NoiseFound,
    ParameterFound,
    Verdict,
)

__all__ = [
    "Alias",
    "Diagnosis",
    "EffectFound",
    "Hypothesis",
    "Improvement",
    "ModelSamples",
    "NextMeasurement",
    "NoiseFound",
    "ParameterFound",
    "Place",
    "PriorOdds",
    "SensorPrior",
    "Verdict",
    "diagnose",
    "diagnosis_json",
    "diagnosis_schema",
    "join",
]
