"""What a reading at each setting promises: information, and how near it brings the sds that are asked for.

At each setting the samples of the posterior are sorted by the reading that they predict and put into groups. The
predictive density is the mixture of the groups, each as wide as its noise and its own spread together; means over it
are sums over the groups and over the nodes of a quadrature. Nothing is binned, so a reading that tells a hundredth of a
bit is valued as surely as one that tells ten.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from probewise._arrays import FloatArray
from probewise.inquiry.any_settings.noise import ReadingNoise

__all__ = ["Predictive"]

_N_GROUPS = 40
_N_OUTLIERS = 32
_BLOCK = 2_000_000  # densities held at a time
_LEAST_SHARE = 1e-9  # of the variance that rounding may leave


class Predictive:
    """Predictive distribution of the reading at each setting, of equally weighted samples of a posterior.

    Parameters
    ----------
    predicted, scale
        Predicted readings and sds of their noise, (n_samples, n_settings).
    noise
        The noise.
    """

    def __init__(self, predicted: FloatArray, scale: FloatArray, noise: ReadingNoise) -> None:
        n_groups = min(_N_GROUPS, len(predicted))
        n = len(predicted) // n_groups * n_groups
        self.noise = noise
        self._shape = (n_groups, n // n_groups)
        self._order = np.argsort(predicted[:n], axis=0)
        sorted_, scales = (np.take_along_axis(a[:n], self._order, axis=0) for a in (predicted, scale))
        grouped = sorted_.reshape(*self._shape, -1)
        self._centre = grouped.mean(axis=1)
        self._scale = np.sqrt((scales.reshape(*self._shape, -1) ** 2).mean(axis=1))
        self._width = np.sqrt(self._scale**2 + grouped.var(axis=1))

    def information(self) -> FloatArray:
        """Expected information about all parameters together, bits, (n_settings,)."""
        node, weight = self.noise.nodes
        alone = self._centre[:, None, :] + self._scale[:, None, :] * node[:, None]
        log_own = self.noise.log_density(alone, self._centre[:, None, :], self._scale[:, None, :])
        given = (weight[:, None] * log_own).sum(axis=1).mean(axis=0)
        mixed = np.concatenate([self._over_nodes(np.log(density)) for _, density, _ in self._blocks()])
        share = self.noise.outliers
        if share:
            outliers = self.noise.outlier_nodes(_N_OUTLIERS)[:, None, None]
            own = self.noise.log_density(outliers, self._centre, self._scale).mean(axis=(0, 1))
            given = (1 - share) * given + share * own
        return np.maximum(given - mixed, 0.0) / math.log(2)

    def distance(self, values: FloatArray, goal: FloatArray) -> FloatArray:
        """Expected distance from the goal after a reading, (n_settings,): the sum of ln(sd / goal) where above 0.

        Parameters
        ----------
        values
            What is to be known, (n_samples, n_values).
        goal
            The sd of each that is asked for, (n_values,).
        """
        n = self._order.shape[0]
        centred = values[:n] - values[:n].mean(axis=0)
        means, squares = [], []
        for value in centred.T:
            own = value[self._order].reshape(*self._shape, -1)
            means.append(own.mean(axis=1))
            squares.append((own**2).mean(axis=1))
        least = _LEAST_SHARE * (centred**2).mean(axis=0)
        out = np.zeros(self._order.shape[1])
        for rows, density, each in self._blocks():
            for mean, square, sd, at_least in zip(means, squares, goal, least, strict=True):
                given = np.einsum("gsn,gs->sn", each, mean[:, rows]) / density
                variance = np.einsum("gsn,gs->sn", each, square[:, rows]) / density - given**2
                far = 0.5 * np.log(np.maximum(variance, at_least)) - math.log(sd)
                out[rows] += self._over_nodes(np.maximum(far, 0.0))
        return out

    def _blocks(self) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """Yield settings by settings: rows, density of each node (n_rows, n_nodes), and each group's part of it."""
        n_groups, n_settings = self._centre.shape
        node = self.noise.nodes[0]
        outliers = self.noise.outlier_nodes(_N_OUTLIERS)
        n_nodes = n_groups * len(node) + len(outliers)
        size = max(1, _BLOCK // (n_groups * n_nodes))
        for start in range(0, n_settings, size):
            rows = slice(start, start + size)
            centre, width = self._centre[:, rows], self._width[:, rows]
            at = (centre[:, None, :] + width[:, None, :] * node[:, None]).reshape(-1, centre.shape[1]).T
            if len(outliers):
                at = np.concatenate([at, np.broadcast_to(outliers, (len(at), len(outliers)))], axis=1)
            each = np.exp(self.noise.log_density(at[None], centre[:, :, None], width[:, :, None])) / n_groups
            yield rows, each.sum(axis=0), each

    def _over_nodes(self, values: FloatArray) -> FloatArray:
        """Mean over the predictive distribution, (n_rows, n_nodes) -> (n_rows,)."""
        n_groups = len(self._centre)
        weight = np.tile(self.noise.nodes[1], n_groups) / n_groups
        core = values[:, : len(weight)] @ weight
        share = self.noise.outliers
        if not share:
            return np.asarray(core)
        return np.asarray((1 - share) * core + share * values[:, len(weight) :].mean(axis=1))
