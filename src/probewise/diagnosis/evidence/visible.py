"""Whether what a fit holds is large enough to be seen: smaller, it is as good as nothing."""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr

from probewise._arrays import IntArray
from probewise.diagnosis.evidence.laplace import LEAST_VISIBLE
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.noise.law import NoiseLaw

__all__ = ["log_visible"]


def log_visible(found: Fit, law: NoiseLaw, usable: IntArray) -> float:
    """Give the log probability that every effect of a fit is of a size (lambda) that can be seen.

    A size is that of the change by the effect, to first order what is left of it when all other parameters
    have been refitted; its posterior is normal of unit sd about it. Multiplied with the evidence this keeps
    of a hypothesis the part that is not, to these readings, the one with an effect less.

    Parameters
    ----------
    found
        The fit.
    law
        The law of its noise.
    usable
        Rows of the plan that were read, (n_usable,).
    """
    sd = found.sd / np.sqrt(law.information)
    slopes, out = law(found.slopes) / sd, 0.0
    for name in found.model.names:
        rest = np.delete(slopes, found.model.columns_of(name), axis=1)
        change = law(found.change_by(name, usable)[:, None])[:, 0] / sd
        taken = np.linalg.solve(rest.T @ rest + np.eye(rest.shape[1]), rest.T @ change)
        left = float(np.linalg.norm(np.append(change - rest @ taken, taken)))
        out += float(log_ndtr(left - LEAST_VISIBLE))
    return out
