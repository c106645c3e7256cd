"""Do the readings that are far out lie together? Then they are no outliers.

A heavy tail takes whatever is wrong with a few readings, and says nothing of which. Where they all lie at one level, at
one end of a scan or near an edge, something is missing there that shows in them alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import betaln

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.screening import log_mean
from probewise.diagnosis.noise.law import NoiseLaw, Tail
from probewise.diagnosis.residuals.covariate import Covariate
from probewise.diagnosis.residuals.locate import windows

__all__ = ["FAR_OUT", "outlying", "score_together"]

FAR_OUT = ", far out"
"""Ends the name of a family of what is unknown: by whatever readings far out lie together."""

_A = 0.5  # of the share of readings that are far out, a beta distribution of both parameters (Jeffreys)


def outlying(residuals: FloatArray, law: NoiseLaw) -> FloatArray:
    """Probability of each reading to be in the tail of a law, (n_points,)."""
    whitened = law(residuals)
    return Tail(law.share, law.times).wide((whitened / law.scale(whitened[:, None])[0]) ** 2)


def score_together(far_out: FloatArray, covariates: Sequence[Covariate]) -> dict[str, float]:
    """Weigh that more, or fewer, are far out in some window of a covariate against one share for all.

    Parameters
    ----------
    far_out
        Probability of each reading to be far out, (n_points,).
    covariates
        What the share may depend on.

    Returns
    -------
    Log Bayes factors, averaged over the windows of each covariate.
    """
    n, total = len(far_out), float(far_out.sum())
    even = float(betaln(total + _A, n - total + _A) - betaln(_A, _A))
    scores: dict[str, list[FloatArray]] = {}
    for covariate in covariates:
        columns, _ = windows(covariate, n)
        if columns.shape[1]:
            inside, many = far_out @ columns, columns.sum(axis=0)
            outside, few = total - inside, n - many
            apart = betaln(inside + _A, many - inside + _A) + betaln(outside + _A, few - outside + _A)
            scores.setdefault(f"{covariate.name}{FAR_OUT}", []).append(apart - 2 * betaln(_A, _A) - even)
    return {family: log_mean(np.concatenate(own)) for family, own in scores.items()}
