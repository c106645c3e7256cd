"""Weigh hypotheses: Laplace evidence of a fit, closed-form Bayes factors of what could be added to it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, logsumexp

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.fit import Fit
from probewise.diagnosis.noise import NoiseModel, Whitener

__all__ = ["SCALES", "Blocks", "Linearised", "NoiseEvidence", "block_log_bayes_factors", "weigh"]

SCALES = np.geomspace(0.05, 25.0, 8)
"""Prior scales of an effect's rms, in noise sd: a mixture with a heavy tail."""


@dataclass(frozen=True, eq=False)
class NoiseEvidence:
    """Log evidence of a fit under one noise model, and where among its nodes the evidence lies."""

    noise: NoiseModel
    log_z: float
    log_z_nodes: FloatArray

    @property
    def weights(self) -> FloatArray:
        """Posterior weight of each node."""
        return np.exp(self.log_z_nodes - logsumexp(self.log_z_nodes))

    @property
    def whitener(self) -> Whitener:
        """The most probable node's."""
        return self.noise.whiteners[int(np.argmax(self.log_z_nodes))]


def weigh(found: Fit, noise: NoiseModel, *, sd_floor: float) -> NoiseEvidence:
    """Integrate a fit's likelihood over its parameters (Laplace), the noise sd, and the noise model's nodes.

    At each node the fit is carried to its new optimum by the linearised model, so that a correlation
    is judged without the bias of residuals that were fitted as if white.
    """
    n_points = len(found.residuals)
    joined = np.concatenate([found.slopes, found.residuals[:, None]], axis=1)
    p = found.slopes.shape[1]
    eye = np.eye(p)
    constant = float(gammaln(n_points / 2)) - 0.5 * n_points * math.log(math.pi) + found.model.sensor.log_multiplicity
    out = np.empty(len(noise.whiteners))
    for node, whitener in enumerate(noise.whiteners):
        turned = whitener(joined)
        gram = turned.T @ turned
        jj, jr, rr = gram[:p, :p], gram[:p, p], float(gram[p, p])
        floor = n_points * sd_floor**2
        rss = rr + floor
        for _ in range(3):
            variance = rss / n_points
            curvature = jj / variance + eye
            step = np.linalg.solve(curvature, jr / variance - found.z)
            rss = max(rr - 2 * float(step @ jr) + float(step @ jj @ step), 0.0) + floor
        _, log_det = np.linalg.slogdet(curvature)
        z = found.z + step
        out[node] = constant - 0.5 * n_points * math.log(rss) - whitener.log_det() - 0.5 * float(z @ z) - 0.5 * log_det
    return NoiseEvidence(noise, float(logsumexp(out)) - math.log(len(out)), out)


@dataclass(frozen=True, eq=False)
class Linearised:
    """A fit as a linear Gaussian problem whose parameters are projected out, prior included.

    Rows are the whitened readings in units of the noise sd, then one row for each parameter's prior.
    Under the null every row is standard normal, so r* = P eps needs no refit.
    """

    basis: FloatArray  # Q of the augmented slopes, (n_rows, n_params)
    residual: FloatArray  # P r, (n_rows,)
    whitener: Whitener
    sd: float
    n_points: int

    @classmethod
    def of(cls, found: Fit, whitener: Whitener) -> Linearised:
        """Linearise about a fit."""
        whitened = whitener(found.residuals)
        n_points, p = found.slopes.shape
        sd = math.sqrt(float(whitened @ whitened) / max(n_points - p, 1)) or found.sd
        basis, _ = np.linalg.qr(np.concatenate([whitener(found.slopes) / sd, np.eye(p)]))
        augmented = np.concatenate([whitened / sd, -found.z])
        return cls(basis, augmented - basis @ (basis.T @ augmented), whitener, sd, n_points)

    @property
    def n_rows(self) -> int:
        """Readings and priors."""
        return len(self.basis)

    def project(self, columns: FloatArray) -> FloatArray:
        """Whiten columns of readings (n_points, k) and project the fit's parameters out: (n_rows, k)."""
        return self.without_fit(self.whitener(columns) / self.sd)

    def without_fit(self, whitened: FloatArray) -> FloatArray:
        """Project the fit's parameters out of columns in units of the noise sd: (n_points, k) -> (n_rows, k)."""
        out = -self.basis @ (self.basis[: self.n_points].T @ whitened)
        out[: self.n_points] += whitened
        return out

    def absorbed(self, found: Fit, change: FloatArray) -> FloatArray:
        """Move the fit's coordinates so that a change of the readings (n_points,) is taken up, (n_params,)."""
        slopes = self.whitener(found.slopes) / self.sd
        shift = slopes.T @ (self.whitener(found.residuals - change) / self.sd) - found.z
        return np.asarray(np.linalg.solve(slopes.T @ slopes + np.eye(len(found.z)), shift))

    def draws(self, n_draws: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw residuals under the null, shape (n_rows, n_draws)."""
        eps = rng.standard_normal((self.n_rows, n_draws))
        return eps - self.basis @ (self.basis.T @ eps)


@dataclass(frozen=True, eq=False)
class Blocks:
    """Templates made orthonormal: columns `u` (n_rows, n_columns) in blocks, `gain` the surviving share.

    `gain` (n_columns,) is the squared length of what survives of a template of unit rms (times
    n_points); `starts` (n_blocks,) is the first column of each block; `label` says what each block is.
    """

    u: FloatArray
    gain: FloatArray
    starts: IntArray
    labels: tuple[str, ...]
    share: FloatArray  # surviving share of each block's norm, (n_blocks,)

    @classmethod
    def of(cls, problem: Linearised, templates: Sequence[FloatArray], labels: Sequence[str]) -> Blocks:
        """Whiten, scale to unit rms, project, and orthonormalise each template (n_points, k) by itself."""
        widths = [t.shape[1] for t in templates]
        whitened = problem.whitener(np.concatenate(templates, axis=1))
        per_column = np.repeat(widths, widths)
        norms = np.sqrt(np.einsum("ij,ij->j", whitened, whitened))
        whitened *= np.sqrt(problem.n_points / per_column) / np.where(norms > 0, norms, 1.0)
        projected = problem.without_fit(whitened)
        starts = np.concatenate([[0], np.cumsum(widths)[:-1]])
        u, gain = np.empty_like(projected), np.empty(len(per_column))
        for width in set(widths):  # all templates of one width at a time
            columns = (starts[np.array(widths) == width, None] + np.arange(width)).ravel()
            u[:, columns], gain[columns] = _orthonormal(projected[:, columns], width)
        shares = np.sqrt(np.add.reduceat(gain, starts) / problem.n_points)
        return cls(u, gain, starts, tuple(labels), shares)


def _orthonormal(columns: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
    """Orthonormalise neighbours, `width` at a time: (n_rows, n_columns) and squared lengths (n_columns,).

    By the eigenvectors of their products. What is shorter than a millionth is not there: its column is 0.
    """
    blocks = columns.reshape(len(columns), -1, width)
    squares, axes = np.linalg.eigh(np.einsum("ibj,ibk->bjk", blocks, blocks, optimize=True))
    per_length = np.where(squares > 1e-12, 1 / np.sqrt(np.maximum(squares, 1e-12)), 0.0)
    u = np.einsum("ibj,bjk->ibk", blocks, axes * per_length[:, None, :], optimize=True)
    return u.reshape(columns.shape), np.maximum(squares, 0.0).ravel()


def block_log_bayes_factors(blocks: Blocks, residuals: FloatArray, n_points: int) -> FloatArray:
    """Weigh each block against the null, its amplitude and the noise sd integrated out.

    An amplitude whose template has unit rms is normal with sd kappa noise sd, kappa mixed over
    `SCALES`; the noise sd marginalised makes it a Student-t.

    Parameters
    ----------
    blocks
        The templates.
    residuals
        Projected residuals, shape (n_rows, n_draws).
    n_points
        Number of readings.

    Returns
    -------
    Log Bayes factors, shape (n_blocks, n_draws).
    """
    scores = (blocks.u.T @ residuals) ** 2
    total = np.maximum(np.sum(residuals**2, axis=0), 1e-300)
    terms = np.empty((len(SCALES), len(blocks.starts), residuals.shape[1]))
    for k, scale in enumerate(SCALES):
        ratio = scale**2 * blocks.gain
        occam = np.add.reduceat(0.5 * np.log1p(ratio), blocks.starts)
        explained = np.add.reduceat(scores * (ratio / (1 + ratio))[:, None], blocks.starts, axis=0) / total
        terms[k] = -occam[:, None] - 0.5 * n_points * np.log1p(-np.minimum(explained, 1 - 1e-12))
    top = terms.max(axis=0)
    return np.asarray(top + np.log(np.exp(terms - top).mean(axis=0)))
