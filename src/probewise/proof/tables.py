"""The tables of challenges: quantity, target, estimate and decision in each row, from the results of the cases.

A case that failed counts in the last row alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np

from probewise._arrays import FloatArray
from probewise.proof.campaign import Result
from probewise.proof.estimates import Estimate, estimated_mean, estimated_share, estimated_statistic
from probewise.proof.scoring import (
    acts_on_mean,
    are_names_right,
    calibration_error,
    credible_set_holds_truth,
    credible_set_size_with_aliases_merged,
    has_false_extra_effect,
    is_confidently_wrong,
    is_distinguishable_from_ssf,
    is_leading_name_right,
    is_out_of_vocabulary,
    is_recognised_as_out_of_vocabulary,
    leading_hypothesis,
    leading_probability_and_correctness,
    names_effect_on_mean,
    names_match,
    oracle_covariate_rate,
    oracle_credible_set_size,
    oracle_name_rate,
    readings_to_separate_alias,
    right_names_of_each_effect,
)

Decision: TypeAlias = Literal["met", "missed", "open"]

_GAUSSIAN = ("gaussian", "two_lobes")  # SSFs that are mixtures of Gaussians
_BESIDE = 0.8  # least share of an effect's size given the other: sqrt(1 - 0.5^2), less some tolerance
_SCANS = ("angle", "pattern", "direction")
_RUNS = ("inside", "beyond")
_MOST_NATS = 100.0  # cap on a recording's held-out gain
_LEAST_NATS = 3.0  # least gain of the right model for a share of it to be meaningful
_AS_GOOD = 0.8  # share of the true law's held-out gain that counts as equally good
_BOOTSTRAPS = 2000


@dataclass(frozen=True)
class ScoreRow:
    """One row of the table.

    `found`: estimate with its 95 % interval; `least`, `most`: bounds of the target, infinite by default; if both are,
    there is no target.
    """

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


def _share(name: str, hits: Iterable[bool], least: float = -math.inf, most: float = math.inf) -> ScoreRow:
    return ScoreRow(name, estimated_share(list(hits)), least, most)


def _mean(name: str, values: Iterable[float], least: float = -math.inf, most: float = math.inf) -> ScoreRow:
    return ScoreRow(name, estimated_mean(list(values)), least, most)


def _rejected(results: Iterable[Result], alpha: float) -> list[bool]:
    return [r["p_value"] <= alpha for r in results]


def _of_kind(results: Iterable[Result], *kinds: str) -> list[Result]:
    return [r for r in results if r["kind"] in kinds]


def _with_one_effect(results: Iterable[Result], size: float) -> list[Result]:
    return [r for r in _of_kind(results, "single") if r["size"] == size]


def _clean_with_white_and_other_noise(done: list[Result]) -> tuple[list[Result], list[Result]]:
    clean = _of_kind(done, "clean")
    return [r for r in clean if not r["other_noise"]], [r for r in clean if r["other_noise"]]


def _alarms_by_noise(other: list[Result], most: float = math.inf) -> Iterator[ScoreRow]:
    for model in sorted({r["noise_model"] for r in other}):
        yield _share(f"  {model}", _rejected([r for r in other if r["noise_model"] == model], 0.05), most=most)


def _first_covariate_is_right(result: Result) -> bool:
    return bool(result["where"]) and result["where"][0] in result["hidden"][0]["shows_in"]


def _covered(intervals: Iterable[Sequence[float]]) -> list[bool]:
    return [low <= truth <= high for truth, low, high in intervals]


def _set_sizes(results: Iterable[Result]) -> list[float]:
    return [float(len(r["credible_set"])) for r in results]


def _unknown(results: Iterable[Result]) -> list[bool]:
    return [r["verdict"] == "unknown" for r in results]


def _rows(results: Sequence[Result], *parts: Callable[[list[Result]], Iterator[ScoreRow]]) -> tuple[ScoreRow, ...]:
    """Return the rows of these parts of a table, and that of the cases that failed."""
    done = [r for r in results if "failed" not in r]
    failed = _share("cases that failed", ["failed" in r for r in results])
    return (*(row for part in parts for row in part(done)), failed)


def score(results: Sequence[Result]) -> tuple[ScoreRow, ...]:
    """Return the rows of a challenge of the light sensor, from results of `run_case`."""
    parts = _alarms_and_detection, _names, _probabilities, _places_and_intervals, _held_out_scans
    return _rows(results, *parts, _pairs_aliases_and_unlisted, _seconds_by_plan)


def _seconds_by_plan(done: list[Result]) -> Iterator[ScoreRow]:
    for plan, most in (("paper", 5.0), ("two_way", math.inf)):
        seconds = [r["cpu_s"] for r in done if r["plan"] == plan]
        yield _mean(f"processor time of a diagnosis, {plan} plan (s)", seconds, most=most)


def detected_and_named_by_effect(results: Sequence[Result], size: float = 8.0) -> dict[str, tuple[Estimate, Estimate]]:
    """Return by name of single effects of this size: (share detected at alpha .01, share with the right name first)."""
    cases: dict[str, list[Result]] = {}
    for r in _with_one_effect((r for r in results if "failed" not in r), size):
        cases.setdefault(r["hidden"][0]["name"], []).append(r)
    return {
        name: (estimated_share(_rejected(rs, 0.01)), estimated_share([is_leading_name_right(r) for r in rs]))
        for name, rs in cases.items()
    }


def _alarms_and_detection(done: list[Result]) -> Iterator[ScoreRow]:
    white, other = _clean_with_white_and_other_noise(done)
    yield _share("false alarms, clean, alpha .05", _rejected(white, 0.05), 0.04, 0.06)
    yield _share("false alarms, clean, alpha .01", _rejected(white, 0.01), 0.006, 0.015)
    yield _share("false alarms, other noise, alpha .05", _rejected(other, 0.05), most=0.06)
    yield from _alarms_by_noise(other, most=0.06)
    yield _share("physics named, clean", map(names_effect_on_mean, _of_kind(done, "clean")), most=0.005)
    more = _of_kind(done, "ssf_order")
    yield _share("physics named, one Gaussian more", map(names_effect_on_mean, more), most=0.01)
    # The p-value does not test the noise, and one more Gaussian in the SSF imitates some effects.
    visible = [r for r in done if acts_on_mean(r) and is_distinguishable_from_ssf(r)]
    for size, least in ((5.0, 0.8), (6.0, 0.93), (8.0, 0.995)):
        found = _rejected(_with_one_effect(visible, size), 0.01)
        yield _share(f"detection, alpha .01, lambda {size:g}", found, least)
    each = [detected for detected, _ in detected_and_named_by_effect(visible).values()]
    worst = min(each, key=lambda e: (e.value, e.high), default=estimated_share([]))
    yield ScoreRow("detection, lambda 8, least of all effects", worst, 0.9)


def _names(done: list[Result]) -> Iterator[ScoreRow]:
    shares = []
    for size, least in ((6.0, 0.9), (8.0, 0.97), (12.0, 0.99), (20.0, 0.995)):
        singles = _with_one_effect(done, size)
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
    for size, most in ((8.0, 1.25), (12.0, 1.1)):
        singles = _with_one_effect(done, size)
        merged = map(credible_set_size_with_aliases_merged, singles)
        oracle = [oracle_credible_set_size(r["hidden"][0]) for r in singles]
        yield _mean(f"size of the credible set, lambda {size:g}", _set_sizes(singles), most=most)
        yield _mean(f"  the truth and its aliases as one, lambda {size:g}", merged)
        yield _mean(f"  oracle, aliases as one, lambda {size:g}", oracle)
    yield ScoreRow("expected calibration error", calibration_error(done), most=0.02)
    yield _share("wrong name stated above .9", map(is_confidently_wrong, done), most=0.005)


def _places_and_intervals(done: list[Result]) -> Iterator[ScoreRow]:
    for size, least in ((12.0, 0.8), (20.0, 0.9)):
        overlaps = [r["overlap"] for r in _with_one_effect(done, size) if r["overlap"] is not None]
        yield _mean(f"overlap of the place, lambda {size:g}", overlaps, least)
    shown = [r for r in _with_one_effect(done, 8.0) if acts_on_mean(r)]
    yield _share("right covariate first, lambda 8", map(_first_covariate_is_right, shown), 0.98)
    yield _mean("  oracle against the hardest rival", [oracle_covariate_rate(r["hidden"][0]) for r in shown])
    right = [
        r
        for r in done
        if names_match(r["combination"], right_names_of_each_effect(r, merged=False)) and not is_out_of_vocabulary(r)
    ]
    gaussian = [r for r in right if r["ssf"] in _GAUSSIAN and r["kind"] != "ssf_order"]
    of_effects = (interval for r in right for effect in r["parameters"].values() for interval in effect.values())
    of_sensors = (interval for r in gaussian for interval in r["sensor"].values())
    yield _share("95 % intervals of effect parameters cover", _covered(of_effects), 0.93, 0.97)
    yield _share("95 % intervals of SSF and levels cover", _covered(of_sensors), 0.93)


def _held_out_scans(done: list[Result]) -> Iterator[ScoreRow]:
    inside = [r for r in _of_kind(done, "single", "pair") if acts_on_mean(r)]
    gains = _gains_by_scan([r for r in inside if all("right" in s for s in r["held_out"].values())], "right")
    yield ScoreRow("held-out gain, share of the right model's", estimated_statistic(gains, _ratio_of_gains), 0.98)
    for k, scan in enumerate(_SCANS):
        yield ScoreRow(f"  a new {scan}", estimated_statistic(gains[:, k], _ratio_of_gains))
    shares = {
        "  share of what the truth itself would gain": inside,
        "  the same, outside the vocabulary": _of_kind(done, "outside"),
    }
    for name, cases in shares.items():
        of_truth = _gains_by_scan([r for r in cases if r["noise_model"] == "white"], "true")
        yield ScoreRow(name, estimated_statistic(of_truth, _ratio_of_gains))
    worse = [_summed_gains(r, _SCANS, "true")[0] < -1.0 for r in done]
    yield _share("held-out worse than the null by over 1 nat", worse, most=0.01)
    # The scatter that noise alone causes in the best gain possible with these readings.
    by_chance = [bool(g < -1.0) for g in gains[:, :, 1].sum(axis=1)]
    yield _share("  of the right model, fitted to the same", by_chance)


def _gains_by_scan(results: Sequence[Result], best: str) -> FloatArray:
    """Return the gains in nats over the null of the repaired model and of model `best`, (n_cases, n_scans, 2)."""
    gains = [[_summed_gains(r, [scan], best) for scan in _SCANS] for r in results]
    return np.array(gains, dtype=np.float64).reshape(-1, len(_SCANS), 2)


def _summed_gains(result: Result, parts: Sequence[str], best: str) -> tuple[float, float]:
    scores = [result["held_out"][part] for part in parts]
    return sum(s["repaired"] - s["null"] for s in scores), sum(s[best] - s["null"] for s in scores)


def _ratio_of_gains(gains: FloatArray) -> float:
    repaired, true = gains.reshape(-1, 2).sum(axis=0)
    return float(repaired / true)


def _pairs_aliases_and_unlisted(done: list[Result]) -> Iterator[ScoreRow]:
    pairs, aliased = _of_kind(done, "pair"), _of_kind(done, "alias")
    # Each effect keeps most of its size when the other is in the model.
    shown = [r for r in pairs if all(h.get("size_beside", 0) >= _BESIDE * h["size_lambda"] for h in r["hidden"])]
    yield _share("two effects: both named", map(is_leading_name_right, pairs), 0.95)
    yield _share("  where neither hides the other", map(is_leading_name_right, shown))
    yield _share("two effects: a false extra", map(has_false_extra_effect, pairs), most=0.03)
    for size, least in ((12.0, 0.9), (20.0, 0.97)):
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


def score_rounds(results: Sequence[Result]) -> tuple[ScoreRow, ...]:
    """Return the rows of a challenge in rounds: each target after the last round and the first, then costs."""
    return _rows(results, _rounds)


def _rounds(last: list[Result]) -> Iterator[ScoreRow]:
    first = [r | r["rounds"][0] for r in last]
    for after_last, after_first in zip(_of_round(last), _of_round(first), strict=True):
        yield after_last
        yield ScoreRow(f"  after one round: {after_first.name}", after_first.found)
    further = np.array([sum(each["readings"] for each in r["rounds"][1:]) for r in last], dtype=np.float64)
    extra = _bootstrapped_median(further[further > 0])
    yield ScoreRow("extra readings, median of those not settled at once", extra, most=80.0)
    yield _share("settled at last", [r["rounds"][-1]["settled"] for r in last])
    yield _mean("processor time of an investigation (s)", [r["cpu_s"] for r in last])


def _of_round(results: list[Result]) -> Iterator[ScoreRow]:
    small, large = _with_one_effect(results, 8.0), _with_one_effect(results, 12.0)
    pairs, on_mean = _of_kind(results, "pair"), filter(acts_on_mean, small)
    holds = [credible_set_holds_truth(r, merged=False) for r in results]
    yield _share("right name first, lambda 8", map(is_leading_name_right, small), 0.985)
    yield _share("right name first, lambda 12", map(is_leading_name_right, large), 0.995)
    yield _mean("size of the credible set, lambda 8", _set_sizes(small), most=1.15)
    yield _mean("size of the credible set, lambda 12", _set_sizes(large), most=1.05)
    yield _share("95 % credible set holds the truth", holds, 0.95)
    yield _share("detection, alpha .01, lambda 8", _rejected(on_mean, 0.01), 0.995)
    yield _share("two effects: both named", map(is_leading_name_right, pairs), 0.96)
    yield _share("two effects: a false extra", map(has_false_extra_effect, pairs), most=0.03)
    yield _share("physics named, clean", map(names_effect_on_mean, _of_kind(results, "clean")), most=0.005)


def _bootstrapped_median(values: FloatArray) -> Estimate:
    if not values.size:
        return estimated_mean([])
    drawn = np.random.default_rng(0).choice(values, (_BOOTSTRAPS, values.size))
    low, high = np.quantile(np.median(drawn, axis=1), [0.025, 0.975])
    return Estimate(float(np.median(values)), float(low), float(high), int(values.size))


def score_systems(results: Sequence[Result]) -> tuple[ScoreRow, ...]:
    """Return the rows of a challenge of systems, from results of `run_system_case`."""
    parts = _alarms_and_names_of_systems, _probabilities_and_intervals_of_systems, _held_out_runs
    return _rows(results, *parts, _unlisted_laws, _seconds_by_law)


def _seconds_by_law(done: list[Result]) -> Iterator[ScoreRow]:
    for kind, law, most in (("closed form", False, 5.0), ("differential equations", True, 20.0)):
        seconds = [r["cpu_s"] for r in done if r["law"] is law]
        yield _mean(f"processor time of a diagnosis, {kind} (s)", seconds, most=most)


def name_without_target(name: str) -> str:
    """Return a name, or several joined by "+", without the targets after ":"."""
    return "+".join(part.split(":")[0] for part in name.split("+"))


def _alarms_and_names_of_systems(done: list[Result]) -> Iterator[ScoreRow]:
    white, other = _clean_with_white_and_other_noise(done)
    yield _share("false alarms, no effect, white noise, alpha .05", _rejected(white, 0.05), 0.03, 0.06)
    yield _share("false alarms, no effect, other noise, alpha .05", _rejected(other, 0.05), most=0.06)
    yield from _alarms_by_noise(other)
    yield _share("physics named, no effect, white noise", map(names_effect_on_mean, white), most=0.005)
    yield _share("physics named, no effect, other noise", map(names_effect_on_mean, other), most=0.005)
    noise_is_right = [leading_hypothesis(r, clean=True)[0] == tuple(r["truth"]) for r in other]
    yield _share("noise named right, no effect, other noise", noise_is_right)
    for size, least in ((6.0, -math.inf), (8.0, 0.9), (12.0, 0.95), (20.0, 0.98)):
        singles = _with_one_effect(done, size)
        yield _share(f"right name and target first, lambda {size:g}", map(is_leading_name_right, singles), least)
        if oracle := [oracle_name_rate(hidden) for hidden in _effects_with_rivals(singles)]:
            yield _mean(f"  oracle against the hardest rival, lambda {size:g}", oracle)
    shown, pairs = _with_one_effect(done, 12.0), _of_kind(done, "pair")
    yield _share("right covariate first, lambda 12", map(_first_covariate_is_right, shown), 0.95)
    yield _share("two effects, lambda 12 each: both named", map(is_leading_name_right, pairs), 0.85)


def _effects_with_rivals(singles: Sequence[Result]) -> list[Result]:
    """List the concealed effects of cases with one effect whose rivals are on file."""
    return [r["hidden"][0] for r in singles if "rival_nats" in r["hidden"][0]]


def _probabilities_and_intervals_of_systems(done: list[Result]) -> Iterator[ScoreRow]:
    singles = _with_one_effect(done, 12.0)
    holds, holds_in_all = ([credible_set_holds_truth(r, merged=True) for r in rs] for rs in (singles, done))
    yield _share("95 % credible set holds the truth or its alias, lambda 12", holds, 0.95)
    yield _share("  the same, all cases", holds_in_all)
    sizes = map(credible_set_size_with_aliases_merged, singles)
    yield _mean("size of the credible set, the truth and its aliases as one, lambda 12", sizes, most=1.4)
    if oracle := [oracle_credible_set_size(hidden) for hidden in _effects_with_rivals(singles)]:
        yield _mean("  oracle, so counted, lambda 12", oracle)
    wrong = [is_confidently_wrong(r) and not are_names_right(r, leading_hypothesis(r, clean=True)[0]) for r in done]
    yield _share("wrong name stated above .9", wrong, most=0.01)
    yield ScoreRow("expected calibration error", calibration_error(done))
    stated = [item for r in done for effect in r["parameters"].values() for item in effect.items()]
    others, per_run = ([i for name, i in stated if name.startswith("values[") is of_runs] for of_runs in (False, True))
    yield _share("95 % intervals of effect parameters cover", _covered(others), 0.92, 0.98)
    if per_run:
        yield _share("  of values per run", _covered(per_run))


def gains_on_held_out_runs(result: Result, best: str) -> tuple[float, float] | None:
    """Return (gain of the repaired model, gain of model `best`) over the null in nats, summed over the held-out runs.

    Each is capped at 100. None if a run lacks a density under one of the three models.
    """
    if any(model not in result["held_out"][run] for run in _RUNS for model in ("null", "repaired", best)):
        return None
    repaired, most = _summed_gains(result, _RUNS, best)
    return min(repaired, _MOST_NATS), min(most, _MOST_NATS)


def _all_gains(results: Iterable[Result], best: str) -> list[tuple[float, float]]:
    return [g for g in (gains_on_held_out_runs(r, best) for r in results) if g is not None]


def _held_out_runs(done: list[Result]) -> Iterator[ScoreRow]:
    named = _all_gains(_of_kind(done, "single", "pair"), "right")
    shares = np.array([repaired / right for repaired, right in named if right >= _LEAST_NATS])
    found = estimated_statistic(shares, lambda values: float(np.median(values)))
    yield ScoreRow("held-out runs: median share of the right model's gain", found, 0.95)
    every, clean = _all_gains(done, "true"), _all_gains(_of_kind(done, "clean"), "true")
    yield _share("held-out worse than the null by over 3 nats", [bool(g < -3.0) for g, _ in every])
    yield _share("  of those without an effect on the mean", [bool(g < -3.0) for g, _ in clean])


def _unlisted_laws(done: list[Result]) -> Iterator[ScoreRow]:
    outside = _of_kind(done, "outside")
    good = [_gains_as_much_as_true_law(r) for r in outside]
    recognised = [g or unknown for g, unknown in zip(good, _unknown(outside), strict=True)]
    name = "out of vocabulary, lambda 20: unknown, a right name, or 0.8 of the held-out gain"
    yield _share(name, recognised, 0.9)
    yield _share("  the same without unknown", good, 0.6)
    yield _share("  a formula found", [bool(r["formula"]) for r in outside])
    yield _share("false unknown", _unknown(r for r in done if r["kind"] != "outside" and not is_out_of_vocabulary(r)))


def _gains_as_much_as_true_law(result: Result) -> bool:
    """Return whether the right name or an alias leads, or the repaired model gains 80 % of the right model's nats."""
    names = leading_hypothesis(result, clean=True)[0]
    if names_match(names, right_names_of_each_effect(result, merged=True)) and result["verdict"] != "unknown":
        return True
    gains = gains_on_held_out_runs(result, "right")
    return gains is not None and gains[1] >= _LEAST_NATS and gains[0] >= _AS_GOOD * gains[1]
