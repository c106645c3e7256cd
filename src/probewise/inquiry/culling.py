"""Culling bounds: the region in which each hypothesis changes the reading; elsewhere no prediction is needed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from probewise._arrays import FloatArray, IntArray, read_only_floats
from probewise.errors import ParameterError
from probewise.recordings.plan import Plan
from probewise.scene import CardedScene, HypothesisScene, outlines
from probewise.sensor import Chain, FixedLevels, FixedMixture
from probewise.sensor.commanded import has_commanded_height_or_led
from probewise.sensor.stages import SensorModel

_REACH = 6.0  # sds of the footprint beyond which it is negligible: 1e-9 of the levels' difference
_TILE_MM = 110.0
_FAR_MM = 1e5


@dataclass(frozen=True, eq=False)
class CullingBounds:
    """Bounding box of each hypothesis, corners `low_mm` and `high_mm`, (n_samples, 2).

    A sensor outside the box reads `outside`.
    """

    low_mm: FloatArray
    high_mm: FloatArray
    outside: float

    @classmethod
    def of(cls, model: SensorModel, theta: FloatArray, plan: Plan) -> Self | None:
        """Compute the bounds of hypotheses, (n_samples, n_params); None if readings depend on more than the shape.

        Only the shape matters for a known mixture and known levels without effects. None also for a shape without
        closed edge.
        """
        if not isinstance(model, Chain) or model.effects or has_commanded_height_or_led(plan) or len(plan) == 0:
            return None
        if not isinstance(model.ssf, FixedMixture) or not isinstance(model.levels, FixedLevels):
            return None
        if not isinstance(model.scene, HypothesisScene) or isinstance(model.scene, CardedScene):
            return None
        region = model.scene.shape.region(theta)
        try:
            edges = outlines(region)
        except ParameterError:  # no closed edge: it may be visible anywhere
            return None
        sds = np.sqrt(np.linalg.eigvalsh(model.ssf.covs_mm2)[:, -1])
        reach = float((np.linalg.norm(model.ssf.means_mm, axis=1) + _REACH * sds).max())
        low, high = (np.array([f(edge, axis=0) for edge in edges]) for f in (np.nanmin, np.nanmax))
        one = plan.take(np.array([0]))
        outside = model.predict(theta[:1], replace(one, x_mm=one.x_mm + _FAR_MM))[0, 0]
        return cls(read_only_floats(low - reach), read_only_floats(high + reach), float(outside))

    def visible_hypotheses_by_tile(self, plan: Plan) -> Iterator[tuple[IntArray, IntArray]]:
        """Yield, for each tile of the field, its rows of the plan and the indices of the hypotheses visible there."""
        column, row = (np.floor(place / _TILE_MM).astype(np.int64) for place in (plan.x_mm, plan.y_mm))
        tiles = np.unique(np.stack([column, row]), axis=1, return_inverse=True)[1].ravel()
        order = np.argsort(tiles, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(tiles[order])) + 1):
            place = np.stack([plan.x_mm[rows], plan.y_mm[rows]], axis=-1)
            meets = (self.low_mm <= place.max(axis=0)).all(axis=1) & (self.high_mm >= place.min(axis=0)).all(axis=1)
            yield rows, np.flatnonzero(meets)
