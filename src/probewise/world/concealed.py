"""Effects that a world may have and a plain sensor model leaves out: one small class each, written independently of it.

A concealed effect acts at one stage of the chain from pose to reading. To add one, write a frozen
dataclass with `name`, `stage` and the method of that stage (`stages`); `World` applies it there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.special import ndtr, stdtrit

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.world.spots import Blob, blurred, gaussian_spot
from probewise.world.stages import FootprintPart, Rows, Stage


@dataclass(frozen=True)
class Backlash:
    """Backlash: the arm stops `width_mm` / 2, half the play of its gears, short of the commanded place."""

    name: ClassVar[str] = "backlash"
    stage: ClassVar[Stage] = "place"
    width_mm: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values - rows.direction * (self.width_mm / 2)


@dataclass(frozen=True)
class PositionScale:
    """Scale error of the arm: true X is 1 + `x` times the commanded one, true Y 1 + `y` times."""

    name: ClassVar[str] = "position_scale"
    stage: ClassVar[Stage] = "place"
    x: float
    y: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return np.asarray(values * [1 + self.x, 1 + self.y])


@dataclass(frozen=True)
class PeriodicPositionError:
    """Runout of a gear or lead screw: adds `amp_mm` sin(2 pi X / `period_mm` + `phase`) to X."""

    name: ClassVar[str] = "periodic_position_error"
    stage: ClassVar[Stage] = "place"
    amp_mm: float
    period_mm: float
    phase: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        x_mm, y_mm = values.T
        wave = self.amp_mm * np.sin(2 * math.pi * x_mm / self.period_mm + self.phase)
        return np.stack([x_mm + wave, y_mm], axis=-1)


@dataclass(frozen=True)
class ScanAngleError:
    """An error of `deg` degrees in the sensor's orientation, in the scans named in `scans`."""

    name: ClassVar[str] = "scan_angle_error"
    stage: ClassVar[Stage] = "turn"
    deg: float
    scans: tuple[str, ...]

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + math.radians(self.deg) * rows.in_scans_mask(self.scans)


@dataclass(frozen=True)
class OrientationError:
    """A constant error of `deg` degrees in the sensor's orientation."""

    name: ClassVar[str] = "orientation_error"
    stage: ClassVar[Stage] = "turn"
    deg: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + math.radians(self.deg)


@dataclass(frozen=True)
class EdgeMisplacement:
    """A displacement of every pattern by `offset_mm` across its edges (along X if they have no common direction)."""

    name: ClassVar[str] = "edge_misplacement"
    stage: ClassVar[Stage] = "pattern"
    offset_mm: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.offset_mm * rows.across


@dataclass(frozen=True)
class ScanMisplacement:
    """A displacement of the pattern by `offset_mm` across its edges (else along X), in the one scan named `scan`."""

    name: ClassVar[str] = "scan_misplacement"
    stage: ClassVar[Stage] = "pattern"
    offset_mm: float
    scan: str

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.offset_mm * rows.across * rows.in_scans_mask((self.scan,))[:, None]


@dataclass(frozen=True)
class AlbedoGradient:
    """A print that is whiter on one side: albedo times 1 + `per_mm_x` X + `per_mm_y` Y (lab frame, mm)."""

    name: ClassVar[str] = "albedo_gradient"
    stage: ClassVar[Stage] = "albedo"
    per_mm_x: float
    per_mm_y: float

    def retouch(self, albedo: FloatArray, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        return albedo * (1 + self.per_mm_x * x_mm + self.per_mm_y * y_mm)


@dataclass(frozen=True)
class AlbedoPatch:
    """A stain on every pattern, at `x`, `y` of the lab frame: adds a Gaussian of height `albedo`, sd `r` (mm)."""

    name: ClassVar[str] = "albedo_patch"
    stage: ClassVar[Stage] = "albedo"
    albedo: float
    x: float
    y: float
    r: float

    def retouch(self, albedo: FloatArray, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        squared = (x_mm - self.x) ** 2 + (y_mm - self.y) ** 2
        return albedo + self.albedo * np.exp(-squared / (2 * self.r**2))


@dataclass(frozen=True)
class SensorTilt:
    """A tilted sensor: it moves the footprint by `dx_mm`, `dy_mm` in the lab frame, whatever the orientation."""

    name: ClassVar[str] = "sensor_tilt"
    stage: ClassVar[Stage] = "tilt"
    dx_mm: float
    dy_mm: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return np.asarray(values + np.array([self.dx_mm, self.dy_mm]))


@dataclass(frozen=True)
class HeightGradient:
    """A sloping table: the sensor's height grows by `mm_per_mm` per mm of X."""

    name: ClassVar[str] = "height_gradient"
    stage: ClassVar[Stage] = "height"
    mm_per_mm: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.mm_per_mm * rows.place_mm[:, 0]


@dataclass(frozen=True)
class HeightOffset:
    """A height offset of the sensor by `mm` in the scans named in `scans`."""

    name: ClassVar[str] = "height_offset"
    stage: ClassVar[Stage] = "height"
    mm: float
    scans: tuple[str, ...]

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.mm * rows.in_scans_mask(self.scans)


@dataclass(frozen=True)
class EdgeBlur:
    """Soft printed edges: a Gaussian blur of sd `sd_mm`, here applied to the footprint, which is equivalent."""

    name: ClassVar[str] = "edge_blur"
    stage: ClassVar[Stage] = "footprint"
    sd_mm: float

    def change_footprint(self, parts: Sequence[FootprintPart]) -> tuple[FootprintPart, ...]:
        return tuple(replace(g, spot=blurred(g.spot, self.sd_mm)) for g in parts)


@dataclass(frozen=True)
class Halo:
    """A halo: a `share` of the light comes through a wide Gaussian of sd `r_mm` about the footprint's centre."""

    name: ClassVar[str] = "halo"
    stage: ClassVar[Stage] = "footprint"
    share: float
    r_mm: float

    def change_footprint(self, parts: Sequence[FootprintPart]) -> tuple[FootprintPart, ...]:
        middle = np.sum([g.share * g.spot.moments()[0] for g in parts], axis=0)
        blob = Blob(1.0, (float(middle[0]), float(middle[1])), (self.r_mm, self.r_mm))
        # Rays resolve edges within pixels; the wide Gaussian is nearly linear over a third of its sd.
        skirt = gaussian_spot([blob], pixel_mm=self.r_mm / 3)
        return (*(replace(g, share=g.share * (1 - self.share)) for g in parts), FootprintPart(self.share, skirt))


@dataclass(frozen=True)
class ExtraGaussian:
    """A round Gaussian at `u_mm`, `v_mm` in the sensor frame with a `share` of the light; not a physical fault."""

    name: ClassVar[str] = "ssf_order"
    stage: ClassVar[Stage] = "footprint"
    share: float
    u_mm: float
    v_mm: float
    sd_mm: float

    def change_footprint(self, parts: Sequence[FootprintPart]) -> tuple[FootprintPart, ...]:
        blob = Blob(1.0, (self.u_mm, self.v_mm), (self.sd_mm, self.sd_mm))
        more = gaussian_spot([blob], pixel_mm=parts[0].spot.pixel_mm)
        return (*(replace(g, share=g.share * (1 - self.share)) for g in parts), FootprintPart(self.share, more))


@dataclass(frozen=True)
class EdgeShadow:
    """Shadow along edges of the pattern: the seen fraction falls by `amp` exp(-d^2 / 2 `w`^2), d mm from an edge."""

    name: ClassVar[str] = "edge_shadow"
    stage: ClassVar[Stage] = "seen"
    amp: float
    w: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Subtract amp exp(-d^2 / 2 w^2) from the seen fraction; d is the distance to the nearest edge."""
        return values - self.amp * np.exp(-((rows.edge_mm / self.w) ** 2) / 2)


@dataclass(frozen=True)
class Nonlinearity:
    """A response that is the `gamma`-th power of the light."""

    name: ClassVar[str] = "nonlinearity"
    stage: ClassVar[Stage] = "response"
    gamma: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return np.asarray(np.power(np.maximum(values, 0.0), self.gamma), dtype=np.float64)


@dataclass(frozen=True)
class GainDrift:
    """Warm-up of the LED: the signal is wrong by a fraction `frac` at time 0 and settles with time constant `tau_s`."""

    name: ClassVar[str] = "gain_drift"
    stage: ClassVar[Stage] = "gain"
    frac: float
    tau_s: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values * (1 + self.frac * np.exp(-rows.time_s / self.tau_s))


@dataclass(frozen=True)
class BatterySag:
    """LED brightness that follows the battery: the signal times 1 + `per_volt` (volts of `battery_mv` - `full_v`)."""

    name: ClassVar[str] = "battery_sag"
    stage: ClassVar[Stage] = "gain"
    per_volt: float
    full_v: float = 8.3

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        if "battery_mv" not in rows.covariates:
            raise ParameterError("covariates", ", ".join(rows.covariates) or "none", "battery_mv among them")
        return values * (1 + self.per_volt * (rows.covariates["battery_mv"] / 1000 - self.full_v))


@dataclass(frozen=True)
class AmbientGradient:
    """Room light from one side: adds `per_mm_x` X + `per_mm_y` Y (lab frame, mm) to the reading."""

    name: ClassVar[str] = "ambient_gradient"
    stage: ClassVar[Stage] = "offset"
    per_mm_x: float
    per_mm_y: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.per_mm_x * rows.place_mm[:, 0] + self.per_mm_y * rows.place_mm[:, 1]


@dataclass(frozen=True)
class AmbientStep:
    """A lamp is switched on: adds `amp` to the readings after `at_s`."""

    name: ClassVar[str] = "ambient_step"
    stage: ClassVar[Stage] = "offset"
    amp: float
    at_s: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.amp * (rows.time_s > self.at_s)


@dataclass(frozen=True)
class OffsetDrift:
    """Linear drift of the dark level, by `per_hour` reading units per hour."""

    name: ClassVar[str] = "offset_drift"
    stage: ClassVar[Stage] = "offset"
    per_hour: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.per_hour * rows.time_s / 3600


@dataclass(frozen=True)
class Flicker:
    """A sinusoidal offset of amplitude `amp` at `alias_hz`: mains flicker, aliased by the sampling, or a slow lamp."""

    name: ClassVar[str] = "flicker"
    stage: ClassVar[Stage] = "offset"
    amp: float
    alias_hz: float
    phase: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.amp * np.sin(2 * math.pi * self.alias_hz * rows.time_s + self.phase)


@dataclass(frozen=True)
class Hysteresis:
    """An offset of +`amp` or -`amp`, by the direction of motion."""

    name: ClassVar[str] = "hysteresis"
    stage: ClassVar[Stage] = "offset"
    amp: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Add `amp` times the sign of the motion along X, or along Y if X does not change."""
        along_x, along_y = np.sign(rows.direction).T
        sign: FloatArray = np.where(along_x != 0, along_x, along_y)
        return values + self.amp * sign


@dataclass(frozen=True)
class Glint:
    """A reflection of a lamp: adds a Gaussian of height `amp` and sd `r` about `x`, `y` (lab frame) to the reading."""

    name: ClassVar[str] = "glint"
    stage: ClassVar[Stage] = "offset"
    amp: float
    x: float
    y: float
    r: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        squared = (rows.place_mm[:, 0] - self.x) ** 2 + (rows.place_mm[:, 1] - self.y) ** 2
        return values + self.amp * np.exp(-squared / (2 * self.r**2))


@dataclass(frozen=True)
class Lag:
    """A first-order lag with time constant `tau_s`, which starts anew with each scan."""

    name: ClassVar[str] = "lag"
    stage: ClassVar[Stage] = "lag"
    tau_s: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Mix each reading with the one before: v_k = a v_(k-1) + (1 - a) y_k, a = exp(-(t_k - t_(k-1))/tau)."""
        kept = np.exp(-np.diff(rows.time_s, prepend=-np.inf) / self.tau_s)
        kept[rows.scan_start_mask()] = 0.0
        out = values.copy()
        for k in range(1, len(out)):
            out[k] = kept[k] * out[k - 1] + (1 - kept[k]) * values[k]
        return out


@dataclass(frozen=True)
class Saturation:
    """Saturation at a level; `softness` (reading units, 0 for a sharp corner) rounds the corner."""

    name: ClassVar[str] = "saturation"
    stage: ClassVar[Stage] = "saturation"
    level: float
    softness: float = 0.0

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        if self.softness == 0:
            return np.minimum(values, self.level)
        return self.level - self.softness * np.logaddexp(0.0, (self.level - values) / self.softness)


@dataclass(frozen=True)
class Quantisation:
    """Rounding to multiples of `step` (reading units) that the plan does not declare."""

    name: ClassVar[str] = "quantisation"
    stage: ClassVar[Stage] = "quantisation"
    step: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return np.asarray(self.step * np.round(values / self.step))


@dataclass(frozen=True)
class CorrelatedNoise:
    """AR(1) noise within each scan: correlation `rho` between successive readings, with unchanged sd."""

    name: ClassVar[str] = "correlated_noise"
    stage: ClassVar[Stage] = "noise"
    rho: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        fresh = math.sqrt(1 - self.rho**2)
        out = values.copy()
        for k in np.flatnonzero(~rows.scan_start_mask()):
            out[k] = self.rho * out[k - 1] + fresh * values[k]
        return out


@dataclass(frozen=True)
class SignalDependentNoise:
    """Noise variance that grows linearly from its value on black to 1 + `ratio` times that on white."""

    name: ClassVar[str] = "signal_dependent_noise"
    stage: ClassVar[Stage] = "noise"
    ratio: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        return values * np.sqrt(1 + self.ratio * seen)


@dataclass(frozen=True)
class RisingNoiseSd:
    """Noise sd that rises linearly to `factor` times its first value from time 0 to `over_s`, then stays constant."""

    name: ClassVar[str] = "drifting_noise"
    stage: ClassVar[Stage] = "noise"
    factor: float
    over_s: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        return values * (1 + (self.factor - 1) * np.clip(rows.time_s / self.over_s, 0.0, 1.0))


@dataclass(frozen=True)
class HeavyTails:
    """Student-t noise of `dof` degrees of freedom, 3 or more, with unchanged sd."""

    name: ClassVar[str] = "heavy_tails"
    stage: ClassVar[Stage] = "noise"
    dof: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Map each draw to the same quantile of the Student-t distribution."""
        return np.asarray(stdtrit(self.dof, ndtr(values)) * math.sqrt((self.dof - 2) / self.dof))


@dataclass(frozen=True)
class Outliers:
    """Outliers: a random `share` of the readings has additional Gaussian noise, of sd `size` times the noise sd."""

    name: ClassVar[str] = "outliers"
    stage: ClassVar[Stage] = "noise"
    share: float
    size: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        hit = rng.random(len(values)) < self.share
        return values + hit * self.size * rng.standard_normal(len(values))


@dataclass(frozen=True)
class Dropouts:
    """Dropouts: a random `share` of the readings is replaced by `value`."""

    name: ClassVar[str] = "dropouts"
    stage: ClassVar[Stage] = "loss"
    share: float
    value: float

    def disturb(self, values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        return np.where(rng.random(len(values)) < self.share, self.value, values)
