"""An SSF of any form, written as a mixture: one Gaussian, and small narrower ones of either sign about it.

A real SSF (a ring, a shadow across the spot, a long tail) is no mixture of a few Gaussians. Here one Gaussian sets
place and size, and nineteen more, which lie in its own metric, bend its form: readings are linear in their shares.
Shares are taken in those directions alone that leave the first two moments as they are, so that mean and covariance of
the whole are those of the one Gaussian, and nothing is said twice.
"""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray

__all__ = ["N_BENDS", "N_FREE_FORM", "bends_of", "free_form", "is_free_form"]


def _rings(*rings: tuple[float, int, float, float]) -> tuple[FloatArray, FloatArray]:
    """Lay out places (n, 2) and widths (n,): of each ring radius, number, width, and its turn in steps."""
    places = [
        (radius * np.cos(turn), radius * np.sin(turn))
        for radius, n, _, first in rings
        for turn in 2 * np.pi * (np.arange(n) + first) / n
    ]
    return np.array(places), np.repeat([width for _, _, width, _ in rings], [n for _, n, _, _ in rings])


# In sds of the one Gaussian: about as far apart as they are wide, out to where a long tail still shows.
_PLACES, _WIDTHS = _rings((0.0, 1, 0.45, 0.0), (0.8, 6, 0.5, 0.0), (1.6, 8, 0.6, 0.0), (2.7, 4, 0.9, 0.5))


def _directions() -> FloatArray:
    """Find the shares that change neither mean nor covariance, as orthonormal columns (n_probes, n)."""
    x, y = _PLACES.T
    moments = np.stack([x, y, x * x + _WIDTHS**2 - 1, y * y + _WIDTHS**2 - 1, x * y])
    return np.ascontiguousarray(np.linalg.svd(moments)[2][len(moments) :].T)


_DIRECTIONS = _directions()

N_BENDS: int = _DIRECTIONS.shape[1]
"""Free amounts that bend the form."""

N_FREE_FORM = 1 + len(_WIDTHS)
"""Gaussians that a free form is written with, the one first."""


def free_form(one: FloatArray, bends: FloatArray) -> FloatArray:
    """Bend Gaussians; mean and covariance stay what they are.

    Parameters
    ----------
    one
        The paper's a, u, v, A, B, C of the Gaussian, a that of the whole mass, (n_samples, 6).
    bends
        How much, as shares of the mass in each direction, of either sign, (n_samples, N_BENDS).

    Returns
    -------
    The paper's parameters of the mixture, (n_samples, 6 N_FREE_FORM).
    """
    shares = bends @ _DIRECTIONS.T
    a, u, v, aa, bb, cc = (one[:, k, None] for k in range(6))
    det = aa * bb - cc**2
    sd_u, rest_v = np.sqrt(bb / (2 * det)), np.sqrt(0.5 / bb)  # the covariance's lower root, with the next line
    slope = -cc / bb
    blocks = np.empty((len(one), N_FREE_FORM, 6))
    blocks[:, 0] = one
    blocks[:, 0, 0] *= 1 - shares.sum(axis=1)
    blocks[:, 1:, 0] = a * shares / _WIDTHS**2
    blocks[:, 1:, 1] = u + sd_u * _PLACES[:, 0]
    blocks[:, 1:, 2] = v + slope * sd_u * _PLACES[:, 0] + rest_v * _PLACES[:, 1]
    for k, moment in ((3, aa), (4, bb), (5, cc)):
        blocks[:, 1:, k] = moment / _WIDTHS**2
    return blocks.reshape(len(one), -1)


def bends_of(theta: FloatArray) -> FloatArray:
    """Give the bends back, (n_samples, 6 N_FREE_FORM) -> (n_samples, N_BENDS)."""
    blocks = theta.reshape(len(theta), N_FREE_FORM, 6)
    mass = blocks[..., 0] / np.sqrt(blocks[..., 3] * blocks[..., 4] - blocks[..., 5] ** 2)
    return np.asarray(mass[:, 1:] / mass.sum(axis=1, keepdims=True) @ _DIRECTIONS)


def is_free_form(theta: FloatArray) -> bool:
    """Tell whether mixtures, (n_samples, 6 n), are free forms: by their number, and the widths of all but the first."""
    if theta.shape[1] != 6 * N_FREE_FORM:
        return False
    blocks = theta.reshape(len(theta), N_FREE_FORM, 6)
    return bool(np.allclose(blocks[:, 1:, 3:] * _WIDTHS[:, None] ** 2, blocks[:, :1, 3:], rtol=1e-6, atol=1e-12))
