"""How well names can be told, by their likeness alone: a yardstick to hold the found rows against.

What survives of an effect of size lambda, and the nearest that an effect of another name comes to it with its size
fitted, lie d = lambda sqrt(1 - rho^2) noise sds apart, rho the cosine of the two. Where nothing else is open, the log
Bayes factor of the true one is normal, mean d^2 / 2, sd d, and it is right with probability Phi(d / 2). That is no
bound: who averages over a rival's settings does better than against the nearest, and who has a sensor to learn, and
rivals by the dozen, does worse than against one.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import Any, cast

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray
from probewise.challenge.scoring import HONEST_NATS, accepted
from probewise.effects import VOCABULARY

__all__ = ["covariate_by_likeness", "name_by_likeness", "readings_by_repeating", "set_size_by_likeness"]

_DRAWS = 400
_HELD = 0.95

Hidden = Mapping[str, Any]


def name_by_likeness(hidden: Hidden) -> float:
    """Expect how often the right name or an alias of it comes before the one rival that is hardest to tell."""
    return _against_the_hardest(hidden, accepted(hidden))


def covariate_by_likeness(hidden: Hidden) -> float:
    """Expect how often the right covariate comes before the hardest rival that shows in none of the right ones."""
    shown = set(hidden["shows_in"])
    named = [name for name in hidden["cosines"] if name in VOCABULARY]
    covariates = {name: cast(tuple[str, ...], VOCABULARY[name].covariates) for name in named}
    covariates["ssf_order"] = ("edge_distance",)
    return _against_the_hardest(hidden, {name for name, own in covariates.items() if shown & set(own)})


def set_size_by_likeness(hidden: Hidden) -> float:
    """Expect the size of a 95 % credible set, the truth and its aliases as one.

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


def readings_by_repeating(result: Mapping[str, Any]) -> float:
    """Tell how many readings of the same plan would set an aliased pair 3 nats apart (inf, if alike)."""
    size, rho = float(result["hidden"][0]["size_lambda"]), float(result["cosine"])
    apart = size**2 * (1 - rho**2) / 2
    return float(result["readings"]) * HONEST_NATS / apart if apart > 0 else np.inf


def _against_the_hardest(hidden: Hidden, right: Set[str]) -> float:
    return min((float(ndtr(d / 2)) for name, d in _apart(hidden).items() if name not in right), default=1.0)


def _apart(hidden: Hidden) -> dict[str, float]:
    """How far every rival is, in noise sds; nothing looks like an effect on the noise."""
    cosines: Mapping[str, float] = hidden["cosines"]
    size = float(hidden["size_lambda"])
    return {
        name: size * float(np.sqrt(max(1 - rho**2, 0.0))) for name, rho in cosines.items() if name != hidden["name"]
    }
