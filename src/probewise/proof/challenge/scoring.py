"""Score one case at a time from the result of `run_case` or `run_system_case`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from probewise.diagnosis.prior_odds import Names
from probewise.proof.sensors import NO_PHYSICS, NOISE_NAMES

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

Result = Mapping[str, Any]


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

    Parameters
    ----------
    result
        A case.
    merged
        Whether aliases of an effect are right too; for effects outside the vocabulary they always are.
    noise
        Whether noise effects have to be named.
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


def names_in_label(label: str) -> Names:
    """Split a label of a credible set, such as "lag+backlash", into names; "clean" has none."""
    return () if label == "clean" else tuple(label.split("+"))
