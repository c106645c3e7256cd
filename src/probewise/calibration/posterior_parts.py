"""Parts of a posterior, by how many of its Gaussians are bright.

Mixtures with one Gaussian of nearly all light, beside faint ones, and mixtures of several that share the light lie far
apart: moves rarely lead from the former to the latter. So each such part is sampled, and its evidence estimated, by
itself. Bright: more than a tenth of the heaviest one's light.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.calibration.fields import gaussians_sorted_by_mass
from probewise.calibration.priors import SSFPrior
from probewise.calibration.smc import N_CLOUDS, N_SNAPSHOTS, SMCResult
from probewise.calibration.whole_coordinates import WholeFootprintCoordinates, count_bright_gaussians
from probewise.nested import NestedResult, Weighted

_N_SAMPLES = 4000
# A part of which there are fewer samples is left out.
_LEAST_SAMPLES = 40
# A doubt about a part is a doubt about the whole where the part holds this share of the evidence.
_COUNTS = 0.1


@dataclass(frozen=True)
class FootprintPlaceAndSize:
    """Centre and size of the whole footprint: `centre_mm` (x', y'), and `size_mm2`, the trace of its covariance."""

    centre_mm: tuple[float, float]
    size_mm2: float

    @classmethod
    def from_gaussian(cls, theta: FloatArray) -> FootprintPlaceAndSize:
        """Take centre and size from the parameters of an SSF of one Gaussian, (8,)."""
        _, u, v, a, b, c = theta[:6]
        return cls((float(u), float(v)), float(0.5 * (a + b) / (a * b - c * c)))

    def whole_footprint_coordinates(self, prior: SSFPrior, n_bright: int) -> WholeFootprintCoordinates:
        """Return the coordinates of mixtures of which `n_bright` Gaussians are bright."""
        return WholeFootprintCoordinates(prior, self.centre_mm, self.size_mm2, n_bright)


@dataclass(frozen=True, eq=False)
class PosteriorPart:
    """Equally weighted samples of a part, (n, 6 N + 2), cloud after cloud, Gaussians sorted by mass; and its evidence.

    `log_z_of_clouds`, (n_clouds,), and `start_error` are those of an `SMCResult`.
    """

    theta: FloatArray
    log_z_of_clouds: FloatArray
    start_error: float

    @classmethod
    def from_smc(cls, climbed: SMCResult) -> PosteriorPart:
        """Take the samples and the evidence of an SMC run."""
        return cls(climbed.theta, climbed.log_z_of_clouds, climbed.start_error)

    @property
    def log_z(self) -> float:
        """Natural log of the mean of the clouds' evidences."""
        return float(logsumexp(self.log_z_of_clouds)) - math.log(len(self.log_z_of_clouds))


def evidence_shares(parts: dict[int, PosteriorPart]) -> dict[int, float]:
    """Return the share of the evidence that each part holds, by number of bright Gaussians."""
    return dict(zip(parts, _normalised_evidences(parts.values()).tolist(), strict=True))


def _normalised_evidences(each: Iterable[PosteriorPart | SMCResult]) -> FloatArray:
    """Return the evidences divided by their sum, (n_parts,)."""
    log_z = np.array([one.log_z for one in each])
    return np.asarray(np.exp(log_z - logsumexp(log_z)))


def split_posterior_by_n_bright(
    found: SMCResult | NestedResult | Weighted, rng: np.random.Generator
) -> dict[int, PosteriorPart]:
    """Split a posterior's samples by their number of bright Gaussians, and its evidence by the samples' shares.

    Return a dict by that number, without parts of fewer than 40 samples.
    """
    if isinstance(found, SMCResult):
        theta, log_z, error = found.theta, found.log_z_of_clouds, found.start_error
    else:
        theta, log_z, error = found.samples(_N_SAMPLES, rng=rng), np.full(N_CLOUDS, found.log_z), found.log_z_error
        theta = gaussians_sorted_by_mass(theta, theta.shape[1] // 6)
    bright = count_bright_gaussians(theta)
    parts = {}
    for m in np.unique(bright).tolist():
        rows = np.flatnonzero(bright == m)
        if len(rows) >= _LEAST_SAMPLES:
            # In the order of the clouds.
            chosen = np.sort(rows[(np.arange(_N_SAMPLES) * len(rows)) // _N_SAMPLES])
            parts[m] = PosteriorPart(theta[chosen], log_z + math.log(len(rows) / len(theta)), error)
    return parts


def join_smc_results_of_parts(made: dict[int, SMCResult], rng: np.random.Generator) -> SMCResult:
    """Join SMC runs to the parts of a posterior, given by number of bright Gaussians, into one result.

    Each part contributes samples by its share of the evidence. If a run did not reach its part, it is returned alone.
    """
    climbs = list(made.values())
    share = _normalised_evidences(climbs)
    main = climbs[int(np.argmax(share))]
    lost = [climbed for climbed in climbs if climbed.temperatures[-1] < 1.0]
    if lost:
        # A run that did not reach its part says so itself; how much the part holds is not known.
        return lost[0]
    n_clouds = len(main.log_z_of_clouds)
    blocks = n_clouds * N_SNAPSHOTS
    size = len(main.theta) // blocks
    # Samples of each part in proportion to its share, on average: in each cloud and snapshot.
    up_to = np.floor(np.concatenate([[0.0], np.cumsum(share)])[:, None] * size + rng.random(blocks)).astype(np.int64)
    up_to[0], up_to[-1] = 0, size
    counts = np.diff(up_to, axis=0)
    theta, log_likelihood = [], []
    for block in range(blocks):
        for climbed, count in zip(climbs, counts[:, block], strict=True):
            own = len(climbed.theta) // blocks
            rows = block * own + np.resize(rng.permutation(own), count)
            theta.append(climbed.theta[rows])
            log_likelihood.append(climbed.log_likelihood[rows])
    error = math.sqrt(sum((float(s) * climbed.start_error) ** 2 for s, climbed in zip(share, climbs, strict=True)))
    large = [climbed for s, climbed in zip(share, climbs, strict=True) if s > _COUNTS]
    return replace(
        main,
        theta=np.concatenate(theta),
        log_likelihood=np.concatenate(log_likelihood),
        log_weight=np.full(size * blocks, -math.log(size * blocks)),
        log_z_of_clouds=logsumexp([climbed.log_z_of_clouds for climbed in climbs], axis=0),
        start_error=error,
        accepted=min(climbed.accepted for climbed in large),
        n_calls=sum(climbed.n_calls for climbed in climbs),
        doubts=tuple(dict.fromkeys(doubt for climbed in large for doubt in climbed.doubts)),
    )
