"""The amplitude at which an effect has a requested size lambda, and the region where a local effect acts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy.integrate import quad
from scipy.stats import norm

from probewise._arrays import BoolArray, FloatArray
from probewise.errors import NotConvergedError, ParameterError
from probewise.proof.sensors.effects import CleanSetup
from probewise.recordings.plan import Recording
from probewise.world.stages import AFTER_VIEW, Concealed
from probewise.world.world import View

NormAfterRefit: TypeAlias = Callable[[Recording, Recording], float]
"""Norm of an effect after a refit of the null model: noise-free readings (without, with effect) to reading units.

It is the 2-norm of `with - null`, where the null model is refitted in full to `with`. The misfit to the readings
without effect (the model cannot have the true SSF's shape) must not be counted.
"""


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
    extrapolation, then by interpolation, with bisection where interpolation gains too little.

    `size`: function from amplitude to size; `wanted`: requested size, greater than 0; `first`: first amplitude tried;
    `tolerance`: relative error of the size at which the search ends; `acceptable`: relative error accepted when the
    search ends otherwise; `max_calls`: largest number of calls of `size`. Raises NotConvergedError if even the limit is
    too small, or no amplitude has an acceptable size; `partial` holds (amplitude, size) of the nearest.
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


@dataclass(frozen=True, eq=False)
class EffectSizer:
    """Computes sizes lambda of effects in one plan and with one sensor, and the cosine of two.

    `setup`: a plan and a world without effects; `norm_after_refit`: function of two recordings, without and with an
    effect: its norm after a full refit of the null model.
    """

    setup: CleanSetup
    norm_after_refit: NormAfterRefit

    @cached_property
    def _clean_view(self) -> View:
        return self.setup.world.view(self.setup.plan)

    @cached_property
    def clean_recording(self) -> Recording:
        """Recording of the plan: noise-free readings without any effect."""
        return self.setup.world.simulate(self.setup.plan, rng=None, view=self._clean_view).without_declared_range()

    def recording_with_effects(self, *concealed: Concealed) -> Recording:
        """Return a recording of the plan: noise-free readings with these effects."""
        same_view = all(effect.stage in AFTER_VIEW for effect in concealed)
        world = replace(self.setup.world, concealed=concealed)
        return world.simulate(
            self.setup.plan, rng=None, view=self._clean_view if same_view else None
        ).without_declared_range()

    def size(self, *concealed: Concealed) -> float:
        """Return the joint lambda of effects: norm after the refit / noise sd; of one on noise, `noise_effect_size`."""
        if len(concealed) == 1 and concealed[0].disturbs:
            return noise_effect_size(
                concealed[0], self._clean_view, self.clean_recording.readings, self.setup.world.noise_sd
            )
        return (
            self.norm_after_refit(self.clean_recording, self.recording_with_effects(*concealed))
            / self.setup.world.noise_sd
        )

    def cosine(self, one: Concealed, other: Concealed) -> float:
        """Return the cosine between two effects' residuals after the refit, from the sizes of each and of both."""
        a, b, both = self.size(one), self.size(other), self.size(one, other)
        return float(np.clip((both**2 - a**2 - b**2) / (2 * a * b), -1.0, 1.0))


def noise_effect_size(effect: Concealed, view: View, readings: FloatArray, noise_sd: float) -> float:
    """Return the size of an effect on the noise: the lambda of an equally detectable effect on the mean.

    lambda^2 / 2 is the expected gain in log likelihood of the truth over white Gaussian noise of the best constant
    variance (Kullback-Leibler divergence summed over readings). Lost readings count as an effect on the mean: lambda is
    the norm of their expected deviations in noise sds.

    `effect`: correlated or signal-dependent noise, outliers, or dropouts; `view`, `readings`: view of the sensor
    (`World.view`), and the noise-free readings, shape (n_points,); `noise_sd`: sd of the noise's Gaussian core, reading
    units. Raises ParameterError if the effect is any other.
    """
    n_points, known = len(view.seen), effect.parameters
    match effect.name:
        case "correlated_noise":
            n_correlated = n_points - int(view.rows.scan_start_mask().sum())
            return math.sqrt(-n_correlated * math.log(1 - known["rho"] ** 2))
        case "signal_dependent_noise":
            variance = 1 + known["ratio"] * view.seen
            return math.sqrt(n_points * (math.log(variance.mean()) - float(np.log(variance).mean())))
        case "outliers":
            return math.sqrt(2 * n_points * _outlier_divergence(**known))
        case "dropouts":
            # As for the mean: a lost reading deviates by its distance from the right value.
            return math.sqrt(known["share"] * float(((known["value"] - readings) ** 2).sum())) / noise_sd
        case _:
            raise ParameterError("effect", effect.name, "a noise effect of the vocabulary")


def _outlier_divergence(share: float, size: float) -> float:
    """Return KL in nats of (1 - share) N(0, 1) + share N(0, 1 + size^2) from the Gaussian of equal variance."""
    wide, even = math.sqrt(1 + size**2), math.sqrt(1 + share * size**2)

    def integrand(z: float) -> float:
        density = (1 - share) * norm.pdf(z) + share * norm.pdf(z, scale=wide)
        return float(density * (math.log(density) - norm.logpdf(z, scale=even)))

    return 2 * float(quad(integrand, 0, 12 * wide, points=[2.0, 4.0], limit=200)[0])


@dataclass(frozen=True)
class CovariateRegion:
    """The interval `low` to `high` of `covariate`, in its unit; for the covariate "scan", the names `scans` instead."""

    covariate: str
    low: float | None = None
    high: float | None = None
    scans: tuple[str, ...] = ()


def region_of_effect(effect: Concealed, sizer: EffectSizer) -> CovariateRegion | None:
    """Return the region of a local effect, or None for any other.

    Effects on named scans: those scans. Ambient step: from the step to the last reading. Saturation: its level to the
    largest reading. Edge shadow: distances at which it is at least half its maximum. Stain, glint, step in X: the range
    of X in which it changes readings of scans along X by at least half its maximum.
    """
    plan, clean, known = sizer.clean_recording.plan, sizer.clean_recording.readings, effect.parameters
    match effect.name:
        case "scan_misplacement":
            return CovariateRegion("scan", scans=(known["scan"],))
        case "scan_angle_error" | "height_offset":
            return CovariateRegion("scan", scans=known["scans"])
        case "ambient_step":
            return CovariateRegion("time", known["at_s"], float(plan.time_s[-1]))
        case "saturation":
            return CovariateRegion("level", known["level"], float(clean.max()))
        case "edge_shadow":
            return CovariateRegion("edge_distance", 0.0, known["w"] * math.sqrt(2 * math.log(2)))
        case "albedo_patch" | "glint" | "place_step":
            along_x: BoolArray = np.abs(plan.direction_of_motion[:, 0]) > 0
            strength = np.where(along_x, np.abs(sizer.recording_with_effects(effect).readings - clean), 0.0)
            there = plan.x_mm[strength >= strength.max() / 2]
            return CovariateRegion("place", float(there.min()), float(there.max()))
        case _:
            return None
