"""Effects that a world may have and a plain sensor model leaves out, written independently of it.

Each is a function of its parameters that returns how it acts at one stage of the chain from pose to reading
(`stages.acts_at`); `World` applies it there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtr, stdtrit

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.world.spots import Blob, Spot, blurred, gaussian_spot
from probewise.world.stages import Act, FootprintPart, Rows, acts_at


@acts_at("place")
def backlash(width_mm: float) -> Act:
    """Backlash: the arm stops `width_mm` / 2, half the play of its gears, short of the commanded place."""
    return lambda values, rows: values - rows.direction * (width_mm / 2)


@acts_at("place")
def position_scale(x: float, y: float) -> Act:
    """Scale error of the arm: true X is 1 + `x` times the commanded one, true Y 1 + `y` times."""
    return lambda values, rows: values * [1 + x, 1 + y]


@acts_at("place")
def periodic_position_error(amp_mm: float, period_mm: float, phase: float) -> Act:
    """Runout of a gear or lead screw: adds `amp_mm` sin(2 pi X / `period_mm` + `phase`) to X."""

    def act(values: FloatArray, rows: Rows) -> FloatArray:
        x_mm, y_mm = values.T
        wave = amp_mm * np.sin(2 * math.pi * x_mm / period_mm + phase)
        return np.stack([x_mm + wave, y_mm], axis=-1)

    return act


@acts_at("turn")
def scan_angle_error(deg: float, scans: tuple[str, ...]) -> Act:
    """Conceal an error of `deg` degrees in the sensor's orientation, in the scans named in `scans`."""
    return lambda values, rows: values + math.radians(deg) * rows.in_scans_mask(scans)


@acts_at("turn")
def orientation_error(deg: float) -> Act:
    """Conceal a constant error of `deg` degrees in the sensor's orientation."""
    return lambda values, rows: values + math.radians(deg)


@acts_at("pattern")
def edge_misplacement(offset_mm: float) -> Act:
    """Displace every pattern by `offset_mm` across its edges (along X if they have no common direction)."""
    return lambda values, rows: values + offset_mm * rows.across


@acts_at("pattern")
def scan_misplacement(offset_mm: float, scan: str) -> Act:
    """Displace the pattern by `offset_mm` across its edges (else along X), in the one scan named `scan`."""
    return lambda values, rows: values + offset_mm * rows.across * rows.in_scans_mask((scan,))[:, None]


@acts_at("albedo")
def albedo_gradient(per_mm_x: float, per_mm_y: float) -> Act:
    """Conceal a print that is whiter on one side: albedo times 1 + `per_mm_x` X + `per_mm_y` Y (lab frame, mm)."""
    return lambda albedo, x_mm, y_mm: albedo * (1 + per_mm_x * x_mm + per_mm_y * y_mm)


@acts_at("albedo")
def albedo_patch(albedo: float, x: float, y: float, r: float) -> Act:
    """Stain every pattern at `x`, `y` of the lab frame: adds a Gaussian of height `albedo`, sd `r` (mm)."""
    return lambda white, x_mm, y_mm: white + albedo * np.exp(-((x_mm - x) ** 2 + (y_mm - y) ** 2) / (2 * r**2))


@acts_at("tilt")
def sensor_tilt(dx_mm: float, dy_mm: float) -> Act:
    """Tilt the sensor: it moves the footprint by `dx_mm`, `dy_mm` in the lab frame, whatever the orientation."""
    return lambda values, rows: values + np.array([dx_mm, dy_mm])


@acts_at("height")
def height_gradient(mm_per_mm: float) -> Act:
    """Conceal a sloping table: the sensor's height grows by `mm_per_mm` per mm of X."""
    return lambda values, rows: values + mm_per_mm * rows.place_mm[:, 0]


@acts_at("height")
def height_offset(mm: float, scans: tuple[str, ...]) -> Act:
    """Conceal a height offset of the sensor by `mm` in the scans named in `scans`."""
    return lambda values, rows: values + mm * rows.in_scans_mask(scans)


@acts_at("footprint")
def edge_blur(sd_mm: float) -> Act:
    """Soft printed edges: a Gaussian blur of sd `sd_mm`, here applied to the footprint, which is equivalent."""
    return lambda parts: tuple(replace(g, spot=blurred(g.spot, sd_mm)) for g in parts)


@acts_at("footprint")
def halo(share: float, r_mm: float) -> Act:
    """Add a halo: a `share` of the light comes through a wide Gaussian of sd `r_mm` about the footprint's centre."""

    def act(parts: Sequence[FootprintPart]) -> tuple[FootprintPart, ...]:
        middle = np.sum([g.share * g.spot.moments()[0] for g in parts], axis=0)
        blob = Blob(1.0, (float(middle[0]), float(middle[1])), (r_mm, r_mm))
        # Rays resolve edges within pixels; the wide Gaussian is nearly linear over a third of its sd.
        skirt = gaussian_spot([blob], pixel_mm=r_mm / 3)
        return _with_share(parts, share, skirt)

    return act


@acts_at("footprint")
def ssf_order(share: float, u_mm: float, v_mm: float, sd_mm: float) -> Act:
    """Add a round Gaussian at `u_mm`, `v_mm` in the sensor frame with a `share` of the light; not a physical fault."""

    def act(parts: Sequence[FootprintPart]) -> tuple[FootprintPart, ...]:
        blob = Blob(1.0, (u_mm, v_mm), (sd_mm, sd_mm))
        return _with_share(parts, share, gaussian_spot([blob], pixel_mm=parts[0].spot.pixel_mm))

    return act


def _with_share(parts: Sequence[FootprintPart], share: float, spot: Spot) -> tuple[FootprintPart, ...]:
    return (*(replace(g, share=g.share * (1 - share)) for g in parts), FootprintPart(share, spot))


@acts_at("seen")
def edge_shadow(amp: float, w: float) -> Act:
    """Shadow along edges of the pattern: the seen fraction falls by `amp` exp(-d^2 / 2 `w`^2), d mm from an edge."""
    return lambda values, rows: values - amp * np.exp(-((rows.edge_mm / w) ** 2) / 2)


@acts_at("response")
def nonlinearity(gamma: float) -> Act:
    """Conceal a response that is the `gamma`-th power of the light."""
    return lambda values, rows: np.power(np.maximum(values, 0.0), gamma)


@acts_at("gain")
def gain_drift(frac: float, tau_s: float) -> Act:
    """Warm-up of the LED: the signal is wrong by a fraction `frac` at time 0 and settles with time constant `tau_s`."""
    return lambda values, rows: values * (1 + frac * np.exp(-rows.time_s / tau_s))


@acts_at("gain")
def gain(frac: float) -> Act:
    """Scale the signal by 1 + `frac`, as since a calibration."""
    return lambda values, rows: values * (1 + frac)


@acts_at("gain")
def battery_sag(per_volt: float, full_v: float = 8.3) -> Act:
    """LED brightness that follows the battery: the signal times 1 + `per_volt` (volts of `battery_mv` - `full_v`)."""

    def act(values: FloatArray, rows: Rows) -> FloatArray:
        if "battery_mv" not in rows.covariates:
            raise ParameterError("covariates", ", ".join(rows.covariates) or "none", "battery_mv among them")
        return values * (1 + per_volt * (rows.covariates["battery_mv"] / 1000 - full_v))

    return act


@acts_at("offset")
def ambient_gradient(per_mm_x: float, per_mm_y: float) -> Act:
    """Room light from one side: adds `per_mm_x` X + `per_mm_y` Y (lab frame, mm) to the reading."""
    return lambda values, rows: values + per_mm_x * rows.place_mm[:, 0] + per_mm_y * rows.place_mm[:, 1]


@acts_at("offset")
def ambient_step(amp: float, at_s: float) -> Act:
    """Switch on a lamp: adds `amp` to the readings after `at_s`."""
    return lambda values, rows: values + amp * (rows.time_s > at_s)


@acts_at("offset")
def dark_level(offset: float) -> Act:
    """Raise every reading by `offset`, as since a calibration."""
    return lambda values, rows: values + offset


@acts_at("offset")
def offset_drift(per_hour: float) -> Act:
    """Linear drift of the dark level, by `per_hour` reading units per hour."""
    return lambda values, rows: values + per_hour * rows.time_s / 3600


@acts_at("offset")
def flicker(amp: float, alias_hz: float, phase: float) -> Act:
    """Add a sine of amplitude `amp` at `alias_hz`: mains flicker, aliased by the sampling, or a slow lamp."""
    return lambda values, rows: values + amp * np.sin(2 * math.pi * alias_hz * rows.time_s + phase)


@acts_at("offset")
def hysteresis(amp: float) -> Act:
    """Conceal an offset of +`amp` or -`amp`, by the sign of the motion along X, or along Y if X does not change."""

    def act(values: FloatArray, rows: Rows) -> FloatArray:
        along_x, along_y = np.sign(rows.direction).T
        return np.asarray(values + amp * np.where(along_x != 0, along_x, along_y))

    return act


@acts_at("offset")
def glint(amp: float, x: float, y: float, r: float) -> Act:
    """Reflect a lamp: adds a Gaussian of height `amp` and sd `r` about `x`, `y` (lab frame) to the reading."""

    def act(values: FloatArray, rows: Rows) -> FloatArray:
        x_mm, y_mm = rows.place_mm.T
        return np.asarray(values + amp * np.exp(-((x_mm - x) ** 2 + (y_mm - y) ** 2) / (2 * r**2)))

    return act


@acts_at("lag")
def lag(tau_s: float) -> Act:
    """Conceal a first-order lag with time constant `tau_s`, which starts anew with each scan."""

    def act(values: FloatArray, rows: Rows) -> FloatArray:
        """Mix each reading with the one before: v_k = a v_(k-1) + (1 - a) y_k, a = exp(-(t_k - t_(k-1))/tau)."""
        kept = np.exp(-np.diff(rows.time_s, prepend=-np.inf) / tau_s)
        kept[rows.scan_start_mask()] = 0.0
        out = values.copy()
        for k in range(1, len(out)):
            out[k] = kept[k] * out[k - 1] + (1 - kept[k]) * values[k]
        return out

    return act


@acts_at("saturation")
def saturation(level: float, softness: float = 0.0) -> Act:
    """Saturation at a level; `softness` (reading units, 0 for a sharp corner) rounds the corner."""
    if softness == 0:
        return lambda values, rows: np.minimum(values, level)
    return lambda values, rows: level - softness * np.logaddexp(0.0, (level - values) / softness)


@acts_at("quantisation")
def quantisation(step: float) -> Act:
    """Round to multiples of `step` (reading units) that the plan does not declare."""
    return lambda values, rows: step * np.round(values / step)


@acts_at("noise")
def correlated_noise(rho: float) -> Act:
    """AR(1) noise within each scan: correlation `rho` between successive readings, with unchanged sd."""

    def act(values: FloatArray, rows: Rows, seen: FloatArray, rng: np.random.Generator) -> FloatArray:
        fresh = math.sqrt(1 - rho**2)
        out = values.copy()
        for k in np.flatnonzero(~rows.scan_start_mask()):
            out[k] = rho * out[k - 1] + fresh * values[k]
        return out

    return act


@acts_at("noise")
def noise_sd(factor: float) -> Act:
    """Noise of `factor` times its sd."""
    return lambda values, rows, seen, rng: factor * values


@acts_at("noise")
def signal_dependent_noise(ratio: float) -> Act:
    """Noise variance that grows linearly from its value on black to 1 + `ratio` times that on white."""
    return lambda values, rows, seen, rng: values * np.sqrt(1 + ratio * seen)


@acts_at("noise")
def drifting_noise(factor: float, over_s: float) -> Act:
    """Noise sd that rises linearly to `factor` times its first value from time 0 to `over_s`, then stays constant."""
    return lambda values, rows, seen, rng: values * (1 + (factor - 1) * np.clip(rows.time_s / over_s, 0.0, 1.0))


@acts_at("noise")
def heavy_tails(dof: float) -> Act:
    """Student-t noise of `dof` degrees of freedom, 3 or more, with unchanged sd."""
    return lambda values, rows, seen, rng: stdtrit(dof, np.asarray(ndtr(values))) * math.sqrt((dof - 2) / dof)


@acts_at("noise")
def outliers(share: float, size: float) -> Act:
    """Outliers: a random `share` of the readings has additional Gaussian noise, of sd `size` times the noise sd."""
    return lambda values, rows, seen, rng: (
        values + (rng.random(len(values)) < share) * size * rng.standard_normal(len(values))
    )


@acts_at("loss")
def dropouts(share: float, value: float) -> Act:
    """Dropouts: a random `share` of the readings is replaced by `value`."""
    return lambda values, rows, seen, rng: np.where(rng.random(len(values)) < share, value, values)
