"""What is stated of each effect: how probable, how large, its parameters, in words."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.fitting.fit import fit
from probewise.diagnosis.noise.law import noise_statistics, steps_within_scans
from probewise.diagnosis.repair.repaired import N_SAMPLES, ModelSamples, sample_model
from probewise.diagnosis.search.weighed_fit import Search, WeighedFit, in_vocabulary
from probewise.diagnosis.verdict_report.verdict import EffectFound, Hypothesis, NoiseFound, ParameterFound
from probewise.diagnosis.verdict_report.words import unit_in_words
from probewise.effects import NUISANCES, UNNAMED, NamedEffect
from probewise.recordings.plan import Plan, Recording
from probewise.sensor import Stage

__all__ = ["effects_found", "noise_found"]

Names = tuple[str, ...]

_LEAST_PROBABILITY = 1e-3
_N_DRAWS = 999


def effects_found(
    search: Search,
    hypotheses: tuple[Hypothesis, ...],
    best: WeighedFit,
    samples: ModelSamples,
    noise_of: Names,
    *,
    rng: np.random.Generator,
) -> tuple[EffectFound, ...]:
    """Give probability, size, parameters and sentence of every effect of the vocabulary that matters.

    Parameters
    ----------
    search
        What was weighed.
    hypotheses
        All, with their probabilities.
    best, samples, noise_of
        What the repaired model is, its posterior samples and noise model: the numbers of its effects are from there.
        Those of the others are from the most probable candidate that holds them.
    rng
        Source of randomness.
    """
    out, unit = [], search.recording.plan.instrumentation.unit
    for name, effect in search.effects.items():
        p = sum(h.probability for h in hypotheses if name in h.effects)
        if p <= _LEAST_PROBABILITY or name in NUISANCES or name in UNNAMED:
            continue
        holder, noise = (best, noise_of) if name in samples.effects else _holder(search, name)
        if holder is None:
            effect, values, size = _too_small(search, effect, rng=rng)
        else:
            effect = next((e for e in holder.found.model.effects if e.name == name), effect)
            own = samples
            if name not in samples.effects:
                evidence, weights = holder.evidence[noise], holder.weights
                own = sample_model(holder.found, evidence, search.recording, weights=weights, rng=rng, annealed=False)
            values, size = own.columns(name), _size(search, holder, name, noise)
        out.append(
            EffectFound(
                name,
                min(p, 1.0),
                size,
                effect.sentence(values.mean(axis=0), values.std(axis=0)),
                (*_parameters(effect, values, unit), *_scans(effect, search.recording.plan)),
                effect.scans,
            )
        )
    return tuple(sorted(out, key=lambda e: -e.probability))


def _holder(search: Search, name: str) -> tuple[WeighedFit | None, Names]:
    """Find the most probable refitted candidate that holds an effect."""
    ranked = sorted(search.probabilities.items(), key=lambda item: -item[1])
    for (mean, noise), p in ranked:
        if p > 0 and name in (*mean, *noise):
            candidate = search.best(mean, noise)
            if candidate is not None:
                return candidate, noise
    return None, ()


def _too_small(
    search: Search, effect: NamedEffect[Any], *, rng: np.random.Generator
) -> tuple[NamedEffect[Any], FloatArray, float]:
    """Bound an effect that is not felt: amplitudes by the linearised null, the rest as the prior has it.

    Of its variants the one is taken that stands in the middle.
    """
    null = search.candidates[search.order, ()]
    best = max(null.evidence.values(), key=lambda e: e.log_z)
    problem = Linearised.of(null.found, best.law)
    templates = search.templates.of(search.about, effect.coarse())
    middle = len(templates.columns) // 2
    effect = templates.variant(middle)
    values = effect.prior.from_unit_cube(rng.random((N_SAMPLES, len(effect.prior.names))))
    if not effect.amplitudes:
        return effect, values, 0.0
    projected = problem.project(templates.columns[middle])
    # A ridge of one prior scale keeps amplitudes that the plan cannot see from running off.
    precision = projected.T @ projected + np.eye(projected.shape[1])
    amount = np.linalg.solve(precision, projected.T @ problem.residual)
    spread = np.linalg.cholesky(np.linalg.inv(precision))
    draws = amount + rng.standard_normal((N_SAMPLES, len(amount))) @ spread.T
    for k in effect.amplitudes:
        values[:, k] = draws @ templates.settings[middle][:, k]
    # Signs that the prior rules out are folded back.
    inside = np.isfinite(effect.prior.log_prob(values))
    values[~inside] = np.abs(values[~inside])
    return effect, values, float(np.linalg.norm(projected @ amount))


def _size(search: Search, holder: WeighedFit, name: str, noise: Names) -> float:
    """Measure lambda: what is left on noise-free readings after a full refit without the effect."""
    law = holder.evidence[noise].law
    found = holder.found
    if name in search.certain:
        step = holder.evidence[noise].nodes.settings[0, holder.evidence[noise].noise.columns_of(name)]
        return float(step[0]) / math.sqrt(12) / found.sd * math.sqrt(len(found.residuals))
    if search.effects[name].stage is Stage.NOISE:
        # On the noise: the evidence for it, as the effect of that many sd on the mean would leave.
        gain = holder.evidence[noise].log_z - holder.evidence[tuple(n for n in noise if n != name)].log_z
        return math.sqrt(2 * max(gain, 0.0))
    clean = np.full(len(search.recording), np.nan)
    clean[search.recording.usable] = found.predicted
    model, stay = found.model.without(name)
    noise_free = Recording(search.recording.plan, clean).unlimited()
    # With the noise's own sd as floor the refit weighs readings against priors as the real one did.
    sigma = float(law.scale(law(found.residuals)[:, None])[0])
    refit = fit(model, noise_free, found.z[stay], law.at_least(sigma), max_steps=12, tolerance=0.02)
    return float(np.linalg.norm(law(refit.residuals))) / sigma * math.sqrt(law.information)


def noise_found(
    search: Search,
    best: WeighedFit,
    noise: Names,
    after: Linearised,
    samples: ModelSamples,
    *,
    rng: np.random.Generator,
) -> NoiseFound:
    """Test the repaired model's residual for memory, heavy tails and a spread that follows the level."""
    steps = steps_within_scans(search.recording)
    own = after.residual[: after.n_points, None]
    null = after.draws(_N_DRAWS, rng=rng)[: after.n_points]
    joined = noise_statistics(np.concatenate([own, null], axis=1), steps, best.found.predicted)
    center, spread = joined[:, 1:].mean(axis=1), joined[:, 1:].std(axis=1)
    worst = np.max(np.abs(joined - center[:, None]) / np.maximum(spread, 1e-12)[:, None], axis=0)
    p_value = (1 + int(np.sum(worst[1:] >= worst[0]))) / (1 + _N_DRAWS)
    unit = search.recording.plan.instrumentation.unit
    parameters = [_parameter("sd", unit, samples.noise_sd)]
    for name in in_vocabulary(noise):
        parameters += _parameters(search.effects[name], samples.columns(name), unit)
    return NoiseFound("+".join(noise) or "white", p_value, tuple(parameters))


def _parameters(effect: NamedEffect[Any], values: FloatArray, unit: str) -> tuple[ParameterFound, ...]:
    return tuple(
        _parameter(name, unit_in_words(own, unit), values[:, k])
        for k, (name, own) in enumerate(zip(effect.prior.names, effect.units, strict=True))
    )


def _scans(effect: NamedEffect[Any], plan: Plan) -> tuple[ParameterFound, ...]:
    """Give the numbers of the scans that an effect is bound to, from 0 in order of taking; its sentence names them."""
    numbers = np.flatnonzero([name in effect.scans for name in plan.scan_names]).astype(np.float64)
    return (_parameter("scans", "scan", numbers),) if numbers.size else ()


def _parameter(name: str, unit: str, values: FloatArray) -> ParameterFound:
    low, high = np.quantile(values, [0.025, 0.975])
    return ParameterFound(name, unit, float(values.mean()), float(values.std()), (float(low), float(high)))
