"""Acquisition functions of a setting: expected information, and expected distance of the sds from a goal.

At each setting the posterior samples are sorted by the reading that they predict, and divided into groups; if the sd of
the noise is unknown, first by that sd, so that the noise of each group has its own scale. The predictive density is a
mixture with one component per group, whose variance is that of the noise plus that within the group; means over the
density are sums over groups and nodes of a quadrature over the noise. Nothing is binned, so a hundredth of a bit is
resolved as well as ten bits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from probewise._arrays import FloatArray
from probewise.inquiry.any_settings.noise import ReadingNoise

_N_GROUPS = 32
_N_GROUPS_BY_SD, _N_GROUPS_EACH = 8, 5  # where the sd of the noise is unknown
_N_OUTLIERS = 32
_BLOCK = 2_000_000  # densities held at a time
_LEAST_SHARE = 1e-9  # of the variance that rounding may leave


class Predictive:
    """Predictive distribution of the reading at each setting, of equally weighted samples of a posterior.

    `predicted`, `scale`: predicted readings and sds of their noise, (n_samples, n_settings).
    """

    def __init__(self, predicted: FloatArray, scale: FloatArray, noise: ReadingNoise) -> None:
        n_sds, each = (_N_GROUPS_BY_SD, _N_GROUPS_EACH) if noise.is_sd_inferred else (1, _N_GROUPS)
        n_sds = min(n_sds, len(predicted))
        n_groups = n_sds * min(each, len(predicted) // n_sds)
        n = len(predicted) // n_groups * n_groups
        self.noise = noise
        self._shape = (n_groups, n // n_groups)
        by_sd = np.argsort(scale[:n, 0]) if n_sds > 1 else np.arange(n)
        by_prediction = np.argsort(predicted[by_sd].reshape(n_sds, n // n_sds, -1), axis=1)
        self._order = np.take_along_axis(by_sd.reshape(n_sds, -1, 1), by_prediction, axis=1).reshape(n, -1)
        sorted_, scales = (np.take_along_axis(a[:n], self._order, axis=0) for a in (predicted, scale))
        grouped = self._grouped = sorted_.reshape(*self._shape, -1)
        self._centre = grouped.mean(axis=1)
        self._scale = np.sqrt((scales.reshape(*self._shape, -1) ** 2).mean(axis=1))
        self._width = np.sqrt(self._scale**2 + grouped.var(axis=1))
        self._read = self._predictions_at_nodes(grouped, noise.nodes_and_weights[1])

    def _predictions_at_nodes(self, grouped: FloatArray, weight: FloatArray) -> FloatArray:
        """Return the prediction of each group to which each noise node is added, (n_groups, n_nodes, n_settings).

        A group may hold samples far apart, with no sample near its mean. So each pair of nodes, above and below, is
        added to another sample's prediction, in turn from group to group. If the noise is wider than the group, these
        predictions are shifted and scaled to the group's mean and variance.
        """
        n_groups, size = self._shape
        n_pairs = (len(weight) + 1) // 2
        pair = np.minimum(np.arange(len(weight)), np.arange(len(weight))[::-1])
        turn = (pair + np.arange(n_groups)[:, None]) % n_pairs
        read = grouped[np.arange(n_groups)[:, None], (2 * turn + 1) * size // (2 * n_pairs)]
        own = weight[:, None]
        mean = (read * own).sum(axis=1, keepdims=True)
        spread = ((read - mean) ** 2 * own).sum(axis=1, keepdims=True)
        variance = self._width[:, None] ** 2 - self._scale[:, None] ** 2
        stretch = np.sqrt(np.divide(variance, spread, out=np.zeros_like(spread), where=spread > 0))
        hidden = variance < self._scale[:, None] ** 2
        return np.where(hidden, self._centre[:, None] + (read - mean) * stretch, read)

    def information(self) -> FloatArray:
        """Return the expected information about all parameters jointly, bits, (n_settings,)."""
        node, weight = self.noise.nodes_and_weights
        alone = self._centre[:, None, :] + self._scale[:, None, :] * node[:, None]
        log_own = self.noise.log_density(alone, self._centre[:, None, :], self._scale[:, None, :])
        given = (weight[:, None] * log_own).sum(axis=1).mean(axis=0)
        mixed = np.concatenate(
            [self._mean_over_nodes(np.log(density)) for _, _, density, _ in self._yield_density_blocks()]
        )
        share = self.noise.outliers
        if share:
            outliers = self.noise.outlier_nodes(_N_OUTLIERS)[:, None, None]
            own = self.noise.log_density(outliers, self._centre, self._scale).mean(axis=(0, 1))
            given = (1 - share) * given + share * own
        return np.asarray(np.maximum(given - mixed, 0.0) / math.log(2))

    def expected_nats_above_goal(self, values: FloatArray, goal: FloatArray) -> FloatArray:
        """Return the expected distance from the goal after a reading, nats, (n_settings,).

        The distance is the sum over quantities of ln(sd / goal), 0 where an sd is below its goal.

        Parameters
        ----------
        values
            Posterior samples of the quantities in the goal, (n_samples, n_values).
        goal
            Target sd of each, (n_values,).
        """
        n = self._order.shape[0]
        centred = values[:n] - values[:n].mean(axis=0)
        lines = [self._regress_on_reading(value) for value in centred.T]
        least = _LEAST_SHARE * (centred**2).mean(axis=0)
        out = np.zeros(self._order.shape[1])
        for rows, at, density, each in self._yield_density_blocks():
            for (level, slope, rest), sd, at_least in zip(lines, goal, least, strict=True):
                a, b, r = level[:, rows], slope[:, rows], rest[:, rows]
                mean, by_reading, square, both, curve = (
                    np.einsum("gsn,gs->sn", each, part) / density for part in (a, b, a**2 + r, 2 * a * b, b**2)
                )
                variance = square + at * (both + at * curve) - (mean + at * by_reading) ** 2
                far = 0.5 * np.log(np.maximum(variance, at_least)) - math.log(sd)
                out[rows] += self._mean_over_nodes(np.maximum(far, 0.0))
        return out

    def _regress_on_reading(self, value: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Regress values, (n_samples,), on the reading in each group; return level, slope and residual variance.

        Each is (n_groups, n_settings). Within a group, value and reading are assumed jointly Gaussian.
        """
        own = value[self._order].reshape(*self._shape, -1)
        mean = own.mean(axis=1)
        together = ((own - mean[:, None]) * (self._grouped - self._centre[:, None])).mean(axis=1)
        slope = together / self._width**2
        return mean - slope * self._centre, slope, own.var(axis=1) - slope * together

    def _yield_density_blocks(self) -> Iterator[tuple[slice, FloatArray, FloatArray, FloatArray]]:
        """Yield for blocks of settings: their slice, nodes, predictive density there, and each group's part of it.

        Nodes and density are (n_rows, n_nodes); the parts, (n_groups, n_rows, n_nodes), sum to the density.
        """
        n_groups, n_settings = self._centre.shape
        node = self.noise.nodes_and_weights[0]
        outliers = self.noise.outlier_nodes(_N_OUTLIERS)
        n_nodes = n_groups * len(node) + len(outliers)
        size = max(1, _BLOCK // (n_groups * n_nodes))
        for start in range(0, n_settings, size):
            rows = slice(start, start + size)
            centre, width = self._centre[:, rows], self._width[:, rows]
            at = self._read[..., rows] + self._scale[:, None, rows] * node[:, None]
            at = at.reshape(-1, centre.shape[1]).T
            if len(outliers):
                at = np.concatenate([at, np.broadcast_to(outliers, (len(at), len(outliers)))], axis=1)
            each = np.exp(self.noise.log_density(at[None], centre[:, :, None], width[:, :, None])) / n_groups
            yield rows, at, each.sum(axis=0), each

    def _mean_over_nodes(self, values: FloatArray) -> FloatArray:
        """Average values at the nodes over the predictive distribution, (n_rows, n_nodes) -> (n_rows,)."""
        n_groups = len(self._centre)
        weight = np.tile(self.noise.nodes_and_weights[1], n_groups) / n_groups
        core = values[:, : len(weight)] @ weight
        share = self.noise.outliers
        if not share:
            return np.asarray(core)
        return np.asarray((1 - share) * core + share * values[:, len(weight) :].mean(axis=1))
