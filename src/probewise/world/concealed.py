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
    return lambda values, rows: _with_x_error(values, amp_mm * np.sin(2 * math.pi * values[:, 0] / period_mm + phase))


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
    return lambda white, x_mm, y_mm: white + albedo * _bump(x_mm - x, y_mm - y, r)


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
    return lambda values, rows: values + amp * _bump(rows.place_mm[:, 0] - x, rows.place_mm[:, 1] - y, r)


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


# Effects outside the vocabulary, which a diagnosis can detect and locate but not name.


@acts_at("place")
def bent_rail(amp_mm: float) -> Act:
    """Conceal an error in X quadratic in X: `amp_mm` at 10 mm from the origin."""
    return lambda values, rows: _with_x_error(values, amp_mm * (values[:, 0] / 10) ** 2)


@acts_at("place")
def twisted_rail(amp_mm: float) -> Act:
    """Conceal an error in X cubic in X: `amp_mm` at 10 mm from the origin."""
    return lambda values, rows: _with_x_error(values, amp_mm * (values[:, 0] / 10) ** 3)


@acts_at("place")
def place_step(amp_mm: float, at_mm: float) -> Act:
    """Conceal a missing gear tooth: true X is larger than commanded by `amp_mm` where X exceeds `at_mm`."""
    return lambda values, rows: _with_x_error(values, np.where(values[:, 0] > at_mm, amp_mm, 0.0))


@acts_at("place")
def stick_slip(amp_mm: float, period_mm: float, phase: float) -> Act:
    """Stick-slip of the slide: an error in X, a sawtooth of X between -`amp_mm` and `amp_mm`, period `period_mm`."""
    return lambda values, rows: _with_x_error(values, amp_mm * (2 * np.mod(values[:, 0] / period_mm + phase, 1.0) - 1))


@acts_at("pattern")
def slipped_paper(offset_mm: float, at_s: float) -> Act:
    """Slip the paper by `offset_mm` across its edge at time `at_s`; it stays there."""
    return lambda values, rows: values + offset_mm * rows.across * (rows.time_s > at_s)[:, None]


@acts_at("footprint")
def ghost(share: float, dx_mm: float, dy_mm: float) -> Act:
    """Add a faint second image from a glass plate: a `share` of the light, its footprint moved by `dx_mm`, `dy_mm`."""

    def act(parts: Sequence[FootprintPart]) -> tuple[FootprintPart, ...]:
        first = (replace(g, share=g.share * (1 - share)) for g in parts)
        second = (
            replace(g, share=g.share * share, shift_mm=(g.shift_mm[0] + dx_mm, g.shift_mm[1] + dy_mm)) for g in parts
        )
        return (*first, *second)

    return act


@acts_at("gain")
def thermal_gain(frac: float, longest_s: float, phases: tuple[float, ...]) -> Act:
    """Gain that wanders with room temperature by a relative sd `frac`: slow waves with a 1/f power spectrum.

    Frequencies are the first multiples of 1/`longest_s`, one for each of `phases` (rad); the sum of all waves has sd 1
    over the longest period.
    """

    def act(values: FloatArray, rows: Rows) -> FloatArray:
        order = np.arange(1, len(phases) + 1)
        waves = np.cos(2 * math.pi * np.outer(rows.time_s / longest_s, order) + np.array(phases))
        heights = np.sqrt(1 / order)
        return np.asarray(values * (1 + frac * (waves @ heights * math.sqrt(2 / float(heights @ heights)))))

    return act


@acts_at("gain")
def cross_talk(frac: float, phase: float) -> Act:
    """Gain that varies by a fraction `frac` with twice the orientation, as when a pulled cable disturbs the signal."""
    return lambda values, rows: values * (1 + frac * np.cos(2 * rows.orientation_rad + phase))


@acts_at("response")
def floor(share: float) -> Act:
    """Conceal a dead zone: light below a `share` of white gives no signal."""
    return lambda values, rows: np.where(values < share, 0.0, values)


@acts_at("response")
def peak_memory(share: float) -> Act:
    """Let the photodiode remember: adds a `share` of the brightest light since the start of the scan."""

    def act(values: FloatArray, rows: Rows) -> FloatArray:
        peaks = values.copy()
        for part in np.split(np.arange(len(values)), np.flatnonzero(rows.scan_start_mask())[1:]):
            peaks[part] = np.maximum.accumulate(values[part])
        return values + share * peaks

    return act


@acts_at("offset")
def after_glow(amp: float, tau_s: float, level: float) -> Act:
    """Conceal a pulse of height `amp` that decays with `tau_s`, added each time the reading rises through `level`."""

    def act(values: FloatArray, rows: Rows) -> FloatArray:
        bright = values > level
        rises = rows.time_s[np.flatnonzero(bright & ~np.concatenate([[True], bright[:-1]]))]
        since = rows.time_s[:, None] - rises
        pulses = np.where(since >= 0, np.exp(-np.maximum(since, 0.0) / tau_s), 0.0)
        return np.asarray(values + amp * pulses.sum(axis=1))

    return act


@acts_at("offset")
def chirp(amp: float, first_hz: float, rate_hz_per_s: float, phase: float) -> Act:
    """Conceal an oscillating offset, as of a fan: amplitude `amp`, frequency `first_hz` + `rate_hz_per_s` t."""
    return lambda values, rows: (
        values
        + amp * np.sin(2 * math.pi * (first_hz * rows.time_s + rate_hz_per_s * rows.time_s * rows.time_s / 2) + phase)
    )


@acts_at("place")
def play_of_axes(x_mm: float, y_mm: float) -> Act:
    """Play of each axis by itself: it stops `x_mm` / 2 or `y_mm` / 2 short, whatever the way of the other."""
    return lambda values, rows: values - np.sign(rows.direction) * [x_mm / 2, y_mm / 2]


@acts_at("gain")
def gain_loss(share: float, each_s: float) -> Act:
    """Conceal a lamp that fades linearly: every `each_s` it loses a `share` of its first signal, down to zero."""
    return lambda values, rows: values * np.maximum(1.0 - share * rows.time_s / each_s, 0.0)


def _with_x_error(place_mm: FloatArray, error_mm: FloatArray) -> FloatArray:
    return place_mm + np.stack([error_mm, np.zeros_like(error_mm)], axis=-1)


def _bump(dx_mm: FloatArray, dy_mm: FloatArray, sd_mm: float) -> FloatArray:
    return np.asarray(np.exp(-(dx_mm**2 + dy_mm**2) / (2 * sd_mm**2)))
