"""Oracle baseline: how well effects can be identified, given the cosines of their changes alone.

The change by an effect of size lambda (after the refit) and the best imitation by a rival (another effect) are
d = lambda sqrt(1 - rho^2) noise sds apart, where rho is their cosine. With nothing else unknown, the log Bayes factor
of the true effect is normal with mean d^2 / 2 and sd d, so it is right with probability Phi(d / 2). This is not a
bound: averaging over a rival's parameters does better; many rivals and an unknown sensor do worse.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import Any, cast

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray
from probewise.effects import VOCABULARY
from probewise.proof.challenge.scoring import HONEST_NATS, right_names

_DRAWS = 400
_HELD = 0.95

Hidden = Mapping[str, Any]


def oracle_name_rate(hidden: Hidden) -> float:
    """Return the probability that the right name or an alias ranks before the most similar rival (other effect)."""
    return _rate_against_closest_rival(hidden, right_names(hidden))


def oracle_covariate_rate(hidden: Hidden) -> float:
    """Return the probability that the effect ranks before its most similar rival without any of its covariates."""
    shown = set(hidden["shows_in"])
    named = [name for name in hidden["cosines"] if name in VOCABULARY]
    covariates = {name: cast(tuple[str, ...], VOCABULARY[name].covariates) for name in named}
    covariates["ssf_order"] = ("edge_distance",)
    return _rate_against_closest_rival(hidden, {name for name, own in covariates.items() if shown & set(own)})


def oracle_credible_set_size(hidden: Hidden) -> float:
    """Return the expected size of a 95 % credible set, with the truth and its aliases counted as one.

    The log Bayes factors against the rivals are taken as independent; the random draws have a fixed seed.
    """
    apart = _distances_of_rivals(hidden)
    d: FloatArray = np.array(list(apart.values()))
    right = np.array([True, *(name in right_names(hidden) for name in apart)])
    rng = np.random.default_rng(len(d))
    log_odds = np.zeros((_DRAWS, len(d) + 1))
    log_odds[:, 1:] = -(d**2) / 2 - d * rng.standard_normal((_DRAWS, len(d)))
    odds = np.exp(log_odds - log_odds.max(axis=1, keepdims=True))
    order = np.argsort(-odds, axis=1)
    shares = np.take_along_axis(odds, order, axis=1) / odds.sum(axis=1, keepdims=True)
    inside = np.cumsum(shares, axis=1) - shares < _HELD
    n_right = np.sum(inside & right[order], axis=1)
    return float(np.mean(inside.sum(axis=1) - np.maximum(n_right - 1, 0)))


def readings_to_separate_alias(result: Mapping[str, Any]) -> float:
    """Return how many readings of the same plan would separate a case's aliased pair by 3 nats (inf if identical)."""
    size, rho = float(result["hidden"][0]["size_lambda"]), float(result["cosine"])
    apart = size**2 * (1 - rho**2) / 2
    return float(result["readings"]) * HONEST_NATS / apart if apart > 0 else np.inf


def _rate_against_closest_rival(hidden: Hidden, right: Set[str]) -> float:
    return min(
        (float(ndtr(d / 2)) for name, d in _distances_of_rivals(hidden).items() if name not in right), default=1.0
    )


def _distances_of_rivals(hidden: Hidden) -> dict[str, float]:
    """Return the distance of each rival in noise sds, by name; {} for a noise effect.

    It is lambda sqrt(1 - rho^2), or sqrt(2 nats) where the case holds the rival's loss of log likelihood (systems).
    """
    if "rival_nats" in hidden:
        return {name: float(np.sqrt(2 * nats)) for name, nats in hidden["rival_nats"].items()}
    cosines: Mapping[str, float] = hidden["cosines"]
    size = float(hidden["size_lambda"])
    return {
        name: size * float(np.sqrt(max(1 - rho**2, 0.0))) for name, rho in cosines.items() if name != hidden["name"]
    }
