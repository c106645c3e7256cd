"""Audit a plan: what it cannot tell apart, which readings would cure that, and what to measure next."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.commands import MOST_READINGS, commands, minutes_of, rescheduled
from probewise.diagnosis.evidence import Linearised
from probewise.diagnosis.fit import Fit, Model, degrees_of_freedom
from probewise.diagnosis.joining import join
from probewise.effects import NamedEffect
from probewise.recordings.patterns import Uniform
from probewise.recordings.plan import Plan, Recording

__all__ = [
    "Alias",
    "NextMeasurement",
    "aliases",
    "candidate_plans",
    "covariance_of",
    "log_bayes_factor_expected",
    "next_measurement",
    "settle",
]

ALIAS_COSINE = 0.9
_LEAST_ROWS = 8


@dataclass(frozen=True)
class Alias:
    """Effects whose surviving parts look alike under this plan, and what would tell them apart."""

    effects: tuple[str, str]
    cosine: float
    settle_by: str
    readings: int


@dataclass(frozen=True, eq=False)
class NextMeasurement:
    """A plan to take next, and how much it is expected to tell between the two leading hypotheses, in nats."""

    plan: Plan
    description: str
    minutes: float
    expected_log_bayes_factor: float


def surviving_cosine(problem: Linearised, first: FloatArray, second: FloatArray) -> float:
    """Largest principal cosine of what survives of two templates, each (n_points, k)."""
    bases = []
    for columns in (first, second):
        raw = np.linalg.norm(problem.law(columns)) / problem.sd
        projected = problem.project(columns)
        # What the fit absorbs to within a thousandth is not there to be compared.
        if np.linalg.norm(projected) <= 1e-3 * raw:
            return 0.0
        u, lengths, _ = np.linalg.svd(projected, full_matrices=False)
        bases.append(u[:, lengths > 1e-3 * lengths[0]])
    return float(min(np.linalg.svd(bases[0].T @ bases[1], compute_uv=False)[0], 1.0))


def aliases(problem: Linearised, templates: Mapping[str, FloatArray]) -> list[Alias]:
    """List pairs of effects whose surviving templates have a cosine of 0.9 or more; `settle` says what would part them.

    Parameters
    ----------
    problem
        The null fit.
    templates
        For each effect its most telling columns (n_points, k).
    """
    out = []
    for pair in itertools.combinations(sorted(templates), 2):
        cosine = surviving_cosine(problem, templates[pair[0]], templates[pair[1]])
        if cosine >= ALIAS_COSINE:
            out.append(Alias(pair, cosine, "no reading that this apparatus can take tells them apart", 0))
    return sorted(out, key=lambda alias: -alias.cosine)


def candidate_plans(plan: Plan) -> list[tuple[str, Plan]]:
    """List what could be measured next, with words for it: the six R's, plain surfaces, the other axis."""
    out = [(command.description, command.plan) for command in commands(plan)]
    if not out:
        return out
    rows = next(rows for rows in plan.rows_by_scan() if rows.size >= _LEAST_ROWS)
    first = rescheduled(plan, rows, out[0][1].time_s[0], float(np.diff(out[0][1].time_s[:2])[0]), "across")
    for colour, albedo in (("white", 1.0), ("black", 0.0)):
        flat = first.take(np.arange(0, len(rows), max(len(rows) // 20, 1)))
        names = (*flat.pattern_names, f"plain_{colour}")
        flat = replace(
            flat,
            time_s=first.time_s[: len(flat)],
            scan_names=(f"{colour}_next",),
            pattern=np.full(len(flat), len(names) - 1),
            pattern_names=names,
            patterns={**flat.patterns, f"plain_{colour}": Uniform(albedo)},
        )
        out.append((f"scan a plain {colour} surface", flat))
    turned_way = replace(
        first,
        x_mm=plan.x_mm[rows].mean() + (plan.y_mm[rows] - plan.y_mm[rows].mean()),
        y_mm=plan.y_mm[rows].mean() + (plan.x_mm[rows] - plan.x_mm[rows].mean()),
    )
    out.append((f"scan across scan {plan.scan_names[int(plan.scan[rows[0]])]}, along the other axis", turned_way))
    return out


def log_bayes_factor_expected(
    first: tuple[Model, FloatArray, FloatArray], second: tuple[Model, FloatArray, FloatArray], sd: float, plan: Plan
) -> float:
    """Expect the log Bayes factor for the true one of two fitted models after this plan's readings.

    Each model is (model, z, covariance of z). Predictive distributions are normal; the value is the
    mean of the two Kullback-Leibler divergences.
    """
    means, covs = [], []
    for model, z, cov in (first, second):
        moved = replace_plan(model, plan)
        mean, slopes = moved.jacobian(z)
        means.append(mean)
        covs.append(sd**2 * np.eye(len(plan)) + slopes @ cov @ slopes.T)
    difference = means[0] - means[1]
    inverse = [np.linalg.inv(c) for c in covs]
    n = len(plan)
    total = 0.0
    for a, b in ((0, 1), (1, 0)):
        trace = float(np.sum(inverse[b] * covs[a]))
        log_det = float(np.linalg.slogdet(covs[b])[1] - np.linalg.slogdet(covs[a])[1])
        total += 0.5 * (trace - n + log_det + float(difference @ inverse[b] @ difference))
    return max(total / 2, 0.0)


def replace_plan(model: Model, plan: Plan) -> Model:
    """Look at another plan with the same model."""
    return Model(model.sensor, model.effects, plan)


def next_measurement(
    first: tuple[Model, FloatArray, FloatArray],
    second: tuple[Model, FloatArray, FloatArray],
    sd: float,
    plan: Plan,
) -> NextMeasurement | None:
    """Choose, among what the arm can do, the plan that tells the two leading hypotheses apart best per minute.

    A plan that promises three nats in less time is preferred to more for longer; None where the recording
    holds no scan to build on.
    """
    best: tuple[float, NextMeasurement] | None = None
    for description, candidate in candidate_plans(plan):
        minutes = minutes_of(candidate)
        expected = log_bayes_factor_expected(first, second, sd, candidate)
        option = NextMeasurement(candidate, description, minutes, expected)
        worth = min(expected, 10.0) / minutes
        if best is None or worth > best[0]:
            best = (worth, option)
    return None if best is None else best[1]


def settle(pairs: Sequence[Alias], found: Fit, effects: Mapping[str, NamedEffect[Any]], sd: float) -> list[Alias]:
    """Say which candidate plan tells aliased effects apart, pair by pair, and by how many readings.

    Each effect is taken at the size at which 400 readings would show it at lambda 8; the plan of the
    most expected nats a reading is advised, as many readings of it as three nats take.
    """
    names = sorted({name for pair in pairs for name in pair.effects})
    null = found.model.predict(found.z[None, :])[0]
    shapes = {}
    for name in names:
        model = found.model.with_effect(effects[name])
        z = np.concatenate([found.z, model.scores_of(effects[name].bank()[0][:1])[0]])
        here = model.predict(z[None, :])[0] - null
        shapes[name] = (model, z, here, 0.4 * sd / max(float(np.sqrt(np.mean(here**2))), 1e-12))
    best = {pair.effects: (0.0, pair) for pair in pairs}
    plans = candidate_plans(found.model.plan)
    if not (best and plans):
        return list(pairs)
    everywhere = _one_after_another([plan for _, plan in plans])
    null = replace_plan(found.model, everywhere).predict(found.z[None, :])[0]
    there = {
        name: (replace_plan(model, everywhere).predict(z[None, :])[0] - null) * scale
        for name, (model, z, _, scale) in shapes.items()
    }
    ends = np.cumsum([len(plan) for _, plan in plans])
    for (description, plan), end in zip(plans, ends, strict=True):
        rows = slice(end - len(plan), end)
        for first, second in best:
            sign = np.sign(float(shapes[first][2] @ shapes[second][2])) or 1.0
            apart = there[first][rows] - sign * there[second][rows]
            per_reading = 0.5 * float(np.sum(apart**2)) / sd**2 / len(plan)
            if per_reading > best[first, second][0]:
                readings = min(max(math.ceil(3.0 / per_reading), 1), MOST_READINGS)
                advised = replace(best[first, second][1], settle_by=description, readings=readings)
                best[first, second] = (per_reading, advised)
    return [alias for _, alias in best.values()]


def _one_after_another(plans: Sequence[Plan]) -> Plan:
    """Lay plans out as one, so that a model looks at all of them in one prediction."""
    return join([Recording(plan, np.zeros(len(plan))) for plan in plans]).plan


def covariance_of(found: Fit) -> FloatArray:
    """Covariance of a fit's coordinates by Laplace, noise white."""
    n_points, p = found.slopes.shape
    variance = found.sd**2 * n_points / degrees_of_freedom(found.slopes, found.sd)
    return np.asarray(np.linalg.inv(found.slopes.T @ found.slopes / variance + np.eye(p)))
