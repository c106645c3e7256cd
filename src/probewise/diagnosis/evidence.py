"""Evidence of a fit under noise models, by Laplace's method and on held-out readings; and the fit linearised.

The nodes of a noise model's prior serve every fit. Many readings determine the noise better than its nodes lie apart:
all nodes miss the peak, the evidence is too low, and the tests of the fit assume a noise that is wrong. There adaptive
Gauss-Hermite quadrature (Naylor & Smith 1982) finds the peak and puts three nodes there along each such parameter.

Of readings whole parts are held out, since rows chosen at random would leak information.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr, logsumexp

from probewise._arrays import ROUNDING, TINY, BoolArray, FloatArray, IntArray
from probewise.diagnosis.fit import Fit, fit, residual_degrees_of_freedom, with_prior
from probewise.diagnosis.noise import (
    LEAST_SCALE,
    NoiseLaw,
    NoiseModel,
    NoiseNodes,
    SdPrior,
    innovations_given_rest,
    stacked_density,
    whiten_under_each,
)
from probewise.effects import NoiseEffect
from probewise.effects.effect import LEAST_VISIBLE
from probewise.recordings.plan import Recording
from probewise.sensor.stages import effects_with_columns

SCALES = np.geomspace(0.05, 25.0, 8)  # prior scales of an effect's rms, in noise sds: a mixture with a heavy tail

NUMBERS = 4_000_000  # readings or slopes that are predicted or whitened at once, to fit in memory


@dataclass(frozen=True, eq=False)
class NoiseEvidence:
    """Log evidence of a fit under one noise model, in total and by node (a setting of the model's parameters).

    An impossible model (none of its nodes fits these readings) has no nodes and log evidence minus infinity. `peak`:
    the likeliest log of a reading's sd, rounding included, and its variance, (2, n_nodes); (2, 0) without prior of it.
    """

    noise: NoiseModel
    log_z: float
    log_z_nodes: FloatArray
    nodes: NoiseNodes
    peak: FloatArray

    @property
    def weights(self) -> FloatArray:
        """Posterior probability of each node, (n_nodes,)."""
        return np.exp(self.log_z_nodes - logsumexp(self.log_z_nodes))

    def likeliest_nodes_of_effect(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Return the (up to) four likeliest settings of one noise effect, (n_nodes, n_params), and log prior weights.

        These weights are raised by a constant, so that the evidence of the returned settings alone is that of all.
        """
        own = self.nodes.settings[:, self.noise.columns_of_effect(name)]
        settings, node_of = np.unique(own, axis=0, return_inverse=True)
        node_of = node_of.ravel()
        weights = np.bincount(node_of, self.weights)
        top = float(self.nodes.log_weights.max())
        log_prior = top + np.log(np.bincount(node_of, np.exp(self.nodes.log_weights - top)))
        best = np.argsort(-weights)[:4]
        return settings[best], log_prior[best] - math.log(float(weights[best].sum()))

    @property
    def likeliest_law(self) -> NoiseLaw:
        """Noise distribution at the most probable node."""
        return self.nodes.laws[int(np.argmax(self.log_z_nodes))]

    @property
    def with_likeliest_node_alone(self) -> NoiseEvidence:
        """A copy with the most probable node alone; `log_z` remains that of all nodes."""
        at = [int(np.argmax(self.log_z_nodes))]
        own = NoiseNodes(self.nodes.settings[at], (self.likeliest_law,), self.nodes.log_weights[at])
        return replace(self, log_z_nodes=self.log_z_nodes[at], nodes=own, peak=self.peak[:, at[: self.peak.shape[1]]])

    def by_sd(self, changed: NoiseEffect) -> tuple[NoiseEvidence, NoiseEvidence]:
        """Return the evidence if the sd is that at the calibration, and if it has `changed`; without their prior odds.

        The second has the factor among its settings; samples of it lie about that of their node.
        """
        prior, model, nodes = self.noise.sd_prior, self.noise, self.nodes
        assert prior is not None

        def of(own: SdPrior, effects: tuple[NoiseEffect, ...], settings: FloatArray) -> NoiseEvidence:
            every = self.log_z_nodes - prior.log_density(self.peak) + own.log_density(self.peak)
            share = logsumexp(every) - logsumexp(self.log_z_nodes) if np.isfinite(self.log_z) else 0.0
            noise, given = replace(model, effects=effects, sd_prior=own), replace(nodes, settings=settings)
            return NoiseEvidence(noise, self.log_z + float(share), every, given, self.peak)

        log_sd, variance = self.peak
        sd = math.hypot(prior.spread, math.sqrt(float(variance.max(initial=0.0))))
        factor = replace(changed, draws_about=lambda about, rng: about * np.exp(sd * rng.standard_normal(about.shape)))
        effects = tuple(sorted((*model.effects, factor), key=lambda effect: effect.name))  # as a chain has them
        column = next(own.start for effect, own in effects_with_columns(effects) if effect is factor)
        settings = np.insert(nodes.settings, column, np.exp(log_sd - prior.log_sd), axis=1)
        return (
            of(replace(prior, log_same=0.0, log_changed=-math.inf), model.effects, nodes.settings),
            of(replace(prior, log_same=-math.inf, log_changed=0.0), effects, settings),
        )


def laplace_evidence(found: Fit, noise: NoiseModel) -> NoiseEvidence:
    """Integrate a fit's likelihood over its parameters and the noise sd (Laplace) and the nodes of the noise model.

    At each node the linearised model moves the fit to its new optimum, which avoids the bias of residuals fitted as if
    white. If the floor of the sd exceeds the residuals, the integral over the sd is taken as wide as without a floor.
    """
    every = noise.nodes_for_predictions(found.predicted)
    out, peak = log_evidence_under(found, every.laws, noise.sd_prior)
    out += every.log_weights
    return NoiseEvidence(noise, float(logsumexp(out)) if out.size else -math.inf, out, every, peak)


def log_evidence_under(found: Fit, laws: Sequence[NoiseLaw], sd_prior: SdPrior | None) -> tuple[FloatArray, FloatArray]:
    """Return the log evidence of a fit under each noise distribution, (n_laws,); minus infinity if impossible.

    With a prior of the sd, also the `peak` of `NoiseEvidence`, (2, n_laws); else (2, 0).
    """
    joined = np.concatenate([found.slopes, found.residuals[:, None]], axis=1)
    out, peak = np.full(len(laws), -math.inf), np.zeros((2, 0 if sd_prior is None else len(laws)))
    if not np.isfinite(joined).all():  # a fit at the edge of what its formula predicts
        return out, peak

    def weigh(nodes: Sequence[int], evidences: Callable[..., tuple[FloatArray, ...]]) -> None:
        own = [laws[node] for node in nodes]
        out[nodes], sigma, bend, curvature = evidences(found, own, joined)
        if sd_prior is not None:  # the likeliest log of a reading's sd, and its variance, the parameters integrated out
            n_points = np.array([law.n_kept for law in own])
            n_fitted = curvature.shape[1] - np.trace(np.linalg.inv(curvature), axis1=1, axis2=2)
            more = n_points / np.maximum(n_points - n_fitted, 1.0)  # by which fitted parameters reduce the variance
            flat = [law.flat > 0 for law in own]
            more, variance = np.where(flat, [[1.0], [0.0]], [more, more / bend])
            peak[:, nodes] = np.log(sigma * np.sqrt(more) * [law.sd_factor_of_rounding for law in own]), variance

    normal = [node for node, law in enumerate(laws) if law.whitened_density.is_normal]
    chunk = max(NUMBERS // joined.size, 1)
    for nodes in (normal[at : at + chunk] for at in range(0, len(normal), chunk)):
        weigh(nodes, _normal_log_evidences)
    tailed: dict[tuple[tuple[bytes, ...], bool], list[int]] = {}  # grouped by whitening, rounded noise separately
    for node in sorted({*range(len(out))} - {*normal}):
        tailed.setdefault((laws[node].whitening_key, laws[node].flat > 0), []).append(node)
    for nodes in tailed.values():
        weigh(nodes, _tailed_log_evidences)
    out += np.array([law.log_extra for law in laws])
    if found.model.sensor.has_exchangeable_gaussians:  # whose permutations are modes of equal height
        out += math.lgamma(found.model.sensor.n_gaussians + 1)
    if sd_prior is not None:
        out += sd_prior.log_density(peak)
    out[np.isnan(out)] = -math.inf  # slopes or residuals whose squares overflow: impossible
    return out, peak


def _normal_log_evidences(found: Fit, laws: Sequence[NoiseLaw], joined: FloatArray) -> tuple[FloatArray, ...]:
    """Return the log evidence under Gaussian noise, (n_laws,); `joined` (n_points, n_params + 1): slopes, residual.

    Returns also the likeliest sigma and the curvature of log sigma there, (n_laws,) both; and that of the coordinates,
    (n_laws, n_params, n_params).
    """
    p, n_points = joined.shape[1] - 1, np.array([law.n_kept for law in laws])
    turned = np.ascontiguousarray(whiten_under_each(laws, joined))
    gram = turned.transpose(0, 2, 1) @ turned
    jj, jr, rr = gram[:, :p, :p], gram[:, :p, p], gram[:, p, p]
    steps, least = np.zeros_like(jr), np.array([law.sigma_floor**2 for law in laws])

    def sums_of_squares() -> FloatArray:
        rss = rr - 2 * np.sum(steps * jr, axis=1) + np.einsum("lp,lpq,lq->l", steps, jj, steps)
        return np.asarray(np.maximum(rss, 0.0))

    for _ in range(3):
        variance = np.maximum(sums_of_squares() / n_points, least)
        curvature = with_prior(jj / variance[:, None, None])
        steps = _newton_steps(curvature, jr / variance[:, None] - found.z)
    fit_and_prior = _laplace_terms(found.z + steps, curvature, n_points) - [law.half_log_det() for law in laws]
    rss = sums_of_squares()
    variance = np.maximum(rss / n_points, least)
    misfit = 0.5 * n_points * np.log(variance) + 0.5 * rss / variance
    log_z = fit_and_prior - misfit + 0.5 * np.log(math.pi / n_points)
    return log_z, np.sqrt(variance), 2.0 * n_points, curvature


def _tailed_log_evidences(found: Fit, laws: Sequence[NoiseLaw], joined: FloatArray) -> tuple[FloatArray, ...]:
    """Return the same under noise models that whiten alike but differ in tail or rounding."""
    turned = laws[0](joined)
    p, n_points = turned.shape[1] - 1, laws[0].n_kept
    slopes, residual = turned[:, :p], turned[:, p:]
    gram = slopes.T @ slopes
    tail, least = stacked_density(laws), laws[0].sigma_floor
    steps, sigma = np.zeros((p, len(laws))), tail.likeliest_sigma(residual, n_points, floor=least)
    for _ in range(3):
        left = residual - slopes @ steps
        sigma = tail.likeliest_sigma(left, n_points, floor=least, start=sigma)
        variance = sigma**2 / tail.fisher_information
        curvature = with_prior(gram / variance[:, None, None])
        downhill = slopes.T @ tail.normal_pseudo_residuals(left, sigma) / variance - found.z[:, None] - steps
        steps += _newton_steps(curvature, downhill.T).T
    left = residual - slopes @ steps
    sigma = tail.likeliest_sigma(left, n_points, floor=least, start=sigma)
    fit_and_prior = _laplace_terms((found.z[:, None] + steps).T, curvature, n_points) - laws[0].half_log_det()
    bend = tail.log_sigma_curvature(left, sigma, n_points)
    log_z = fit_and_prior - tail.minus_log_likelihood(left, sigma, n_points) + 0.5 * np.log(2 * math.pi / bend)
    return log_z, sigma, bend, curvature


def _newton_steps(curvature: FloatArray, downhill: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(curvature, downhill[:, :, None])[:, :, 0])


def _laplace_terms(z: FloatArray, curvature: FloatArray, n_points: int | IntArray) -> FloatArray:
    widths = -0.5 * np.linalg.slogdet(curvature)[1]
    return np.asarray(widths - 0.5 * np.sum(z**2, axis=1) - 0.5 * n_points * math.log(2 * math.pi))


_EDGE = 1e-6  # of the prior's unit cube
_ROUNDS = 6
_REACH = math.sqrt(3)  # of the nodes on both sides of a peak, in posterior sds
_NODES = _REACH * np.array([0.0, -1.0, 1.0])
_LOG_WEIGHTS = np.log([2 / 3, 1 / 6, 1 / 6]) + 0.5 * _NODES**2 + 0.5 * math.log(2 * math.pi)


def refined(found: Fit, evidence: NoiseEvidence, *, least: float = -math.inf) -> NoiseEvidence:
    """Return the evidence of a fit with nodes about its peak, along each parameter whose nodes lie too far apart.

    The other nodes of these parameters are dropped. The evidence is returned as it is if all nodes are close enough, if
    refined nodes cannot raise it to `least` nats, or if no higher peak is found.
    """
    if not np.isfinite(evidence.log_z):
        return evidence
    columns, start, spacing, gain = _coarse_parameters(evidence)
    if not columns.size or evidence.log_z + gain < least:
        return evidence
    model, best = evidence.noise, evidence.nodes.settings[int(np.argmax(evidence.log_z_nodes))]
    parts = [(effect, part) for effect, part in effects_with_columns(model.effects) if effect.nodes_per_parameter]

    def log_density(points: FloatArray) -> FloatArray:
        settings = np.repeat(best[None, :], len(points), axis=0)
        for effect, part in parts:
            own = (columns >= part.start) & (columns < part.stop)
            if own.any():
                unit = effect.prior.to_unit_cube(settings[:, part])
                unit[:, columns[own] - part.start] = points[:, own]
                settings[:, part] = effect.prior.from_unit_cube(unit)
        return log_evidence_under(found, model.laws_at(settings, found.predicted), model.sd_prior)[0]

    while columns.size:
        peak, sd, inside = _peak_and_sds(log_density, start, spacing)
        if inside.all():
            break
        # At an end of its prior a parameter keeps the nodes that it has.
        columns, start, spacing = columns[inside], start[inside], spacing[inside]
    if not columns.size:
        return evidence
    nodes = dict(model.likely)
    for effect, part in parts:
        about = {int(c) - part.start: (peak[k], sd[k]) for k, c in enumerate(columns) if part.start <= c < part.stop}
        if about:
            nodes[effect.name] = _nodes_about(effect, about)
    out = laplace_evidence(found, replace(model, likely=nodes))
    before, after = (float((e.log_z_nodes - e.nodes.log_weights).max(initial=-math.inf)) for e in (evidence, out))
    return out if after > before else evidence


def _coarse_parameters(evidence: NoiseEvidence) -> tuple[IntArray, FloatArray, FloatArray, float]:
    """Find parameters of a noise model whose nodes lie further apart than a fit determines them.

    Returns their numbers among the settings of the nodes, their values at the likeliest node and the distances of
    nodes, in the unit cube of the prior, (n_coarse,) all; and the nats by which the evidence may rise between nodes.
    """
    weights, found = evidence.weights, []
    for effect, part in effects_with_columns(evidence.noise.effects):
        settings = evidence.nodes.settings[:, part]
        if len(effect.nodes_per_parameter) != settings.shape[1] or np.all(settings == settings[0]):
            continue  # without nodes of the prior, or known
        unit = effect.prior.to_unit_cube(settings)
        for k, n in enumerate(effect.nodes_per_parameter):
            own, node_of = np.unique(np.round(unit[:, k] / ROUNDING), return_inverse=True)
            marginal = np.bincount(node_of.ravel(), weights).astype(np.float64)
            own = own * ROUNDING
            spacing = float(np.diff(own).min(initial=math.inf)) if len(own) > 1 else 1 / n
            mean = float(marginal @ own)
            # From a posterior sd of that share of the distance of nodes on, their sum is the integral to a percent.
            if math.sqrt(float(marginal @ (own - mean) ** 2)) < 0.6 * spacing:
                at = unit[int(np.argmax(weights)), k]
                found.append((part.start + k, float(at), spacing, _rise_between(marginal)))
    columns, peak, spacings, gains = zip(*found, strict=True) if found else ((), (), (), ())
    return np.array(columns, dtype=np.int64), np.array(peak), np.array(spacings), float(sum(gains))


def _rise_between(marginal: FloatArray) -> float:
    """Return how many nats a parabola through the best node and its neighbours rises above it; inf for one node."""
    if len(marginal) < 2:
        return math.inf
    with np.errstate(divide="ignore"):
        log_p = np.maximum(np.log(marginal), -700.0)
    k = int(np.argmax(log_p))
    before, after = log_p[max(k - 1, 0)], log_p[min(k + 1, len(log_p) - 1)]
    bend = float(2 * log_p[k] - before - after)
    return float(after - before) ** 2 / (8 * bend) if bend > 0 else 0.0


def _peak_and_sds(
    log_density: Callable[[FloatArray], FloatArray], start: FloatArray, spacing: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the peak of a density over the unit cube, its sd along each axis, and whether it is inside, (n_axes,) all.

    Parabolas through three points along each axis lead to it; the points draw together from `spacing` to the sd. Where
    one of them is at an end of an axis and the parabola leads beyond, the peak is at the end, and the search is over.
    """
    center, step, sd, eye = start, spacing, spacing, np.eye(len(start))
    for _ in range(_ROUNDS):
        center = np.clip(center, step + _EDGE, 1 - step - _EDGE)
        middle, *around = log_density(center + step * np.concatenate([0 * eye[:1], -eye, eye]))
        below, above = np.split(np.array(around), 2)
        if not np.isfinite([middle, *around]).all():
            break
        slope, bend = 0.5 * (above - below), 2 * middle - above - below
        concave = bend > 1e-3
        bend = np.where(concave, bend, 1.0)
        sd = step / np.sqrt(bend)
        move = np.clip(np.where(concave, slope / bend, np.sign(slope)), -2.0, 2.0)
        to = center + move * step
        ended = (to < _EDGE) & (center - step < 2 * _EDGE) | (to > 1 - _EDGE) & (center + step > 1 - 2 * _EDGE)
        if ended.any():
            return center, sd, ~ended
        center = np.clip(to, _EDGE, 1 - _EDGE)
        if np.all(np.abs(move) * step < 0.5 * sd) and np.all(step < 2 * sd):
            break
        step = np.where(concave, np.clip(sd, step / 8, step), step)
    return center, sd, (center - _REACH * sd > 0) & (center + _REACH * sd < 1)


def _nodes_about(effect: NoiseEffect, about: Mapping[int, tuple[float, float]]) -> tuple[FloatArray, FloatArray]:
    """Return the nodes of one effect, (n_nodes, n_params), and log weights: about a peak, the prior's where not coarse.

    `about` has the peak and the sd of coarse parameters, by their number, in the unit cube.
    """
    axes, log_weights = [], []
    for k, n in enumerate(effect.nodes_per_parameter):
        if k in about:
            peak, sd = about[k]
            axes.append(peak + sd * _NODES)
            log_weights.append(_LOG_WEIGHTS + math.log(sd))
        else:
            axes.append((np.arange(n) + 0.5) / n)
            log_weights.append(np.full(n, -math.log(n)))
    unit = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, len(axes))
    return effect.prior.from_unit_cube(unit), np.sum(np.meshgrid(*log_weights), axis=0).ravel()


def covariance_root(slopes: FloatArray, variance: float) -> FloatArray:
    """Return a root of the Laplace covariance, (n_params, n_params), from whitened slopes and a reading's variance."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(with_prior(slopes.T @ slopes / variance))).T)


def log_evidence_of(found: Fit, law: NoiseLaw) -> float:
    """Return a fit's log evidence by Laplace's method, up to a constant; minus infinity without a finite prediction."""
    if not np.isfinite(found.objective):
        return -np.inf
    with np.errstate(all="ignore"):
        root = covariance_root(law(found.slopes), max(found.sd, LEAST_SCALE) ** 2)
    return float(np.linalg.slogdet(root)[1]) - found.objective


@dataclass(frozen=True, eq=False)
class Linearised:
    """A fit linearised to a Gaussian problem with its parameters, including their prior, projected out.

    Rows are the whitened readings in units of the noise sd, then one row for each parameter's prior, and one more if
    the sd is known. Under the null every row is standard normal, so that residuals are drawn by projection alone.
    `basis`: Q of the augmented slopes, (n_rows, n_params); `residual`: P r, (n_rows,).
    """

    basis: FloatArray
    residual: FloatArray
    law: NoiseLaw
    sd: float
    n_points: int

    @classmethod
    def of(cls, found: Fit, law: NoiseLaw, beside: FloatArray | None = None) -> Linearised:
        """Linearise a fit under noise `law`; `beside` are slopes (n_points, k) by additional coordinates of 0."""
        # A censored reading that is predicted beyond the end tells nothing, whatever small change is added.
        beyond = law.is_censored & (found.residuals == 0)
        law, slopes, z = replace(law, lost=law.lost | beyond) if beyond.any() else law, found.slopes, found.z
        if beside is not None:
            slopes, z = np.concatenate([slopes, beside], axis=1), np.concatenate([z, np.zeros(beside.shape[1])])
        n_points, p = slopes.shape
        whitened = law(found.residuals)[:, None]
        turned, sigma = law(slopes), law.likeliest_sigma(whitened)
        known = bool(law.flat) or (law.least > 0 and float(sigma[0]) <= law.sigma_floor)
        sigma = np.where(sigma > 0, sigma, found.sd)
        free = residual_degrees_of_freedom(turned, float(sigma[0]) / math.sqrt(law.fisher_information), law.n_kept)
        sigma = sigma if known else sigma * math.sqrt(law.n_kept / free)
        sd = float(sigma[0]) / math.sqrt(law.fisher_information)
        basis, _ = np.linalg.qr(np.concatenate([turned / sd, np.eye(p)]))
        augmented = np.concatenate([law.bounded_pseudo_residuals(whitened, sigma)[:, 0] / sd, -z])
        residual = augmented - basis @ (basis.T @ augmented)
        if known:
            # Rounded readings carry less information, which must not make the noise sd smaller.
            rest = math.sqrt(max(free - float(residual @ residual), 0.0))
            basis, residual = np.concatenate([basis, np.zeros((1, p))]), np.append(residual, rest)
        return cls(basis, residual, law, sd, n_points)

    def whiten(self, columns: FloatArray) -> FloatArray:
        """Whiten columns of readings and divide them by the noise sd, (n_points, k) both."""
        return self.law(columns) / self.sd

    def project(self, columns: FloatArray) -> FloatArray:
        """Whiten columns of readings (n_points, k) and project the fit's parameters out: (n_rows, k)."""
        return self.project_whitened(self.whiten(columns))

    def project_whitened(self, whitened: FloatArray) -> FloatArray:
        """Project the fit's parameters out of columns in units of the noise sd: (n_points, k) -> (n_rows, k)."""
        out = -self.basis @ (self.basis[: self.n_points].T @ whitened)
        out[: self.n_points] += whitened
        return out

    def absorbing_shift(self, found: Fit, change: FloatArray) -> FloatArray:
        """Return the shift of coordinates, (n_params,), at which predictions plus `change` (n_points,) fit best."""
        slopes = self.whiten(found.slopes)
        sigma = np.array([self.sd * math.sqrt(self.law.fisher_information)])
        normal = self.law.normal_pseudo_residuals(self.law(found.residuals - change)[:, None], sigma)[:, 0]
        shift = slopes.T @ (normal / self.sd) - found.z
        return np.asarray(np.linalg.solve(with_prior(slopes.T @ slopes), shift))

    def draw_null_residuals(self, n_draws: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw projected residuals under the null, in noise sds, (n_rows, n_draws)."""
        of_readings = self.law.draw_pseudo_residuals(n_draws, rng=rng)
        eps = np.concatenate([of_readings, rng.standard_normal((len(self.basis) - self.n_points, n_draws))])
        return np.asarray(eps - self.basis @ (self.basis.T @ eps))


@dataclass(frozen=True, eq=False)
class OrthonormalBlocks:
    """Orthonormalised templates: columns `u` (n_rows, n_columns) in blocks, one for each template.

    Rows are those of `Linearised`. `starts` (n_blocks,): first columns.
    """

    u: FloatArray
    starts: IntArray

    @classmethod
    def of(cls, problem: Linearised, templates: Sequence[FloatArray]) -> OrthonormalBlocks:
        """Whiten, scale to unit rms, project, and orthonormalise each template (n_points, k) by itself."""
        projected, widths = scale_and_project(problem, templates), np.array([t.shape[1] for t in templates])
        starts, u = np.cumsum(widths) - widths, np.empty_like(projected)
        for width in set(widths.tolist()):  # all templates of one width at a time
            columns = (starts[widths == width, None] + np.arange(width)).ravel()
            u[:, columns] = orthonormalise_groups(projected[:, columns], width)
        return cls(u, starts)


def scale_and_project(problem: Linearised, templates: Sequence[FloatArray]) -> FloatArray:
    """Whiten templates (n_points, k), scale to unit rms, project the fit out; concatenated, (n_rows, n_columns)."""
    widths = [template.shape[1] for template in templates]
    whitened = problem.law(np.concatenate(templates, axis=1))
    norms = np.sqrt(np.einsum("ij,ij->j", whitened, whitened))
    whitened *= np.sqrt(problem.law.n_kept / np.repeat(widths, widths)) / np.where(norms > 0, norms, 1.0)
    return problem.project_whitened(whitened)


def orthonormalise_groups(columns: FloatArray, width: int, *, least: float = 1e-12, share: float = 0.0) -> FloatArray:
    """Orthonormalise groups of `width` adjacent columns, (n_rows, n_columns).

    It uses the eigenvectors of the Gram matrices. Directions with squared length up to `least`, or up to `share` times
    the greatest in the group, become zero columns.
    """
    blocks = columns.reshape(len(columns), -1, width)
    squares, axes = np.linalg.eigh(np.einsum("ibj,ibk->bjk", blocks, blocks, optimize=True))
    there = squares > np.maximum(share * squares[:, -1:], least)
    per_length = np.where(there, 1 / np.sqrt(np.maximum(squares, least)), 0.0)
    u = np.einsum("ibj,bjk->ibk", blocks, axes * per_length[:, None, :], optimize=True)
    return np.asarray(u.reshape(columns.shape))


def log_probability_effects_detectable(found: Fit, law: NoiseLaw, usable: IntArray) -> float:
    """Return the log probability that every effect of a fit has a detectable size (lambda 4 or more).

    The size is the norm, in noise sds, of its change after a linearised refit of all else; its posterior has unit sd.
    Without this factor hypotheses would count that readings cannot tell from those without the effect.
    """
    sizes = linearised_sizes(found, law, usable, found.model.names)
    return float(sum(log_ndtr(size - LEAST_VISIBLE) for size in sizes))


def linearised_sizes(found: Fit, law: NoiseLaw, usable: IntArray, names: Sequence[str]) -> Iterator[float]:
    """Iterate over the lambdas of some effects of a fit: norm, in noise sds, of the change after a linearised refit."""
    sd = found.sd / np.sqrt(law.fisher_information)
    slopes = law(found.slopes) / sd
    for name in names:
        rest = np.delete(slopes, found.model.coordinate_slice(name), axis=1)
        change = law(found.change_by_effect(name, usable)[:, None])[:, 0] / sd
        taken = np.linalg.solve(with_prior(rest.T @ rest), rest.T @ change)
        yield float(np.linalg.norm(np.append(change - rest @ taken, taken)))


LEAST_ROWS = 8  # least number of rows of a held-out part
MOST_PARTS = 10  # largest number of parts held out in turn

Parts = tuple[IntArray, tuple[str, ...]]
"""Part number of each usable reading, (n_usable,), -1 for one that is never held out, and the names of the parts."""

N_BLOCKS = 5  # number of parts of readings that have no scans or runs
_NO_DENSITY = -690.0  # log density of a reading for which a model predicts no number: that of 1e-300
_NO_SLOPE = 1e-6  # of a parameter's slope on its own readings: so little on others is rounding of predictions
_HARDLY_TOLD = 0.5  # variance of a coordinate given the other parts, of 1 before them


@dataclass(frozen=True)
class HeldOutGain:
    """Gain of a model over the null on held-out readings: mean in nats per reading, and the sd of that mean.

    `by_scan`: name and mean gain of each held-out part, such as a scan.
    """

    per_reading: float
    sd: float
    n_readings: int
    by_scan: tuple[tuple[str, float], ...]


def held_out_gain(
    null: Fit,
    repaired: Fit,
    recording: Recording,
    law: NoiseLaw,
    held_out: Parts,
    *,
    law_of_null: NoiseLaw,
    each_alone: bool = False,
) -> HeldOutGain:
    """Refit both models without one part of the readings at a time, and compare their log densities of that part.

    A held-out reading is predicted from the other parts alone. If the part has parameters of its own, which other parts
    do not determine, or if the noise has memory, its readings are predicted sequentially, each given those before it:
    together they have the joint density of the part given the rest, unless `each_alone` asks for what the rest tells of
    each: far from the rest, noise with memory is as wide as it is without. Parts of fewer than eight readings are not
    held out, and of more than ten parts only ten.

    `law`, `law_of_null`: noise distribution of the repaired model, and of the null; `held_out`: number of the part of
    each usable reading, and names of the parts.
    """
    usable, (parts, names) = recording.usable, held_out

    def log_densities(found: Fit, law: NoiseLaw, out: BoolArray) -> FloatArray:
        """Return the log predictive density of each held-out reading, from a refit to the others; 0 for lost readings.

        At an end of the range it is a log likelihood relative to its peak: 0 where the prediction is beyond the end.
        Lost readings (dropouts at one value) add the same to every model of the mean.
        """
        readings, rest = recording.readings.copy(), law.take_readings(~out)
        readings[np.flatnonzero(usable)[out]] = np.nan
        if not rest.n_kept:  # without them the noise sd, and so the density, is unknown
            return np.zeros(int(out.sum()))
        without = fit(found.model, recording.with_readings(readings), found.z, rest, max_steps=4, tolerance=0.05)
        # Such as where its run starts: parameters that change only the readings of the part.
        here, elsewhere = (np.linalg.norm(found.slopes[rows], axis=0) for rows in (out, ~out))
        of_its_own = (here > 0.0) & (elsewhere <= _NO_SLOPE * here)
        turned = np.where(of_its_own, 0.0, rest(without.slopes))
        # Parameters of the part alone are linearised about the fit to all readings: their prior may be wide, and the
        # other readings may bound them on one side only, as for a ceiling.
        about = np.where(of_its_own, found.z, without.z)
        predicted, slopes = (part[usable] for part in found.model.predict_and_differentiate(about))
        free = residual_degrees_of_freedom(turned, without.sd / math.sqrt(rest.fisher_information), rest.n_kept)
        sigma_2 = without.sd**2 * (1.0 if rest.flat else rest.n_kept / free)  # beside rounding it is known
        curvature = with_prior(turned.T @ turned * rest.fisher_information / sigma_2)
        covariance = np.asarray(np.linalg.inv(curvature), dtype=np.float64)
        # Of values with one scale in common, those of the other parts tell how large this part's is, not which it is.
        hardly_told = found.model.has_shared_scale & (np.diag(covariance) > _HARDLY_TOLD) & np.any(slopes[out], axis=0)
        sequential = not each_alone and bool(law.has_memory or (of_its_own | hardly_told).any())
        told = (law, out, recording.readings[usable] - predicted, slopes, without.z - about, covariance, sigma_2)
        return predictive_log_densities(*told, sequential=sequential)

    def gain_per_reading(out: BoolArray) -> FloatArray:
        with np.errstate(invalid="ignore"):  # without them a model may predict no number
            densities = (log_densities(repaired, law, out), log_densities(null, law_of_null, out))
            repaired_one, null_one = (np.where(np.isnan(each), _NO_DENSITY, each) for each in densities)
        return np.asarray(repaired_one - null_one)

    return mean_gain_over_parts(parts, gain_per_reading, names)


def partition_into_blocks(recording: Recording) -> Parts:
    """Partition usable readings into five parts: every fifth block of eight successive readings.

    Returns numbers (n_usable,) and names of the parts. An effect local in time cannot be predicted for another scan,
    but it can between known readings; a block is long enough that its middle is not adjacent to known readings.
    """
    block = np.arange(int(recording.usable.sum())) // LEAST_ROWS
    return block % N_BLOCKS, tuple(f"every fifth block of {LEAST_ROWS}, from {k + 1}" for k in range(N_BLOCKS))


def mean_gain_over_parts(
    scan: IntArray, gain: Callable[[BoolArray], FloatArray], scan_names: Sequence[str] = ()
) -> HeldOutGain:
    """Hold out one part at a time, at most ten, and average the gains of their readings.

    `scan`: number of the part of each usable reading, such as its scan, (n_usable,); `gain`: function of a mask of
    held-out readings (n_usable,); returns the gain of each of them, in nats. Returns the gain; no readings and gain 0
    if fewer than two parts are long enough, or none beside readings that are never held out.
    """
    long_enough = [int(k) for k in np.unique(scan) if k >= 0 and np.sum(scan == k) >= LEAST_ROWS]
    if len(long_enough) < (1 if np.any(scan < 0) else 2):
        return HeldOutGain(0.0, 0.0, 0, ())
    if len(long_enough) > MOST_PARTS:
        long_enough = [long_enough[int(i)] for i in np.linspace(0, len(long_enough) - 1, MOST_PARTS).round()]
    gains = [gain(np.asarray(scan == k)) for k in long_enough]
    joined, names = np.concatenate(gains), (scan_names[k] if scan_names else str(k) for k in long_enough)
    sd = float(joined.std(ddof=1)) / math.sqrt(len(joined))
    by_scan = zip(names, (float(g.mean()) for g in gains), strict=True)
    return HeldOutGain(float(joined.mean()), sd, len(joined), tuple(by_scan))


def predictive_log_densities(
    law: NoiseLaw,
    out: BoolArray,
    miss: FloatArray,
    slopes: FloatArray,
    mean: FloatArray,
    covariance: FloatArray,
    sigma_2: float,
    *,
    sequential: bool = True,
) -> FloatArray:
    """Return the log density of each held-out reading from a linear model of the others, (n_out,); 0 for lost ones.

    `out`: mask of the held-out readings, (n_points,); `miss`, `slopes`: residuals of all readings, (n_points,), and
    slopes, (n_points, n_params), at one point; `mean`, `covariance`: of the coordinates about that point, from the
    readings that are not held out. If `sequential`, each is given those held out before it too: the sum is the log of
    the joint density. Of censored readings, densities are relative to the peak.
    """
    columns = np.concatenate([slopes, miss[:, None]], axis=1)
    whitened, sd = innovations_given_rest(law, columns, out, each_alone=not sequential)
    turned, innovations, kept, censored = whitened[:, :-1], whitened[:, -1], law.kept[out], law.is_censored[out]
    noise_2 = sigma_2 * (np.sqrt(law.sd[out] ** 2 + law.flat**2 / 3) / law.sd[out]) ** 2
    log_shares = np.log(np.maximum([1 - law.share, law.share], TINY))
    widths = np.tile([1.0, law.times**2], (len(sd), 1))
    if law.wide.size:  # variances, in units of sd^2, if each is narrow and if it is wide: it may be either
        own = law.sd[out] ** 2
        narrow = own * law.relative_precision[out]
        widths = np.stack([sd**2 - own + narrow, sd**2 - own + narrow * law.times**2], axis=1) / sd[:, None] ** 2

    def given(rows: slice, mean: FloatArray, gain: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return log densities, residuals, and most probable variances, (n_rows,) each; `gain` (n_rows, n_params)."""
        left, spread = innovations[rows] - turned[rows] @ mean, np.maximum(np.sum(turned[rows] * gain, axis=1), 0.0)
        parts = noise_2[rows, None] * widths[rows] + spread[:, None]
        at_zero = log_shares - 0.5 * np.log(2 * np.pi * parts)
        by_width = at_zero - 0.5 * left[:, None] ** 2 / parts
        density = np.logaddexp(*by_width.T)
        variance = np.sum(np.exp(by_width - density[:, None]) * parts, axis=1)
        unit = np.where(censored[rows], np.logaddexp(*at_zero.T), np.log(sd[rows]))
        return density - unit, left, variance

    if not sequential:
        return given(slice(None), mean, turned @ covariance)[0] * kept
    mean, covariance, densities = mean.copy(), covariance.copy(), np.zeros(len(innovations))
    for k in np.flatnonzero(kept).tolist():
        gain = covariance @ turned[k]
        densities[k], left, variance = (float(own[0]) for own in given(slice(k, k + 1), mean, gain[None]))
        mean += gain * left / variance
        covariance -= np.outer(gain, gain) / variance
    return densities
