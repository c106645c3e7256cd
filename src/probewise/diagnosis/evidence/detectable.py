"""Probability that the effects of a fit are large enough to be detectable."""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr

from probewise._arrays import IntArray
from probewise.diagnosis.evidence.laplace import LEAST_VISIBLE
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.noise.law import NoiseLaw


def log_probability_effects_detectable(found: Fit, law: NoiseLaw, usable: IntArray) -> float:
    """Return the log probability that every effect of a fit has a detectable size (lambda 4 or more).

    The size is the norm, in noise sds, of the effect's change after a (linearised) refit of all other parameters; its
    posterior is normal with unit sd. This probability, multiplied with the evidence, removes the part of a hypothesis
    that readings cannot tell from the hypothesis without the effect.

    Parameters
    ----------
    found
        The fit.
    law
        Its noise model.
    usable
        Row numbers of the usable readings, (n_usable,).
    """
    return sum(float(log_ndtr(linearised_size(found, law, name, usable) - LEAST_VISIBLE)) for name in found.model.names)


def linearised_size(found: Fit, law: NoiseLaw, name: str, usable: IntArray) -> float:
    """Return an effect's lambda: the norm, in noise sds, of its change after a linearised refit of all else.

    Parameters
    ----------
    found
        The fit.
    law
        Its noise model.
    name
        The effect, one of the fit.
    usable
        Row numbers of the usable readings, (n_usable,).
    """
    sd = found.sd / np.sqrt(law.fisher_information)
    rest = np.delete(law(found.slopes) / sd, found.model.coordinate_slice(name), axis=1)
    change = law(found.change_by_effect(name, usable)[:, None])[:, 0] / sd
    taken = np.linalg.solve(rest.T @ rest + np.eye(rest.shape[1]), rest.T @ change)
    return float(np.linalg.norm(np.append(change - rest @ taken, taken)))
