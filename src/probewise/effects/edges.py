"""Effects at the edges between black and white: blur, shadow, and a halo of light scattered from farther away."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed_prior import HeavyTailedPrior
from probewise.effects.linear import LinearEffect
from probewise.effects.patches import gaussian_bump
from probewise.effects.vocabulary import NamedEffect, single_column_bank
from probewise.priors import LogUniform, Product
from probewise.recordings.patterns import Disc, HalfPlane, Polygon, Quadrant, Stripes
from probewise.recordings.plan import Plan
from probewise.scene.regions import edge_distance
from probewise.sensor.commanded import height_ratio
from probewise.sensor.stages import Footprint, Stage, View


@dataclass(frozen=True)
class EdgeBlur(LinearEffect[Footprint]):
    """Printed edges are blurred by a Gaussian of sd_mm, which acts as a wider footprint over sharp edges would.

    The footprint's covariance grows by sd_mm^2 along each axis, whatever the sensor's orientation.
    """

    typical_mm: float = 2.0

    name = "edge_blur"
    words = "soft printed edges"
    stage = Stage.FOOTPRINT
    units = ("mm",)
    covariates = ("edge_distance",)
    parameters = ("sd_mm",)
    positive = True

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with a typical sd of 2 % of the length of the longest scan."""
        return cls(typical_mm=0.02 * extent.length_mm)

    def apply(self, value: Footprint, theta: FloatArray, plan: Plan) -> Footprint:
        wider = theta[:, :, None] ** 2
        return replace(value, var_u=value.var_u + wider, var_v=value.var_v + wider)

    def is_absorbed_by_ssf(self, plan: Plan) -> bool:
        """Return True (it equals a wider SSF) unless the height varies, which scales a footprint but not a blur."""
        ratio = height_ratio(plan)
        return ratio is None or float(np.ptp(ratio)) == 0.0

    def start(self, entry: FloatArray, amounts: FloatArray) -> FloatArray:
        """Return a starting sd, (1,): the entry's, its square scaled by the fitted amount."""
        return np.asarray(entry[0] * np.sqrt(max(float(amounts[0]), 1e-4)))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return f"the printed edges are soft: blurred by {value_with_sd(mean[0], sd[0])} mm (sd)"


@dataclass(frozen=True)
class Halo(NamedEffect[Footprint]):
    """Light scattered in the lens: `share` of the footprint becomes one more Gaussian, of sd r_mm about its centre."""

    least_share: float = 1e-3
    narrowest_mm: float = 10.0
    widest_mm: float = 100.0

    name = "halo"
    words = "scattered light around the spot"
    stage = Stage.FOOTPRINT
    units = ("1", "mm")
    covariates = ("edge_distance",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with radii from a tenth of the length of the longest scan to all of it."""
        return cls(narrowest_mm=0.1 * extent.length_mm, widest_mm=extent.length_mm)

    @cached_property
    def prior(self) -> Product:
        return Product(
            {"share": LogUniform(self.least_share, 0.7), "r_mm": LogUniform(self.narrowest_mm, self.widest_mm)}
        )

    def apply(self, value: Footprint, theta: FloatArray, plan: Plan) -> Footprint:
        share, variance = theta[:, :1, None], theta[:, 1:2, None] ** 2

        def with_halo_appended(own: FloatArray, halo: FloatArray) -> FloatArray:
            n_gaussians = max(own.shape[2], value.weight.shape[2])
            shape = (*np.broadcast_shapes(own.shape[:2], halo.shape[:2]), n_gaussians)
            return np.concatenate([np.broadcast_to(own, shape), np.broadcast_to(halo, (*shape[:2], 1))], axis=2)

        def mixture_mean(mean: FloatArray) -> FloatArray:
            return np.asarray(np.sum(value.weight * mean, axis=2, keepdims=True))

        return replace(
            value,
            weight=with_halo_appended((1 - share) * value.weight, share),
            u_mm=with_halo_appended(value.u_mm, mixture_mean(value.u_mm)),
            v_mm=with_halo_appended(value.v_mm, mixture_mean(value.v_mm)),
            var_u=with_halo_appended(value.var_u, variance),
            var_v=with_halo_appended(value.var_v, variance),
            cov_uv=with_halo_appended(value.cov_uv, np.zeros((1, 1, 1))),
        )

    def bank(self) -> FloatArray:
        return single_column_bank(0.02, np.geomspace(self.narrowest_mm * 1.2, self.widest_mm / 1.2, 5))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"a wide halo around the sensor's spot, of sd {value_with_sd(mean[1], sd[1])} mm, contributes "
            f"{value_with_sd(mean[0], sd[0], factor=100)} % of the light: the lens scatters it"
        )


@dataclass(frozen=True)
class EdgeShadow(NamedEffect[View]):
    """A raised edge casts a shadow: u - amp exp(-d^2 / 2 w^2), d the sensor's distance from the nearest edge.

    Here u is the seen white fraction. Patterns may be made in different ways, one glued on, another printed. `patterns`
    are those with raised edges, () for all; `choices` are the candidate groups.
    """

    typical: float = 0.01
    narrowest_mm: float = 1.0
    widest_mm: float = 30.0
    patterns: tuple[str, ...] = ()
    choices: tuple[tuple[str, ...], ...] = ((),)

    name = "edge_shadow"
    words = "shadows along the edges"
    stage = Stage.SEEN
    units = ("1", "mm")
    covariates = ("edge_distance",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with widths from a hundredth to a third of the length of the longest scan.

        Raised edges may belong to all kinds of pattern, to one kind, or to all kinds but one.
        """
        kinds = _groups_of_edged_patterns(extent.plan)
        but_one = [tuple(itertools.chain(*kinds[:k], *kinds[k + 1 :])) for k in range(len(kinds))]
        choices = tuple(dict.fromkeys([(), *kinds, *but_one])) if len(kinds) > 1 else ((),)
        return cls(narrowest_mm=0.01 * extent.length_mm, widest_mm=extent.length_mm / 3, choices=choices)

    @cached_property
    def prior(self) -> Product:
        return Product({"amp": HeavyTailedPrior(self.typical), "w": LogUniform(self.narrowest_mm, self.widest_mm)})

    def apply(self, value: View, theta: FloatArray, plan: Plan) -> View:
        everywhere = (1, len(plan))
        x_mm, y_mm = (
            np.broadcast_to(place, np.broadcast_shapes(place.shape, everywhere))
            for place in (value.poses.x_mm, value.poses.y_mm)
        )
        parts = [
            (rows, edge_distance(value.regions[name], x_mm[:, rows], y_mm[:, rows]))
            for name, rows in plan.rows_by_pattern()
            if not self.patterns or name in self.patterns
        ]
        distance = np.full((max((len(part) for _, part in parts), default=1), len(plan)), np.inf)
        for rows, part in parts:
            distance[:, rows] = part
        return replace(value, seen=value.seen - theta[:, :1] * gaussian_bump(distance**2, theta[:, 1:2]))

    def variants(self) -> tuple[Self, ...]:
        return tuple(replace(self, patterns=choice) for choice in self.choices)

    def bank(self) -> FloatArray:
        return single_column_bank(self.typical, np.geomspace(self.narrowest_mm * 1.5, self.widest_mm / 1.5, 6))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        kind = "darker" if mean[0] > 0 else "brighter"
        where = f" of pattern {', '.join(self.patterns)}" if self.patterns else ""
        why = "the edge casts a shadow" if mean[0] > 0 else "the edge reflects light"
        return (
            f"within {value_with_sd(mean[1], sd[1])} mm of an edge{where} the surface looks "
            f"{value_with_sd(abs(mean[0]), sd[0], factor=100)} % {kind} than the pattern explains: {why}"
        )


def _groups_of_edged_patterns(plan: Plan) -> tuple[tuple[str, ...], ...]:
    """Return the names of patterns with edges under readings, one group for each type of pattern."""
    kinds: dict[type, list[str]] = {}
    for name, _ in plan.rows_by_pattern():
        if isinstance(pattern := plan.patterns.get(name), HalfPlane | Quadrant | Disc | Polygon | Stripes):
            kinds.setdefault(type(pattern), []).append(name)
    return tuple(tuple(names) for names in kinds.values())
