"""What the sensor model may leave out: the effects that could act in a run, each a rival of the sensor as calibrated.

The effects and their priors are those of the diagnosis. A run is no recording, though: before its first reading
nothing is known of places and times. Effects of the pose and of the footprint take their scales from a scan of
100 mm, as a calibration has it; effects that change with the place, from the whole field; with time, from five minutes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.effects import VOCABULARY, Extent, NamedEffect, Outliers, log_density
from probewise.errors import ParameterError
from probewise.inference import GaussianKnown, Rounded
from probewise.inference.problem import Likelihood
from probewise.priors import LogUniform
from probewise.recordings.plan import Instrumentation, Plan
from probewise.sensor import Chain, FixedLevels, NoiseLevel
from probewise.sensor.stages import SensorModel

__all__ = ["ON_FIELD", "Rival", "rivals_of"]

_DURATION_S = 300.0
_READING_S = 8.0
_SCAN_MM = 100.0
_REACH = 5.0  # sds beyond its range that a sensor may read
_SHARES = LogUniform(2e-3, 0.2).from_unit((np.arange(8) + 0.5) / 8)

ON_FIELD = {
    "ambient_gradient": True,
    "ambient_step": False,
    "offset_drift": False,
    "gain_drift": False,
    "saturation": False,
    "nonlinearity": False,
    "albedo_gradient": True,
    "hysteresis": False,
    "lag": False,
    "backlash": False,
    "edge_blur": False,
    "halo": False,
}
"""Effects on the mean of the readings that one shape on a field can show, and whether their scale is the field's."""


@dataclass(frozen=True, eq=False)
class Rival:
    """One thing that the sensor model may leave out: an effect on the mean, or another law of the noise."""

    name: str
    effect: NamedEffect[FloatArray] | None = None
    likelihood: Likelihood | None = None


def rivals_of(model: SensorModel, likelihood: Likelihood, field_mm: tuple[float, float]) -> tuple[Rival, ...]:
    """List the rivals of a sensor model.

    Parameters
    ----------
    model
        A chain with known levels.
    likelihood
        Noise of known sd: `GaussianKnown` or `Rounded`.
    field_mm
        Width and height of the field.

    Raises
    ------
    ParameterError
        If the model or the likelihood is of another kind, which has no such effects.
    """
    if not isinstance(model, Chain) or not isinstance(model.levels, FixedLevels):
        raise ParameterError(
            "trust",
            "below 1",
            '1 with a sensor model that is naive, is learnt along, or is one of your own: "--trust 1"',
        )
    ends = sorted((model.levels.i_min, model.levels.i_max))
    carried = {effect.name for effect in model.effects}
    found = []
    for name, wide in ON_FIELD.items():
        reach_mm = math.hypot(*field_mm) if wide else _SCAN_MM
        effect = VOCABULARY[name].for_extent(Extent(ends[0], ends[1], _scan(reach_mm)))
        if effect is not None and name not in carried:
            found.append(Rival(name, effect=effect))
    noise = _noise_of(likelihood)
    if noise is not None:
        sd, step = noise
        shares, sizes = Outliers().bank()[:, 0].T
        found.append(Rival("outliers", likelihood=Tailed(sd, step, shares, sizes)))
        found.append(Rival("dropouts", likelihood=Lost(sd, step, model.levels.i_min, ends[0], ends[1])))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class Tailed:
    """Score readings of which some scatter more widely, over the prior of how many and how widely.

    `sd` and `step` are those of the plain noise (step 0: not rounded); `shares` and `sizes`, (n_nodes,), are equally
    weighted nodes.
    """

    sd: float
    step: float
    shares: FloatArray
    sizes: FloatArray

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """See `Likelihood.log_prob`."""
        narrow = _each(readings, predicted, self.sd, self.step)
        nodes = []
        for share, size in zip(self.shares, self.sizes, strict=True):
            wide = _each(readings, predicted, self.sd * size, self.step)
            nodes.append(np.logaddexp(narrow + math.log1p(-share), wide + math.log(share)).sum(axis=1))
        return np.asarray(logsumexp(nodes, axis=0) - math.log(len(nodes)))


@dataclass(frozen=True, eq=False)
class Lost:
    """Score readings of which some are lost, whatever lies under the sensor: to black, or to anything in its range."""

    sd: float
    step: float
    black: float
    low: float
    high: float

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """See `Likelihood.log_prob`."""
        kept = _each(readings, predicted, self.sd, self.step)
        to_black = _each(readings, np.array([[self.black]]), self.sd, self.step)
        low, high = self.low - _REACH * self.sd, self.high + _REACH * self.sd
        within = (readings >= low) & (readings <= high)
        anywhere = np.where(within, math.log((self.step or 1.0) / (high - low)), -np.inf)
        lost = np.logaddexp(to_black, anywhere) - math.log(2.0)
        nodes = [
            np.logaddexp(kept + math.log1p(-share), lost + math.log(share)).sum(axis=1) for share in _SHARES.tolist()
        ]
        return np.asarray(logsumexp(nodes, axis=0) - math.log(len(nodes)))


def _each(readings: FloatArray, predicted: FloatArray, sd: float, step: float) -> FloatArray:
    """Log density of each reading, or log probability of its cell, (n_samples, n_points)."""
    level = NoiseLevel(np.array([[sd]]), np.zeros((1, 1)), step=np.array([[step]]))
    return np.asarray(log_density(level, readings, predicted) + (math.log(step) if step else 0.0))


def _noise_of(likelihood: Likelihood) -> tuple[float, float] | None:
    if isinstance(likelihood, Rounded):
        return likelihood.sd, likelihood.step
    if isinstance(likelihood, GaussianKnown) and np.ndim(likelihood.sd) == 0:
        return float(np.asarray(likelihood.sd)), 0.0
    return None


def _scan(length_mm: float) -> Plan:
    """Lay out one scan of some length over the time that a run may take: what scales are taken from."""
    n = int(_DURATION_S / _READING_S) + 1
    zeros = np.zeros(n, dtype=np.int64)
    return Plan(
        x_mm=np.linspace(0.0, length_mm, n),
        y_mm=np.zeros(n),
        orientation_rad=np.zeros(n),
        time_s=np.linspace(0.0, _DURATION_S, n),
        scan=zeros,
        scan_names=("field",),
        pattern=zeros,
        pattern_names=("field",),
        instrumentation=Instrumentation(),
    )
