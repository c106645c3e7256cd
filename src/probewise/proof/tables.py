"""The tables of challenges: each case scored from what was concealed and what was said, and rows with targets."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, TypeAlias

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.words import Names
from probewise.effects import VOCABULARY
from probewise.proof.campaign import (
    Estimate,
    Result,
    estimated_mean,
    estimated_share,
    estimated_statistic,
    grouped,
    median_with_interval,
)
from probewise.proof.sensors import CLEAR, FAINT, GROSS, NO_PHYSICS, NOISE_NAMES, SINGLES, SMALL

Results: TypeAlias = Sequence[Result]

NOISE = frozenset(NOISE_NAMES.values()) | {"quantisation", "random_walk", "noise_per_run"}
"""Effects on the noise."""

HONEST_NATS = 3.0
"""Two effects that differ by less are aliased (diagnosis, section 3)."""

_LIKE = 0.9  # cosine from which an effect outside the vocabulary scores as the one inside (section 4)

COUNTERPARTS: Mapping[str, str] = {
    "bent_rail": "bent_rails",
    "twisted_rail": "bent_rails",
    "place_step": "missing_tooth",
    "stick_slip": "stick_slip",
    "slipped_paper": "arm_knock",
    "ghost": "reflection",
    "cross_talk": "polarisation",
    "after_glow": "overshoot",
}
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
    alike = {name for name, rho in cosines.items() if rho >= _LIKE} or {"unknown"}
    return frozenset(alike | {COUNTERPARTS[name] for name in [hidden["name"]] if name in COUNTERPARTS})


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
    physics, hidden = sorted(set(names) - NOISE), result["hidden"]
    strange = (0.5 * float(h["size_lambda"]) ** 2 * (1 - _LIKE**2) for h in hidden if not h["in_vocabulary"])
    nats = result.get("alternative_nats", {}).get("+".join(physics), math.inf)
    due = set(result["truth"]) & NOISE if noise else set()
    alias = len(physics) <= len(hidden) and nats < max(HONEST_NATS, *strange, 0.0)
    return bool(alias and set(names) & NOISE == due)


def names_in_label(label: str) -> Names:
    """Split a label of a credible set, such as "lag+backlash", into names; "clean" has none."""
    return () if label == "clean" else tuple(label.split("+"))


def leading_hypothesis(result: Result, *, clean: bool = True) -> tuple[Names, float]:
    """Return (names, probability) of the most probable hypothesis; the clean one, (), counts only if `clean`."""
    options = [(tuple(names), p) for names, p in result["hypotheses"] if names or clean]
    return max(options, key=lambda option: option[1], default=((), 0.0))


def _without_noise(names: Iterable[str]) -> Names:
    return tuple(name for name in names if name not in NOISE)


def acts_on_mean(result: Result) -> bool:
    """Return whether no concealed effect acts on the noise only; True if nothing is concealed."""
    return not any(h["on_noise"] for h in result["hidden"])


def is_distinguishable_from_ssf(result: Result) -> bool:
    """Return whether any concealed effect cannot be imitated by one more Gaussian in the SSF; False if clean."""
    return any(not right & NO_PHYSICS for right in right_names_of_each_effect(result, merged=True))


def is_out_of_vocabulary(result: Result) -> bool:
    """Return whether a concealed effect is outside the vocabulary and has no alias there."""
    return any("unknown" in right for right in right_names_of_each_effect(result, merged=True))


def is_recognised_as_out_of_vocabulary(result: Result) -> bool:
    """Return whether the verdict is unknown, or names the rare effect that acts as the concealed one does."""
    right = {COUNTERPARTS[hidden["name"]] for hidden in result["hidden"] if hidden["name"] in COUNTERPARTS}
    named = result["verdict"] == "named" and bool(right) and set(result["combination"]) - NOISE == right
    return result["verdict"] == "unknown" or named


def names_effect_on_mean(result: Result) -> bool:
    """Return whether the diagnosis names an effect on the mean ("unknown" is none)."""
    return bool(set(result["combination"]) - NOISE - {"unknown"})


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
        if (key := _without_noise(names)) or not due:
            joined[key] = joined.get(key, 0.0) + p
    first = max(joined, key=lambda key: joined[key], default=())
    return are_names_right(result, first, noise=False)


def has_false_extra_effect(result: Result) -> bool:
    """Return whether the leading hypothesis names an effect on the mean that is neither the truth nor an alias."""
    named = _without_noise(leading_hypothesis(result)[0])
    return count_extra_names(named, right_names_of_each_effect(result, merged=True, noise=False)) > 0


def count_extra_names(names: Sequence[str], wanted: Sequence[frozenset[str]]) -> int:
    """Count the names left over when as many as possible match a wanted effect, one name per effect."""
    orders = itertools.permutations([*names, *[""] * len(wanted)], len(wanted))
    return len(names) - max(sum(n in right for n, right in zip(order, wanted, strict=False)) for order in orders)


def leading_probability_and_correctness(result: Result) -> tuple[float, bool]:
    """Return the leading hypothesis's probability and whether it is right; an alias is, outside the vocabulary only."""
    names, probability = leading_hypothesis(result)
    return probability, names_match(names, right_names_of_each_effect(result, merged=False))


def is_confidently_wrong(result: Result) -> bool:
    """Return whether a wrong effect, or an alias, has a probability above 0.9; "clean" and "unknown" do not count."""
    probability, right = leading_probability_and_correctness(result)
    return probability > 0.9 and not right and leading_hypothesis(result)[0] not in ((), ("unknown",))


def credible_set_holds_truth(result: Result, *, merged: bool) -> bool:
    """Return whether the credible set holds the truth or, if `merged`, aliases of it."""
    sets, wanted = map(names_in_label, result["credible_set"]), right_names_of_each_effect(result, merged=False)
    return any(are_names_right(result, names) if merged else names_match(names, wanted) for names in sets)


def credible_set_size_with_aliases_merged(result: Result) -> float:
    """Count the hypotheses of a credible set; the right one and its aliases count as one."""
    right = sum(are_names_right(result, names_in_label(label)) for label in result["credible_set"])
    return float(len(result["credible_set"]) - max(right - 1, 0))


_EDGES = np.linspace(0, 1, 11)


def _bin_numbers(probability: FloatArray) -> IntArray:
    return np.clip(np.searchsorted(_EDGES, probability, side="right") - 1, 0, len(_EDGES) - 2)


def reliability_bins(results: Results) -> list[tuple[float, Estimate]]:
    """Bin cases by the probability of their leading hypothesis into ten equal bins; return those that are not empty.

    Of each, ascending: the mean probability stated, and the share of right answers.
    """
    said = [leading_probability_and_correctness(result) for result in results]
    bins = grouped(zip(_bin_numbers(np.array([p for p, _ in said])).tolist(), said, strict=True))
    return [
        (float(np.mean([p for p, _ in own])), estimated_share(right for _, right in own))
        for _, own in sorted(bins.items())
    ]


def calibration_error(results: Results) -> Estimate:
    """Estimate the expected calibration error: abs(mean stated - share right) of each bin, averaged over the cases."""

    def error_of_rows(said: FloatArray) -> float:
        off = np.bincount(_bin_numbers(said[:, 0]), said[:, 0] - said[:, 1])
        return float(np.abs(off).sum()) / len(said)

    said = [leading_probability_and_correctness(result) for result in results]
    found = estimated_statistic(np.array(said, dtype=np.float64).reshape(-1, 2), error_of_rows)
    return replace(found, low=max(found.low, 0.0), high=max(found.high, 0.0)) if found.n else found


OUTSIDE, SEVERAL = "outside", "several"


def confusion_counts(
    results: Results, *, label: Callable[[str], str] = str
) -> tuple[tuple[str, ...], tuple[str, ...], IntArray]:
    """Count answers by truth, over cases of kind "clean", "single" and "outside".

    An answer is that of the leading hypothesis: "clean", its one name, or `SEVERAL`; an alias of the truth counts as
    the truth. If the concealed effects act on the mean, names of noise effects are ignored. `label` maps a name to that
    of its row and column, e.g. to merge several. Returns the truths and answers that occur, and counts, (n_truths,
    n_answers).
    """
    counts: Counter[tuple[str, str]] = Counter()
    for result in _of(results, "clean", "single", "outside"):
        truth = {"clean": "clean", "outside": OUTSIDE}.get(result["kind"]) or result["hidden"][0]["name"]
        names, on_mean = leading_hypothesis(result)[0], acts_on_mean(result)
        names = _without_noise(names) if on_mean else names
        answer = SEVERAL if len(names) > 1 else "".join(names) or "clean"
        if truth not in ("clean", OUTSIDE) and names_match(
            names, right_names_of_each_effect(result, merged=True, noise=not on_mean)
        ):
            answer = truth
        counts[label(truth), label(answer)] += 1

    def in_order(found: set[str], order: Sequence[str]) -> tuple[str, ...]:
        return (*(name for name in order if name in found), *sorted(found - set(order)))

    columns = in_order({s for _, s in counts}, ["clean", *SINGLES, "unknown", SEVERAL])
    truths = in_order({t for t, _ in counts}, ["clean", *SINGLES, OUTSIDE])
    return truths, columns, np.array([[counts[t, s] for s in columns] for t in truths]).reshape(len(truths), -1)


Hidden = Mapping[str, Any]


def oracle_name_rate(hidden: Hidden) -> float:
    """Return the probability that the right name or an alias ranks before the most similar rival (other effect)."""
    return _rate_against_closest_rival(hidden, right_names(hidden))


def oracle_covariate_rate(hidden: Hidden) -> float:
    """Return the probability that the effect ranks before its most similar rival without any of its covariates."""
    covariates = {name: VOCABULARY[name].covariates for name in hidden["cosines"] if name in VOCABULARY}
    covariates["ssf_order"] = ("edge_distance",)
    alike = {name for name, own in covariates.items() if set(hidden["shows_in"]) & set(own)}
    return _rate_against_closest_rival(hidden, alike)


def oracle_credible_set_size(hidden: Hidden) -> float:
    """Return the expected size of a 95 % credible set, with the truth and its aliases counted as one.

    The log Bayes factors against the rivals are taken as independent; the random draws have a fixed seed.
    """
    apart = _distances_of_rivals(hidden)
    d: FloatArray = np.array(list(apart.values()))
    right = np.array([True, *(name in right_names(hidden) for name in apart)])
    rng = np.random.default_rng(len(d))
    log_odds = np.zeros((400, len(d) + 1))
    log_odds[:, 1:] = -(d**2) / 2 - d * rng.standard_normal((400, len(d)))
    odds = np.exp(log_odds - log_odds.max(axis=1, keepdims=True))
    order = np.argsort(-odds, axis=1)
    shares = np.take_along_axis(odds, order, axis=1) / odds.sum(axis=1, keepdims=True)
    inside = np.cumsum(shares, axis=1) - shares < 0.95
    n_right = np.sum(inside & right[order], axis=1)
    return float(np.mean(inside.sum(axis=1) - np.maximum(n_right - 1, 0)))


def readings_to_separate_alias(result: Result) -> float:
    """Return how many readings of the same plan would separate a case's aliased pair by 3 nats (inf if identical)."""
    apart = float(result["hidden"][0]["size_lambda"]) ** 2 * (1 - float(result["cosine"]) ** 2) / 2
    return float(result["readings"]) * HONEST_NATS / apart if apart > 0 else np.inf


def _rate_against_closest_rival(hidden: Hidden, right: Set[str]) -> float:
    apart = (d for name, d in _distances_of_rivals(hidden).items() if name not in right)
    return min((float(ndtr(d / 2)) for d in apart), default=1.0)


def _distances_of_rivals(hidden: Hidden) -> dict[str, float]:
    """Return the distance of each rival in noise sds, by name; {} for a noise effect."""
    if "rival_nats" in hidden:  # of a system, the rival's loss of log likelihood
        return {name: float(np.sqrt(2 * nats)) for name, nats in hidden["rival_nats"].items()}
    size, rivals = float(hidden["size_lambda"]), {n: r for n, r in hidden["cosines"].items() if n != hidden["name"]}
    return {name: size * float(np.sqrt(max(1 - rho**2, 0.0))) for name, rho in rivals.items()}


Decision: TypeAlias = Literal["met", "missed", "open"]

_GAUSSIAN = ("gaussian", "two_lobes")  # SSFs that are mixtures of Gaussians
_ALPHA, _STRICT = 0.05, 0.01  # p-values that are rejected
_LEAST_NATS = 3.0  # least gain of the right model for a share of it to be meaningful


@dataclass(frozen=True)
class ScoreRow:
    """One row of the table: an estimate with its 95 % interval, and the bounds of its target, infinite without one."""

    name: str
    found: Estimate
    least: float = -math.inf
    most: float = math.inf

    @property
    def decision(self) -> Decision | None:
        """The word "met" (interval within bounds), "missed" (beyond one) or "open" (neither); None without a target."""
        if math.isinf(self.least) and math.isinf(self.most):
            return None
        if self.found.low >= self.least and self.found.high <= self.most:
            return "met"
        return "missed" if self.found.low > self.most or self.found.high < self.least else "open"


Part: TypeAlias = Callable[[list[Result]], Iterator[ScoreRow]]
"""Rows of a table, of the cases that did not fail."""


def _share(name: str, hits: Iterable[bool], least: float = -math.inf, most: float = math.inf) -> ScoreRow:
    return ScoreRow(name, estimated_share(hits), least, most)


def _mean(name: str, values: Iterable[float], least: float = -math.inf, most: float = math.inf) -> ScoreRow:
    return ScoreRow(name, estimated_mean(values), least, most)


def _of(results: Iterable[Result], *kinds: str, **wanted: object) -> list[Result]:
    return [r for r in results if r["kind"] in kinds and all(r[name] == value for name, value in wanted.items())]


def _rejected(results: Iterable[Result], alpha: float) -> list[bool]:
    return [r["p_value"] <= alpha for r in results]


def _alarms_by_noise(other: Results, most: float = math.inf) -> Iterator[ScoreRow]:
    for model, own in sorted(grouped((r["noise_model"], r) for r in other).items()):
        yield _share(f"  {model}", _rejected(own, _ALPHA), most=most)


def _first_covariate_is_right(result: Result) -> bool:
    return bool(result["where"]) and result["where"][0] in result["hidden"][0]["shows_in"]


def _covered(intervals: Iterable[Sequence[float]]) -> list[bool]:
    return [low <= truth <= high for truth, low, high in intervals]


def _set_sizes(results: Iterable[Result]) -> list[float]:
    return [float(len(r["credible_set"])) for r in results]


def _unknown(results: Iterable[Result]) -> list[bool]:
    return [r["verdict"] == "unknown" for r in results]


def _scored(results: Results, *parts: Part) -> tuple[ScoreRow, ...]:
    done = [r for r in results if "failed" not in r]
    return (
        *(row for part in parts for row in part(done)),
        _share("cases that failed", ["failed" in r for r in results]),
    )


def _seconds(part: str, *kinds: tuple[object, str, float]) -> Part:
    """Return the rows of processor times of the cases whose `part` has each value, with its words and most seconds."""

    def rows(done: list[Result]) -> Iterator[ScoreRow]:
        for value, words, most in kinds:
            seconds = [r["cpu_s"] for r in done if r[part] == value]
            yield _mean(f"processor time of a diagnosis, {words} (s)", seconds, most=most)

    return rows


def detected_and_named_by_effect(results: Results) -> dict[str, tuple[Estimate, Estimate]]:
    """Return by name of single effects of lambda 8: (share detected at alpha .01, share with the right name first)."""
    singles = _of((r for r in results if "failed" not in r), "single", size=SMALL)
    return {
        name: (estimated_share(_rejected(own, _STRICT)), estimated_share(map(is_leading_name_right, own)))
        for name, own in grouped((r["hidden"][0]["name"], r) for r in singles).items()
    }


def _alarms_and_detection(done: list[Result]) -> Iterator[ScoreRow]:
    white, other = (_of(done, "clean", other_noise=is_other) for is_other in (False, True))
    yield _share("false alarms, clean, alpha .05", _rejected(white, _ALPHA), 0.04, 0.06)
    yield _share("false alarms, clean, alpha .01", _rejected(white, _STRICT), 0.006, 0.015)
    yield _share("false alarms, other noise, alpha .05", _rejected(other, _ALPHA), most=0.06)
    yield from _alarms_by_noise(other, most=0.06)
    for kind, words, most in (("clean", "clean", 0.005), ("ssf_order", "one Gaussian more", 0.01)):
        yield _share(f"physics named, {words}", map(names_effect_on_mean, _of(done, kind)), most=most)
    # The p-value does not test the noise, and one more Gaussian in the SSF imitates some effects.
    visible = [r for r in done if acts_on_mean(r) and is_distinguishable_from_ssf(r)]
    for size, least in ((5.0, 0.8), (FAINT, 0.93), (SMALL, 0.995)):
        found = _rejected(_of(visible, "single", size=size), _STRICT)
        yield _share(f"detection, alpha .01, lambda {size:g}", found, least)
    each = [detected for detected, _ in detected_and_named_by_effect(visible).values()]
    worst = min(each, key=lambda e: (e.value, e.high), default=estimated_share([]))
    yield ScoreRow("detection, lambda 8, least of all effects", worst, 0.9)


def _names(done: list[Result]) -> Iterator[ScoreRow]:
    shares = []
    for size, least in ((FAINT, 0.9), (SMALL, 0.97), (CLEAR, 0.99), (GROSS, 0.995)):
        singles = _of(done, "single", size=size)
        yield (row := _share(f"right name first, lambda {size:g}", map(is_leading_name_right, singles), least))
        oracle = [oracle_name_rate(r["hidden"][0]) for r in singles]
        yield _mean(f"  oracle against the hardest rival, lambda {size:g}", oracle)
        shares.append(row.found)
    falls = [_difference_of_shares(a, b) for a, b in pairwise(shares) if a.n and b.n]
    worst = max(falls, key=lambda fall: fall.value, default=estimated_share([]))
    yield ScoreRow("right name first, largest fall as lambda grows", worst, most=0.0)


def _difference_of_shares(before: Estimate, after: Estimate) -> Estimate:
    """Return the proportion `before` minus `after`, with Newcombe's interval."""
    fall = before.value - after.value
    down = math.hypot(before.value - before.low, after.high - after.value)
    up = math.hypot(before.high - before.value, after.value - after.low)
    return Estimate(fall, fall - down, fall + up, before.n + after.n)


def _probabilities(done: list[Result]) -> Iterator[ScoreRow]:
    yield _share("95 % credible set holds the truth", [credible_set_holds_truth(r, merged=False) for r in done], 0.95)
    for size, most in ((SMALL, 1.25), (CLEAR, 1.1)):
        singles = _of(done, "single", size=size)
        merged = map(credible_set_size_with_aliases_merged, singles)
        oracle = [oracle_credible_set_size(r["hidden"][0]) for r in singles]
        yield _mean(f"size of the credible set, lambda {size:g}", _set_sizes(singles), most=most)
        yield _mean(f"  the truth and its aliases as one, lambda {size:g}", merged)
        yield _mean(f"  oracle, aliases as one, lambda {size:g}", oracle)
    yield ScoreRow("expected calibration error", calibration_error(done), most=0.02)
    yield _share("wrong name stated above .9", map(is_confidently_wrong, done), most=0.005)


def _places_and_intervals(done: list[Result]) -> Iterator[ScoreRow]:
    for size, least in ((CLEAR, 0.8), (GROSS, 0.9)):
        overlaps = [r["overlap"] for r in _of(done, "single", size=size) if r["overlap"] is not None]
        yield _mean(f"overlap of the place, lambda {size:g}", overlaps, least)
    shown = [r for r in _of(done, "single", size=SMALL) if acts_on_mean(r)]
    yield _share("right covariate first, lambda 8", map(_first_covariate_is_right, shown), 0.98)
    yield _mean("  oracle against the hardest rival", [oracle_covariate_rate(r["hidden"][0]) for r in shown])
    named = (r for r in done if names_match(r["combination"], right_names_of_each_effect(r, merged=False)))
    right = [r for r in named if not is_out_of_vocabulary(r)]
    gaussian = [r for r in right if r["ssf"] in _GAUSSIAN and r["kind"] != "ssf_order"]
    of_effects = (interval for r in right for effect in r["parameters"].values() for interval in effect.values())
    of_sensors = (interval for r in gaussian for interval in r["sensor"].values())
    yield _share("95 % intervals of effect parameters cover", _covered(of_effects), 0.93, 0.97)
    yield _share("95 % intervals of SSF and levels cover", _covered(of_sensors), 0.93)


def _held_out_gain(result: Result, model: str) -> float:
    """Return the gain of a model over the null, in nats, summed over what is held out."""
    return float(sum(scores[model] - scores["null"] for scores in result["held_out"].values()))


def _have_densities(result: Result, *models: str) -> bool:
    return all(model in scores for scores in result["held_out"].values() for model in models)


def _held_out_scans(done: list[Result]) -> Iterator[ScoreRow]:
    known = [r for r in _of(done, "single", "pair") if acts_on_mean(r) and _have_densities(r, "right")]
    gains = np.array([[_held_out_gain(r, model) for model in ("repaired", "right")] for r in known]).reshape(-1, 2)
    share = estimated_statistic(gains, lambda rows: float(rows[:, 0].sum() / rows[:, 1].sum()))
    yield ScoreRow("held-out gain, share of the right model's", share, 0.98)
    worse = [_held_out_gain(r, "repaired") < -1.0 for r in done]
    yield _share("held-out worse than the null by over 1 nat", worse, most=0.01)
    # The scatter that noise alone causes in the best gain possible with these readings.
    yield _share("  of the right model, fitted to the same", [bool(gain < -1.0) for gain in gains[:, 1]])


def _pairs_aliases_and_unlisted(done: list[Result]) -> Iterator[ScoreRow]:
    pairs, aliased = _of(done, "pair"), _of(done, "alias")
    yield _share("two effects: both named", map(is_leading_name_right, pairs), 0.95)
    yield _share("two effects: a false extra", map(has_false_extra_effect, pairs), most=0.03)
    for size, least in ((CLEAR, 0.9), (GROSS, 0.97)):
        outside = [r for r in done if is_out_of_vocabulary(r) and r["size"] == size]
        name = f"outside the vocabulary: unknown, or a rare effect named right, lambda {size:g}"
        yield _share(name, map(is_recognised_as_out_of_vocabulary, outside), least)
    yield _share("false unknown", _unknown(r for r in done if r["kind"] != "outside"), most=0.02)
    yield _share("aliased pair: cannot tell", [r["verdict"] == "cannot_tell" for r in aliased], 0.98)
    yield _share("aliased pair: sure of the wrong name", map(is_confidently_wrong, aliased), most=0.01)
    right_at_last = [leading_probability_and_correctness({**r, **(r["settled"] or {})})[1] for r in aliased]
    yield _share("right name after the advised readings", right_at_last, 0.95)
    needed = [r["settled"]["readings"] / readings_to_separate_alias(r) for r in aliased if r["settled"]]
    yield _mean("  readings advised, of those that repeating the plan needs", needed, most=0.25)


def _rounds(last: list[Result]) -> Iterator[ScoreRow]:
    first = [r | r["rounds"][0] for r in last]
    for after_last, after_first in zip(_of_round(last), _of_round(first), strict=True):
        yield after_last
        yield ScoreRow(f"  after one round: {after_first.name}", after_first.found)
    further = [sum(each["readings"] for each in r["rounds"][1:]) for r in last]
    extra = median_with_interval([n for n in further if n > 0])
    yield ScoreRow("extra readings, median of those not settled at once", extra, most=80.0)
    yield _share("settled at last", [r["rounds"][-1]["settled"] for r in last])
    yield _mean("processor time of an investigation (s)", [r["cpu_s"] for r in last])


def _of_round(results: list[Result]) -> Iterator[ScoreRow]:
    small, large = (_of(results, "single", size=size) for size in (SMALL, CLEAR))
    pairs, holds = _of(results, "pair"), [credible_set_holds_truth(r, merged=False) for r in results]
    yield _share("right name first, lambda 8", map(is_leading_name_right, small), 0.985)
    yield _share("right name first, lambda 12", map(is_leading_name_right, large), 0.995)
    yield _mean("size of the credible set, lambda 8", _set_sizes(small), most=1.15)
    yield _mean("size of the credible set, lambda 12", _set_sizes(large), most=1.05)
    yield _share("95 % credible set holds the truth", holds, 0.95)
    yield _share("detection, alpha .01, lambda 8", _rejected(filter(acts_on_mean, small), _STRICT), 0.995)
    yield _share("two effects: both named", map(is_leading_name_right, pairs), 0.96)
    yield _share("two effects: a false extra", map(has_false_extra_effect, pairs), most=0.03)
    yield _share("physics named, clean", map(names_effect_on_mean, _of(results, "clean")), most=0.005)


def name_without_target(name: str) -> str:
    """Return a name, or several joined by "+", without the targets after ":"."""
    return "+".join(part.split(":")[0] for part in name.split("+"))


def _alarms_and_names_of_systems(done: list[Result]) -> Iterator[ScoreRow]:
    white, other = (_of(done, "clean", other_noise=is_other) for is_other in (False, True))
    yield _share("false alarms, no effect, white noise, alpha .05", _rejected(white, _ALPHA), 0.03, 0.06)
    yield _share("false alarms, no effect, other noise, alpha .05", _rejected(other, _ALPHA), most=0.06)
    yield from _alarms_by_noise(other)
    yield _share("physics named, no effect, white noise", map(names_effect_on_mean, white), most=0.005)
    yield _share("physics named, no effect, other noise", map(names_effect_on_mean, other), most=0.005)
    for size, least in ((FAINT, -math.inf), (SMALL, 0.9), (CLEAR, 0.95), (GROSS, 0.98)):
        singles = _of(done, "single", size=size)
        yield _share(f"right name and target first, lambda {size:g}", map(is_leading_name_right, singles), least)
        if oracle := [oracle_name_rate(hidden) for hidden in _effects_with_rivals(singles)]:
            yield _mean(f"  oracle against the hardest rival, lambda {size:g}", oracle)
    shown, pairs = _of(done, "single", size=CLEAR), _of(done, "pair")
    yield _share("right covariate first, lambda 12", map(_first_covariate_is_right, shown), 0.95)
    yield _share("two effects, lambda 12 each: both named", map(is_leading_name_right, pairs), 0.85)


def _effects_with_rivals(singles: Results) -> list[Result]:
    return [r["hidden"][0] for r in singles if "rival_nats" in r["hidden"][0]]


def _probabilities_and_intervals_of_systems(done: list[Result]) -> Iterator[ScoreRow]:
    singles = _of(done, "single", size=CLEAR)
    holds, holds_in_all = ([credible_set_holds_truth(r, merged=True) for r in rs] for rs in (singles, done))
    yield _share("95 % credible set holds the truth or its alias, lambda 12", holds, 0.95)
    yield _share("  the same, all cases", holds_in_all)
    sizes = map(credible_set_size_with_aliases_merged, singles)
    yield _mean("size of the credible set, the truth and its aliases as one, lambda 12", sizes, most=1.4)
    if oracle := [oracle_credible_set_size(hidden) for hidden in _effects_with_rivals(singles)]:
        yield _mean("  oracle, so counted, lambda 12", oracle)
    wrong = [is_confidently_wrong(r) and not are_names_right(r, leading_hypothesis(r)[0]) for r in done]
    yield _share("wrong name stated above .9", wrong, most=0.01)
    yield ScoreRow("expected calibration error", calibration_error(done))
    stated = [item for r in done for effect in r["parameters"].values() for item in effect.items()]
    # One effect has a value for each run: they would outnumber all others.
    shared = [interval for name, interval in stated if not name.startswith("values[")]
    yield _share("95 % intervals of effect parameters cover", _covered(shared), 0.92, 0.98)


def gains_on_held_out_runs(result: Result) -> tuple[float, float] | None:
    """Return (gain of the repaired model, of the right one) over the null in nats, summed over the held-out runs.

    Each is capped at 100. None if a run lacks a density under one of the three models.
    """
    if not _have_densities(result, "null", "repaired", "right"):
        return None
    return min(_held_out_gain(result, "repaired"), 100.0), min(_held_out_gain(result, "right"), 100.0)


def _held_out_runs(done: list[Result]) -> Iterator[ScoreRow]:
    named = map(gains_on_held_out_runs, _of(done, "single", "pair"))
    shares = [gains[0] / gains[1] for gains in named if gains is not None and gains[1] >= _LEAST_NATS]
    yield ScoreRow("held-out runs: median share of the right model's gain", median_with_interval(shares), 0.95)
    scored = (r for r in done if _have_densities(r, "null", "repaired"))
    worse = [_held_out_gain(r, "repaired") < -3.0 for r in scored]
    yield _share("held-out worse than the null by over 3 nats", worse)


def _unlisted_laws(done: list[Result]) -> Iterator[ScoreRow]:
    outside = _of(done, "outside")
    good = [_gains_as_much_as_true_law(r) for r in outside]
    recognised = [g or unknown for g, unknown in zip(good, _unknown(outside), strict=True)]
    name = "out of vocabulary, lambda 20: unknown, a right name, or 0.8 of the held-out gain"
    yield _share(name, recognised, 0.9)
    yield _share("  the same without unknown", good, 0.6)
    yield _share("false unknown", _unknown(r for r in done if r["kind"] != "outside" and not is_out_of_vocabulary(r)))


def _gains_as_much_as_true_law(result: Result) -> bool:
    """Return whether the right name or an alias leads, or the repaired model gains 80 % of the right model's nats."""
    names = leading_hypothesis(result)[0]
    if names_match(names, right_names_of_each_effect(result, merged=True)) and result["verdict"] != "unknown":
        return True
    gains = gains_on_held_out_runs(result)
    return gains is not None and gains[1] >= _LEAST_NATS and gains[0] >= 0.8 * gains[1]


def score(results: Results) -> tuple[ScoreRow, ...]:
    """Return the rows of a challenge of the light sensor, from results of `run_case`."""
    parts = _alarms_and_detection, _names, _probabilities, _places_and_intervals, _held_out_scans
    times = _seconds("plan", ("paper", "paper plan", 5.0), ("two_way", "two_way plan", math.inf))
    return _scored(results, *parts, _pairs_aliases_and_unlisted, times)


def score_rounds(results: Results) -> tuple[ScoreRow, ...]:
    """Return the rows of a challenge in rounds: each target after the last round and the first, then costs."""
    return _scored(results, _rounds)


def score_systems(results: Results) -> tuple[ScoreRow, ...]:
    """Return the rows of a challenge of systems, from results of `run_system_case`."""
    parts = _alarms_and_names_of_systems, _probabilities_and_intervals_of_systems, _held_out_runs
    times = _seconds("law", (False, "closed form", 5.0), (True, "differential equations", 20.0))
    return _scored(results, *parts, _unlisted_laws, times)
