"""The sensor as an unknown beside the shape, with a prior from its calibration and possible changes since.

Paper, Conclusion: "calibration on the fly". The calibrated SSF keeps its form; its size along the sensor's two axes,
its place and the two levels are free. Their prior is the calibration's posterior, widened for possible changes since:
another height, mounting or lamp.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.calibration import FittedSensor
from probewise.errors import ParameterError
from probewise.priors import Normal, Product
from probewise.sensor import FixedMixture, Footprint, footprint_of
from probewise.sensor.stages import require_theta_columns


@dataclass(frozen=True)
class SensorChangeSds:
    """Prior sds of a sensor's changes since its calibration.

    `log_size`: of the log of the footprint's size along each axis (0.3: a factor of 1.35 either way); `shift_mm`: of
    its centre; `level`: of dark and bright readings, as a share of the difference between them.
    """

    log_size: float = 0.3
    shift_mm: float = 1.0
    level: float = 0.03

    def __post_init__(self) -> None:
        for name in ("log_size", "shift_mm", "level"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ParameterError(name, getattr(self, name), "finite, 0 or more")


@dataclass(frozen=True, eq=False)
class AdjustedMixture:
    """A known mixture, scaled about its mean along the sensor's axes and shifted: four parameters."""

    mixture: FixedMixture

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters: log_size_u, log_size_v, shift_u_mm, shift_v_mm."""
        return ("log_size_u", "log_size_v", "shift_u_mm", "shift_v_mm")

    def footprint(self, theta: FloatArray) -> Footprint:
        """Return the mixture of each hypothesis, theta (n_samples, 4)."""
        require_theta_columns(theta, self.names)
        size_u, size_v = np.exp(theta[:, None, 0:1]), np.exp(theta[:, None, 1:2])
        whole = self.mixture.footprint(np.empty((1, 0)))
        mean_u, mean_v = self.mixture.mean_mm
        return Footprint(
            whole.weight,
            mean_u + size_u * (whole.u_mm - mean_u) + theta[:, None, 2:3],
            mean_v + size_v * (whole.v_mm - mean_v) + theta[:, None, 3:4],
            size_u**2 * whole.var_u,
            size_v**2 * whole.var_v,
            size_u * size_v * whole.cov_uv,
        )


def sensor_prior(sensor: FittedSensor, change: SensorChangeSds | None = None) -> Product:
    """Return the prior of the sensor: the calibration's posterior, widened for possible changes.

    The parameters are those of `AdjustedMixture`, then I_min and I_max.
    """
    change = SensorChangeSds() if change is None else change
    n = sensor.n_gaussians
    moments = _footprint_means_and_sds(footprint_of(sensor.samples[:, : 6 * n], n))
    mean, sd = sensor.mean(), sensor.sd()
    level = change.level * abs(mean["I_max"] - mean["I_min"])
    return Product(
        {
            "log_size_u": Normal(0.0, math.hypot(change.log_size, float(np.log(moments["sd_u"]).std()))),
            "log_size_v": Normal(0.0, math.hypot(change.log_size, float(np.log(moments["sd_v"]).std()))),
            "shift_u_mm": Normal(0.0, math.hypot(change.shift_mm, float(moments["u"].std()))),
            "shift_v_mm": Normal(0.0, math.hypot(change.shift_mm, float(moments["v"].std()))),
            "I_min": Normal(mean["I_min"], math.hypot(level, sd["I_min"])),
            "I_max": Normal(mean["I_max"], math.hypot(level, sd["I_max"])),
        }
    )


def _footprint_means_and_sds(footprint: Footprint) -> Mapping[str, FloatArray]:
    """Return means "u", "v" and sds "sd_u", "sd_v" of footprints along the sensor's axes, mm, (n_samples,) each."""
    weight = footprint.weight[:, 0]
    u, v = (weight * footprint.u_mm[:, 0]).sum(axis=1), (weight * footprint.v_mm[:, 0]).sum(axis=1)
    var_u = (weight * (footprint.var_u[:, 0] + footprint.u_mm[:, 0] ** 2)).sum(axis=1) - u**2
    var_v = (weight * (footprint.var_v[:, 0] + footprint.v_mm[:, 0] ** 2)).sum(axis=1) - v**2
    return {"u": u, "v": v, "sd_u": np.sqrt(var_u), "sd_v": np.sqrt(var_v)}
