"""A start density that mixes another one, such as that from the order below, with densities about peaks.

The other density covers most of a posterior, but its draws may leave out a narrow peak. So three tenths of the
particles start about the peaks that least squares found.
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
    """A reference density mixed with densities about peaks, usable as a `ReferenceDensity`.

    `reference`: of N Gaussians, seven tenths of the mixture. `peaks`: densities about the highest peaks of the
    likelihood of N, one or more. `log_z_below`: constant in the log density of `reference`, ln of the evidence of N - 1
    or 0.
    """

    reference: ReferenceDensity
    peaks: tuple[PeakDensity, ...]
    log_z_below: float

    @property
    def prior(self) -> SSFPrior:
        """The prior of N Gaussians."""
        return self.reference.prior

    def log_density_over_prior(self, theta: FloatArray) -> FloatArray:
        """Log of the density over the prior's, plus ln Z of N - 1; Gaussians sorted by mass, (n, 6 N + 2) -> (n,)."""
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

    def propose_moves(self, here: FloatArray, *, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Propose new parameters, (n, 6 N + 2), by one of the densities, drawn for each particle.

        Also return that density's log over the prior's at the particles minus that at the new parameters, (n,).
        """
        there, log_drawn = np.empty(here.shape), np.empty(len(here))
        for density, rows in self._assign_rows_to_densities(len(here), rng):
            there[rows], log_drawn[rows] = density.propose_moves(here[rows], rng=rng)
        return there, log_drawn

    def _assign_rows_to_densities(self, n: int, rng: np.random.Generator) -> list[tuple[ReferenceDensity, IntArray]]:
        """Assign each of `n` rows at random to one of the densities: return pairs of a density and its rows."""
        which = np.minimum((rng.random(n) * len(self.peaks) / _SHARE).astype(np.int64), len(self.peaks))
        densities: tuple[ReferenceDensity, ...] = (*self.peaks, self.reference)
        return [(density, np.flatnonzero(which == k)) for k, density in enumerate(densities)]
