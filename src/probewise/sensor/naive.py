"""The paper's naive sensor: it sees one point (paper, section 2.4.1, "The Naive Likelihood", eq. 6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.recordings.plan import Plan
from probewise.scene.scenes import Scene
from probewise.sensor.chain import Levels, region_named, require_levels, require_scene
from probewise.sensor.stages import require_theta_columns


@dataclass(frozen=True)
class NaiveSensor:
    """Predict I_max where the point under the sensor is white, I_min elsewhere.

    White is an albedo of 0.5 or more. Columns of theta: the levels', then the scene's.
    """

    levels: Levels
    scene: Scene

    def __post_init__(self) -> None:
        order = "in the order NaiveSensor(levels, scene)"
        require_levels(self.levels, order)
        require_scene(self.scene, order)

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.levels.names, *self.scene.names)

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        require_theta_columns(theta, self.names)
        n_levels = len(self.levels.names)
        i_min, i_max = self.levels.values(theta[:, :n_levels])
        regions = self.scene.regions(theta[:, n_levels:])
        out = np.empty((len(theta), len(plan)))
        points = np.stack([plan.x_mm, plan.y_mm], axis=-1)
        for name, rows in plan.rows_by_pattern():
            out[:, rows] = np.where(region_named(regions, name).albedo(points[rows]) >= 0.5, i_max, i_min)
        return out
