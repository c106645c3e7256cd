"""A density that particles of SMC start from, and how draws from the density are proposed to particles later."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray
from probewise.calibration.priors import SSFPrior


class ReferenceDensity(Protocol):
    """A normalised density of N Gaussians that particles start from."""

    @property
    def prior(self) -> SSFPrior:
        """The prior of N Gaussians."""
        ...

    def log_density_over_prior(self, theta: FloatArray) -> FloatArray:
        """Log of the density over the prior's for Gaussians sorted by mass, (n, 6 N + 2) -> (n,).

        Where the particles start from samples of N - 1, ln Z of N - 1 is added.
        """
        ...

    def draw(self, rest: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Draw parameters of N for each sample `rest` of N - 1, (n, 6 N - 4) -> (n, 6 N + 2); nan: impossible.

        A density that needs no samples uses only the number of rows.
        """
        ...

    def propose_moves(self, here: FloatArray, *, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Propose new parameters for particles `here`, both (n, 6 N + 2); nan where there are none.

        Also return the log of the density over the prior's at `here`, minus that at the new parameters, (n,).
        """
        ...


def propose_independently(
    density: ReferenceDensity, here: FloatArray, *, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Draw from a density, independently of the particles `here`, (n, 6 N + 2).

    Return the draws, nan where outside the prior, and the log of the density over the prior's at `here`, minus that at
    the draws, (n,); -inf where there is no draw.
    """
    there = density.draw(here, rng=rng)
    log_drawn = np.full(len(here), -np.inf)
    rows = np.flatnonzero(np.isfinite(there).all(axis=1))
    log_drawn[rows] = density.log_density_over_prior(here[rows]) - density.log_density_over_prior(there[rows])
    return there, log_drawn
