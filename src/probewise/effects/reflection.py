"""A ghost image: light reflected by a plate or a lens."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed_prior import HeavyTailedPrior
from probewise.effects.vocabulary import NamedEffect, single_column_bank
from probewise.priors import Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Footprint, Stage

_ANGLES = 8


@dataclass(frozen=True)
class Reflection(NamedEffect[Footprint]):
    """`share` of the light comes from a copy of the footprint, displaced by (dx_mm, dy_mm) in the lab frame."""

    typical: float = 0.02
    farthest_mm: float = 20.0

    name = "reflection"
    words = "a reflection beside the spot"
    stage = Stage.FOOTPRINT
    units = ("1", "mm", "mm")
    covariates = ("place", "edge_distance")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with displacements up to half the length of the longest scan, along X and along Y."""
        return cls(farthest_mm=0.5 * extent.length_mm)

    @cached_property
    def prior(self) -> Product:
        reach = Uniform(-self.farthest_mm, self.farthest_mm)
        return Product({"share": HeavyTailedPrior(self.typical, positive=True), "dx_mm": reach, "dy_mm": reach})

    def apply(self, value: Footprint, theta: FloatArray, plan: Plan) -> Footprint:
        share = np.clip(theta[:, :1, None], 0.0, 1.0)
        turn = plan.orientation_rad[None, :, None]
        dx, dy = theta[:, 1:2, None], theta[:, 2:3, None]
        u_mm = value.u_mm + np.cos(turn) * dx + np.sin(turn) * dy
        v_mm = value.v_mm - np.sin(turn) * dx + np.cos(turn) * dy
        return Footprint(
            weight=_concatenated_components(value.weight * (1 - share), value.weight * share),
            u_mm=_concatenated_components(value.u_mm, u_mm),
            v_mm=_concatenated_components(value.v_mm, v_mm),
            var_u=_concatenated_components(value.var_u, value.var_u),
            var_v=_concatenated_components(value.var_v, value.var_v),
            cov_uv=_concatenated_components(value.cov_uv, value.cov_uv),
            brightness=value.brightness,
        )

    def bank(self) -> FloatArray:
        angles = 2 * math.pi * np.arange(_ANGLES) / _ANGLES
        far = self.farthest_mm * np.array([0.2, 0.4, 0.8])[:, None]
        dx, dy = (far * np.cos(angles)).ravel(), (far * np.sin(angles)).ravel()
        return single_column_bank(self.typical, dx, dy)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"a second spot, {value_with_sd(mean[1], sd[1])} mm along X and {value_with_sd(mean[2], sd[2])} mm along Y "
            f"from the first, contributes {value_with_sd(mean[0], sd[0], factor=100)} % of the light: a reflection"
        )


def _concatenated_components(first: FloatArray, second: FloatArray) -> FloatArray:
    """Concatenate values of two sets of Gaussians, (n_samples, n_points, n_gaussians) each, along the last axis."""
    shape = np.broadcast_shapes(first.shape, second.shape)
    return np.concatenate([np.broadcast_to(first, shape), np.broadcast_to(second, shape)], axis=2)
