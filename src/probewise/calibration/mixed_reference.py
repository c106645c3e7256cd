"""A start density that mixes another one, such as that from the order below, with densities about peaks.

The other density covers most of a posterior, but its draws may leave out a peak that is narrow. A part of the particles
starts about the peaks that least squares found, so that each is represented where it holds a part of the evidence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray, IntArray
from probewise.calibration.peak_density import PeakDensity
from probewise.calibration.priors import SSFPrior
from probewise.calibration.reference_density import ReferenceDensity

_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class MixedReferenceDensity:
    """A reference mixed with densities about peaks: a `ReferenceDensity`.

    Parameters
    ----------
    reference
        The density that is mixed with them, of N Gaussians.
    peaks
        Densities about the highest peaks of the likelihood of N, one or more.
    log_z_below
        What `reference` adds to its log density: natural log of the evidence of N - 1, or 0.
    """

    reference: ReferenceDensity
    peaks: tuple[PeakDensity, ...]
    log_z_below: float

    @property
    def prior(self) -> SSFPrior:
        """The prior of N Gaussians."""
        return self.reference.prior

    def log_density_over_prior(self, theta: FloatArray) -> FloatArray:
        """Log of the density over the prior's sorted one, plus ln Z of N - 1; sorted (n, 6 N + 2) -> (n,)."""
        each = math.log(_SHARE / len(self.peaks)) + self.log_z_below
        parts = [each + peak.log_density_over_prior(theta) for peak in self.peaks]
        return np.asarray(
            logsumexp([math.log(1.0 - _SHARE) + self.reference.log_density_over_prior(theta), *parts], axis=0)
        )

    def draw(self, rest: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Draw parameters of N for each sample `rest` of N - 1, (n, 6 N - 4) -> (n, 6 N + 2); nan: impossible."""
        out = np.empty((len(rest), len(self.prior.names)))
        for density, rows in self._assign_rows_to_densities(len(rest), rng):
            out[rows] = density.draw(rest[rows], rng=rng)
        return out

    def propose(self, here: FloatArray, *, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Propose new parameters by one of the densities, drawn for each particle; see `ReferenceDensity`."""
        there, log_drawn = np.empty(here.shape), np.empty(len(here))
        for density, rows in self._assign_rows_to_densities(len(here), rng):
            there[rows], log_drawn[rows] = density.propose(here[rows], rng=rng)
        return there, log_drawn

    def _assign_rows_to_densities(self, n: int, rng: np.random.Generator) -> list[tuple[ReferenceDensity, IntArray]]:
        """Assign each of `n` rows to one of the densities at random: pairs of a density and its rows."""
        which = np.minimum((rng.random(n) * len(self.peaks) / _SHARE).astype(np.int64), len(self.peaks))
        densities: tuple[ReferenceDensity, ...] = (*self.peaks, self.reference)
        return [(density, np.flatnonzero(which == k)) for k, density in enumerate(densities)]
