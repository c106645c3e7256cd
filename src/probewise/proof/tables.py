"""The table of a challenge: quantity, target, estimate and decision in each row."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np

from probewise._arrays import FloatArray
from probewise.proof.campaign import Result
from probewise.proof.estimates import Estimate, estimated_mean, estimated_share, estimated_statistic
from probewise.proof.scoring import (
    NOISE,
    acts_on_mean,
    are_names_right,
    calibration_error,
    credible_set_holds_truth,
    has_false_extra_effect,
    is_distinguishable_from_ssf,
    is_leading_name_right,
    is_out_of_vocabulary,
    is_recognised_as_out_of_vocabulary,
    leading_hypothesis,
    leading_probability_and_correctness,
    names_in_label,
    names_match,
    oracle_covariate_rate,
    oracle_credible_set_size,
    oracle_name_rate,
    readings_to_separate_alias,
    right_names_of_each_effect,
)

__all__ = ["Decision", "ScoreRow", "score"]

Decision: TypeAlias = Literal["met", "missed", "open"]

_GAUSSIAN = ("gaussian", "two_lobes")  # SSFs that are mixtures of Gaussians
_BESIDE = 0.8  # least share of an effect's size given the other: sqrt(1 - 0.5^2), less some tolerance
_SCANS = ("angle", "pattern", "direction")


@dataclass(frozen=True)
class ScoreRow:
    """One row of the table.

    Parameters
    ----------
    name
        Quantity measured.
    found
        Estimate with its 95 % interval.
    least, most
        Bounds of the target, infinite by default; if both are, there is no target.
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


def score(results: Sequence[Result]) -> tuple[ScoreRow, ...]:
    """Return the table's rows from results of `run_case`; a case that failed counts in the last row alone."""
    done = [r for r in results if "failed" not in r]
    return (
        *_rows_on_clean_cases(done),
        *_rows_on_detection(done),
        *_rows_on_naming(done),
        *_rows_on_stated_probabilities(done),
        *_rows_on_location(done),
        *_rows_on_intervals(done),
        *_rows_on_held_out_gains(done),
        *_rows_on_pairs(done),
        *_rows_on_out_of_vocabulary(done),
        *_rows_on_aliased_pairs(done),
        *_rows_on_processor_time(done),
        ScoreRow("cases that failed", estimated_share(["failed" in r for r in results])),
    )


def detected_and_named_by_effect(results: Sequence[Result], size: float = 8.0) -> dict[str, tuple[Estimate, Estimate]]:
    """Return by name of single effects of this size: (share detected at alpha .01, share with the right name first)."""
    singles = cases_with_one_effect([r for r in results if "failed" not in r], size)
    names = dict.fromkeys(r["hidden"][0]["name"] for r in singles)
    own = {name: [r for r in singles if r["hidden"][0]["name"] == name] for name in names}
    return {
        name: (rejection_rate(rs, 0.01), estimated_share([is_leading_name_right(r) for r in rs]))
        for name, rs in own.items()
    }


def _rows_on_clean_cases(done: list[Result]) -> list[ScoreRow]:
    clean = [r for r in done if r["kind"] == "clean"]
    white, other = ([r for r in clean if r["other_noise"] is o] for o in (False, True))
    models = sorted({r["noise_model"] for r in other})
    return [
        ScoreRow("false alarms, clean, alpha .05", rejection_rate(white, 0.05), 0.04, 0.06),
        ScoreRow("false alarms, clean, alpha .01", rejection_rate(white, 0.01), 0.006, 0.015),
        ScoreRow("false alarms, other noise, alpha .05", rejection_rate(other, 0.05), most=0.06),
        *(
            ScoreRow(f"  {m}", rejection_rate([r for r in other if r["noise_model"] == m], 0.05), most=0.06)
            for m in models
        ),
        ScoreRow("physics named, clean", estimated_share([names_effect_on_mean(r) for r in clean]), most=0.005),
        ScoreRow(
            "physics named, one Gaussian more",
            estimated_share([names_effect_on_mean(r) for r in done if r["kind"] == "ssf_order"]),
            most=0.01,
        ),
    ]


def _rows_on_detection(done: list[Result]) -> list[ScoreRow]:
    targets = {5.0: 0.8, 6.0: 0.93, 8.0: 0.995}
    rows = [
        ScoreRow(
            f"detection, alpha .01, lambda {size:g}",
            rejection_rate(_cases_distinguishable_from_ssf(cases_with_one_effect(done, size)), 0.01),
            least,
        )
        for size, least in targets.items()
    ]
    each = [detected for detected, _ in detected_and_named_by_effect(_cases_distinguishable_from_ssf(done)).values()]
    worst = min(each, key=lambda e: (e.value, e.high), default=estimated_share([]))
    return [*rows, ScoreRow("detection, lambda 8, least of all effects", worst, 0.9)]


def _rows_on_naming(done: list[Result]) -> list[ScoreRow]:
    targets = {6.0: 0.9, 8.0: 0.97, 12.0: 0.99, 20.0: 0.995}
    found = {
        size: estimated_share([is_leading_name_right(r) for r in cases_with_one_effect(done, size)]) for size in targets
    }
    falls = [_difference_of_shares(a, b) for a, b in pairwise(found.values()) if a.n and b.n]
    worst = max(falls, key=lambda fall: fall.value, default=estimated_share([]))
    rows = []
    for size, least in targets.items():
        like = [oracle_name_rate(r["hidden"][0]) for r in cases_with_one_effect(done, size)]
        rows.append(ScoreRow(f"right name first, lambda {size:g}", found[size], least))
        rows.append(ScoreRow(f"  oracle against the hardest rival, lambda {size:g}", estimated_mean(like)))
    return [
        *rows,
        ScoreRow("right name first, largest fall as lambda grows", worst, most=0.0),
    ]


def _difference_of_shares(before: Estimate, after: Estimate) -> Estimate:
    """Return the proportion `before` minus `after`, with Newcombe's interval."""
    fall = before.value - after.value
    down = math.hypot(before.value - before.low, after.high - after.value)
    up = math.hypot(before.high - before.value, after.value - after.low)
    return Estimate(fall, fall - down, fall + up, before.n + after.n)


def _rows_on_stated_probabilities(done: list[Result]) -> list[ScoreRow]:
    rows = []
    for size, most in ((8.0, 1.25), (12.0, 1.1)):
        singles = cases_with_one_effect(done, size)
        like = [oracle_credible_set_size(r["hidden"][0]) for r in singles]
        rows += [
            ScoreRow(
                f"size of the credible set, lambda {size:g}",
                estimated_mean([float(len(r["credible_set"])) for r in singles]),
                most=most,
            ),
            ScoreRow(
                f"  the truth and its aliases as one, lambda {size:g}",
                estimated_mean([credible_set_size_with_aliases_merged(r) for r in singles]),
            ),
            ScoreRow(f"  oracle, aliases as one, lambda {size:g}", estimated_mean(like)),
        ]
    return [
        ScoreRow(
            "95 % credible set holds the truth",
            estimated_share([credible_set_holds_truth(r, merged=False) for r in done]),
            0.95,
        ),
        *rows,
        ScoreRow("expected calibration error", calibration_error(done), most=0.02),
        ScoreRow("wrong name stated above .9", estimated_share([is_confidently_wrong(r) for r in done]), most=0.005),
    ]


def credible_set_size_with_aliases_merged(result: Result) -> float:
    """Count the hypotheses of a credible set; the right one and its aliases count as one."""
    right = sum(are_names_right(result, names_in_label(label)) for label in result["credible_set"])
    return float(len(result["credible_set"]) - max(right - 1, 0))


def _rows_on_location(done: list[Result]) -> list[ScoreRow]:
    targets = {12.0: 0.8, 20.0: 0.9}
    local = {
        size: [r["overlap"] for r in cases_with_one_effect(done, size) if r["overlap"] is not None] for size in targets
    }
    shown = [r for r in cases_with_one_effect(done, 8.0) if acts_on_mean(r)]
    first = [bool(r["where"]) and r["where"][0] in r["hidden"][0]["shows_in"] for r in shown]
    return [
        *(
            ScoreRow(f"overlap of the place, lambda {size:g}", estimated_mean(local[size]), least)
            for size, least in targets.items()
        ),
        ScoreRow("right covariate first, lambda 8", estimated_share(first), 0.98),
        ScoreRow(
            "  oracle against the hardest rival", estimated_mean([oracle_covariate_rate(r["hidden"][0]) for r in shown])
        ),
    ]


def _rows_on_intervals(done: list[Result]) -> list[ScoreRow]:
    right = [
        r
        for r in done
        if names_match(r["combination"], right_names_of_each_effect(r, merged=False)) and not is_out_of_vocabulary(r)
    ]
    stated_of = [interval for r in right for own in r["parameters"].values() for interval in own.values()]
    gaussian = [r for r in right if r["ssf"] in _GAUSSIAN and r["kind"] != "ssf_order"]
    sensors = [interval for r in gaussian for interval in r["sensor"].values()]
    return [
        ScoreRow("95 % intervals of effect parameters cover", share_of_intervals_with_truth(stated_of), 0.93, 0.97),
        ScoreRow("95 % intervals of SSF and levels cover", share_of_intervals_with_truth(sensors), 0.93),
    ]


def share_of_intervals_with_truth(intervals: list[list[float]]) -> Estimate:
    """Estimate the share of intervals, [truth, low, high] each, that hold the truth."""
    return estimated_share([low <= truth <= high for truth, low, high in intervals])


def _rows_on_held_out_gains(done: list[Result]) -> list[ScoreRow]:
    inside = [r for r in done if r["kind"] in ("single", "pair") and acts_on_mean(r)]
    gains = _held_out_gains_by_scan(
        [r for r in inside if all("right" in scan for scan in r["held_out"].values())], "right"
    )
    white = [r for r in inside if r["noise_model"] == "white"]
    outside = [r for r in done if r["kind"] == "outside" and r["noise_model"] == "white"]
    worse = [_summed_gains_over_null(r, _SCANS, "true")[0] < -1.0 for r in done]
    return [
        ScoreRow("held-out gain, share of the right model's", estimated_statistic(gains, _ratio_of_gains), 0.98),
        *(
            ScoreRow(f"  a new {scan}", estimated_statistic(gains[:, k], _ratio_of_gains))
            for k, scan in enumerate(_SCANS)
        ),
        ScoreRow(
            "  share of what the truth itself would gain",
            estimated_statistic(_held_out_gains_by_scan(white, "true"), _ratio_of_gains),
        ),
        ScoreRow(
            "  the same, outside the vocabulary",
            estimated_statistic(_held_out_gains_by_scan(outside, "true"), _ratio_of_gains),
        ),
        ScoreRow("held-out worse than the null by over 1 nat", estimated_share(worse), most=0.01),
        # The scatter that noise alone causes in the best gain possible with these readings.
        ScoreRow(
            "  of the right model, fitted to the same",
            estimated_share([bool(own < -1.0) for own in gains[:, :, 1].sum(axis=1)]),
        ),
    ]


def _held_out_gains_by_scan(results: Sequence[Result], best: str) -> FloatArray:
    """Return the gains in nats over the null of the repaired model and of model `best`, (n_cases, n_scans, 2)."""
    gains = [[_summed_gains_over_null(r, [scan], best) for scan in _SCANS] for r in results]
    return np.array(gains, dtype=np.float64).reshape(-1, len(_SCANS), 2)


def _summed_gains_over_null(result: Result, scans: Sequence[str], best: str) -> tuple[float, float]:
    own = [result["held_out"][scan] for scan in scans]
    return sum(s["repaired"] - s["null"] for s in own), sum(s[best] - s["null"] for s in own)


def _ratio_of_gains(gains: FloatArray) -> float:
    repaired, true = gains.reshape(-1, 2).sum(axis=0)
    return float(repaired / true)


def _rows_on_pairs(done: list[Result]) -> list[ScoreRow]:
    pairs = [r for r in done if r["kind"] == "pair"]
    both = [is_leading_name_right(r) for r in pairs]
    shown = [right for r, right in zip(pairs, both, strict=True) if _each_keeps_size_beside_other(r)]
    return [
        ScoreRow("two effects: both named", estimated_share(both), 0.95),
        ScoreRow("  where neither hides the other", estimated_share(shown)),
        ScoreRow("two effects: a false extra", estimated_share([has_false_extra_effect(r) for r in pairs]), most=0.03),
    ]


def _each_keeps_size_beside_other(result: Result) -> bool:
    """Return whether each effect of a pair keeps at least 80 % of its lambda when the other is in the model."""
    return all("size_beside" in h and h["size_beside"] >= _BESIDE * h["size_lambda"] for h in result["hidden"])


def _rows_on_out_of_vocabulary(done: list[Result]) -> list[ScoreRow]:
    targets = {12.0: 0.9, 20.0: 0.97}
    outside = [r for r in done if is_out_of_vocabulary(r)]
    inside = [r for r in done if r["kind"] != "outside"]
    return [
        *(
            ScoreRow(
                f"outside the vocabulary: unknown, or a rare effect named right, lambda {size:g}",
                estimated_share([is_recognised_as_out_of_vocabulary(r) for r in outside if r["size"] == size]),
                least,
            )
            for size, least in targets.items()
        ),
        ScoreRow("false unknown", estimated_share([r["verdict"] == "unknown" for r in inside]), most=0.02),
    ]


def _rows_on_aliased_pairs(done: list[Result]) -> list[ScoreRow]:
    aliased = [r for r in done if r["kind"] == "alias"]
    settled = [r | r["settled"] if r["settled"] else r for r in aliased]
    return [
        ScoreRow("aliased pair: cannot tell", estimated_share([r["verdict"] == "cannot_tell" for r in aliased]), 0.98),
        ScoreRow(
            "aliased pair: sure of the wrong name",
            estimated_share([is_confidently_wrong(r) for r in aliased]),
            most=0.01,
        ),
        ScoreRow(
            "right name after the advised readings",
            estimated_share([leading_probability_and_correctness(r)[1] for r in settled]),
            0.95,
        ),
        ScoreRow(
            "  readings advised, of those that repeating the plan needs",
            estimated_mean([r["settled"]["readings"] / readings_to_separate_alias(r) for r in aliased if r["settled"]]),
            most=0.25,
        ),
    ]


def _rows_on_processor_time(done: list[Result]) -> list[ScoreRow]:
    plans = {"paper": 5.0, "two_way": math.inf}
    return [
        ScoreRow(
            f"processor time of a diagnosis, {plan} plan (s)",
            estimated_mean([r["cpu_s"] for r in done if r["plan"] == plan]),
            most=most,
        )
        for plan, most in plans.items()
    ]


def cases_with_one_effect(done: Sequence[Result], size: float) -> list[Result]:
    """List the cases of kind "single" whose effect has this size lambda."""
    return [r for r in done if r["kind"] == "single" and r["size"] == size]


def _cases_distinguishable_from_ssf(results: Sequence[Result]) -> list[Result]:
    """Keep the cases whose effects on the mean cannot be imitated by one more Gaussian in the SSF."""
    return [r for r in _cases_with_mean_effects(results) if is_distinguishable_from_ssf(r)]


def _cases_with_mean_effects(results: Sequence[Result]) -> list[Result]:
    """Keep the cases without effects on the noise, which the p-value does not test."""
    return [r for r in results if acts_on_mean(r)]


def rejection_rate(results: Sequence[Result], alpha: float) -> Estimate:
    """Estimate the share of cases with a p-value of at most `alpha`."""
    return estimated_share([r["p_value"] <= alpha for r in results])


def names_effect_on_mean(result: Result) -> bool:
    """Return whether the diagnosis names an effect on the mean ("unknown" is none)."""
    return bool(set(result["combination"]) - NOISE - {"unknown"})


def is_confidently_wrong(result: Result) -> bool:
    """Return whether a wrong effect, or an alias, has a probability above 0.9; "clean" and "unknown" do not count."""
    probability, right = leading_probability_and_correctness(result)
    names = leading_hypothesis(result, clean=True)[0]
    return probability > 0.9 and not right and names not in ((), ("unknown",))
