"""A null model whose sensor has a free-form SSF.

The misfit of a few Gaussians to a real SSF looks like physics, and the evidence favours another Gaussian only if it
gains ten nats or more. A free form (`probewise.sensor.free_form`) absorbs this misfit: small weights at many places,
each with a normal prior, so that the evidence penalises only those used.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.fitting.coordinates import (
    CalibratedSensor,
    GaussianMixtureSensor,
    natural_to_theta,
    theta_to_natural,
)
from probewise.sensor import N_BENDS, N_FREE_FORM, bend_coefficients, free_form_theta

_SHARE = 0.1  # prior sd of each weight, as a share of the mass


@dataclass(frozen=True, eq=False)
class FreeFormSensor(CalibratedSensor):
    """A sensor with a free-form SSF.

    Its natural coordinates are those of one Gaussian and the two levels, then N_BENDS weights of the free form.
    """

    center: FloatArray
    factor: FloatArray
    n_gaussians: int = field(default=N_FREE_FORM, init=False)
    calibrated_height_mm: float | None = field(default=None, kw_only=True)

    @classmethod
    def from_one_gaussian(cls, one: GaussianMixtureSensor) -> Self:
        """Build the prior from that of one Gaussian's place and size, with weights of sd 0.1 of the mass about 0."""
        factor = np.diag(np.concatenate([np.zeros(one.n_params), np.full(N_BENDS, _SHARE)]))
        factor[: one.n_params, : one.n_params] = one.factor
        return cls(np.concatenate([one.center, np.zeros(N_BENDS)]), factor)

    def start_from_one_gaussian(self, one: FloatArray) -> FloatArray:
        """Return one start of a fit, (1, n_params): coordinates of one Gaussian, (7,), with weights of 0."""
        return np.pad(one, (0, N_BENDS))[None, :]

    @property
    def n_params(self) -> int:
        """Number of coordinates."""
        return 7 + N_BENDS

    @property
    def effective_n_gaussians(self) -> int:
        """2: the free form counts as one Gaussian more than one."""
        return 2

    @property
    def ssf_in_words(self) -> str:
        """Description of its SSF: "an SSF of free form"."""
        return "an SSF of free form"

    def theta_from_natural(self, natural: FloatArray) -> FloatArray:
        """Map natural coordinates, (n_samples, n_params), to a_1 .. C_N, I_min, I_max, (n_samples, 6 N + 2)."""
        one = natural_to_theta(natural[:, :-N_BENDS], 1)
        return np.concatenate([free_form_theta(one[:, :6], natural[:, -N_BENDS:]), one[:, 6:]], axis=1)

    def natural_from_theta(self, theta: FloatArray) -> FloatArray:
        """Map a_1 .. C_N, I_min, I_max to natural coordinates: the inverse of `theta_from_natural`."""
        return theta_to_free_form_natural(theta)


def theta_to_free_form_natural(theta: FloatArray) -> FloatArray:
    """Map theta, (n_samples, 6 N + 2), to a free form's natural coordinates, (n_samples, 7 + N_BENDS)."""
    # The amplitude of the first does not enter its natural coordinates.
    one = np.concatenate([np.ones((len(theta), 1)), theta[:, 1:6], theta[:, -2:]], axis=1)
    return np.concatenate([theta_to_natural(one, 1), bend_coefficients(theta[:, :-2])], axis=1)
