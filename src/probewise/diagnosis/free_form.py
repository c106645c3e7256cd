"""A sensor whose SSF has any form, as a null.

What a mixture of a few Gaussians leaves of a real SSF looks like physics, and the evidence pays for another Gaussian
only where it gains ten nats and more. A free form (`probewise.sensor.bent`) takes it up: small shares at many
places, each with a normal prior, so that the evidence charges for what is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.coordinates import (
    LEAST_READINGS,
    SensorCoordinates,
    known_scene,
    natural_to_theta,
    theta_to_natural,
)
from probewise.effects import NamedEffect
from probewise.recordings.plan import Plan
from probewise.sensor import N_BENDS, N_FREE_FORM, Chain, FreeLevels, FreeMixture, bends_of, free_form

__all__ = ["FreeForm", "free_form_to_natural"]

_SHARE = 0.1  # prior sd of each bend, of the mass


@dataclass(frozen=True, eq=False)
class FreeForm:
    """A sensor with a free-form SSF.

    Its natural coordinates are those of one Gaussian and the two levels, then the bends: `center`
    (7 + N_BENDS,) of a normal prior, `factor` a square root of its covariance.
    """

    center: FloatArray
    factor: FloatArray

    @classmethod
    def about(cls, one: SensorCoordinates) -> Self:
        """Believe in the place and size of one Gaussian, and in small bends."""
        factor = np.diag(np.concatenate([np.zeros(one.n_params), np.full(N_BENDS, _SHARE)]))
        factor[: one.n_params, : one.n_params] = one.factor
        return cls(np.concatenate([one.center, np.zeros(N_BENDS)]), factor)

    @property
    def n_gaussians(self) -> int:
        """Gaussians that it is written with."""
        return N_FREE_FORM

    @property
    def worth(self) -> int:
        """As two: from one Gaussian to any form is one step."""
        return 2

    @property
    def form(self) -> str:
        """Free."""
        return "an SSF of free form"

    @property
    def exchangeable(self) -> bool:
        """No two of its Gaussians can trade names."""
        return False

    @property
    def n_params(self) -> int:
        """Number of coordinates."""
        return len(self.center)

    @property
    def starts(self) -> FloatArray:
        """Start from the centre, (1, n_params)."""
        return np.zeros((1, self.n_params))

    @property
    def nuisance(self) -> tuple[str, ...]:
        """Nothing: all its parameters are the sensor's own."""
        return ()

    @property
    def least_readings(self) -> int:
        """As many as for one Gaussian: priors hold what the readings do not."""
        return LEAST_READINGS

    @property
    def log_multiplicity(self) -> float:
        """One peak."""
        return 0.0

    def admits(self, effect: NamedEffect[Any]) -> bool:
        """All of them."""
        return True

    def theta(self, z: FloatArray) -> FloatArray:
        """Map coordinates, (n_samples, n_params), to a_1 .. C_N, I_min, I_max."""
        natural = self.center + z @ self.factor.T
        one = natural_to_theta(natural[:, :-N_BENDS], 1)
        return np.concatenate([free_form(one[:, :6], natural[:, -N_BENDS:]), one[:, 6:]], axis=1)

    def z(self, theta: FloatArray) -> FloatArray:
        """Invert `theta`."""
        return np.asarray(np.linalg.solve(self.factor, (free_form_to_natural(theta) - self.center).T).T)

    def chain(self, plan: Plan, effects: Sequence[NamedEffect[Any]], *, n_nodes: int) -> Chain:
        """Build the chain over the plan's patterns."""
        return Chain(FreeMixture(self.n_gaussians), FreeLevels(), known_scene(plan), tuple(effects), n_nodes=n_nodes)


def free_form_to_natural(theta: FloatArray) -> FloatArray:
    """Invert what `FreeForm.theta` makes of natural coordinates, (n_samples, 6 N + 2) -> (n_samples, 7 + N_BENDS)."""
    # The amplitude of the first plays no part in its natural coordinates.
    one = np.concatenate([np.ones((len(theta), 1)), theta[:, 1:6], theta[:, -2:]], axis=1)
    return np.concatenate([theta_to_natural(one, 1), bends_of(theta[:, :-2])], axis=1)
