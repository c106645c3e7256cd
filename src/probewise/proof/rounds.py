"""The table of a challenge in rounds: the gain from the readings that a diagnosis advises."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from probewise.proof.campaign import Result
from probewise.proof.estimates import Estimate, estimated_mean, estimated_share
from probewise.proof.scoring import (
    acts_on_mean,
    credible_set_holds_truth,
    has_false_extra_effect,
    is_leading_name_right,
)
from probewise.proof.tables import ScoreRow, cases_with_one_effect, names_effect_on_mean, rejection_rate

_BOOTSTRAPS = 2000


def score_rounds(results: Sequence[Result]) -> tuple[ScoreRow, ...]:
    """Return rows for `RunCaseInRounds` results: each target after the last round and the first, then costs."""
    last = [r for r in results if "failed" not in r]
    first = [r | r["rounds"][0] for r in last]
    return (
        *_rows_after_last_and_first_round(
            last, first, "right name first, lambda 8", lambda rs: _share_with_right_name_first(rs, 8.0), least=0.985
        ),
        *_rows_after_last_and_first_round(
            last, first, "right name first, lambda 12", lambda rs: _share_with_right_name_first(rs, 12.0), least=0.995
        ),
        *_rows_after_last_and_first_round(
            last, first, "size of the credible set, lambda 8", lambda rs: _mean_set_size(rs, 8.0), most=1.15
        ),
        *_rows_after_last_and_first_round(
            last, first, "size of the credible set, lambda 12", lambda rs: _mean_set_size(rs, 12.0), most=1.05
        ),
        *_rows_after_last_and_first_round(
            last, first, "95 % credible set holds the truth", _share_of_sets_with_truth, least=0.95
        ),
        *_rows_after_last_and_first_round(last, first, "detection, alpha .01, lambda 8", _share_detected, least=0.995),
        *_rows_after_last_and_first_round(
            last, first, "two effects: both named", _share_of_pairs_with_both_named, least=0.96
        ),
        *_rows_after_last_and_first_round(
            last, first, "two effects: a false extra", _share_of_pairs_with_false_extra, most=0.03
        ),
        *_rows_after_last_and_first_round(
            last, first, "physics named, clean", _share_of_clean_with_effect_named, most=0.005
        ),
        ScoreRow("extra readings, median of those not settled at once", _median_further_readings(last), most=80.0),
        ScoreRow("settled at last", estimated_share([r["rounds"][-1]["settled"] for r in last])),
        ScoreRow("processor time of an investigation (s)", estimated_mean([r["cpu_s"] for r in last])),
        ScoreRow("cases that failed", estimated_share(["failed" in r for r in results])),
    )


def _rows_after_last_and_first_round(
    last: list[Result],
    first: list[Result],
    name: str,
    scored: Any,
    *,
    least: float = -np.inf,
    most: float = np.inf,
) -> tuple[ScoreRow, ScoreRow]:
    return ScoreRow(name, scored(last), least, most), ScoreRow(f"  after one round: {name}", scored(first))


def _share_with_right_name_first(results: list[Result], size: float) -> Estimate:
    return estimated_share([is_leading_name_right(r) for r in cases_with_one_effect(results, size)])


def _mean_set_size(results: list[Result], size: float) -> Estimate:
    return estimated_mean([float(len(r["credible_set"])) for r in cases_with_one_effect(results, size)])


def _share_of_sets_with_truth(results: list[Result]) -> Estimate:
    return estimated_share([credible_set_holds_truth(r, merged=False) for r in results])


def _share_detected(results: list[Result]) -> Estimate:
    return rejection_rate([r for r in cases_with_one_effect(results, 8.0) if acts_on_mean(r)], 0.01)


def _pair_results(results: list[Result]) -> list[Result]:
    return [r for r in results if r["kind"] == "pair"]


def _share_of_pairs_with_both_named(results: list[Result]) -> Estimate:
    return estimated_share([is_leading_name_right(r) for r in _pair_results(results)])


def _share_of_pairs_with_false_extra(results: list[Result]) -> Estimate:
    return estimated_share([has_false_extra_effect(r) for r in _pair_results(results)])


def _share_of_clean_with_effect_named(results: list[Result]) -> Estimate:
    return estimated_share([names_effect_on_mean(r) for r in results if r["kind"] == "clean"])


def _median_further_readings(results: list[Result]) -> Estimate:
    """Estimate the median number of readings after the first round, over cases that took any, with its interval."""
    extra = np.array([sum(each["readings"] for each in r["rounds"][1:]) for r in results], dtype=np.float64)
    extra = extra[extra > 0]
    if not extra.size:
        return estimated_mean([])
    drawn = np.random.default_rng(0).choice(extra, (_BOOTSTRAPS, extra.size))
    low, high = np.quantile(np.median(drawn, axis=1), [0.025, 0.975])
    return Estimate(float(np.median(extra)), float(low), float(high), int(extra.size))
