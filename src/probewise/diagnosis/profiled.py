"""A proposal density for importance sampling, profiled along the coordinate in which a posterior is least normal.

Laplace's approximation in slices (Rue, Martino and Chopin 2009): at fixed values of that coordinate, such as a time
constant, the others are refitted, and are normal about each fit. A normal approximation in all coordinates would have
too light a tail there, which importance weights cannot restore.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.diagnosis.fit import DIFFERENCE, FARTHEST, Fit
from probewise.diagnosis.noise_law import LEAST_SCALE, NoiseLaw
from probewise.nested.weights import n_effective, resampled_rows
from probewise.recordings.plan import Recording

_NODES = np.arange(-8.0, 8.5)  # of a slice, in sds of the Laplace approximation
_STEPS = 3  # of the fit in each slice, in each of these rounds
_ROUNDS = 2
_FAR = 30.0  # nats below the best slice: no further ones
_FREEDOM = 6  # of a Student-t within each slice: no weight is large in its tails
_N_CELLS = 400
_INDEPENDENT = 0.25  # least effective sample size, as a share of the samples wanted


@dataclass(frozen=True, eq=False)
class ProfiledDensity:
    """A density of a fit's coordinates: the sliced one has the evidence of each slice, the others are Student-t in it.

    `at`: index of the sliced coordinate; `nodes`: its values in the slices, rising, (n_nodes,); `modes`: the other
    coordinates' best values in each slice, (n_nodes, n_params - 1); `roots`: lower Cholesky factors of their
    covariances there, (n_nodes, n_params - 1, n_params - 1); `log_evidence`: log evidence of each slice, up to a
    constant, (n_nodes,).
    """

    at: int
    nodes: FloatArray
    modes: FloatArray
    roots: FloatArray
    log_evidence: FloatArray

    @classmethod
    def of(cls, found: Fit, law: NoiseLaw, recording: Recording) -> Self | None:
        """Profile each nonlinear coordinate of the effects of a fit, and return the density that is least normal.

        None if there is no such coordinate, or none whose slices can be fitted.
        """
        slopes = law(found.slopes)
        sd = max(law.likeliest_sigma_of(found.residuals), LEAST_SCALE) / np.sqrt(law.fisher_information)
        covariance = np.linalg.inv(slopes.T @ slopes / sd**2 + np.eye(len(found.z)))
        tried = [
            cls._of_coordinate(found, law, recording, at, covariance, float(sd)) for at in _nonlinear_coordinates(found)
        ]
        return max(
            (profile for profile in tried if profile is not None),
            key=lambda p: p._departure_from_normal_nats,
            default=None,
        )

    @classmethod
    def _of_coordinate(
        cls, found: Fit, law: NoiseLaw, recording: Recording, at: int, covariance: FloatArray, sd: float
    ) -> Self | None:
        nodes = found.z[at] + _NODES * np.sqrt(covariance[at, at])
        nodes = nodes[np.abs(nodes) < FARTHEST]
        if len(nodes) < len(_NODES) // 2:
            return None
        z = found.z + np.outer(nodes - found.z[at], covariance[at] / covariance[at, at])
        z = np.clip(z, -FARTHEST, FARTHEST)
        rest, usable = np.delete(np.arange(len(found.z)), at), recording.usable
        readings, n, eye = recording.readings[usable], len(nodes), np.eye(len(found.z))

        def heights_and_slopes(z: FloatArray) -> tuple[FloatArray, FloatArray]:
            """Return each slice's log posterior, (n_nodes,), and whitened slopes, (n_nodes, n_params, n_points).

            The slopes are those by the other n_params - 1 coordinates; the last row is the residuals.
            """
            near = z[:, None, :] + DIFFERENCE * np.concatenate([np.zeros((1, len(rest))) @ eye[rest], eye[rest]])
            predicted = found.model.predict(near.reshape(-1, z.shape[1]))[:, usable]
            with np.errstate(all="ignore"):  # of predictions that ran away: impossible below
                whitened = law((readings - predicted).T).T.reshape(n, len(rest) + 1, -1)
                sigma = law.likeliest_sigma(whitened[:, 0].T)
                height = -law.minus_log_likelihood(whitened[:, 0].T, sigma) - 0.5 * np.sum(z**2, axis=1)
                normal = law.normal_pseudo_residuals(whitened[:, 0].T, sigma).T
                joined = np.concatenate([(whitened[:, 1:] - whitened[:, :1]) / DIFFERENCE, normal[:, None]], axis=1)
            possible = np.isfinite(height) & np.isfinite(joined).all(axis=(1, 2))
            return np.where(possible, height, -np.inf), np.where(possible[:, None, None], joined, 0.0)

        state = z, *heights_and_slopes(z)
        for _ in range(_ROUNDS):
            for _ in range(_STEPS):
                curvature, downhill = _normal_equations(state[2], state[0][:, rest], sd)
                tried = state[0].copy()
                tried[:, rest] += np.clip(np.linalg.solve(curvature, downhill[:, :, None])[:, :, 0], -1.0, 1.0)
                tried = np.clip(tried, -FARTHEST, FARTHEST)
                state = _better_fit_of_each_slice(state, (tried, *heights_and_slopes(tried)))
            # A slice that went astray begins again from its neighbour's fit, towards the middle.
            towards = np.arange(n) - np.sign(np.arange(n) - int(np.argmax(state[1])))
            tried = state[0][towards]
            tried[:, at] = nodes
            state = _better_fit_of_each_slice(state, (tried, *heights_and_slopes(tried)))
        z, height, joined = state
        there = _near_best_mask(height)
        if there.sum() < len(_NODES) // 2:
            return None
        curvature, _ = _normal_equations(joined[there], z[there][:, rest], sd)
        roots = np.linalg.cholesky(np.linalg.inv(curvature))
        volume = np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
        return cls(at, nodes[there], z[there][:, rest], roots, height[there] + volume)

    @property
    def _departure_from_normal_nats(self) -> float:
        """Largest difference in nats from a normal log density, within three sds of the best slice."""
        spacing = float(np.median(np.diff(self.nodes)))
        best = int(np.argmax(self.log_evidence))
        apart = (self.nodes - self.nodes[best]) / spacing
        within = np.abs(apart) < 3.5
        fall = self.log_evidence[best] - self.log_evidence
        return float(np.max(np.abs(fall - 0.5 * apart**2)[within]))

    @cached_property
    def _cell_edges(self) -> FloatArray:
        return np.linspace(self.nodes[0], self.nodes[-1], _N_CELLS + 1)

    @cached_property
    def _cell_probabilities(self) -> FloatArray:
        middle = 0.5 * (self._cell_edges[1:] + self._cell_edges[:-1])
        log_density = np.interp(middle, self.nodes, self.log_evidence)
        shares = np.exp(log_density - log_density.max())
        return np.asarray(shares / shares.sum())

    def _means_and_nearest_slices(self, value: FloatArray) -> tuple[FloatArray, IntArray]:
        middle = np.stack([np.interp(value, self.nodes, column) for column in self.modes.T], axis=1)
        return middle, np.argmin(np.abs(value[:, None] - self.nodes), axis=1)

    def draw(self, n_samples: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw coordinates, (n_samples, n_params)."""
        cell = rng.choice(_N_CELLS, n_samples, p=self._cell_probabilities)
        value = self._cell_edges[cell] + np.diff(self._cell_edges)[cell] * rng.random(n_samples)
        middle, slice_of = self._means_and_nearest_slices(value)
        eps = rng.standard_normal(middle.shape) / np.sqrt(rng.chisquare(_FREEDOM, (n_samples, 1)) / _FREEDOM)
        rest = middle + np.einsum("nij,nj->ni", self.roots[slice_of], eps)
        return np.insert(rest, self.at, value, axis=1)

    def importance_resample(
        self, log_p: Callable[[FloatArray], FloatArray], *, n_first: int, n_wanted: int, rng: np.random.Generator
    ) -> FloatArray | None:
        """Draw from a posterior of log density `log_p` by weighting `n_first` draws: coordinates, (n_wanted, n_params).

        None if the effective sample size is below a quarter of `n_wanted`. Weights are truncated at the mean weight
        times the square root of the number of draws (Ionides 2008), so that no draw in a heavy tail dominates.
        """
        first = self.draw(n_first, rng=rng)
        gain = log_p(first) - self.log_density(first)
        if not np.isfinite(gain).any():
            return None
        gain = np.minimum(gain, logsumexp(gain) - 0.5 * np.log(n_first))
        if n_effective(gain) < _INDEPENDENT * n_wanted:
            return None
        return np.asarray(first[rng.permutation(resampled_rows(np.exp(gain - gain.max()), n_wanted, rng))])

    def log_density(self, z: FloatArray) -> FloatArray:
        """Return the log density of coordinates, up to a constant, (n_samples, n_params) -> (n_samples,)."""
        value, rest = z[:, self.at], np.delete(z, self.at, axis=1)
        middle, slice_of = self._means_and_nearest_slices(value)
        eps = np.linalg.solve(self.roots[slice_of], (rest - middle)[:, :, None])[:, :, 0]
        volume = np.log(np.diagonal(self.roots, axis1=1, axis2=2)).sum(axis=1)
        cell = np.clip(np.searchsorted(self._cell_edges, value) - 1, 0, _N_CELLS - 1)
        with np.errstate(divide="ignore"):
            log_share = np.log(self._cell_probabilities[cell])
        tail = 0.5 * (_FREEDOM + rest.shape[1]) * np.log1p(np.sum(eps**2, axis=1) / _FREEDOM)
        return np.asarray(log_share - tail - volume[slice_of])


Slices = tuple[FloatArray, FloatArray, FloatArray]
"""Coordinates (n_nodes, n_params), log posteriors (n_nodes,), whitened derivatives with residuals."""


def _better_fit_of_each_slice(old: Slices, new: Slices) -> Slices:
    higher = new[1] > old[1]
    return (
        np.where(higher[:, None], new[0], old[0]),
        np.where(higher, new[1], old[1]),
        np.where(higher[:, None, None], new[2], old[2]),
    )


def _near_best_mask(height: FloatArray) -> BoolArray:
    """Mark the slices about the best one, up to the first on either side 30 nats or more below it, (n_nodes,)."""
    best = int(np.argmax(height))
    low = np.flatnonzero(~(height > height[best] - _FAR))
    out = np.zeros(len(height), dtype=np.bool_)
    out[max(low[low < best], default=-1) + 1 : min(low[low > best], default=len(height))] = True
    return out


def _nonlinear_coordinates(found: Fit) -> list[int]:
    """List the indices of the effects' coordinates other than amplitudes."""
    out = []
    for effect in found.model.effects:
        first = found.model.coordinate_slice(effect.name).start
        out += [first + k for k in range(len(effect.prior.names)) if k not in effect.amplitudes]
    return out


def _normal_equations(joined: FloatArray, rest: FloatArray, sd: float) -> tuple[FloatArray, FloatArray]:
    gram = joined @ joined.transpose(0, 2, 1) / sd**2
    return gram[:, :-1, :-1] + np.eye(rest.shape[1]), -gram[:, :-1, -1] - rest
