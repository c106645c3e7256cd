"""A start density of N Gaussians: samples of a part of the posterior of N - 1, with one faint Gaussian added to each.

The others stay; or they shift to compensate for the new one; or the new one is split off a bright one so that light,
centre and covariance of the two stay (split and merge moves: Richardson & Green 1997).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Protocol

import numpy as np
from scipy.special import logsumexp, ndtr, ndtri

from probewise._arrays import FloatArray
from probewise.calibration.compensation import CompensatedShapeProposal, CompensatingShift
from probewise.calibration.priors import SSFPrior
from probewise.calibration.whole_coordinates import FAINT, count_bright_gaussians
from probewise.errors import ParameterError
from probewise.inference import SensorProblem
from probewise.priors import Uniform

# Share of the new Gaussians that lie near one of the others, and how near: of the cube's side, in precision and
# correlation; in place, by the other's own width.
_NEAR = 0.25
_NEAR_PRECISION = 0.12
_NEAR_CORRELATION = 0.2
_LEAST_WIDTH, _MOST_WIDTH = 0.005, 1.0
# The new mass over the least of the others': a share uniform, the rest log-uniform above the least ratio.
_EVEN_MASS = 0.3
_LEAST_RATIO = 1e-4
_SHAPE = slice(1, 6)
# Shares of the draws that are added as they are, and that are split; the others are compensated for.
_ADDED, _SPLIT = 0.2, 0.3
# Share of the independent proposals that split the new Gaussian off a bright one.
_RESPLIT = 0.5
# Share of the compensated ones whose light follows the first-order posterior.
_TOLD = 0.7
_TINY = float(np.finfo(float).tiny)


def has_uniform_prior_of_light(prior: SSFPrior) -> bool:
    """Return whether a Gaussian's light has a uniform prior from 0, as `FaintGaussianReferenceDensity` requires."""
    return prior.unit_mass_mm2 is not None and prior.amplitude == Uniform(0.0, 1.0)


class _GaussianAdder(Protocol):
    """A function that adds a Gaussian to each sample of N - 1, (n, 6 N - 4) -> (n, 6 N + 2)."""

    def __call__(self, rest: FloatArray, *, rng: np.random.Generator) -> FloatArray: ...


@dataclass(frozen=True)
class AddedGaussianProposal:
    """A proposal of N sorted Gaussians that adds one to N - 1, and its inverse.

    Attributes
    ----------
    share
        Share of the draws.
    draw
        Adds one Gaussian to each sample, (n, 6 N - 4) -> (n, 6 N + 2); nan where that is impossible.
    back
        Inverse of `draw`, (n, 6 N + 2) -> (n, 6 N - 4). It also returns the log of the density over the prior's, (n,),
        without the likelihood of N - 1 Gaussians and the factor 1 / N.
    """

    share: float
    draw: _GaussianAdder
    back: Callable[[FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class FaintGaussianReferenceDensity:
    """A part of the posterior of N - 1 Gaussians with one more, lighter than each of them, and faint.

    Gaussians have no labels, so they are sorted by mass here as in `MomentCoordinates`, the lightest last. With p_N the
    prior of N unsorted Gaussians, L the likelihood and Z the evidence of the part of N - 1, the density mixes three
    ways:

    - One is added. With m the most mass that it may have (that of the lightest of the N - 1, or if less, a tenth
      of the heaviest's), in the prior's unit, and r the new one's density over its prior's below m: N! p_N L r / (N m
      Z). r mixes Gaussians of the prior, light ones more often, and some near one of the others.
    - One is added and the others shift, by an amount that depends on the new one and the masses alone, so that volumes
      stay; see `CompensatedShapeProposal`.
    - A bright one is split. Its moments (mass, mass times centre, mass times second moment) lose those of
      the new one, which lies near it; at a fixed new one that is a shift, so volumes of moments stay.

    All integrate to one, so that the evidence of N over that of N - 1 is the mean of posterior density over reference,
    both without their Z, over draws from the reference.

    Parameters
    ----------
    prior
        Prior of N Gaussians, 2 or more, with uniform mass (see `has_uniform_prior_of_light`); else ParameterError.
    below
        Problem of N - 1 Gaussians.
    compensation
        How the others shift.
    n_bright
        Number of bright Gaussians, below N; see `count_bright_gaussians`.
    """

    prior: SSFPrior
    below: SensorProblem
    compensation: CompensatedShapeProposal
    n_bright: int

    def __post_init__(self) -> None:
        if self.prior.n_gaussians < 2 or not has_uniform_prior_of_light(self.prior):
            raise ParameterError("prior", self.prior, "a prior of 2 Gaussians or more, with masses uniform from 0 to 1")

    @cached_property
    def proposals(self) -> tuple[AddedGaussianProposal, ...]:
        """The proposals that the density mixes: a split per bright Gaussian, an addition, a compensated addition."""
        return (
            *(
                AddedGaussianProposal(
                    _SPLIT / self.n_bright,
                    partial(self.split_gaussian_off_bright_one, label=label),
                    partial(self.merge_last_gaussian_into_bright_one, label=label),
                )
                for label in range(self.n_bright)
            ),
            AddedGaussianProposal(
                _ADDED,
                self.with_drawn_gaussian,
                lambda theta: (self.without_last_gaussian(theta), self.log_density_of_drawn_gaussian(theta)),
            ),
            AddedGaussianProposal(
                1.0 - _ADDED - _SPLIT, self.with_compensated_gaussian, self.without_compensated_gaussian
            ),
        )

    def log_density_over_prior(self, theta: FloatArray) -> FloatArray:
        """Log of the density over the prior's, plus ln Z of N - 1; Gaussians sorted by mass, (n, 6 N + 2) -> (n,)."""
        parts = np.empty((len(self.proposals), len(theta)))
        for part, proposal in zip(parts, self.proposals, strict=True):
            rest, part[:] = proposal.back(theta)
            possible = np.flatnonzero(part > -np.inf)
            if possible.size:
                part[possible] += self.below.log_likelihood(rest[possible]) + math.log(proposal.share)
        return np.asarray(logsumexp(parts, axis=0) - math.log(self.prior.n_gaussians))

    def draw(self, rest: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Add a Gaussian to each sample of N - 1, sorted by mass, (n, 6 N - 4) -> (n, 6 N + 2); nan: impossible."""
        which = rng.choice(len(self.proposals), size=len(rest), p=[proposal.share for proposal in self.proposals])
        out = np.empty((len(rest), rest.shape[1] + 6))
        for k, proposal in enumerate(self.proposals):
            out[which == k] = proposal.draw(rest[which == k], rng=rng)
        return out

    def propose_moves(self, here: FloatArray, *, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Replace one faint Gaussian: the others shift to compensate, or the new one is split off a bright one.

        Return the new parameters, (n, 6 N + 2), nan where there are none; and the log of the density over the prior's
        at the old parameters, minus that at the new ones, (n,); -inf where the move is impossible.
        """
        there, log_drawn = np.empty(here.shape), np.empty(len(here))
        split = rng.random(len(here)) < _RESPLIT
        for rows, move in (
            (np.flatnonzero(split), self._propose_merge_and_split),
            (np.flatnonzero(~split), self._propose_faint_gaussian_replaced),
        ):
            there[rows], log_drawn[rows] = move(here[rows], rng=rng)
        return there, log_drawn

    def _propose_faint_gaussian_replaced(
        self, here: FloatArray, *, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Take away any one faint Gaussian, undo the shift of the others, add another one and shift them for it.

        The new one may be heavier than other faint ones, so that each of these is moved, not the lightest alone. `here`
        is sorted; the new one comes last. Return as `propose_moves` does.
        """
        m, n = len(here), self.prior.n_gaussians
        g = here[:, :-2].reshape(m, n, 6)
        label = rng.integers(self.n_bright, n, size=m)
        others = g[np.arange(n) != label[:, None]].reshape(m, 6 * (n - 1))
        rest = np.concatenate([others, here[:, -2:]], axis=1)
        old = g[np.arange(m), label]
        before, log_here = self._undo_compensation(
            rest, old, self.compensation.linear.shift_for_added_gaussian(old), False
        )
        there, log_drawn = np.full(here.shape, np.nan), np.full(m, -np.inf)
        rows = np.flatnonzero(np.isfinite(log_here))
        if rows.size:
            after, last, answer = self._draw_gaussian_and_compensate(before[rows], False, rng)
            real = np.isfinite(after).all(axis=1)
            rows, after, last, answer = rows[real], after[real], last[real], answer.select_rows(np.flatnonzero(real))
            there[rows] = _insert_gaussian_before_levels(after, last)
            log_there = self._undo_compensation(after, last, answer, False)[1]
            log_drawn[rows] = np.where(np.isfinite(log_there), log_here[rows] - log_there, -np.inf)
        return there, log_drawn

    def without_last_gaussian(self, theta: FloatArray) -> FloatArray:
        """Leave out the last Gaussian, (n, 6 N + 2) -> (n, 6 N - 4)."""
        return np.concatenate([theta[:, :-8], theta[:, -2:]], axis=1)

    def with_drawn_gaussian(self, rest: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Add a Gaussian, drawn from the density r of the class, to N - 1 sorted ones, (n, 6 N - 4) -> (n, 6 N + 2)."""
        n = len(rest)
        near = rng.random(n) < _NEAR
        last = self.prior.from_unit_cube(rng.random((n, len(self.prior.names))))[:, :6]
        last[near] = self._draw_gaussians_near_others(rest[near], rng)
        ratio = np.where(near, 1.0 - rng.random(len(rest)), _draw_mass_ratios(len(rest), rng))
        last[:, 0] = (
            ratio * self._greatest_faint_mass(self._masses(rest), last_of_all=True) * self._amplitude_at_unit_mass(last)
        )
        return _insert_gaussian_before_levels(rest, last)

    def log_density_of_drawn_gaussian(self, theta: FloatArray) -> FloatArray:
        """Log of r / m, as defined for the class, at the last Gaussian, (n, 6 N + 2) -> (n,)."""
        mass = self._masses(theta)
        least = self._greatest_faint_mass(mass[:, :-1], last_of_all=True)
        near = self._log_density_near_others(theta[:, -8:-2], self.without_last_gaussian(theta))
        anywhere = _log_density_of_mass_ratio(mass[:, -1] / least)
        return np.asarray(np.logaddexp(math.log(1.0 - _NEAR) + anywhere, math.log(_NEAR) + near) - np.log(least))

    def with_compensated_gaussian(self, rest: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Add a Gaussian to N - 1 sorted ones and shift these, (n, 6 N - 4) -> (n, 6 N + 2)."""
        return _insert_gaussian_before_levels(*self._draw_gaussian_and_compensate(rest, True, rng)[:2])

    def without_compensated_gaussian(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Take away the last Gaussian and undo the others' shift for it, (n, 6 N + 2) -> (n, 6 N - 4).

        Also return the log density of its addition over the prior's, (n,), as `AddedGaussianProposal.back` does.
        """
        last = theta[:, -8:-2]
        answer = self.compensation.linear.shift_for_added_gaussian(last)
        return self._undo_compensation(self.without_last_gaussian(theta), last, answer, True)

    def _draw_gaussian_and_compensate(
        self, rest: FloatArray, last_of_all: bool, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray, CompensatingShift]:
        """Draw a Gaussian and shift N - 1 others, sorted by mass, to compensate; `last_of_all`: it is the lightest.

        Return the others, (n, 6 N - 4), nan where impossible, the new one, (n, 6), and its compensating shift.
        """
        last, answer = self.compensation.draw(len(rest), rng=rng)
        near = np.flatnonzero(rng.random(len(rest)) < _NEAR)
        last[near] = self._draw_gaussians_near_others(rest[near], rng)
        answer = answer.with_rows_replaced(near, self.compensation.linear.shift_for_added_gaussian(last[near]))
        masses = self._masses(rest)
        whole, most = masses.sum(axis=1), self._greatest_faint_mass(masses, last_of_all=last_of_all)
        told = answer.draw_light_share(most / (whole + most), rng=rng)
        by_share = rng.random(len(rest)) < _TOLD
        ratio = np.where(by_share, told / (1.0 - told) * whole / most, _draw_mass_ratios(len(rest), rng))
        last[:, 0] = ratio * most * self._amplitude_at_unit_mass(last)
        share = ratio * most / (whole + ratio * most)
        coordinates = self.compensation.coordinates
        after, log_prior = coordinates.leave(coordinates.enter(rest) + share[:, None] * answer.shift)
        return np.where(np.isfinite(log_prior)[:, None], after, np.nan), last, answer

    def _undo_compensation(
        self, after: FloatArray, last: FloatArray, answer: CompensatingShift, last_of_all: bool
    ) -> tuple[FloatArray, FloatArray]:
        """Undo the shift of the others `after`, (n, 6 N - 4), that compensates for the Gaussian `last`, (n, 6).

        Return the others before, and the log density of shift and addition over the prior's, (n,); -inf where
        impossible.
        """
        coordinates = self.compensation.coordinates
        masses, mass = self._masses(after), last[:, 0] / self._amplitude_at_unit_mass(last)
        whole, most = masses.sum(axis=1), self._greatest_faint_mass(masses, last_of_all=last_of_all)
        share, ratio = mass / (whole + mass), mass / most
        x = coordinates.enter(after)
        log_after = coordinates.leave(x)[1]
        before, log_before = coordinates.leave(x - share[:, None] * answer.shift)
        log_share = answer.log_light_share_density(share, most / (whole + most))
        log_share += np.log(most * whole) - 2.0 * np.log(whole + mass)  # d share / d ratio
        log_ratio = np.logaddexp(math.log(1.0 - _TOLD) + _log_density_of_mass_ratio(ratio), math.log(_TOLD) + log_share)
        near = self._log_density_near_others(last, np.where(np.isfinite(log_before)[:, None], before, after))
        log_shape = np.logaddexp(
            math.log(1.0 - _NEAR) + self.compensation.log_density_over_prior(answer), math.log(_NEAR) + near
        )
        with np.errstate(invalid="ignore"):  # where both are impossible
            found = log_shape + log_ratio - np.log(most) + log_before - log_after
        return before, np.where((ratio < 1.0) & np.isfinite(found), found, -np.inf)

    def _draw_gaussians_near_others(self, rest: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Draw Gaussians, (n, 6), each near one of the others, (n, 6 N - 4); their masses are to be replaced."""
        n = len(rest)
        u = rng.random((n, len(self.prior.names)))
        centre, width = self._cube_places_and_kernel_widths(rest)
        chosen = np.arange(n), rng.integers(self.prior.n_gaussians - 1, size=n)
        u[:, _SHAPE] = _draw_truncated_normal(centre[chosen], width[chosen], rng)
        return self.prior.from_unit_cube(u)[:, :6]

    def _log_density_near_others(self, last: FloatArray, rest: FloatArray) -> FloatArray:
        """Log density of shapes, (n, 6), near one of the others, (n, 6 N - 4), over the prior's, (n,)."""
        centre, width = self._cube_places_and_kernel_widths(rest)
        at = self._cube_places_and_kernel_widths(_insert_gaussian_before_levels(rest[:, -2:], last))[0]
        return np.asarray(
            logsumexp(_log_truncated_normal_density(at, centre, width), axis=1) - math.log(self.prior.n_gaussians - 1)
        )

    def split_gaussian_off_bright_one(self, rest: FloatArray, label: int, *, rng: np.random.Generator) -> FloatArray:
        """Split one off the bright Gaussian `label`, (n, 6 N - 4) -> (n, 6 N + 2); nan where no Gaussian is left."""
        last = self._draw_gaussian_near_bright_one(
            rest, label, self._greatest_faint_mass(self._masses(rest), last_of_all=True), rng
        )
        return self._split_gaussian_off(rest, label, last)

    def merge_last_gaussian_into_bright_one(self, theta: FloatArray, label: int) -> tuple[FloatArray, FloatArray]:
        """Merge the last Gaussian into the bright one `label`, (n, 6 N + 2) -> (n, 6 N - 4).

        Also return the log density of the reverse split over the prior's, (n,), as `AddedGaussianProposal.back` does.
        """
        rest = self._merge_gaussian_into_bright_one(self.without_last_gaussian(theta), label, theta[:, -8:-2])
        most = self._greatest_faint_mass(self._masses(rest), last_of_all=True)
        return rest, self._log_density_of_split(rest, self.without_last_gaussian(theta), label, theta[:, -8:-2], most)

    def _propose_merge_and_split(self, here: FloatArray, *, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Merge a faint Gaussian into a bright one, split another off a bright one; return as `propose_moves` does."""
        m, n = len(here), self.prior.n_gaussians
        there, log_drawn = np.full(here.shape, np.nan), np.full(m, -np.inf)
        label = rng.integers(self.n_bright, n, size=m)
        to, of = rng.integers(self.n_bright, size=(2, m))
        for faint, to_bright, of_bright in itertools.product(
            range(self.n_bright, n), range(self.n_bright), range(self.n_bright)
        ):
            rows = np.flatnonzero((label == faint) & (to == to_bright) & (of == of_bright))
            if not rows.size:
                continue
            old = here[rows]
            last = old[:, 6 * faint : 6 * faint + 6]
            others = np.delete(old, slice(6 * faint, 6 * faint + 6), axis=1)
            rest = self._merge_gaussian_into_bright_one(others, to_bright, last)
            most = self._greatest_faint_mass(self._masses(rest), last_of_all=False)
            log_here = self._log_density_of_split(rest, others, to_bright, last, most)
            new_last = self._draw_gaussian_near_bright_one(rest, of_bright, most, rng)
            new = self._split_gaussian_off(rest, of_bright, new_last)
            log_there = self._log_density_of_split(rest, self.without_last_gaussian(new), of_bright, new_last, most)
            there[rows] = new
            with np.errstate(invalid="ignore"):
                log_drawn[rows] = np.where(
                    np.isfinite(log_here) & np.isfinite(log_there), log_here - log_there, -np.inf
                )
        return there, log_drawn

    def _draw_gaussian_near_bright_one(
        self, rest: FloatArray, label: int, most: FloatArray, rng: np.random.Generator
    ) -> FloatArray:
        """Draw a Gaussian near the bright one number `label`, (n, 6), of a mass up to `most`, (n,)."""
        n = len(rest)
        u = rng.random((n, len(self.prior.names)))
        centre, width = self._cube_places_and_kernel_widths(rest)
        u[:, _SHAPE] = _draw_truncated_normal(centre[:, label], width[:, label], rng)
        last = self.prior.from_unit_cube(u)[:, :6]
        last[:, 0] = _draw_mass_ratios(n, rng) * most * self._amplitude_at_unit_mass(last)
        return last

    def _split_gaussian_off(self, rest: FloatArray, label: int, last: FloatArray) -> FloatArray:
        """Subtract the moments of `last` from those of Gaussian `label`, and append it; nan where none is left."""
        own = slice(6 * label, 6 * label + 6)
        left = self._gaussian_from_moments(self._moments_of_gaussian(rest[:, own]) - self._moments_of_gaussian(last))
        out = _insert_gaussian_before_levels(rest, last)
        out[:, own] = left
        return np.where(np.isfinite(left).all(axis=1, keepdims=True), out, np.nan)

    def _merge_gaussian_into_bright_one(self, others: FloatArray, label: int, last: FloatArray) -> FloatArray:
        """Add the moments of `last` to those of Gaussian `label`: light, centre and covariance of the two stay."""
        own = slice(6 * label, 6 * label + 6)
        out = others.copy()
        out[:, own] = self._gaussian_from_moments(
            self._moments_of_gaussian(others[:, own]) + self._moments_of_gaussian(last)
        )
        return out

    def _log_density_of_split(
        self, rest: FloatArray, others: FloatArray, label: int, last: FloatArray, most: FloatArray
    ) -> FloatArray:
        """Log density over the prior's, (n,), of splitting `last` off Gaussian `label` of `rest`, leaving `others`.

        `most`: greatest mass of `last`. -inf where the split is impossible.
        """
        own = slice(6 * label, 6 * label + 6)
        centre, width = self._cube_places_and_kernel_widths(rest)
        ratio = last[:, 0] / self._amplitude_at_unit_mass(last) / np.maximum(most, _TINY)
        at = self._cube_places_and_kernel_widths(_insert_gaussian_before_levels(rest[:, -2:], last))[0][:, 0]
        # At a fixed last Gaussian the moments of the bright one are shifted, so volumes in them stay.
        with np.errstate(divide="ignore", invalid="ignore"):
            found = self._log_prior_of_moments(rest[:, own], rest) - self._log_prior_of_moments(others[:, own], rest)
            found += (
                _log_truncated_normal_density(at, centre[:, label], width[:, label])
                + _log_density_of_mass_ratio(ratio)
                - np.log(most)
            )
        possible = (ratio < 1.0) & (ratio > 0.0) & np.isfinite(found)
        possible[possible] = count_bright_gaussians(rest[possible]) == self.n_bright
        return np.where(possible, found, -np.inf)

    def _log_prior_of_moments(self, g: FloatArray, levels_of: FloatArray) -> FloatArray:
        """Log prior density of one Gaussian in the coordinates of its moments, up to a constant, (n, 6) -> (n,)."""
        alone = replace(self.prior, n_gaussians=1)
        log_det = np.log(np.maximum(g[:, 3] * g[:, 4] - g[:, 5] ** 2, _TINY))
        log_mass = np.log(g[:, 0] / self._amplitude_at_unit_mass(g))
        log_prob = alone.log_prob_by_kind(g.T[:, None].copy(), levels_of[:, -2], levels_of[:, -1])
        return np.asarray(log_prob - 5.0 * log_mass + 3.5 * log_det)

    def _moments_of_gaussian(self, g: FloatArray) -> FloatArray:
        """Compute mass and mass times u, v, and the second moments uu, vv, uv about the origin, (n, 6) -> (n, 6)."""
        det = g[:, 3] * g[:, 4] - g[:, 5] ** 2
        u, v = g[:, 1], g[:, 2]
        ones = np.ones(len(g))
        each = [ones, u, v, 0.5 * g[:, 4] / det + u * u, 0.5 * g[:, 3] / det + v * v, -0.5 * g[:, 5] / det + u * v]
        return np.stack(each, axis=1) * (g[:, 0] / self._amplitude_at_unit_mass(g))[:, None]

    def _gaussian_from_moments(self, m: FloatArray) -> FloatArray:
        """Compute a Gaussian's parameters from its moments, (n, 6) -> (n, 6); nan where no Gaussian has the moments."""
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = m[:, 1] / m[:, 0], m[:, 2] / m[:, 0]
            uu, vv, uv = m[:, 3] / m[:, 0] - u * u, m[:, 4] / m[:, 0] - v * v, m[:, 5] / m[:, 0] - u * v
            det = uu * vv - uv * uv
            real = (m[:, 0] > 0) & (uu > 0) & (vv > 0) & (det > 0)
            g = np.stack([m[:, 0], u, v, 0.5 * vv / det, 0.5 * uu / det, -0.5 * uv / det], axis=1)
            g[:, 0] *= self._amplitude_at_unit_mass(g)
        return np.where(real[:, None], g, np.nan)

    def _greatest_faint_mass(self, masses: FloatArray, *, last_of_all: bool) -> FloatArray:
        """Return a tenth of the heaviest of the masses, (n, N - 1) -> (n,); with `last_of_all` at most the lightest."""
        most = FAINT * masses.max(axis=1)
        return np.asarray(np.minimum(most, masses.min(axis=1)) if last_of_all else most)

    def _amplitude_at_unit_mass(self, g: FloatArray) -> FloatArray:
        """Return the amplitudes of Gaussians of these widths at the prior's unit of mass, (..., 6) -> (...)."""
        return self.prior.amplitude_at_unit_mass(g[..., 3] * g[..., 4] - g[..., 5] ** 2)

    def _masses(self, theta: FloatArray) -> FloatArray:
        """Masses in the prior's unit, (n, 6 N' + 2) -> (n, N')."""
        g = theta[:, :-2].reshape(len(theta), theta.shape[1] // 6, 6)
        return np.asarray(g[..., 0] / self._amplitude_at_unit_mass(g))

    def _cube_places_and_kernel_widths(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the coordinates of each Gaussian in the prior's cube, without its mass, and the sds of kernels there.

        Both are (n, N', 5): centre along x' and y', A, B, correlation.
        """
        prior = self.prior
        g = theta[:, :-2].reshape(len(theta), theta.shape[1] // 6, 6)
        a, b = g[..., 3], g[..., 4]
        correlation = g[..., 5] / np.sqrt(a * b)
        sides = [
            prior.offset_mm.to_unit(g[..., 1]),
            prior.offset_mm.to_unit(g[..., 2]),
            prior.precision.to_unit(a),
            prior.precision.to_unit(b),
            0.5 + 0.5 * correlation / prior.max_correlation,
        ]
        centre = np.stack(sides, axis=-1).clip(0.0, 1.0)
        span_mm = float(np.ptp(prior.offset_mm.from_unit(np.array([0.0, 1.0]))))
        sd_mm = np.sqrt(0.5 / (1.0 - correlation**2))[..., None] / np.sqrt(g[..., 3:5])
        width = np.empty_like(centre)
        width[..., :2] = (sd_mm / span_mm).clip(_LEAST_WIDTH, _MOST_WIDTH)
        width[..., 2:4] = _NEAR_PRECISION
        width[..., 4] = _NEAR_CORRELATION
        return centre, width


def _insert_gaussian_before_levels(rest: FloatArray, last: FloatArray) -> FloatArray:
    """Put a Gaussian, (n, 6), before the levels, (n, 6 N - 4) -> (n, 6 N + 2)."""
    return np.concatenate([rest[:, :-2], last, rest[:, -2:]], axis=1)


def _draw_mass_ratios(n: int, rng: np.random.Generator) -> FloatArray:
    """Draw `n` ratios of a new mass to the greatest that it may have, (n,)."""
    ratio = 1.0 - rng.random(n)
    light = rng.random(n) >= _EVEN_MASS
    ratio[light] = _LEAST_RATIO ** (1.0 - ratio[light])
    return ratio


def _log_density_of_mass_ratio(ratio: FloatArray) -> FloatArray:
    """Log density of the ratio of a new mass to the greatest that it may have, (n,) -> (n,)."""
    light = (1.0 - _EVEN_MASS) / (-math.log(_LEAST_RATIO) * np.maximum(ratio, _TINY))
    return np.asarray(np.log(_EVEN_MASS + np.where(ratio > _LEAST_RATIO, light, 0.0)))


def _draw_truncated_normal(centre: FloatArray, width: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Draw from normal kernels of mean `centre` and sd `width`, truncated at the unit cube, (n, 5)."""
    low, high = ndtr(-centre / width), ndtr((1.0 - centre) / width)
    return np.asarray((centre + width * ndtri(low + rng.random(centre.shape) * (high - low))).clip(1e-9, 1.0 - 1e-9))


def _log_truncated_normal_density(at: FloatArray, centre: FloatArray, width: FloatArray) -> FloatArray:
    """Log density of a normal kernel truncated at the unit cube, (..., 5) -> (...,)."""
    kept = ndtr((1.0 - centre) / width) - ndtr(-centre / width)
    return np.asarray(
        (-0.5 * ((at - centre) / width) ** 2 - np.log(width * math.sqrt(2.0 * math.pi) * kept)).sum(axis=-1)
    )
