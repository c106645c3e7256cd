"""Effects to conceal in a sensor: samplers of all parameters, amplitudes of a size, and regions of local effects."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from scipy.integrate import quad
from scipy.stats import norm

from probewise._arrays import BoolArray
from probewise.errors import NotConvergedError, ParameterError
from probewise.recordings.patterns import Uniform
from probewise.recordings.plan import Plan, Recording
from probewise.world import concealed as known
from probewise.world import unlisted as strange
from probewise.world.stages import AFTER_VIEW, Concealed
from probewise.world.world import View, World

NormAfterRefit: TypeAlias = Callable[[Recording, Recording], float]
"""Norm of an effect after a refit of the null model: noise-free readings (without, with effect) to reading units.

It is the 2-norm of `with - null`, where the null model is refitted in full to `with`. The misfit to the readings
without effect (the model cannot have the true SSF's shape) must not be counted.
"""


@dataclass(frozen=True, eq=False)
class CleanSetup:
    """A plan and a simulated sensor without effects, in which effects are concealed; their sizes lambda by a refit."""

    plan: Plan
    world: World
    norm_after_refit: NormAfterRefit

    @property
    def duration_s(self) -> float:
        """Time from the first reading to the last, s."""
        return float(self.plan.time_s[-1] - self.plan.time_s[0])

    @cached_property
    def _view(self) -> View:
        return self.world.view(self.plan)

    @cached_property
    def clean_recording(self) -> Recording:
        """Recording of the plan: noise-free readings without any effect."""
        return self.world.simulate(self.plan, rng=None, view=self._view).without_declared_range()

    def recording_with_effects(self, *concealed: Concealed) -> Recording:
        """Return a recording of the plan: noise-free readings with these effects."""
        same_view = all(effect.stage in AFTER_VIEW for effect in concealed)
        world, view = replace(self.world, concealed=concealed), self._view if same_view else None
        return world.simulate(self.plan, rng=None, view=view).without_declared_range()

    def size(self, *concealed: Concealed) -> float:
        """Return the joint lambda of effects: the norm after the refit over the noise sd.

        Of one on the noise it is that of an equally detectable effect on the mean: lambda^2 / 2 is the expected gain in
        log likelihood of the truth over white Gaussian noise of the best constant variance (Kullback-Leibler divergence
        summed over readings). Lost readings deviate by their distance from the right value.
        """
        if len(concealed) > 1 or not concealed[0].disturbs:
            changed = self.recording_with_effects(*concealed)
            return self.norm_after_refit(self.clean_recording, changed) / self.world.noise_sd
        view, own, name = self._view, concealed[0].parameters, concealed[0].name
        n_points = len(view.seen)
        match name:
            case "correlated_noise":
                n_correlated = n_points - int(view.rows.scan_start_mask().sum())
                return math.sqrt(-n_correlated * math.log(1 - own["rho"] ** 2))
            case "signal_dependent_noise":
                variance = 1 + own["ratio"] * view.seen
                return math.sqrt(n_points * (math.log(variance.mean()) - float(np.log(variance).mean())))
            case "outliers":
                return math.sqrt(2 * n_points * _outlier_divergence(**own))
            case "dropouts":
                squared = float(((own["value"] - self.clean_recording.readings) ** 2).sum())
                return math.sqrt(own["share"] * squared) / self.world.noise_sd
        raise ParameterError("effect", name, "a noise effect of the vocabulary")

    def cosine(self, one: Concealed, other: Concealed) -> float:
        """Return the cosine between two effects' residuals after the refit, from the sizes of each and of both."""
        a, b, both = self.size(one), self.size(other), self.size(one, other)
        return float(np.clip((both**2 - a**2 - b**2) / (2 * a * b), -1.0, 1.0))

    def region(self, effect: Concealed) -> CovariateRegion | None:
        """Return the region of a local effect, or None for any other.

        Effects on named scans: those scans. Ambient step: from the step to the last reading. Saturation: its level to
        the largest reading. Edge shadow: distances at which it is at least half its maximum. Stain, glint, step in X:
        the range of X in which it changes readings of scans along X by at least half its maximum.
        """
        plan, clean, own = self.plan, self.clean_recording.readings, effect.parameters
        match effect.name:
            case "scan_misplacement":
                return CovariateRegion("scan", scans=(own["scan"],))
            case "scan_angle_error" | "height_offset":
                return CovariateRegion("scan", scans=own["scans"])
            case "ambient_step":
                return CovariateRegion("time", own["at_s"], float(plan.time_s[-1]))
            case "saturation":
                return CovariateRegion("level", own["level"], float(clean.max()))
            case "edge_shadow":
                return CovariateRegion("edge_distance", 0.0, own["w"] * math.sqrt(2 * math.log(2)))
            case "albedo_patch" | "glint" | "place_step":
                along_x: BoolArray = np.abs(plan.direction_of_motion[:, 0]) > 0
                strength = np.where(along_x, np.abs(self.recording_with_effects(effect).readings - clean), 0.0)
                there = plan.x_mm[strength >= strength.max() / 2]
                return CovariateRegion("place", float(there.min()), float(there.max()))
        return None


@dataclass(frozen=True)
class CovariateRegion:
    """The interval `low` to `high` of `covariate`, in its unit; for the covariate "scan", the names `scans` instead."""

    covariate: str
    low: float | None = None
    high: float | None = None
    scans: tuple[str, ...] = ()


def _outlier_divergence(share: float, size: float) -> float:
    """Return KL in nats of (1 - share) N(0, 1) + share N(0, 1 + size^2) from the Gaussian of equal variance."""
    wide, even = math.sqrt(1 + size**2), math.sqrt(1 + share * size**2)

    def integrand(z: float) -> float:
        density = (1 - share) * norm.pdf(z) + share * norm.pdf(z, scale=wide)
        return float(density * (math.log(density) - norm.logpdf(z, scale=even)))

    return 2 * float(quad(integrand, 0, 12 * wide, points=[2.0, 4.0], limit=200)[0])


Draw: TypeAlias = Callable[[CleanSetup, np.random.Generator], Any]
"""Draws one parameter of an effect."""


@dataclass(frozen=True)
class EffectSampler:
    """A distribution over one kind of effect, up to its amplitude."""

    covariates: tuple[str, ...]  # along which its residual is visible
    make: Callable[..., Concealed]  # from the amplitude and the values that `draws` drew, in this order
    first: float  # amplitude of the search for a size
    limit: float  # largest plausible amplitude, or `first` if the search does not choose it
    draws: tuple[Draw, ...] = ()

    def draw(self, setup: CleanSetup, rng: np.random.Generator) -> Callable[[float], Concealed]:
        """Draw all parameters but the amplitude; return a function from that, greater than 0, to the effect."""
        drawn = [draw(setup, rng) for draw in self.draws]
        return lambda amplitude: self.make(amplitude, *drawn)


def _effect(covariates: str, make: Callable[..., Concealed], first: float, limit: float, *draws: Draw) -> EffectSampler:
    return EffectSampler(tuple(covariates.split()), make, first, limit, draws)


def _one_of(*values: float) -> Draw:
    return lambda setup, rng: float(rng.choice(values))


def _uniform(low: float, high: float) -> Draw:
    return lambda setup, rng: rng.uniform(low, high)


def _log_uniform(low: float, high: float | Callable[[CleanSetup], float]) -> Draw:
    return lambda setup, rng: math.exp(rng.uniform(math.log(low), math.log(high(setup) if callable(high) else high)))


def _moment(low: float, high: float) -> Draw:
    return lambda setup, rng: float(setup.plan.time_s[0]) + rng.uniform(low, high) * setup.duration_s


def _edge_scan(setup: CleanSetup, rng: np.random.Generator) -> str:
    """Draw a scan of 20 readings or more whose first reading is over a pattern that is not uniform."""
    plan = setup.plan
    patterns = [plan.patterns[name] for name in plan.pattern_names]
    by_scan = zip(plan.scan_names, plan.rows_by_scan(), strict=True)
    names = [n for n, rows in by_scan if rows.size >= 20 and not isinstance(patterns[plan.pattern[rows[0]]], Uniform)]
    return str(rng.choice(names))


def _edge_scans(setup: CleanSetup, rng: np.random.Generator) -> tuple[str, ...]:
    scan, plan = _edge_scan(setup, rng), setup.plan
    if rng.random() >= 0.5:
        return (scan,)
    turn = {n: plan.orientation_rad[rows[0]] for n, rows in zip(plan.scan_names, plan.rows_by_scan(), strict=True)}
    return tuple(name for name in turn if turn[name] == turn[scan])


def _duration_s(setup: CleanSetup, *_: np.random.Generator) -> float:
    return setup.duration_s


def _nyquist_hz(setup: CleanSetup) -> float:  # half the median rate of the readings
    return 0.5 / float(np.median(np.diff(setup.plan.time_s)))


_SIGN, _PHASE = _one_of(-1.0, 1.0), _uniform(0, 2 * math.pi)
_DIRECTION = (_SIGN, _uniform(-math.pi / 3, math.pi / 3))
_SPOT = (_uniform(-40, 40), _uniform(-4, 4), _log_uniform(3.0, 10.0))  # x, y and sd of a stain or glint, mm


def _signed(kind: Callable[..., Concealed]) -> Callable[..., Concealed]:
    return lambda a, sign, *more: kind(sign * a, *more)


def _directed(kind: Callable[[float, float], Concealed]) -> Callable[..., Concealed]:
    """Return the maker of a vector within 60 degrees of +X or -X, whose length is the amplitude."""
    return lambda a, sign, angle: kind(sign * a * math.cos(angle), sign * a * math.sin(angle))


def _saturation(a: float, levels: tuple[float, float], softness: float) -> Concealed:
    black, white = levels
    return known.saturation(white - a * (white - black), softness)


def _ssf_order(a: float, turn: float, sd_mm: float) -> Concealed:
    return known.ssf_order(a, 5.0 * math.cos(turn), 1.5 + 5.0 * math.sin(turn), sd_mm)


def _chirp(a: float, phase: float, cycles: float, duration_s: float) -> Concealed:
    """Let the frequency, `cycles` per recording at first, grow eightfold by its end."""
    first_hz = cycles / duration_s
    return strange.chirp(a, first_hz, 7 * first_hz / duration_s, phase)


INSIDE: Mapping[str, EffectSampler] = {
    "ambient_gradient": _effect("place", _directed(known.ambient_gradient), 0.01, 2.0, *_DIRECTION),
    "ambient_step": _effect("time", _signed(known.ambient_step), 0.5, 30.0, _SIGN, _moment(0.15, 0.85)),
    "offset_drift": _effect("time", _signed(known.offset_drift), 5.0, 500.0, _SIGN),
    "gain_drift": _effect("time", _signed(known.gain_drift), 0.03, 0.9, _SIGN, _log_uniform(60.0, _duration_s)),
    "battery_sag": _effect("battery_mv", _signed(known.battery_sag), 0.5, 10.0, _SIGN),
    "flicker": _effect("time", known.flicker, 0.3, 20.0, _log_uniform(0.01, _nyquist_hz), _PHASE),
    "saturation": _effect(
        "level", _saturation, 0.05, 0.9, lambda setup, rng: (setup.world.black, setup.world.white), _one_of(0.0, 1.0)
    ),
    "nonlinearity": _effect("level", _signed(lambda a: known.nonlinearity(math.exp(a))), 0.1, 1.5, _SIGN),
    "quantisation": _effect("lattice", known.quantisation, 1.0, 20.0),
    "hysteresis": _effect("direction", _signed(known.hysteresis), 0.3, 20.0, _SIGN),
    "lag": _effect("slope direction", known.lag, 0.5, 20.0),
    "backlash": _effect("slope direction", known.backlash, 0.5, 15.0),
    "position_scale": _effect(
        "place", lambda a, sign, ratio: known.position_scale(sign * a, ratio * a), 0.02, 0.4, _SIGN, _uniform(-1, 1)
    ),
    "periodic_position_error": _effect(
        "place", known.periodic_position_error, 0.3, 10.0, _log_uniform(4.0, 25.0), _PHASE
    ),
    "edge_misplacement": _effect("slope", _signed(known.edge_misplacement), 0.3, 8.0, _SIGN),
    "scan_misplacement": _effect("slope scan", _signed(known.scan_misplacement), 0.3, 8.0, _SIGN, _edge_scan),
    "scan_angle_error": _effect("scan orientation", _signed(known.scan_angle_error), 5.0, 45.0, _SIGN, _edge_scans),
    "orientation_error": _effect("orientation", _signed(known.orientation_error), 5.0, 45.0, _SIGN),
    "sensor_tilt": _effect("orientation slope", _directed(known.sensor_tilt), 0.3, 8.0, *_DIRECTION),
    "height_gradient": _effect("place", _signed(known.height_gradient), 0.01, 0.12, _SIGN),
    "height_offset": _effect("scan", _signed(known.height_offset), 0.3, 8.0, _SIGN, _edge_scans),
    "albedo_gradient": _effect("place", _directed(known.albedo_gradient), 5e-4, 0.012, *_DIRECTION),
    "albedo_patch": _effect("place", _signed(known.albedo_patch), 0.05, 1.0, _SIGN, *_SPOT),
    "edge_blur": _effect("edge_distance", known.edge_blur, 1.0, 8.0),
    "edge_shadow": _effect("edge_distance", known.edge_shadow, 0.02, 0.6, _log_uniform(2.0, 8.0)),
    "halo": _effect("edge_distance", known.halo, 0.05, 0.6, _log_uniform(12.0, 40.0)),
    "glint": _effect("place", known.glint, 1.0, 40.0, *_SPOT),
    "ssf_order": _effect("edge_distance", _ssf_order, 0.05, 0.5, _PHASE, _uniform(1.5, 4.0)),
    "signal_dependent_noise": _effect("level", known.signal_dependent_noise, 1.0, 100.0),
    "correlated_noise": _effect("scan", known.correlated_noise, 0.3, 0.95),
    "outliers": _effect("", lambda a, share: known.outliers(share, a), 5.0, 30.0, _log_uniform(0.01, 0.05)),
    # The share of lost readings is half to five times the amplitude, which is fixed.
    "dropouts": _effect(
        "",
        lambda a, value, factor: known.dropouts(factor * a, value),
        *(0.01, 0.01),
        *(_one_of(0.0, 100.0), _log_uniform(0.5, 5.0)),
    ),
}
"""Samplers of the vocabulary's effects by name, in the order of the diagnosis page, section 2."""

NEEDS_SENSOR = frozenset({"orientation_error", "edge_blur"})
"""Effects that an SSF fitted to the same recording absorbs."""

NO_PHYSICS = frozenset({"ssf_order"})

SINGLES = tuple(name for name in INSIDE if name not in NEEDS_SENSOR | NO_PHYSICS)
"""Effects that a case may conceal when the sensor is calibrated on the same recording."""

PAIRABLE = tuple(name for name in SINGLES[: SINGLES.index("signal_dependent_noise")] if name != "quantisation")
"""Effects on the mean of the readings, for which a pair has a cosine."""


OUTSIDE: Mapping[str, EffectSampler] = {
    "bent_rail": _effect("place", _signed(strange.bent_rail), 0.5, 20.0, _SIGN),
    "twisted_rail": _effect("place", _signed(strange.twisted_rail), 0.5, 20.0, _SIGN),
    "place_step": _effect("place", _signed(strange.place_step), 0.5, 10.0, _SIGN, _uniform(-3, 3)),
    "stick_slip": _effect("place", strange.stick_slip, 0.5, 8.0, _log_uniform(3.0, 8.0), _uniform(0, 1)),
    "slipped_paper": _effect("time", _signed(strange.slipped_paper), 0.5, 10.0, _SIGN, _moment(0.2, 0.8)),
    "ghost": _effect(
        "edge_distance",
        lambda a, sign, dx_mm, dy_mm: strange.ghost(a, sign * dx_mm, dy_mm),
        *(0.03, 0.5),
        *(_SIGN, _uniform(8, 20), _uniform(-5, 5)),
    ),
    "thermal_gain": _effect(
        "time",
        strange.thermal_gain,
        *(0.02, 0.5),
        *(_duration_s, lambda setup, rng: tuple(float(phase) for phase in rng.uniform(0, 2 * math.pi, 12))),
    ),
    "cross_talk": _effect("orientation", strange.cross_talk, 0.03, 0.9, _PHASE),
    "floor": _effect("level", strange.floor, 0.03, 0.6),
    "peak_memory": _effect("level", strange.peak_memory, 0.05, 2.0),
    "after_glow": _effect(
        "time",
        strange.after_glow,
        *(1.0, 40.0),
        *(_log_uniform(5.0, 20.0), lambda setup, rng: (setup.world.black + setup.world.white) / 2),
    ),
    "chirp": _effect("time", _chirp, 0.3, 20.0, _PHASE, _log_uniform(2.0, 6.0), _duration_s),
}
"""Samplers of effects outside the vocabulary."""

SAMPLERS = {**INSIDE, **OUTSIDE}


def amplitude_of_size(
    size: Callable[[float], float],
    wanted: float,
    *,
    first: float,
    limit: float,
    tolerance: float = 0.02,
    acceptable: float = 0.1,
    max_calls: int = 16,
) -> float:
    """Return an amplitude greater than 0 at which `size` has the requested value.

    Size grows roughly as a power of the amplitude: steps follow a straight line in log-log coordinates, first by
    extrapolation, then by interpolation, with bisection where interpolation gains too little. `first`: first amplitude
    tried; `tolerance`: relative error of the size at which the search ends; `acceptable`: accepted when it ends
    otherwise. Raises NotConvergedError if even the limit is too small, or no amplitude has an acceptable size;
    `partial` holds (amplitude, size) of the nearest.
    """
    low: tuple[float, float] | None = None  # log amplitude and log(size / wanted), size too small
    high: tuple[float, float] | None = None  # the same, size too large
    at, nearest = math.log(first), (first, 0.0)
    for call in range(max_calls):
        found = size(math.exp(at))
        if abs(found - wanted) < abs(nearest[1] - wanted):
            nearest = (math.exp(at), found)
        if abs(found - wanted) <= tolerance * wanted:
            break
        off = math.log(max(found, 1e-9 * wanted) / wanted)
        if off < 0:
            if at >= math.log(limit):
                break
            low = (at, off)
        else:
            high = (at, off)
        if low is None or high is None:
            at = min(at - float(np.clip(off, -3.0, 3.0)) * 1.05, math.log(limit))
            continue
        if high[0] - low[0] < 0.01:
            break
        share = -low[1] / (high[1] - low[1]) if call % 3 else 0.5
        at = low[0] + float(np.clip(share, 0.02, 0.98)) * (high[0] - low[0])
    if abs(nearest[1] - wanted) <= acceptable * wanted:
        return nearest[0]
    raise NotConvergedError(
        f"the size nearest to {wanted:g} is {nearest[1]:.3g}, at amplitude {nearest[0]:.3g} (limit {limit:g})", nearest
    )
