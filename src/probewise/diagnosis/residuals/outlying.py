"""Test whether outlying readings cluster in a covariate, in which case they are not random outliers.

A heavy tail explains any few deviating readings. If they all lie at one level, at one end of a scan or near an edge, an
effect is missing that changes only them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import betaln

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.screening import log_mean_exp
from probewise.diagnosis.noise.law import NoiseLaw, Tail
from probewise.diagnosis.residuals.covariate import Covariate
from probewise.diagnosis.residuals.locate import window_columns_and_bounds

FAR_OUT = ", far out"
"""Suffix of the names of families of unknown effects in which outlying readings cluster."""

_A = 0.5  # parameter of the beta prior of the share of outlying readings (Jeffreys)


def outlier_probabilities(residuals: FloatArray, law: NoiseLaw) -> FloatArray:
    """Return the probability of each residual to be from the wide part of a noise distribution, (n_points,)."""
    if law.wide.size:
        return law.wide
    whitened = law(residuals)
    return Tail(law.share, law.times).wide_probability((whitened / law.likeliest_sigma(whitened[:, None])[0]) ** 2)


def clustering_log_bayes_factors(far_out: FloatArray, covariates: Sequence[Covariate]) -> dict[str, float]:
    """Return log Bayes factors for another share of outlying readings in a window of a covariate than elsewhere.

    Parameters
    ----------
    far_out
        Probability of each reading to be outlying, (n_points,).
    covariates
        Covariates to test.

    Returns
    -------
    By the covariate's name with the suffix `FAR_OUT`; Bayes factors are averaged over its windows.
    """
    n, total = len(far_out), float(far_out.sum())
    even = float(betaln(total + _A, n - total + _A) - betaln(_A, _A))
    scores: dict[str, list[FloatArray]] = {}
    for covariate in covariates:
        columns, _ = window_columns_and_bounds(covariate, n)
        if columns.shape[1]:
            inside, many = far_out @ columns, columns.sum(axis=0)
            outside, few = total - inside, n - many
            apart = betaln(inside + _A, many - inside + _A) + betaln(outside + _A, few - outside + _A)
            scores.setdefault(f"{covariate.published_name}{FAR_OUT}", []).append(apart - 2 * betaln(_A, _A) - even)
    return {family: log_mean_exp(np.concatenate(own)) for family, own in scores.items()}
