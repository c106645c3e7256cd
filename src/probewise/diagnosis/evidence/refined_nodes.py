"""Nodes of a noise model about the peak of its evidence, where those of the prior lie too far apart.

The nodes of a prior serve every fit. Many readings determine the noise better than its nodes lie apart: all nodes miss
the peak, the evidence is too low, and the tests of the fit assume a noise that is wrong. Adaptive Gauss-Hermite
quadrature (Naylor & Smith 1982) finds the peak and puts three nodes there along each such parameter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.evidence.laplace import NoiseEvidence, laplace_evidence, log_evidence_under
from probewise.diagnosis.fitting.fit import Fit
from probewise.effects import NoiseEffect
from probewise.sensor.stages import effects_with_columns

_RESOLVED = 0.6  # posterior sd over the distance of nodes, from which their sum is the integral to a percent
_SAME = 1e-9  # of the prior's unit cube: nodes as close are one
_EDGE = 1e-6  # of it too
_ROUNDS = 6
_REACH = math.sqrt(3)  # of the nodes on both sides of a peak, in posterior sds
_NODES = _REACH * np.array([0.0, -1.0, 1.0])
_LOG_WEIGHTS = np.log([2 / 3, 1 / 6, 1 / 6]) + 0.5 * _NODES**2 + 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True, eq=False)
class _CoarseParameters:
    """Parameters of a noise model whose nodes lie further apart than a fit determines them.

    `columns` numbers them among the settings of the nodes; `peak` are their values at the likeliest node, and
    `spacing` the distances of nodes, in the unit cube of the prior, (n_coarse,) all. `gain`: nats by which the evidence
    may rise between the nodes.
    """

    columns: IntArray
    peak: FloatArray
    spacing: FloatArray
    gain: float

    @classmethod
    def of(cls, evidence: NoiseEvidence) -> _CoarseParameters:
        weights, found = evidence.weights, []
        for effect, part in effects_with_columns(evidence.noise.effects):
            settings = evidence.nodes.settings[:, part]
            if len(effect.nodes_per_parameter) != settings.shape[1] or np.all(settings == settings[0]):
                continue  # without nodes of the prior, or known
            unit = effect.prior.to_unit_cube(settings)
            for k, n in enumerate(effect.nodes_per_parameter):
                own, node_of = np.unique(np.round(unit[:, k] / _SAME), return_inverse=True)
                marginal = np.bincount(node_of.ravel(), weights).astype(np.float64)
                own = own * _SAME
                spacing = float(np.diff(own).min(initial=math.inf)) if len(own) > 1 else 1 / n
                mean = float(marginal @ own)
                if math.sqrt(float(marginal @ (own - mean) ** 2)) < _RESOLVED * spacing:
                    at = unit[int(np.argmax(weights)), k]
                    found.append((part.start + k, float(at), spacing, _rise_between(marginal)))
        columns, peak, spacings, gains = zip(*found, strict=True) if found else ((), (), (), ())
        return cls(np.array(columns, dtype=np.int64), np.array(peak), np.array(spacings), float(sum(gains)))


def _rise_between(marginal: FloatArray) -> float:
    """Return the height, in nats, of the peak over the best node, from the nodes' probabilities in order, (n_nodes,).

    It is that of a parabola through the best node and its neighbours. Infinity for a single node.
    """
    if len(marginal) < 2:
        return math.inf
    with np.errstate(divide="ignore"):
        log_p = np.maximum(np.log(marginal), -700.0)
    k = int(np.argmax(log_p))
    before, after = log_p[max(k - 1, 0)], log_p[min(k + 1, len(log_p) - 1)]
    bend = float(2 * log_p[k] - before - after)
    return float(after - before) ** 2 / (8 * bend) if bend > 0 else 0.0


def refined(found: Fit, evidence: NoiseEvidence, *, least: float = -math.inf) -> NoiseEvidence:
    """Return the evidence of a fit with nodes about its peak, along each parameter whose nodes lie too far apart.

    The other nodes of these parameters are dropped. The evidence is returned as it is if all nodes are close enough, if
    refined nodes cannot raise it to `least` nats, or if no higher peak is found.
    """
    if not np.isfinite(evidence.log_z):
        return evidence
    coarse = _CoarseParameters.of(evidence)
    if not coarse.columns.size or evidence.log_z + coarse.gain < least:
        return evidence
    model, best = evidence.noise, evidence.nodes.settings[int(np.argmax(evidence.log_z_nodes))]
    parts = [(effect, part) for effect, part in effects_with_columns(model.effects) if effect.nodes_per_parameter]
    columns, peak, spacing = coarse.columns, coarse.peak, coarse.spacing

    def log_density(points: FloatArray) -> FloatArray:
        settings = np.repeat(best[None, :], len(points), axis=0)
        for effect, part in parts:
            own = (columns >= part.start) & (columns < part.stop)
            if own.any():
                unit = effect.prior.to_unit_cube(settings[:, part])
                unit[:, columns[own] - part.start] = points[:, own]
                settings[:, part] = effect.prior.from_unit_cube(unit)
        return log_evidence_under(found, model.laws_at(settings, found.predicted))

    while columns.size:
        peak, sd = _peak_and_sds(log_density, peak, spacing)
        inside = (peak - _REACH * sd > 0) & (peak + _REACH * sd < 1)
        if inside.all():
            break
        # At an end of its prior a parameter keeps the nodes that it has.
        columns, peak, spacing = columns[inside], coarse.peak[np.isin(coarse.columns, columns[inside])], spacing[inside]
    nodes = dict(model.likely)
    for effect, part in parts:
        about = {int(c) - part.start: (peak[k], sd[k]) for k, c in enumerate(columns) if part.start <= c < part.stop}
        if about:
            nodes[effect.name] = _nodes_about(effect, about)
    out = laplace_evidence(found, replace(model, likely=nodes)) if columns.size else evidence
    return out if _height(out) > _height(evidence) else evidence


def _height(evidence: NoiseEvidence) -> float:
    """Return the log evidence at the likeliest node, without the prior weights of nodes."""
    return float((evidence.log_z_nodes - evidence.nodes.log_weights).max(initial=-math.inf))


def _peak_and_sds(
    log_density: Callable[[FloatArray], FloatArray], start: FloatArray, spacing: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the peak of a density over the unit cube and its sd along each axis, (n_axes,) both.

    Parabolas through three points along each axis lead to it; the points draw together from `spacing` to the sd.
    """
    center, step = start, spacing
    eye = np.eye(len(start))
    for _ in range(_ROUNDS):
        center = np.clip(center, step + _EDGE, 1 - step - _EDGE)
        middle, *around = log_density(center + step * np.concatenate([0 * eye[:1], -eye, eye]))
        below, above = np.split(np.array(around), 2)
        if not np.isfinite([middle, *around]).all():
            break
        slope, bend = 0.5 * (above - below), 2 * middle - above - below
        concave = bend > 1e-3
        sd = step / np.sqrt(np.where(concave, bend, 1.0))
        move = np.clip(np.where(concave, slope / np.where(concave, bend, 1.0), np.sign(slope)), -2.0, 2.0)
        center = np.clip(center + move * step, _EDGE, 1 - _EDGE)
        if np.all(np.abs(move) * step < 0.5 * sd) and np.all(step < 2 * sd):
            break
        step = np.where(concave, np.clip(sd, step / 8, step), step)
    return center, sd


def _nodes_about(effect: NoiseEffect, about: Mapping[int, tuple[float, float]]) -> tuple[FloatArray, FloatArray]:
    """Return the nodes of one effect, (n_nodes, n_params), and log weights: about a peak, the prior's where not coarse.

    `about` has the peak and the sd of coarse parameters, by their number, in the unit cube.
    """
    axes, log_weights = [], []
    for k, n in enumerate(effect.nodes_per_parameter):
        if k in about:
            peak, sd = about[k]
            axes.append(peak + sd * _NODES)
            log_weights.append(_LOG_WEIGHTS + math.log(sd))
        else:
            axes.append((np.arange(n) + 0.5) / n)
            log_weights.append(np.full(n, -math.log(n)))
    unit = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, len(axes))
    return effect.prior.from_unit_cube(unit), np.sum(np.meshgrid(*log_weights), axis=0).ravel()
