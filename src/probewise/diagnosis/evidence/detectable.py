"""Probability that the effects of a fit are large enough to be detectable."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

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
    sizes = linearised_sizes(found, law, usable, found.model.names)
    return float(sum(log_ndtr(size - LEAST_VISIBLE) for size in sizes))


def linearised_sizes(found: Fit, law: NoiseLaw, usable: IntArray, names: Sequence[str]) -> Iterator[float]:
    """Iterate over the lambdas of some effects of a fit: norm, in noise sds, of the change after a linearised refit.

    Arguments as of `log_probability_effects_detectable`; `names` are those of the effects.
    """
    sd = found.sd / np.sqrt(law.fisher_information)
    slopes = law(found.slopes) / sd
    for name in names:
        rest = np.delete(slopes, found.model.coordinate_slice(name), axis=1)
        change = law(found.change_by_effect(name, usable)[:, None])[:, 0] / sd
        taken = np.linalg.solve(rest.T @ rest + np.eye(rest.shape[1]), rest.T @ change)
        yield float(np.linalg.norm(np.append(change - rest @ taken, taken)))
