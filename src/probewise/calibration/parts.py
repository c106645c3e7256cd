"""Parts of a posterior, by how many of its Gaussians are bright.

One Gaussian that holds nearly all of the light, beside faint ones, and several that share it, are far apart: moves
rarely lead from the one to the other. So each such part is reached, and its evidence found, by itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.calibration.climb import N_SNAPSHOTS, Climb
from probewise.calibration.priors import SSFPrior
from probewise.calibration.whole_coordinates import WholeCoordinates, count_bright
from probewise.nested import NestedResult, Weighted

_N_CLOUDS, _N_SAMPLES = 8, 4000
# A part of which there are fewer samples is left out.
_LEAST_SAMPLES = 40
# What speaks against a part speaks against the whole where the part holds this share.
_COUNTS = 0.1


@dataclass(frozen=True)
class WholeFrame:
    """Where a sensor is, and how large: `centre_mm`, and `size_mm2`, the trace of its covariance."""

    centre_mm: tuple[float, float]
    size_mm2: float

    @classmethod
    def of(cls, theta: FloatArray) -> WholeFrame:
        """Take it from one Gaussian, (8,)."""
        _, u, v, a, b, c = theta[:6]
        return cls((float(u), float(v)), float(0.5 * (a + b) / (a * b - c * c)))

    def coordinates(self, prior: SSFPrior, n_bright: int) -> WholeCoordinates:
        """Coordinates of mixtures of which so many Gaussians are bright."""
        return WholeCoordinates(prior, self.centre_mm, self.size_mm2, n_bright)


@dataclass(frozen=True, eq=False)
class Part:
    """Equally weighted samples of a part, (n, 6 N + 2), cloud after cloud, sorted by mass, and its evidence."""

    theta: FloatArray
    log_z_of_clouds: FloatArray
    start_error: float

    @classmethod
    def of(cls, climbed: Climb) -> Part:
        """Take the samples and the evidence of a climb."""
        return cls(climbed.theta, climbed.log_z_of_clouds, climbed.start_error)

    @property
    def log_z(self) -> float:
        """Natural log of the evidence."""
        return float(logsumexp(self.log_z_of_clouds)) - math.log(len(self.log_z_of_clouds))


def held_shares(parts: dict[int, Part]) -> dict[int, float]:
    """Share of the evidence that each part holds."""
    log_z = np.array([part.log_z for part in parts.values()])
    share = np.exp(log_z - logsumexp(log_z))
    return dict(zip(parts, share.tolist(), strict=True))


def split_by_bright(found: Climb | NestedResult | Weighted, rng: np.random.Generator) -> dict[int, Part]:
    """Split a posterior into its parts, by its samples."""
    if isinstance(found, Climb):
        theta, log_z, error = found.theta, found.log_z_of_clouds, found.start_error
    else:
        theta, error = found.samples(_N_SAMPLES, rng=rng), found.log_z_error
        log_z = np.full(_N_CLOUDS, found.log_z)
        light = theta[:, :-2].reshape(len(theta), -1, 6)
        mass = light[..., 0] / np.sqrt(light[..., 3] * light[..., 4] - light[..., 5] ** 2)
        light = np.take_along_axis(light, np.argsort(-mass, axis=1)[..., None], axis=1)
        theta = np.concatenate([light.reshape(len(theta), -1), theta[:, -2:]], axis=1)
    bright = count_bright(theta)
    parts = {}
    for m in np.unique(bright).tolist():
        rows = np.flatnonzero(bright == m)
        if len(rows) >= _LEAST_SAMPLES:
            # In the order of the clouds.
            chosen = np.sort(rows[(np.arange(_N_SAMPLES) * len(rows)) // _N_SAMPLES])
            parts[m] = Part(theta[chosen], log_z + math.log(len(rows) / len(theta)), error)
    return parts


def joined(made: dict[int, Climb], rng: np.random.Generator) -> Climb:
    """Join climbs to the parts of a posterior: samples of each by its share of the evidence."""
    climbs = list(made.values())
    log_z = np.array([climbed.log_z for climbed in climbs])
    share = np.exp(log_z - logsumexp(log_z))
    main = climbs[int(np.argmax(share))]
    lost = [climbed for climbed in climbs if climbed.temperatures[-1] < 1.0]
    if lost:
        # A climb that was not reached says so itself; how much it holds is not known.
        return lost[0]
    n_clouds = len(main.log_z_of_clouds)
    blocks = n_clouds * N_SNAPSHOTS
    size = len(main.theta) // blocks
    # As many of each part as its share asks for, on average: in each cloud at each time.
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
