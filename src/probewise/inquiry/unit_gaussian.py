"""Tables of the unit Gaussian's mass inside a corner and inside a curved edge, which approximate any shape locally.

Distances are in sds of the footprint across the edge, positive inside. Entries are evenly spaced and the nearest one is
used, with an rms error of at most 0.4 % of the span between dark and bright, less than the noise.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray, IntArray
from probewise.inquiry.scanlines import to_int32, to_single_precision

REACH = 4.0
"""Sds beyond which an edge is negligible: 3e-5 of the span."""

N_OPENINGS = 64
"""Number of corners in the table: correlations of the two distances, evenly spaced in their arc sine."""

_PER_SD = 32
_N = int(2 * REACH * _PER_SD) + 1
_N_BENDS = 64
_NODES = 40


def mass_within_corner(first: FloatArray, second: FloatArray, opening: IntArray) -> FloatArray:
    """Return the mass of the unit Gaussian inside both edges of a corner: bivariate normal CDF of their distances.

    `first`, `second`: the distances inside, sds. `opening` numbers their correlation r: floor((arcsin(r) / pi + 1 / 2)
    N_OPENINGS).
    """
    index = opening * (_N * _N) + _distance_index(second) * _N
    index += _distance_index(first)
    return np.asarray(_corner_table().reshape(-1)[index])


def mass_within_curved_edge(distance: FloatArray, bend: FloatArray) -> FloatArray:
    """Return the mass of the unit Gaussian inside a curved edge, at a signed `distance` in sds, positive inside.

    `bend`: the edge's curvature times the sd, 0 or more.
    """
    index = np.minimum(to_int32(bend / (1.0 + bend) * _N_BENDS), _N_BENDS - 1) * _N
    index += _distance_index(distance)
    return np.asarray(_curved_edge_table().reshape(-1)[index])


def _distance_index(distance: FloatArray) -> IntArray:
    """Return the index of the nearest tabulated distance."""
    return to_int32(np.clip(distance, -REACH, REACH) * _PER_SD + (REACH * _PER_SD + 0.5))


@cache
def _corner_table() -> FloatArray:
    """Tabulate the bivariate normal CDF F(h, k; r) for correlations r and distances h, k: (N_OPENINGS, n, n).

    Plackett's integral over t, the correlation's arc sine:

    d/dt F(h, k; sin t) = exp(-(h^2 - 2 h k sin t + k^2) / (2 cos^2 t)) / 2 pi (Plackett 1954), from F(h, k; 0), the
    product; and F(h, k; -r) = F(h) - F(h, -k; r).
    """
    distance = np.linspace(-REACH, REACH, _N)
    h, k = distance[:, None], distance[None, :]
    half = N_OPENINGS // 2
    step = np.pi / N_OPENINGS
    node, share = np.polynomial.legendre.leggauss(3)
    out = np.empty((N_OPENINGS, _N, _N), dtype=np.float32)
    total, at = ndtr(h) * ndtr(k), 0.0
    for n in range(half):
        until = (n + 0.5) * step
        for angle, part in zip(at + (until - at) * (node + 1) / 2, share * (until - at) / 2, strict=True):
            away = (h * h - 2 * h * k * np.sin(angle) + k * k) / (2 * np.cos(angle) ** 2)
            total += part / (2 * np.pi) * np.exp(-away)
        at = until
        out[half + n] = total
        out[half - 1 - n] = ndtr(h) - total[:, ::-1]
    return to_single_precision(out)


@cache
def _curved_edge_table() -> FloatArray:
    """Tabulate (n_bends, n): for a parabola, E[F(distance - bend t^2 / 2)], t unit Gaussian, by Gauss-Hermite."""
    node, share = np.polynomial.hermite_e.hermegauss(_NODES)
    middle = (np.arange(_N_BENDS) + 0.5) / _N_BENDS
    bend = (middle / (1.0 - middle))[:, None, None]
    distance = np.linspace(-REACH, REACH, _N)[:, None]
    return to_single_precision(ndtr(distance - bend * node**2 / 2) @ (share / share.sum()))
