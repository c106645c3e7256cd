"""Weigh hypotheses: Laplace evidence of a fit, closed-form Bayes factors of what could be added to it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.fitting.fit import Fit, residual_degrees_of_freedom
from probewise.diagnosis.fitting.null import log_multiplicity
from probewise.diagnosis.noise.law import NoiseLaw, forms
from probewise.diagnosis.noise.models import NoiseModel, NoiseNodes

__all__ = [
    "LEAST_VISIBLE",
    "SCALES",
    "Blocks",
    "Linearised",
    "NoiseEvidence",
    "block_log_bayes_factors",
    "covariance_root",
    "mix_scales",
    "orthonormal",
    "project_scaled",
    "weigh",
]

SCALES = np.geomspace(0.05, 25.0, 8)
"""Prior scales of an effect's rms, in noise sd: a mixture with a heavy tail."""

LEAST_VISIBLE = 4.0
"""Least size (lambda) of what counts as an effect: there the alarm at one in a hundred sees more than it misses."""

_INVISIBLE = -50.0  # log Bayes factor of a template of which nothing survives


_ROUNDING = 1e-12
_MOST_NUMBERS = 4_000_000  # held at once, of the slopes under several laws


@dataclass(frozen=True, eq=False)
class NoiseEvidence:
    """Log evidence of a fit under one noise model, and where among its nodes the evidence lies.

    A model that cannot be (none of its nodes fits these readings) has no nodes, and log evidence minus infinity.
    """

    noise: NoiseModel
    log_z: float
    log_z_nodes: FloatArray
    nodes: NoiseNodes

    @property
    def weights(self) -> FloatArray:
        """Posterior weight of each node."""
        return np.exp(self.log_z_nodes - logsumexp(self.log_z_nodes))

    def likely_nodes(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Give up to four nodes of one effect that hold most, (n_nodes, n_params), and the log weight of each."""
        own = self.nodes.settings[:, self.noise.columns_of(name)]
        settings, node_of = np.unique(own, axis=0, return_inverse=True)
        node_of = node_of.ravel()
        weights = np.bincount(node_of, self.weights)
        top = float(self.nodes.log_weights.max())
        log_prior = top + np.log(np.bincount(node_of, np.exp(self.nodes.log_weights - top)))
        best = np.argsort(-weights)[:4]
        return settings[best], log_prior[best] - math.log(float(weights[best].sum()))

    @property
    def law(self) -> NoiseLaw:
        """The most probable node's."""
        return self.nodes.laws[int(np.argmax(self.log_z_nodes))]

    @property
    def at_best(self) -> NoiseEvidence:
        """The most probable node alone."""
        at = [int(np.argmax(self.log_z_nodes))]
        own = NoiseNodes(self.nodes.settings[at], (self.law,), self.nodes.log_weights[at])
        return NoiseEvidence(self.noise, self.log_z, self.log_z_nodes[at], own)


def weigh(found: Fit, noise: NoiseModel) -> NoiseEvidence:
    """Integrate a fit's likelihood over its parameters and the noise sd (Laplace), and the noise model's nodes.

    At each node the fit is carried to its new optimum by the linearised model, so that a correlation
    is judged without the bias of residuals that were fitted as if white. Where the floor of the sd is above what is
    left, the integral over the sd is taken to be as wide as elsewhere.
    """
    every = noise.laws(found.predicted)
    joined = np.concatenate([found.slopes, found.residuals[:, None]], axis=1)
    out = np.empty(len(every.laws))
    normal = [node for node, law in enumerate(every.laws) if law.tail.is_normal]
    chunk = max(_MOST_NUMBERS // joined.size, 1)
    for nodes in (normal[at : at + chunk] for at in range(0, len(normal), chunk)):
        out[nodes] = _of_normal_laws(found, [every.laws[node] for node in nodes], joined)
    tailed: dict[tuple[tuple[bytes, ...], bool], list[int]] = {}  # by whitening, flat tops apart
    for node in sorted({*range(len(out))} - {*normal}):
        law = every.laws[node]
        tailed.setdefault((law.linear, law.flat > 0), []).append(node)
    for nodes in tailed.values():
        out[nodes] = _of_tails(found, [every.laws[node] for node in nodes], joined)
    out += [law.log_extra for law in every.laws]
    out += every.log_weights + log_multiplicity(found.model.sensor)
    return NoiseEvidence(noise, float(logsumexp(out)) if out.size else -math.inf, out, every)


def covariance_root(slopes: FloatArray, variance: float) -> FloatArray:
    """Take a square root of the covariance of a fit's coordinates by Laplace, root root^T, (n_params, n_params).

    Of whitened slopes (n_points, n_params), and the variance of a whitened reading.
    """
    curvature = slopes.T @ slopes / variance + np.eye(slopes.shape[1])
    return np.asarray(np.linalg.inv(np.linalg.cholesky(curvature)).T)


def _of_normal_laws(found: Fit, laws: Sequence[NoiseLaw], joined: FloatArray) -> FloatArray:
    """Weigh a fit under laws without a tail, (n_laws,); `joined` are slopes and residual, (n_points, n_params + 1)."""
    p, n_points = joined.shape[1] - 1, np.array([law.n_points for law in laws])
    if any(law.walk.size for law in laws):
        turned = np.stack([law(joined) for law in laws])
    else:
        turned = joined * np.stack([law.kept / law.sd for law in laws])[:, :, None]
    if any(law.carry.any() for law in laws) and not any(law.walk.size for law in laws):
        carry = np.stack([law.carry for law in laws])[:, 1:, None]
        turned[:, 1:] = (turned[:, 1:] - carry * turned[:, :-1]) / np.sqrt(1 - carry**2)
    gram = turned.transpose(0, 2, 1) @ turned
    jj, jr, rr = gram[:, :p, :p], gram[:, :p, p], gram[:, p, p]
    steps, least = np.zeros_like(jr), np.array([law.floor**2 for law in laws])

    def squares() -> FloatArray:
        rss = rr - 2 * np.sum(steps * jr, axis=1) + np.einsum("lp,lpq,lq->l", steps, jj, steps)
        return np.asarray(np.maximum(rss, 0.0))

    for _ in range(3):
        variance = np.maximum(squares() / n_points, least)
        curvature = jj / variance[:, None, None] + np.eye(p)
        steps = _solved(curvature, jr / variance[:, None] - found.z)
    fit_and_prior = _peak(found.z + steps, curvature, n_points) - [law.log_det() for law in laws]
    rss = squares()
    variance = np.maximum(rss / n_points, least)
    misfit = 0.5 * n_points * np.log(variance) + 0.5 * rss / variance
    return np.asarray(fit_and_prior - misfit + 0.5 * np.log(math.pi / n_points))


def _of_tails(found: Fit, laws: Sequence[NoiseLaw], joined: FloatArray) -> FloatArray:
    """Weigh a fit under laws of one whitening that differ in their tails or flat tops, (n_laws,)."""
    turned = laws[0](joined)
    p, n_points = turned.shape[1] - 1, laws[0].n_points
    slopes, residual = turned[:, :p], turned[:, p:]
    gram = slopes.T @ slopes
    tail, least = forms(laws), laws[0].floor
    steps, sigma = np.zeros((p, len(laws))), tail.scale(residual, n_points, floor=least)
    for _ in range(3):
        left = residual - slopes @ steps
        sigma = tail.scale(left, n_points, floor=least, start=sigma)
        variance = sigma**2 / tail.information
        curvature = gram / variance[:, None, None] + np.eye(p)
        downhill = slopes.T @ tail.as_normal(left, sigma) / variance - found.z[:, None] - steps
        steps += _solved(curvature, downhill.T).T
    left = residual - slopes @ steps
    sigma = tail.scale(left, n_points, floor=least, start=sigma)
    fit_and_prior = _peak((found.z[:, None] + steps).T, curvature, n_points) - laws[0].log_det()
    scale = 0.5 * np.log(2 * math.pi / tail.scale_curvature(left, sigma, n_points))
    return np.asarray(fit_and_prior - tail.misfit(left, sigma, n_points) + scale)


def _solved(curvature: FloatArray, downhill: FloatArray) -> FloatArray:
    """Take the steps to the peaks, (n_laws, n_params), of curvatures (n_laws, n_params, n_params)."""
    try:
        return np.asarray(np.linalg.solve(curvature, downhill[:, :, None])[:, :, 0])
    except np.linalg.LinAlgError:  # readings that are met exactly: beside their weight a prior's is lost in rounding
        size = np.trace(curvature, axis1=1, axis2=2)[:, None, None] / curvature.shape[1]
        ridge = _ROUNDING * size * np.eye(curvature.shape[1])
        return np.asarray(np.linalg.solve(curvature + ridge, downhill[:, :, None])[:, :, 0])


def _peak(z: FloatArray, curvature: FloatArray, n_points: int | IntArray) -> FloatArray:
    """Give what Laplace's approximation makes of peaks at z (n_laws, n_params), and the densities' constant."""
    widths = -0.5 * np.linalg.slogdet(curvature)[1]
    return np.asarray(widths - 0.5 * np.sum(z**2, axis=1) - 0.5 * n_points * math.log(2 * math.pi))


@dataclass(frozen=True, eq=False)
class Linearised:
    """A fit as a linear Gaussian problem whose parameters are projected out, prior included.

    Rows are the whitened readings in units of the noise sd, then one row for each parameter's prior.
    Under the null every row is standard normal, so r* = P eps needs no refit.
    """

    basis: FloatArray  # Q of the augmented slopes, (n_rows, n_params)
    residual: FloatArray  # P r, (n_rows,)
    law: NoiseLaw
    sd: float
    n_points: int

    @classmethod
    def of(cls, found: Fit, law: NoiseLaw, beside: FloatArray | None = None) -> Linearised:
        """Linearise about a fit; `beside` are slopes (n_points, k) by coordinates that it has not, taken to be 0."""
        slopes, z = found.slopes, found.z
        if beside is not None:
            slopes, z = np.concatenate([slopes, beside], axis=1), np.concatenate([z, np.zeros(beside.shape[1])])
        n_points, p = slopes.shape
        whitened = law(found.residuals)[:, None]
        turned, sigma = law(slopes), law.scale(whitened)
        known = bool(law.flat) or (law.least > 0 and float(sigma[0]) <= law.floor)
        sigma = np.where(sigma > 0, sigma, found.sd)
        free = residual_degrees_of_freedom(turned, float(sigma[0]) / math.sqrt(law.information))
        sigma = sigma if known else sigma * math.sqrt(n_points / free)
        sd = float(sigma[0]) / math.sqrt(law.information)
        basis, _ = np.linalg.qr(np.concatenate([turned / sd, np.eye(p)]))
        augmented = np.concatenate([law.pseudo(whitened, sigma)[:, 0] / sd, -z])
        residual = augmented - basis @ (basis.T @ augmented)
        if known:
            # What says less than so many readings should, flat at the top, does not make the noise smaller.
            rest = math.sqrt(max(free - float(residual @ residual), 0.0))
            basis, residual = np.concatenate([basis, np.zeros((1, p))]), np.append(residual, rest)
        return cls(basis, residual, law, sd, n_points)

    @property
    def n_rows(self) -> int:
        """Readings and priors."""
        return len(self.basis)

    def project(self, columns: FloatArray) -> FloatArray:
        """Whiten columns of readings (n_points, k) and project the fit's parameters out: (n_rows, k)."""
        return self.without_fit(self.law(columns) / self.sd)

    def without_fit(self, whitened: FloatArray) -> FloatArray:
        """Project the fit's parameters out of columns in units of the noise sd: (n_points, k) -> (n_rows, k)."""
        out = -self.basis @ (self.basis[: self.n_points].T @ whitened)
        out[: self.n_points] += whitened
        return out

    def absorbed(self, found: Fit, change: FloatArray) -> FloatArray:
        """Move the fit's coordinates so that a change of the readings (n_points,) is taken up, (n_params,)."""
        slopes = self.law(found.slopes) / self.sd
        left = self.law(found.residuals - change)[:, None]
        normal = self.law.as_normal(left, np.array([self.sd * math.sqrt(self.law.information)]))[:, 0]
        shift = slopes.T @ (normal / self.sd) - found.z
        return np.asarray(np.linalg.solve(slopes.T @ slopes + np.eye(len(found.z)), shift))

    def draws(self, n_draws: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw residuals under the null, shape (n_rows, n_draws)."""
        eps = np.concatenate(
            [self.law.draws(n_draws, rng=rng), rng.standard_normal((self.n_rows - self.n_points, n_draws))]
        )
        return np.asarray(eps - self.basis @ (self.basis.T @ eps))


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
        return cls.of_projected(project_scaled(problem, templates), [t.shape[1] for t in templates], labels, problem)

    @classmethod
    def of_projected(
        cls, projected: FloatArray, widths: Sequence[int], labels: Sequence[str], problem: Linearised
    ) -> Blocks:
        """Orthonormalise templates that `project_scaled` gave, side by side (n_rows, n_columns), each by itself."""
        starts = np.concatenate([[0], np.cumsum(widths)[:-1]]).astype(np.int64)
        u, gain = np.empty_like(projected), np.empty(projected.shape[1])
        for width in set(widths):  # all templates of one width at a time
            columns = (starts[np.array(widths) == width, None] + np.arange(width)).ravel()
            u[:, columns], gain[columns] = orthonormal(projected[:, columns], width)
        shares = np.sqrt(np.add.reduceat(gain, starts) / problem.n_points)
        return cls(u, gain, starts, tuple(labels), shares)


def project_scaled(problem: Linearised, templates: Sequence[FloatArray]) -> FloatArray:
    """Whiten templates (n_points, k), scale each to unit rms, project the fit out: side by side (n_rows, n_columns)."""
    widths = [t.shape[1] for t in templates]
    whitened = problem.law(np.concatenate(templates, axis=1))
    per_column = np.repeat(widths, widths)
    norms = np.sqrt(np.einsum("ij,ij->j", whitened, whitened))
    whitened *= np.sqrt(problem.n_points / per_column) / np.where(norms > 0, norms, 1.0)
    return problem.without_fit(whitened)


def orthonormal(
    columns: FloatArray, width: int, *, least: float = 1e-12, share: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Orthonormalise neighbours, `width` at a time: (n_rows, n_columns) and squared lengths (n_columns,).

    By the eigenvectors of their products. What is no longer than `least`, or than a `share` of the longest of its
    block, both squared, is not there: its column is 0.
    """
    blocks = columns.reshape(len(columns), -1, width)
    squares, axes = np.linalg.eigh(np.einsum("ibj,ibk->bjk", blocks, blocks, optimize=True))
    there = squares > np.maximum(share * squares[:, -1:], least)
    per_length = np.where(there, 1 / np.sqrt(np.maximum(squares, least)), 0.0)
    u = np.einsum("ibj,bjk->ibk", blocks, axes * per_length[:, None, :], optimize=True)
    return u.reshape(columns.shape), np.maximum(squares, 0.0).ravel()


def block_log_bayes_factors(blocks: Blocks, residuals: FloatArray, n_points: int) -> FloatArray:
    """Weigh each block against the null, its amplitude and the noise sd integrated out.

    An amplitude whose template has unit rms is normal with sd kappa noise sd, kappa mixed over those of
    `SCALES` at which it can be seen; the noise sd marginalised makes it a Student-t.

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
    scores /= np.maximum(np.sum(residuals**2, axis=0), 1e-300)
    out = np.empty((len(blocks.starts), residuals.shape[1]))
    widths = np.diff(blocks.starts, append=len(scores))
    for width in np.unique(widths):  # all blocks of one width at a time
        members = np.flatnonzero(widths == width)
        columns = blocks.starts[members, None] + np.arange(width)
        out[members] = mix_scales(scores[columns], blocks.gain[columns], n_points)
    return out


def mix_scales(explained: FloatArray, gain: FloatArray, n_points: int) -> FloatArray:
    """Average the Bayes factors of templates of one width over the `SCALES` at which each can be seen.

    At a smaller one what survives of a template has an rms lambda below `LEAST_VISIBLE`. There the Bayes factor is
    near one whatever is read: it would keep alive what makes no difference.

    Parameters
    ----------
    explained
        Share of the residual's sum of squares along each axis, (n_templates, width, n_draws).
    gain
        Squared length of what survives along each axis, (n_templates, width).
    n_points
        Number of readings.

    Returns
    -------
    Log Bayes factors, (n_templates, n_draws).
    """
    terms = np.empty((len(SCALES), explained.shape[0], explained.shape[2]))
    visible = SCALES[:, None] ** 2 * gain.sum(axis=1) >= LEAST_VISIBLE**2
    for k, scale in enumerate(SCALES):
        ratio = scale**2 * gain
        of_all = np.einsum("bwd,bw->bd", explained, ratio / (1 + ratio))
        np.log1p(-np.minimum(of_all, 1 - 1e-12), out=terms[k])
        terms[k] *= -0.5 * n_points
        terms[k] -= 0.5 * np.log1p(ratio).sum(axis=1)[:, None]
    terms[~visible] = _INVISIBLE
    top = terms.max(axis=0)
    n_visible = np.maximum(np.count_nonzero(visible, axis=0), 1)[:, None]
    return np.asarray(top + np.log(np.exp(terms - top).sum(axis=0) / n_visible))
