"""Convergence of a fit, which a verdict requires."""

from __future__ import annotations

import numpy as np

from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.fitting.coordinates import FARTHEST
from probewise.diagnosis.fitting.fit import Fit
from probewise.errors import NotConvergedError

_FAR = 10.0  # nats; a fit stops when a step gains less than 0.005


def checked_finite_fit(found: Fit) -> Fit:
    """Return a fit after checking that its predictions are finite.

    Raises
    ------
    NotConvergedError
        If they are not, with the fit as its `partial`.
    """
    if not np.isfinite(found.objective):
        raise NotConvergedError("the model predicts readings that are not finite; check the model and its prior", found)
    return found


def require_converged_fit(found: Fit, problem: Linearised) -> None:
    """Refuse a fit that one more step would improve by over ten nats, unless it is at the bounds of its prior.

    Raises
    ------
    NotConvergedError
        With the fit as its `partial`.
    """
    shift = problem.absorbing_shift(found, np.zeros(len(found.residuals)))
    slopes = problem.whiten(found.slopes)
    left = 0.5 * float(np.sum((slopes @ shift) ** 2) + shift @ shift)
    if left > _FAR and np.abs(found.z).max() < FARTHEST - 0.1:
        raise NotConvergedError(
            f"the fit of the model did not converge: one more step would still gain about {left:.0f} nats; "
            "a narrower prior or more informative readings would help",
            found,
        )
