"""Bayesian model averaging: samples of several numbers of Gaussians, or of several hypotheses, in one model.

Predictions must include the uncertainty between hypotheses: for readings unlike the recorded ones, the most probable
explanation alone would be overconfident.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.diagnosis.fitting.null import Null
from probewise.diagnosis.repair.samples import ModelSamples
from probewise.effects import NamedEffect
from probewise.recordings.plan import Plan
from probewise.sensor import ACCURATE_NODES, footprint_of


def mix_over_orders(parts: Sequence[ModelSamples], weights: FloatArray, *, rng: np.random.Generator) -> ModelSamples:
    """Mix samples of one hypothesis at several SSF orders (numbers of Gaussians) by their probability.

    All are converted to the largest order, by splitting Gaussians into two equal halves.

    Parameters
    ----------
    parts
        Samples of each order, in equal numbers.
    weights
        Probability of each order, (n_parts,).
    rng
        Source of randomness.
    """
    largest = max(parts, key=lambda part: part.n_gaussians)
    n = len(largest.theta)
    counts = rng.multinomial(n, weights)
    order = rng.permutation(n)
    theta = [
        _with_more_gaussians(part.theta[:count], part.n_gaussians, largest.n_gaussians)
        for part, count in zip(parts, counts, strict=True)
    ]
    noise_sd = [part.noise_sd[:count] for part, count in zip(parts, counts, strict=True)]
    return replace(largest, theta=np.concatenate(theta)[order], noise_sd=np.concatenate(noise_sd)[order])


def can_share_one_model(first: Sequence[NamedEffect[Any]], second: Sequence[NamedEffect[Any]]) -> bool:
    """Return whether hypotheses of these effects can be combined in one model.

    Shared effects must change readings alike, bound to the same scans; all others need parameters at which they change
    nothing.
    """
    known = {effect.name: effect for effect in first}
    shared = {effect.name for effect in second if effect.name in known}
    alike = all(_change_readings_alike(known[effect.name], effect) for effect in second if effect.name in shared)
    return alike and all(effect.nothing for effect in (*first, *second) if effect.name not in shared)


def _change_readings_alike(one: NamedEffect[Any], other: NamedEffect[Any]) -> bool:
    """Return whether effects are equal, or variants of one form with the same action: these differ in priors alone."""
    act = getattr(one, "act", None)
    return one == other or (act is not None and act is getattr(other, "act", None))


def mix_over_hypotheses(
    parts: Sequence[ModelSamples], shares: FloatArray, null: Null, plan: Plan, *, rng: np.random.Generator
) -> ModelSamples:
    """Mix samples of several hypotheses by their probability, in one model with the effects of all.

    In samples of a hypothesis without an effect, the effect's parameters change nothing and `absent` marks it.

    Parameters
    ----------
    parts
        Samples of each hypothesis, in equal numbers; they fit in one model (`can_share_one_model`).
    shares
        Probability of each, (n_parts,).
    null
        The model without effects, that of the part with the most Gaussians.
    plan
        What was read.
    rng
        Source of randomness.
    """
    largest = max(parts, key=lambda part: part.n_gaussians)
    effects = {e.name: e for part in parts for e in cast(Sequence[NamedEffect[Any]], part.chain.effects)}
    chain = null.chain(plan, tuple(effects.values()), n_nodes=ACCURATE_NODES)
    n = len(largest.theta)
    counts = rng.multinomial(n, shares / shares.sum())
    theta, noise_sd = [], []
    absent: dict[str, list[BoolArray]] = {name: [] for name in effects}
    for part, count in zip(parts, counts, strict=True):
        rows = rng.permutation(n)[:count]
        head = len(part.chain.names) - sum(part.effect_samples(name).shape[1] for name in effects)
        columns = [_with_more_gaussians(part.theta[rows, :head], part.n_gaussians, largest.n_gaussians)]
        for effect in cast(Sequence[NamedEffect[Any]], chain.effects):
            absent[effect.name].append(np.full(count, effect.name not in part.effects))
            if effect.name in part.effects:
                columns.append(part.effect_samples(effect.name)[rows])
                continue
            holder = next(other for other in parts if effect.name in other.effects)
            idle = holder.effect_samples(effect.name)[rows]
            for k, value in (effect.nothing or {}).items():
                idle[:, k] = value
            columns.append(idle)
        theta.append(np.concatenate(columns, axis=1))
        noise_sd.append(part.noise_sd[rows])
    order = rng.permutation(n)
    return replace(
        largest,
        chain=chain,
        theta=np.concatenate(theta)[order],
        noise_sd=np.concatenate(noise_sd)[order],
        effects=tuple(effect.name for effect in chain.effects),
        absent={name: marks[order] for name, own in absent.items() if (marks := np.concatenate(own)).any()},
    )


def _with_more_gaussians(theta: FloatArray, n_gaussians: int, wanted: int) -> FloatArray:
    """Convert each sample's mixture to more Gaussians, by halving the heaviest."""
    blocks = theta[:, : 6 * n_gaussians].reshape(len(theta), n_gaussians, 6)
    rows = np.arange(len(theta))
    for n in range(n_gaussians, wanted):
        heaviest = np.argmax(footprint_of(blocks.reshape(len(theta), 6 * n), n).weight[:, 0], axis=1)
        half = blocks[rows, heaviest].copy()
        half[:, 0] /= 2
        blocks = np.concatenate([blocks, half[:, None, :]], axis=1)
        blocks[rows, heaviest, 0] /= 2
    return np.concatenate([blocks.reshape(len(theta), 6 * wanted), theta[:, 6 * n_gaussians :]], axis=1)
