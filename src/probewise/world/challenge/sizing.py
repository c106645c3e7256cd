"""Find the amplitude at which an effect has a wanted size, lambda of the diagnosis."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy.integrate import quad
from scipy.stats import norm

from probewise._arrays import FloatArray
from probewise.errors import NotConvergedError, ParameterError
from probewise.recordings.plan import Recording
from probewise.world.challenge.candidates import Setting
from probewise.world.concealed import Concealed, CorrelatedNoise, Disturbs, Dropouts, Outliers, SignalDependentNoise
from probewise.world.concealed.stages import ANSWERING
from probewise.world.world import Look

__all__ = ["Ruler", "Surviving", "amplitude_of_size", "noise_size"]

Surviving: TypeAlias = Callable[[Recording, Recording], float]
"""What a null model leaves of noise-free readings: (without effect, with effect) -> in units of the reading.

The root of the sum of squares of `with - null`, the null model refitted in full to `with`; what it leaves of
the readings without effect, because it cannot take the true SSF's shape, is no effect's and not to be counted.
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
    """Search for an amplitude greater than 0 at which `size` is as wanted.

    A size grows about as a power of the amplitude: steps follow the straight line in logarithms, first
    out of the range that is known, then within it, with a bisection wherever the line gains too little.

    Parameters
    ----------
    size
        Size at an amplitude.
    wanted
        Size wanted, greater than 0.
    first
        Amplitude to begin with.
    limit
        Largest amplitude.
    tolerance
        Relative error of the size at which the search ends.
    acceptable
        The same for a size that jumps past what is wanted as the amplitude grows.
    max_calls
        Calls of `size` at most.

    Raises
    ------
    NotConvergedError
        If even the limit is too small, or no amplitude has an acceptable size; `partial` holds the amplitude
        and the size that came nearest.
    """
    low: tuple[float, float] | None = None  # log amplitude and log size over wanted, too small
    high: tuple[float, float] | None = None  # too large
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
class Ruler:
    """Measure how large effects are in a setting.

    Parameters
    ----------
    setting
        A plan and a sensor that conceals nothing.
    surviving
        What the null model leaves of an effect.
    """

    setting: Setting
    surviving: Surviving

    @cached_property
    def _look(self) -> Look:
        return self.setting.world.look(self.setting.plan)

    @cached_property
    def clean(self) -> Recording:
        """Noise-free readings without any effect."""
        return self.setting.world.simulate(self.setting.plan, rng=None, look=self._look).unlimited()

    def recording(self, *concealed: Concealed) -> Recording:
        """Return the noise-free readings with these effects."""
        late = all(effect.stage in ANSWERING for effect in concealed)
        world = replace(self.setting.world, concealed=concealed)
        return world.simulate(self.setting.plan, rng=None, look=self._look if late else None).unlimited()

    def size(self, *concealed: Concealed) -> float:
        """Return lambda of the effects together, in units of the sd of the noise's normal part."""
        if len(concealed) == 1 and isinstance(concealed[0], Disturbs):
            return noise_size(concealed[0], self._look, self.clean.readings, self.setting.world.noise_sd)
        return self.surviving(self.clean, self.recording(*concealed)) / self.setting.world.noise_sd

    def cosine(self, one: Concealed, other: Concealed) -> float:
        """Return how alike the surviving parts of two effects are: a size of both and of each tells."""
        a, b, both = self.size(one), self.size(other), self.size(one, other)
        return float(np.clip((both**2 - a**2 - b**2) / (2 * a * b), -1.0, 1.0))


def noise_size(effect: Disturbs, look: Look, readings: FloatArray, noise_sd: float) -> float:
    """Return the size of an effect on the noise: the lambda of an effect on the mean that is as plain to see.

    Half the square of lambda is the log likelihood that the truth gains, on average, over white Gaussian
    noise of the best constant variance (Kullback-Leibler divergence times the readings).

    Parameters
    ----------
    effect
        One of the vocabulary's.
    look, readings
        What the sensor sees, and the noise-free readings, shape (n_points,).
    noise_sd
        Sd of the noise's normal part.

    Raises
    ------
    ParameterError
        If the effect is none of the vocabulary's.
    """
    n_points = len(look.seen)
    match effect:
        case CorrelatedNoise():
            remembering = n_points - int(look.rows.starts_scan().sum())
            return math.sqrt(-remembering * math.log(1 - effect.rho**2))
        case SignalDependentNoise():
            variance = 1 + effect.ratio * look.seen
            return math.sqrt(n_points * (math.log(variance.mean()) - float(np.log(variance).mean())))
        case Outliers():
            return math.sqrt(2 * n_points * _outlier_divergence(effect.share, effect.size))
        case Dropouts():
            # As on the mean: a reading lost stands out as far as it lies from what it should have been.
            return math.sqrt(effect.share * float(((effect.value - readings) ** 2).sum())) / noise_sd
        case _:
            raise ParameterError("effect", effect.name, "a noise effect of the vocabulary")


def _outlier_divergence(share: float, size: float) -> float:
    """Integrate the divergence of one reading: a mixture of two Gaussians from the one of equal variance."""
    wide, even = math.sqrt(1 + size**2), math.sqrt(1 + share * size**2)

    def integrand(z: float) -> float:
        density = (1 - share) * norm.pdf(z) + share * norm.pdf(z, scale=wide)
        return float(density * (math.log(density) - norm.logpdf(z, scale=even)))

    return 2 * float(quad(integrand, 0, 12 * wide, points=[2.0, 4.0], limit=200)[0])
