"""Score one case at a time from what was concealed and what was said; calibration and confusion over many."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, cast

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.prior_odds import Names
from probewise.effects import VOCABULARY
from probewise.proof.campaign import Result
from probewise.proof.estimates import Estimate, estimated_share, estimated_statistic
from probewise.proof.sensors.effects import NO_PHYSICS, SINGLES
from probewise.proof.sensors.sensors import NOISE_NAMES

NOISE = frozenset(NOISE_NAMES.values()) | {"quantisation", "random_walk", "noise_per_run"}
"""Effects on the noise."""

HONEST_NATS = 3.0
"""Two effects that differ by less are aliased (diagnosis, section 3)."""

_LIKE = 0.9  # cosine from which an effect outside the vocabulary scores as the one inside (section 4)

COUNTERPARTS: Mapping[str, str] = MappingProxyType(
    {
        "bent_rail": "bent_rails",
        "twisted_rail": "bent_rails",
        "place_step": "missing_tooth",
        "stick_slip": "stick_slip",
        "slipped_paper": "arm_knock",
        "ghost": "reflection",
        "cross_talk": "polarisation",
        "after_glow": "overshoot",
    }
)
"""The rare effect of a diagnosis that acts as a concealed effect out of vocabulary does."""


def right_names(hidden: Mapping[str, Any]) -> frozenset[str]:
    """Return all right names of one concealed effect: its own and its aliases.

    Of an effect outside the vocabulary these are its aliases, or "unknown" if it has none, and the rare effect that
    acts alike.
    """
    cosines: Mapping[str, float] = hidden["cosines"]
    if hidden["in_vocabulary"]:
        squared = hidden["size_lambda"] ** 2 / 2
        return frozenset({hidden["name"], *(n for n, rho in cosines.items() if squared * (1 - rho**2) < HONEST_NATS)})
    alike = frozenset(n for n, rho in cosines.items() if rho >= _LIKE)
    counterpart = COUNTERPARTS.get(hidden["name"])
    return (alike or frozenset({"unknown"})) | ({counterpart} if counterpart is not None else set())


def right_names_of_each_effect(result: Result, *, merged: bool, noise: bool = True) -> list[frozenset[str]]:
    """List the effects that have to be named, as one set of right names each; effects on the mean come first.

    `merged`: whether aliases of an effect are right too; for effects outside the vocabulary they always are; `noise`:
    whether noise effects have to be named.
    """
    physics = [h for h in result["hidden"] if not h["on_noise"] and h["name"] not in NO_PHYSICS]
    mean = [right_names(h) if merged or not h["in_vocabulary"] else frozenset({h["name"]}) for h in physics]
    return mean + [frozenset({name}) for name in result["truth"] if noise and name in NOISE]


def names_match(names: Sequence[str], wanted: Sequence[frozenset[str]]) -> bool:
    """Return whether names match the wanted effects one to one; those that "ssf_order" imitates may go unnamed."""
    needed = [right for right in wanted if not right & NO_PHYSICS]
    optional = [right for right in wanted if right & NO_PHYSICS]
    n_more = len(names) - len(needed)
    return 0 <= n_more <= len(optional) and any(
        all(name in right for name, right in zip(order, [*needed, *more], strict=True))
        for more in itertools.combinations(optional, n_more)
        for order in itertools.permutations(names)
    )


def are_names_right(result: Result, names: Sequence[str], *, noise: bool = True) -> bool:
    """Return whether a hypothesis is right: its names match those of the effects or their aliases, or it is an alias.

    `noise`: whether noise effects have to be named. A hypothesis is an alias if the case holds its loss on the
    noise-free readings ("alternative_nats", by names joined with "+") and that is below `HONEST_NATS` or, where an
    effect is outside the vocabulary, is that of a cosine of .9 (section 4); one with more names than there are effects
    is none: beside the right one, any name explains as much.
    """
    if names_match(names, right_names_of_each_effect(result, merged=True, noise=noise)):
        return True
    physics = sorted(set(names) - NOISE)
    if len(physics) > len(result["hidden"]):
        return False
    nats = result.get("alternative_nats", {}).get("+".join(physics), math.inf)
    due = set(result["truth"]) & NOISE if noise else set()
    return bool(nats < _most_nats_of_alias(result)) and set(names) & NOISE == due


def _most_nats_of_alias(result: Result) -> float:
    """Return the loss, in nats, below which another name explains a case as well as the concealed effects."""
    sizes = [float(hidden["size_lambda"]) for hidden in result["hidden"] if not hidden["in_vocabulary"]]
    return max(HONEST_NATS, *(0.5 * size**2 * (1 - _LIKE**2) for size in sizes), 0.0)


def credible_set_holds_truth(result: Result, *, merged: bool) -> bool:
    """Return whether the credible set holds the truth or, if `merged`, aliases of it."""
    if merged:
        return any(are_names_right(result, names_in_label(label)) for label in result["credible_set"])
    wanted = right_names_of_each_effect(result, merged=False)
    return any(names_match(names_in_label(label), wanted) for label in result["credible_set"])


def has_false_extra_effect(result: Result) -> bool:
    """Return whether the leading hypothesis names an effect on the mean that is neither the truth nor an alias."""
    named = [name for name in leading_hypothesis(result, clean=True)[0] if name not in NOISE]
    return count_extra_names(named, right_names_of_each_effect(result, merged=True, noise=False)) > 0


def count_extra_names(names: Sequence[str], wanted: Sequence[frozenset[str]]) -> int:
    """Count the names left over when as many as possible match a wanted effect, one name per effect."""
    most = max(
        sum(name in right for name, right in zip(order, wanted, strict=False))
        for order in itertools.permutations([*names, *[""] * len(wanted)], len(wanted))
    )
    return len(names) - most


def is_distinguishable_from_ssf(result: Result) -> bool:
    """Return whether any concealed effect cannot be imitated by one more Gaussian in the SSF; False if clean."""
    return any(not right & NO_PHYSICS for right in right_names_of_each_effect(result, merged=True))


def is_out_of_vocabulary(result: Result) -> bool:
    """Return whether a concealed effect is outside the vocabulary and has no alias there."""
    return any("unknown" in right for right in right_names_of_each_effect(result, merged=True))


def is_recognised_as_out_of_vocabulary(result: Result) -> bool:
    """Return whether the verdict is unknown, or names the rare effect that acts as the concealed one does."""
    physics = set(result["combination"]) - NOISE
    right = {COUNTERPARTS[hidden["name"]] for hidden in result["hidden"] if hidden["name"] in COUNTERPARTS}
    return result["verdict"] == "unknown" or (result["verdict"] == "named" and bool(right) and physics == right)


def acts_on_mean(result: Result) -> bool:
    """Return whether no concealed effect acts on the noise only; True if nothing is concealed."""
    return not any(h["on_noise"] for h in result["hidden"])


def leading_hypothesis(result: Result, *, clean: bool) -> tuple[Names, float]:
    """Return (names, probability) of the most probable hypothesis; the clean one, (), counts only if `clean`."""
    options = [(tuple(names), p) for names, p in result["hypotheses"] if names or clean]
    return max(options, key=lambda option: option[1], default=((), 0.0))


def is_leading_name_right(result: Result) -> bool:
    """Return whether the right names, or aliases, rank first among the hypotheses that are not clean.

    If the effects act on the mean, names of noise effects are ignored. If one more Gaussian in the SSF absorbs the
    effect, clean is right too.
    """
    if not acts_on_mean(result):
        return names_match(leading_hypothesis(result, clean=False)[0], right_names_of_each_effect(result, merged=True))
    due = is_distinguishable_from_ssf(result)
    joined: dict[Names, float] = {}
    for names, p in result["hypotheses"]:
        key = tuple(name for name in names if name not in NOISE)
        if key or not due:
            joined[key] = joined.get(key, 0.0) + p
    first = max(joined, key=lambda key: joined[key], default=())
    return are_names_right(result, first, noise=False)


def leading_probability_and_correctness(result: Result) -> tuple[float, bool]:
    """Return the leading hypothesis's probability and whether it is right; an alias is, outside the vocabulary only."""
    names, probability = leading_hypothesis(result, clean=True)
    return probability, names_match(names, right_names_of_each_effect(result, merged=False))


def names_effect_on_mean(result: Result) -> bool:
    """Return whether the diagnosis names an effect on the mean ("unknown" is none)."""
    return bool(set(result["combination"]) - NOISE - {"unknown"})


def is_confidently_wrong(result: Result) -> bool:
    """Return whether a wrong effect, or an alias, has a probability above 0.9; "clean" and "unknown" do not count."""
    probability, right = leading_probability_and_correctness(result)
    names = leading_hypothesis(result, clean=True)[0]
    return probability > 0.9 and not right and names not in ((), ("unknown",))


def credible_set_size_with_aliases_merged(result: Result) -> float:
    """Count the hypotheses of a credible set; the right one and its aliases count as one."""
    right = sum(are_names_right(result, names_in_label(label)) for label in result["credible_set"])
    return float(len(result["credible_set"]) - max(right - 1, 0))


def names_in_label(label: str) -> Names:
    """Split a label of a credible set, such as "lag+backlash", into names; "clean" has none."""
    return () if label == "clean" else tuple(label.split("+"))


_EDGES = np.linspace(0, 1, 11)


@dataclass(frozen=True)
class Bin:
    """Cases of similar stated probability: its mean, and the share of right answers."""

    stated: float
    right: Estimate


def reliability_bins(results: Sequence[Mapping[str, Any]]) -> tuple[Bin, ...]:
    """Bin cases by the probability of their leading hypothesis into ten equal bins, ascending, without empty bins."""
    said = [leading_probability_and_correctness(result) for result in results]
    of_case = _bin_numbers(np.array([p for p, _ in said]))
    return tuple(
        Bin(
            float(np.mean([p for (p, _), at in zip(said, of_case, strict=True) if at == k])),
            estimated_share([right for (_, right), at in zip(said, of_case, strict=True) if at == k]),
        )
        for k in np.unique(of_case)
    )


def calibration_error(results: Sequence[Mapping[str, Any]]) -> Estimate:
    """Estimate the expected calibration error: abs(mean stated - share right) of each bin, averaged over the cases."""
    found = estimated_statistic(
        np.array([leading_probability_and_correctness(result) for result in results], dtype=np.float64).reshape(-1, 2),
        _calibration_error_of_rows,
    )
    return replace(found, low=max(found.low, 0.0), high=max(found.high, 0.0)) if found.n else found


def _calibration_error_of_rows(said: FloatArray) -> float:
    """Return the calibration error of rows (probability, 1 if right or 0), (n, 2)."""
    off = np.bincount(_bin_numbers(said[:, 0]), said[:, 0] - said[:, 1])
    return float(np.abs(off).sum()) / len(said)


def _bin_numbers(probability: FloatArray) -> IntArray:
    return np.clip(np.searchsorted(_EDGES, probability, side="right") - 1, 0, len(_EDGES) - 2)


OUTSIDE, SEVERAL = "outside", "several"


def confusion_counts(
    results: Sequence[Mapping[str, Any]], *, label: Callable[[str], str] = str
) -> tuple[tuple[str, ...], tuple[str, ...], IntArray]:
    """Count answers by truth, over cases of kind "clean", "single" and "outside".

    An answer that is an alias of the truth counts as the truth. Only names that occur have a row or a column. `label`
    maps a name to that of its row and column, e.g. to merge several.

    Returns truths, in the order of the vocabulary; answers; counts, (n_truths, n_answers).
    """
    counts: Counter[tuple[str, str]] = Counter()
    for result in results:
        if result["kind"] in ("clean", "single", "outside"):
            truth = {"clean": "clean", "outside": OUTSIDE}.get(result["kind"]) or result["hidden"][0]["name"]
            counts[label(truth), label(_stated_name(result, truth))] += 1
    order = ["clean", *SINGLES, OUTSIDE]
    said_order = ["clean", *SINGLES, "unknown", SEVERAL]
    said = {s for _, s in counts}
    columns = tuple([s for s in said_order if s in said] + sorted(said - set(said_order)))
    concealed = {t for t, _ in counts}
    truths = tuple([t for t in order if t in concealed] + sorted(concealed - set(order)))
    return truths, columns, np.array([[counts[t, s] for s in columns] for t in truths]).reshape(len(truths), -1)


def _stated_name(result: Mapping[str, Any], truth: str) -> str:
    """Return the name for which a leading hypothesis counts: `truth` if right, "clean", its one name, or `SEVERAL`.

    If the concealed effects act on the mean, names of noise effects are ignored.
    """
    names = leading_hypothesis(result, clean=True)[0]
    if acts_on_mean(result):
        names = tuple(name for name in names if name not in NOISE)
    if truth not in ("clean", OUTSIDE) and names_match(
        names, right_names_of_each_effect(result, merged=True, noise=not acts_on_mean(result))
    ):
        return truth
    return SEVERAL if len(names) > 1 else "".join(names) or "clean"


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
