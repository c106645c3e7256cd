"""Which two hypotheses the next readings are to tell apart."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.audit import NextMeasurement, covariance_of, next_measurement
from probewise.diagnosis.evidence import Linearised
from probewise.diagnosis.fit import Model
from probewise.diagnosis.verdict import Hypothesis
from probewise.diagnosis.weighed import Candidate, Search
from probewise.sensor import Stage

__all__ = ["next_readings"]


def next_readings(search: Search, hypotheses: tuple[Hypothesis, ...], null: Candidate) -> NextMeasurement | None:
    """Ask for the readings that tell the two leading refitted hypotheses about the mean apart."""
    leaders: list[Candidate] = []
    for hypothesis in hypotheses:
        names = tuple(n for n in hypothesis.effects if not _on_noise(search, n))
        candidate = null if names in ((), ("unknown",)) else search.best(names, search.certain)
        if candidate is not None and all(candidate.names != leader.names for leader in leaders):
            leaders.append(candidate)
        if len(leaders) == 2:
            break
    if len(leaders) < 2:
        rival = _rival_of(search, leaders[0], hypotheses)
        if rival is None:
            return None
    else:
        rival = (leaders[1].found.model, leaders[1].found.z, covariance_of(leaders[1].found))
    found = leaders[0].found
    return next_measurement((found.model, found.z, covariance_of(found)), rival, found.sd, search.recording.plan)


def _rival_of(
    search: Search, leader: Candidate, hypotheses: tuple[Hypothesis, ...]
) -> tuple[Model, FloatArray, FloatArray] | None:
    """Make a rival of the most probable effect that is not felt: just as large as lambda 3 here."""
    ranked = [n for h in hypotheses for n in h.effects if n in search.effects and not _on_noise(search, n)]
    name = next((n for n in ranked if n not in leader.names), None)
    if name is None:
        return None
    effect, found = search.effects[name], leader.found
    best = max(leader.evidence.values(), key=lambda e: e.log_z)
    problem = Linearised.of(found, best.law)
    templates = search.templates.of(found, effect)
    sizes = [float(np.linalg.norm(problem.project(c[:, :1]))) for c in templates.columns]
    at = int(np.argmin(np.abs(np.log(np.maximum(sizes, 1e-9) / 3.0))))
    setting = templates.settings[at][0].copy()
    for k in effect.amplitudes:
        setting[k] *= min(3.0 / max(sizes[at], 1e-9), 50.0)
    model = found.model.with_effect(templates.variant(at))
    z = np.concatenate([found.z, model.scores_of(setting[None, :])[0]])
    covariance = np.zeros((len(z), len(z)))
    covariance[: len(found.z), : len(found.z)] = covariance_of(found)
    return model, z, covariance


def _on_noise(search: Search, name: str) -> bool:
    return name in search.effects and search.effects[name].stage is Stage.NOISE
