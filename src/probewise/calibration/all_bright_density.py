"""A start density for the part of a posterior where all N Gaussians are bright: a Student-t fitted to N - 1 Gaussians.

N Gaussians that share the light of one footprint have the same moments as a whole as N - 1 Gaussians. The readings
contain little information on each Gaussian's own share, centre and width. Such a part of the posterior is broad, has no
peak of its own, and lies far from that of N - 1 Gaussians with a faint one added.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.calibration.peak_density import StudentTDensity
from probewise.calibration.priors import SSFPrior
from probewise.calibration.reference_density import propose_independently
from probewise.calibration.whole_coordinates import WholeFootprintCoordinates

# Of the others' log ratios to the heaviest: mean and sd; in units of the whole: variance of places, sd of the logs.
_LOG_RATIO, _LOG_RATIO_SD = -1.2, 0.8
_PLACE, _LOG_SD = 0.8, 1.0
_LOG_LIGHT, _LOG_LIGHT_SD = -0.4, 0.4
_WIDENED = 2.0


@dataclass(frozen=True, eq=False)
class AllGaussiansBrightDensity:
    """A Student-t `one` in the coordinates `space` of N Gaussians, usable as a `ReferenceDensity`."""

    space: WholeFootprintCoordinates
    one: StudentTDensity

    @classmethod
    def from_samples_below(cls, space: WholeFootprintCoordinates, fewer: FloatArray) -> AllGaussiansBrightDensity:
        """Make the density of N Gaussians from samples `fewer` of N - 1, (n, 6 N - 4), in coordinates like `space`."""
        d = fewer.shape[1] + 6
        own, last = np.r_[: d - 8, d - 2, d - 1], np.arange(d - 8, d - 2)
        mean, covariance = fewer.mean(axis=0), _WIDENED**2 * np.cov(fewer, rowvar=False)
        # The readings do not depend on the total light.
        covariance[0] = covariance[:, 0] = 0.0
        mean[0], covariance[0, 0] = _LOG_LIGHT, _LOG_LIGHT_SD**2
        middle, root = np.empty(d), np.zeros((d, d))
        middle[own], middle[last] = mean, np.r_[_LOG_RATIO, mean[1:6]]
        root[np.ix_(own, own)] = np.linalg.cholesky(covariance)
        root[last, last] = np.r_[_LOG_RATIO_SD, np.sqrt(_PLACE * np.exp(mean[3:5])), _LOG_SD, _LOG_SD, _LOG_SD]
        # The rows are in the order of the coordinates, so that a lower root stays one.
        return cls(space, StudentTDensity(middle, np.asarray(np.linalg.cholesky(root @ root.T))))

    @property
    def prior(self) -> SSFPrior:
        """The prior of N Gaussians."""
        return self.space.prior

    def log_density_over_prior(self, theta: FloatArray) -> FloatArray:
        """Log of this density over the prior's, Gaussians sorted by mass: (n, 6 N + 2) -> (n,)."""
        x = self.space.enter(theta)
        return np.asarray(self.one.log_density(x) - self.space.leave(x)[1])

    def draw(self, rest: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Draw as many parameters as `rest` has rows, (n, 6 N + 2); nan where outside the prior."""
        theta, log_prior = self.space.leave(self.one.draw(len(rest), rng))
        theta[~np.isfinite(log_prior)] = np.nan
        return theta

    def propose_moves(self, here: FloatArray, *, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Propose a draw of this density to each particle, both (n, 6 N + 2), nan where outside the prior.

        Also return log density over prior at the particles minus that at the draws, (n,); -inf where there is no draw.
        """
        return propose_independently(self, here, rng=rng)
