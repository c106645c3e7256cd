"""What could be said at best: by an observer who knows the sensor, the noise and how large each effect would be.

Only the name is open to him. What is left of two effects of size lambda whose surviving parts have cosine rho lies
d = lambda sqrt(1 - rho^2) noise sds apart, and the log Bayes factor of the true one is normal, mean d^2 / 2, sd d. No
method that has to learn the rest from the same readings can do better on average, all names being as likely before.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import Any, cast

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray
from probewise.challenge.scoring import accepted
from probewise.effects import VOCABULARY

__all__ = ["ideal_set_size", "most_often_located", "most_often_right"]

_DRAWS = 400
_HELD = 0.95

Hidden = Mapping[str, Any]


def most_often_right(hidden: Hidden) -> float:
    """Bound how often the right name or an alias of it comes first: by the one rival that is hardest to tell."""
    return _at_most(hidden, accepted(hidden))


def most_often_located(hidden: Hidden) -> float:
    """Bound how often the right covariate comes first: by the hardest rival that shows in none of the right ones."""
    shown = set(hidden["shows_in"])
    covariates = {name: cast(tuple[str, ...], VOCABULARY[name].covariates) for name in hidden["cosines"]}
    return _at_most(hidden, {name for name, own in covariates.items() if shown & set(own)})


def _at_most(hidden: Hidden, right: Set[str]) -> float:
    return min((float(ndtr(d / 2)) for name, d in _apart(hidden).items() if name not in right), default=1.0)


def ideal_set_size(hidden: Hidden) -> float:
    """Expect the size of his 95 % credible set, the truth and its aliases as one.

    What tells one rival is taken to be independent of what tells another; the draws are the same each time.
    """
    apart = _apart(hidden)
    d: FloatArray = np.array(list(apart.values()))
    right = np.array([True, *(name in accepted(hidden) for name in apart)])
    rng = np.random.default_rng(len(d))
    log_odds = np.zeros((_DRAWS, len(d) + 1))
    log_odds[:, 1:] = -(d**2) / 2 - d * rng.standard_normal((_DRAWS, len(d)))
    odds = np.exp(log_odds - log_odds.max(axis=1, keepdims=True))
    order = np.argsort(-odds, axis=1)
    shares = np.take_along_axis(odds, order, axis=1) / odds.sum(axis=1, keepdims=True)
    inside = np.cumsum(shares, axis=1) - shares < _HELD
    n_right = np.sum(inside & right[order], axis=1)
    return float(np.mean(inside.sum(axis=1) - np.maximum(n_right - 1, 0)))


def _apart(hidden: Hidden) -> dict[str, float]:
    """How far every rival is, in noise sds."""
    cosines: Mapping[str, float] = hidden["cosines"]
    size = float(hidden["size_lambda"])
    return {
        name: size * float(np.sqrt(max(1 - rho**2, 0.0))) for name, rho in cosines.items() if name != hidden["name"]
    }
