"""A density that particles start from, and how draws of it are proposed to them later."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray
from probewise.calibration.priors import SSFPrior


class KnownDensity(Protocol):
    """A normalised density of N Gaussians that particles start from."""

    @property
    def prior(self) -> SSFPrior:
        """Of N Gaussians."""
        ...

    def log_over_prior(self, theta: FloatArray) -> FloatArray:
        """Log of the density over the prior's sorted one, up to what `log_z_below` counts; (n, 6 N + 2) -> (n,)."""
        ...

    def draw(self, rest: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Draw one for each sample of the order below, (n, 6 N - 4) -> (n, 6 N + 2); nan: impossible."""
        ...

    def propose(self, here: FloatArray, *, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Propose afresh, (n, 6 N + 2); and log density of the old over that of the new, over the prior's, (n,)."""
        ...


def independent_proposal(
    density: KnownDensity, here: FloatArray, *, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Draw from a density whatever the particles are, (n, 6 N + 2).

    Returns
    -------
    The draws, nan where outside the prior, and the log density of the old over that of the new, both over the prior's,
    (n,); -inf where there is no draw.
    """
    there = density.draw(here, rng=rng)
    log_drawn = np.full(len(here), -np.inf)
    rows = np.flatnonzero(np.isfinite(there).all(axis=1))
    log_drawn[rows] = density.log_over_prior(here[rows]) - density.log_over_prior(there[rows])
    return there, log_drawn
