"""A free-form SSF: one Gaussian, and nineteen narrower ones of either sign that change its form.

A real SSF (a ring, a shadow across the spot, a long tail) is no mixture of a few Gaussians. Here one Gaussian sets
place and size; the others lie on rings about it, in units of its sds, and readings are linear in their shares of the
mass. The shares are restricted to the directions that keep the first and second moments, so the whole has the mean and
covariance of the one Gaussian and no parameter is redundant.
"""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.sensor.ssf import footprint_of


def _places_and_widths_on_rings(*rings: tuple[float, int, float, float]) -> tuple[FloatArray, FloatArray]:
    """Return Gaussians' places (n, 2) and widths (n,); a ring is (radius, number, width, rotation in spacings)."""
    places = [
        (radius * np.cos(turn), radius * np.sin(turn))
        for radius, n, _, first in rings
        for turn in 2 * np.pi * (np.arange(n) + first) / n
    ]
    return np.array(places), np.repeat([width for _, _, width, _ in rings], [n for _, n, _, _ in rings])


# In sds of the one Gaussian: spaced by about their widths, out to where a long tail still shows.
_PLACES, _WIDTHS = _places_and_widths_on_rings(
    (0.0, 1, 0.45, 0.0), (0.8, 6, 0.5, 0.0), (1.6, 8, 0.6, 0.0), (2.7, 4, 0.9, 0.5)
)


def _moment_preserving_basis() -> FloatArray:
    """Return an orthonormal basis of the shares that change neither mean nor covariance, (N_FREE_FORM - 1, N_BENDS)."""
    x, y = _PLACES.T
    moments = np.stack([x, y, x * x + _WIDTHS**2 - 1, y * y + _WIDTHS**2 - 1, x * y])
    return np.ascontiguousarray(np.linalg.svd(moments)[2][len(moments) :].T)


_DIRECTIONS = _moment_preserving_basis()

N_BENDS: int = _DIRECTIONS.shape[1]
"""Number of free-form coefficients (bends)."""

N_FREE_FORM = 1 + len(_WIDTHS)
"""Number of Gaussians of a free form, the one that sets place and size first."""


def free_form_theta(one: FloatArray, bends: FloatArray) -> FloatArray:
    """Return the parameters of free forms: each a Gaussian bent without a change of its mean and covariance.

    `one`: the paper's a, u, v, A, B, C of one Gaussian that holds the whole mass, (n_samples, 6); `bends`: coefficients
    of the basis of shares that keep mean and covariance, of either sign, (n_samples, N_BENDS). Returns the paper's
    parameters of the mixture, (n_samples, 6 N_FREE_FORM).
    """
    shares = bends @ _DIRECTIONS.T
    a, u, v, aa, bb, cc = (one[:, k, None] for k in range(6))
    det = aa * bb - cc**2
    sd_u, rest_v = np.sqrt(bb / (2 * det)), np.sqrt(0.5 / bb)  # with the next line: the Cholesky factor
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


def bend_coefficients(theta: FloatArray) -> FloatArray:
    """Return the coefficients `bends` of free forms, (n_samples, 6 N_FREE_FORM) -> (n_samples, N_BENDS)."""
    return np.asarray(footprint_of(theta, N_FREE_FORM).weight[:, 0, 1:] @ _DIRECTIONS)


def is_free_form(theta: FloatArray) -> bool:
    """Return whether all these mixtures, (n_samples, 6 n), have a free form's number and widths of Gaussians."""
    if theta.shape[1] != 6 * N_FREE_FORM:
        return False
    blocks = theta.reshape(len(theta), N_FREE_FORM, 6)
    return bool(np.allclose(blocks[:, 1:, 3:] * _WIDTHS[:, None] ** 2, blocks[:, :1, 3:], rtol=1e-6, atol=1e-12))
