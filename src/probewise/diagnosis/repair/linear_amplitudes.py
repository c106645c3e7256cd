"""Draws from the linearised posterior of a fit, in which amplitudes are linear in their value.

Readings are linear in an amplitude, but the coordinate of an amplitude with a heavy-tailed prior is a steep function of
its value about 0: a normal distribution of the coordinate there becomes one of values that is far too wide. The prior
is a mixture of normal distributions. Given the component of each amplitude, the values are jointly normal; given the
values, the components are independent. They are drawn in turn (Gibbs sampling).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy.special import ndtr, ndtri

from probewise._arrays import FloatArray
from probewise.diagnosis.fitting.fit import Fit
from probewise.effects import HeavyTailedPrior, NamedEffect
from probewise.sensor.stages import effects_with_columns

_STRAIGHT = 0.2  # sd of a coordinate within which its value is as good as linear in it
_SWEEPS = 10
_ROUNDING = 1e-12  # of the curvature, by which that of readings fitted exactly may fail to be positive


@dataclass(frozen=True, eq=False)
class LinearAmplitudes:
    """Amplitudes of a fit whose posterior is wide in their coordinate.

    `at` (n,): numbers of their coordinates; `priors`: their heavy-tailed priors; `values` (n,): the fit's; `per_z`
    (n,): derivatives of their values by their coordinates there.
    """

    at: tuple[int, ...]
    priors: tuple[HeavyTailedPrior, ...]
    values: FloatArray
    per_z: FloatArray

    @classmethod
    def of(cls, found: Fit, coordinate_sd: FloatArray) -> Self | None:
        """Find those of a fit, whose coordinates have these posterior sds (n_params,); None if there is none."""
        priors: dict[int, HeavyTailedPrior] = {}
        for effect, columns in effects_with_columns(found.model.effects, found.model.sensor.n_params):
            for k, prior in _two_sided_amplitude_priors(effect).items():
                if coordinate_sd[columns.start + k] > _STRAIGHT:
                    priors[columns.start + k] = prior
        if not priors:
            return None
        z = found.z[list(priors)]
        values = np.array([prior.from_unit(ndtr(one)) for prior, one in zip(priors.values(), z, strict=True)])
        log_density = np.array([prior.log_prob(one) for prior, one in zip(priors.values(), values, strict=True)])
        per_z = np.exp(-0.5 * z**2 - log_density) / np.sqrt(2 * np.pi)
        return cls(tuple(priors), tuple(priors.values()), values, per_z)

    def draw(
        self, found: Fit, slopes: FloatArray, residual: FloatArray, n_samples: int, *, rng: np.random.Generator
    ) -> FloatArray:
        """Draw coordinates, (n_samples, n_params), from the posterior of the linearised problem.

        Parameters
        ----------
        found
            The fit.
        slopes, residual
            Whitened slopes (n_points, n_params) and residuals (n_points,), in noise sds.
        n_samples
            Number of draws, each the end of a chain of its own.
        rng
            Source of randomness.
        """
        at, typical = list(self.at), np.array([prior.typical for prior in self.priors])
        # The unknowns are the values of the amplitudes, in typical sizes, and the coordinates of all else.
        x, by_x = found.z.copy(), slopes.copy()
        x[at] = self.values / typical
        by_x[:, at] *= typical / self.per_z
        curvature, downhill = by_x.T @ by_x, by_x.T @ (residual + by_x @ x)
        sds = np.stack([prior.component_sds / prior.typical for prior in self.priors])  # (n_amplitudes, n_components)
        drawn, precision = np.tile(x, (n_samples, 1)), np.ones((n_samples, len(x)))
        own = np.arange(len(x))
        for _ in range(_SWEEPS):
            log_weight = -0.5 * (drawn[:, at, None] / sds) ** 2 - np.log(sds)
            component = np.argmax(log_weight + rng.gumbel(size=log_weight.shape), axis=2)
            precision[:, at] = sds[np.arange(len(at)), component] ** -2
            every = np.repeat(curvature[None], n_samples, axis=0)
            every[:, own, own] += precision + _ROUNDING * np.diag(curvature)
            # Of the mean plus a draw of covariance 1 / every: one solution with a right side of covariance `every`.
            root = np.linalg.cholesky(every)
            noise = np.einsum("nij,nj->ni", root, rng.standard_normal(drawn.shape))
            drawn = np.linalg.solve(every, (downhill + noise)[:, :, None])[:, :, 0]
        for k, prior in zip(at, self.priors, strict=True):
            drawn[:, k] = ndtri(prior.to_unit(drawn[:, k] * prior.typical))
        return drawn


def _two_sided_amplitude_priors(effect: NamedEffect[Any]) -> dict[int, HeavyTailedPrior]:
    """Return the heavy-tailed priors of the amplitudes that may have either sign, by the number of the parameter."""
    marginals = list(getattr(effect.prior, "marginals", {}).values())
    own = {k: marginals[k] for k in effect.amplitudes if k < len(marginals)}
    return {k: prior for k, prior in own.items() if isinstance(prior, HeavyTailedPrior) and not prior.positive}
