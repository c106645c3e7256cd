"""How the parameters of N - 1 Gaussians shift when one light Gaussian is added, to first order.

Adding a Gaussian that holds the share s of the light changes the predicted readings by s times a known curve. To first
order the other parameters shift to compensate. The covariances of parameters and predictions over the posterior's
samples determine the shift (as in the ensemble Kalman filter, Evensen 1994), and s itself has a normal posterior. Its
integral over s shows which places and widths of the new Gaussian fit the readings, before any likelihood is evaluated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr, logsumexp, ndtri_exp

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.calibration.coordinates import MomentCoordinates
from probewise.calibration.gaussian_responses import SingleGaussianResponses, total_light_by_gaussian
from probewise.calibration.whole_coordinates import WholeFootprintCoordinates
from probewise.effects.noise_distribution import log_gaussian_mass_between
from probewise.inference import SensorProblem, sd_floor
from probewise.nested.weights import n_effective, resampled_rows

# All particles take their shapes from one pool, whose scatter no cloud shows: with 6,000 it was the greatest part of
# the error of ln Z of two Gaussians. So many are drawn at a time, until enough are effective or there are many.
_N_DRAWN, _EFFECTIVE, _MOST_DRAWN = 12_000, 4_000, 60_000
_AT_ONCE = 500
# First-order evidences are tempered, and a share of the shapes does without: far from the mean they mislead.
_TEMPERED, _PLAIN = 0.8, 0.1

# The information on a share is at least this part of what it would be with the other parameters fixed.
_LEAST_TOLD = 0.1
_WIDENED = 1.2
_LOG_ROOT_2PI = 0.5 * float(np.log(2.0 * np.pi))


@dataclass(frozen=True, eq=False)
class CompensatingShift:
    """Shift of the other Gaussians' coordinates that compensates for one Gaussian more, and that one's share of light.

    `shift`: per unit of that share, (n, d). `mean`, `sd`: of the share's first-order posterior, (n,) each; the sd is
    widened by 1.2.
    """

    shift: FloatArray
    mean: FloatArray
    sd: FloatArray

    @classmethod
    def concatenate(cls, parts: Sequence[CompensatingShift]) -> CompensatingShift:
        """Concatenate the rows of several shifts."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("shift", "mean", "sd")))

    def select_rows(self, rows: IntArray) -> CompensatingShift:
        """Select rows."""
        return CompensatingShift(self.shift[rows], self.mean[rows], self.sd[rows])

    def with_rows_replaced(self, rows: IntArray, other: CompensatingShift) -> CompensatingShift:
        """Return a copy in which the rows of `other` stand at `rows`."""
        out = self.select_rows(np.arange(len(self.mean)))
        out.shift[rows], out.mean[rows], out.sd[rows] = other.shift, other.mean, other.sd
        return out

    def log_bayes_factor(self, most: float) -> FloatArray:
        """Log of the mean likelihood over shares from 0 to `most`, over that without the added Gaussian, (n,)."""
        true_sd = self.sd / _WIDENED
        low, high, _ = CompensatingShift(self.shift, self.mean, true_sd)._light_share_bounds_in_sds(
            np.full(len(self.mean), most)
        )
        log_mass = log_gaussian_mass_between(low, high)
        return np.asarray(0.5 * (self.mean / true_sd) ** 2 + log_mass + np.log(true_sd / most) + _LOG_ROOT_2PI)

    def draw_light_share(self, most: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Draw shares of the light from 0 to `most`, both (n,), from their truncated first-order posterior."""
        low, high, mirrored = self._light_share_bounds_in_sds(most)
        at_low, at_high = log_ndtr(low), log_ndtr(high)
        # Both bounds are in the lower tail or about 0, so that logarithms keep their digits.
        z = ndtri_exp(at_high + np.log(rng.random(len(most)) * -np.expm1(at_low - at_high) + np.exp(at_low - at_high)))
        return np.asarray((self.mean + self.sd * np.where(mirrored, -z, z)).clip(1e-12 * most, most))

    def log_light_share_density(self, share: FloatArray, most: FloatArray) -> FloatArray:
        """Natural log of the density from which `draw_light_share` draws, at `share`, all (n,)."""
        low, high, _ = self._light_share_bounds_in_sds(most)
        log_mass = log_gaussian_mass_between(low, high)
        z = (share - self.mean) / self.sd
        return np.asarray(-0.5 * z * z - _LOG_ROOT_2PI - np.log(self.sd) - log_mass)

    def _light_share_bounds_in_sds(self, most: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return the bounds 0 and `most` in sds from the mean, (n,) each; and the mask of mirrored rows, (n,).

        Where both bounds lie above the mean, they change places and signs (mirrored).
        """
        low, high = -self.mean / self.sd, (most - self.mean) / self.sd
        mirrored = low > 0
        return np.where(mirrored, -high, low), np.where(mirrored, -low, high), mirrored


@dataclass(frozen=True, eq=False)
class _LinearisedPosterior:
    """Posterior of N - 1 Gaussians, linearised about its mean; n_used is the number of usable readings.

    Attributes
    ----------
    alone
        Problem of one Gaussian.
    response
        Matrix that multiplies a change of the readings in noise sds, (n_used, 1 + d). Column 0 gives the product with
        the mean residual, the others give minus the shift of the coordinates. The light's shares do not shift.
    inverse
        Inverse covariance of the coordinates that shift, with zeros for the others, (d, d).
    dark, bright
        Mean prediction minus I_min, and mean of I_max - I_min, both in noise sds, (n_used,).
    """

    alone: SensorProblem
    response: FloatArray
    inverse: FloatArray
    dark: FloatArray
    bright: FloatArray

    @classmethod
    def from_samples(
        cls,
        below: SensorProblem,
        coordinates: MomentCoordinates | WholeFootprintCoordinates,
        alone: SensorProblem,
        theta: FloatArray,
    ) -> _LinearisedPosterior:
        """Compute means and covariances from samples `theta`, (n, 6 N - 4), of the posterior of problem `below`."""
        recording = below.recording
        used = recording.usable
        predicted = below.model.predict(theta, recording.plan)[:, used]
        mean = predicted.mean(axis=0)
        residual = recording.readings[used] - mean
        scan = np.unique(recording.plan.scan[used], return_inverse=True)[1]
        variance = np.bincount(scan, residual**2) / np.bincount(scan)
        per_sd = 1.0 / np.maximum(np.sqrt(variance), sd_floor(recording))[scan]
        x = coordinates.enter(theta)
        off = x - x.mean(axis=0)
        # Only the whole and the levels shift: the readings contain too little information on the Gaussians' shares.
        shifts = np.zeros(x.shape[1], dtype=np.bool_)
        shifts[1:6] = shifts[-2:] = True
        off[:, ~shifts] = 0.0
        covariance = off.T @ off / len(off)
        inverse = np.zeros_like(covariance)
        own = np.ix_(shifts, shifts)
        inverse[own] = np.linalg.pinv(covariance[own], hermitian=True)
        return cls(
            alone,
            np.column_stack([residual * per_sd, ((predicted - mean) * per_sd).T @ off / len(off)]),
            inverse,
            (mean - float(theta[:, -2].mean())) * per_sd,
            float((theta[:, -1] - theta[:, -2]).mean()) * per_sd,
        )

    def shift_for_added_gaussian(self, gaussian: FloatArray) -> CompensatingShift:
        """Return the shifts that compensate for one Gaussian more per row, (n, 6); its amplitude does not matter."""
        blocks = np.array_split(gaussian, max(1, -(-len(gaussian) // _AT_ONCE)))
        parts = [self._compensating_shift_of_block(block) for block in blocks]
        return CompensatingShift.concatenate(parts)

    def _compensating_shift_of_block(self, gaussian: FloatArray) -> CompensatingShift:
        if not len(gaussian):
            return CompensatingShift(np.empty((0, len(self.inverse))), np.empty(0), np.empty(0))
        change = SingleGaussianResponses(self.alone).responses_to_gaussians(gaussian) * self.bright
        change -= self.dark
        told = np.einsum("ni,ni->n", change, change)
        both = change @ self.response
        shift = -both[:, 1:]
        told = np.maximum(told - np.einsum("ni,ni->n", shift @ self.inverse, shift), _LEAST_TOLD * told) + 1e-12
        return CompensatingShift(shift, both[:, 0] / told, _WIDENED / np.sqrt(told))


@dataclass(frozen=True, eq=False)
class CompensatedShapeProposal:
    """A proposal of one Gaussian more: its shape (centre and widths), and how the other N - 1 shift to compensate.

    Shapes are drawn from a large pool of draws from the prior, nine tenths by their first-order evidence, the rest
    evenly.

    Attributes
    ----------
    coordinates
        Coordinates of N - 1 Gaussians.
    linear
        Linearised posterior, which gives the shift for a new Gaussian.
    pool
        Gaussians drawn from the prior, (n_pool, 6).
    answers
        Compensating shifts for the Gaussians of the pool, n_pool rows.
    most
        Share of the light up to which first-order Bayes factors are integrated.
    log_norm
        Log of the mean over the pool of the Bayes factors to the power 0.8.
    """

    coordinates: MomentCoordinates | WholeFootprintCoordinates
    linear: _LinearisedPosterior
    pool: FloatArray
    answers: CompensatingShift
    most: float
    log_norm: float

    @classmethod
    def from_samples(
        cls,
        below: SensorProblem,
        coordinates: MomentCoordinates | WholeFootprintCoordinates,
        alone: SensorProblem,
        theta: FloatArray,
        *,
        rng: np.random.Generator,
        n_pool: int = _MOST_DRAWN,
    ) -> CompensatedShapeProposal:
        """Linearise a problem of N - 1 Gaussians about its posterior samples, and draw at most `n_pool` shapes.

        `below`, `alone`: problems of N - 1 Gaussians and of one, over one recording. `coordinates`: of N - 1 Gaussians.
        `theta`: posterior samples of `below`, (n, 6 N - 4). Fewer shapes than `n_pool` are drawn once 4,000 are
        effective.
        """
        linear = _LinearisedPosterior.from_samples(below, coordinates, alone, theta)
        prior = coordinates.prior
        mass = total_light_by_gaussian(theta)
        most = float(np.mean(mass.min(axis=1) / (mass.sum(axis=1) + mass.min(axis=1))))
        pools: list[FloatArray] = []
        answers: list[CompensatingShift] = []
        log_asked = np.empty(0)
        while log_asked.size < n_pool and (not pools or n_effective(log_asked) < _EFFECTIVE):
            n_more = min(_N_DRAWN, n_pool - log_asked.size)
            pools.append(prior.from_unit_cube(rng.random((n_more, len(prior.names))))[:, :6])
            answers.append(linear.shift_for_added_gaussian(pools[-1]))
            log_asked = np.concatenate([log_asked, _TEMPERED * answers[-1].log_bayes_factor(most)])
        log_norm = float(logsumexp(log_asked)) - math.log(log_asked.size)
        return cls(coordinates, linear, np.concatenate(pools), CompensatingShift.concatenate(answers), most, log_norm)

    def draw(self, n: int, *, rng: np.random.Generator) -> tuple[FloatArray, CompensatingShift]:
        """Draw `n` shapes, (n, 6) with amplitudes to be replaced; also return the shifts that compensate for them."""
        log_weight = self.log_density_over_prior(self.answers)
        rows = rng.permutation(resampled_rows(np.exp(log_weight - log_weight.max()), n, rng))
        return self.pool[rows], self.answers.select_rows(rows)

    def log_density_over_prior(self, answer: CompensatingShift) -> FloatArray:
        """Log of the density from which `draw` draws, over the prior's, of shapes with the shifts `answer`, (n,)."""
        asked = _TEMPERED * answer.log_bayes_factor(self.most) - self.log_norm
        return np.asarray(np.logaddexp(math.log(_PLAIN), math.log(1.0 - _PLAIN) + asked))
