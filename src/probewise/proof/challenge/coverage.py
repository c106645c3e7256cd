"""Coverage of the stated intervals (effect and sensor parameters), and overlap with the region of a local effect."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis import EffectFound, ModelSamples, Place
from probewise.proof.sensors import CovariateRegion
from probewise.sensor import footprint_of
from probewise.world.world import World

_NOT_STATED = frozenset({"softness"})  # parameters that the vocabulary does not estimate


def effect_truths_and_intervals(parameters: Mapping[str, Any], found: EffectFound) -> dict[str, list[float]]:
    """Pair each parameter's truth with its 95 % interval: name -> [truth, low, high].

    Angles are compared modulo a turn. Parameters with one value per run are left out.
    """
    out = {}
    for stated in found.parameters:
        truth = parameters.get(stated.name)
        if not isinstance(truth, float) or stated.name in _NOT_STATED:
            continue
        low, high = stated.interval95
        if stated.unit == "rad":
            truth += 2 * math.pi * round(((low + high) / 2 - truth) / (2 * math.pi))
        out[stated.name] = [truth, low, high]
    return out


def sensor_truths_and_intervals(world: World, samples: ModelSamples) -> dict[str, list[float]]:
    """Pair the true moments of the footprint, and the levels, with their 95 % intervals: name -> [truth, low, high].

    Names: "u_mm", "v_mm", "var_u_mm2", "var_v_mm2", "cov_uv_mm2", "I_min", "I_max".
    """
    mean, covariance = world.spot.moments()
    n_ssf = 6 * samples.n_gaussians
    of_samples = _footprint_moments(samples.theta[:, :n_ssf], samples.n_gaussians)
    truths = {
        "u_mm": mean[0],
        "v_mm": mean[1],
        "var_u_mm2": covariance[0, 0],
        "var_v_mm2": covariance[1, 1],
        "cov_uv_mm2": covariance[0, 1],
        "I_min": world.black,
        "I_max": world.white,
    }
    values = np.concatenate([of_samples, samples.theta[:, n_ssf : n_ssf + 2]], axis=1)
    low, high = np.quantile(values, [0.025, 0.975], axis=0)
    return {
        name: [float(truth), float(a), float(b)] for (name, truth), a, b in zip(truths.items(), low, high, strict=True)
    }


def _footprint_moments(theta: FloatArray, n_gaussians: int) -> FloatArray:
    """Return mean u and v, variances of u and v, and covariance of the whole mixture, (n_samples, 5)."""
    f = footprint_of(theta, n_gaussians)

    def average(values: FloatArray) -> FloatArray:
        return np.asarray(np.sum(f.weight * values, axis=-1).reshape(len(theta)))

    u, v = average(f.u_mm), average(f.v_mm)
    columns = (
        u,
        v,
        average(f.var_u + f.u_mm**2) - u**2,
        average(f.var_v + f.v_mm**2) - v**2,
        average(f.cov_uv + f.u_mm * f.v_mm) - u * v,
    )
    return np.stack(columns, axis=1)


def place_overlap(region: CovariateRegion, places: Sequence[Place]) -> float:
    """Return intersection over union of an effect's region and the first of `places` in its covariate; 0 if none."""
    place = next((p for p in places if p.covariate == region.covariate), None)
    if place is None:
        return 0.0
    if region.scans:  # an effect with several scans is located in each by itself, with its own strength
        own = {p.scan for p in places if (p.covariate, p.p_value, p.z) == ("scan", place.p_value, place.z)}
        return len(own & {*region.scans}) / len(own | {*region.scans})
    if region.low is None or region.high is None or place.start is None or place.end is None:
        return 0.0
    both = min(region.high, place.end) - max(region.low, place.start)
    either = max(region.high, place.end) - min(region.low, place.start)
    return max(both, 0.0) / either if either > 0 else float(both == 0.0)
