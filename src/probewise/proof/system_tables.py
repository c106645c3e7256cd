"""The table of a challenge on systems: quantity, target, estimate and decision in each row."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from probewise._arrays import FloatArray
from probewise.proof.campaign import Result
from probewise.proof.estimates import estimated_mean, estimated_share, estimated_statistic
from probewise.proof.scoring import (
    are_names_right,
    calibration_error,
    credible_set_holds_truth,
    is_leading_name_right,
    is_out_of_vocabulary,
    leading_hypothesis,
    names_match,
    oracle_credible_set_size,
    oracle_name_rate,
    right_names_of_each_effect,
)
from probewise.proof.tables import (
    ScoreRow,
    cases_with_one_effect,
    credible_set_size_with_aliases_merged,
    is_confidently_wrong,
    names_effect_on_mean,
    rejection_rate,
    share_of_intervals_with_truth,
)

_MOST_NATS = 100.0  # cap on a recording's held-out gain
_LEAST_NATS = 3.0  # least gain of the right model for a share of it to be meaningful
_AS_GOOD = 0.8  # share of the true law's held-out gain that counts as equally good
_RUNS = ("inside", "beyond")


def name_without_target(name: str) -> str:
    """Return a name, or several joined by "+", without the targets after ":"."""
    return "+".join(part.split(":")[0] for part in name.split("+"))


def score_systems(results: Sequence[Result]) -> tuple[ScoreRow, ...]:
    """Return the table's rows from results of `run_system_case`; a case that failed counts in the last row alone."""
    done = [r for r in results if "failed" not in r]
    return (
        *_rows_on_clean_cases(done),
        *_rows_on_naming(done),
        *_rows_on_stated_probabilities(done),
        *_rows_on_intervals(done),
        *_rows_on_held_out_gains(done),
        *_rows_on_unlisted_laws(done),
        *_rows_on_processor_time(done),
        ScoreRow("cases that failed", estimated_share(["failed" in r for r in results])),
    )


def _rows_on_clean_cases(done: list[Result]) -> list[ScoreRow]:
    clean = [r for r in done if r["kind"] == "clean"]
    white, other = ([r for r in clean if r["other_noise"] is o] for o in (False, True))
    models = sorted({r["noise_model"] for r in other})
    return [
        ScoreRow("false alarms, no effect, white noise, alpha .05", rejection_rate(white, 0.05), 0.03, 0.06),
        ScoreRow("false alarms, no effect, other noise, alpha .05", rejection_rate(other, 0.05), most=0.06),
        *(ScoreRow(f"  {m}", rejection_rate([r for r in other if r["noise_model"] == m], 0.05)) for m in models),
        ScoreRow(
            "physics named, no effect, white noise",
            estimated_share([names_effect_on_mean(r) for r in white]),
            most=0.005,
        ),
        ScoreRow(
            "physics named, no effect, other noise",
            estimated_share([names_effect_on_mean(r) for r in other]),
            most=0.005,
        ),
        ScoreRow(
            "noise named right, no effect, other noise",
            estimated_share([leading_hypothesis(r, clean=True)[0] == tuple(r["truth"]) for r in other]),
        ),
    ]


def _rows_on_naming(done: list[Result]) -> list[ScoreRow]:
    targets = {6.0: -math.inf, 8.0: 0.9, 12.0: 0.95, 20.0: 0.98}
    shown = cases_with_one_effect(done, 12.0)
    pairs = [r for r in done if r["kind"] == "pair"]
    first: list[ScoreRow] = []
    for size, least in targets.items():
        own = cases_with_one_effect(done, size)
        name = f"right name and target first, lambda {size:g}"
        first.append(ScoreRow(name, estimated_share([is_leading_name_right(r) for r in own]), least))
        oracle = [oracle_name_rate(hidden) for hidden in _effects_with_rivals(own)]
        if oracle:
            first.append(ScoreRow(f"  oracle against the hardest rival, lambda {size:g}", estimated_mean(oracle)))
    return [
        *first,
        ScoreRow(
            "right covariate first, lambda 12",
            estimated_share([bool(r["where"]) and r["where"][0] in r["hidden"][0]["shows_in"] for r in shown]),
            0.95,
        ),
        ScoreRow(
            "two effects, lambda 12 each: both named", estimated_share([is_leading_name_right(r) for r in pairs]), 0.85
        ),
    ]


def _rows_on_stated_probabilities(done: list[Result]) -> list[ScoreRow]:
    own = cases_with_one_effect(done, 12.0)
    covered, covered_of_all = (
        estimated_share([credible_set_holds_truth(r, merged=True) for r in rs]) for rs in (own, done)
    )
    oracle = [oracle_credible_set_size(hidden) for hidden in _effects_with_rivals(own)]
    return [
        ScoreRow("95 % credible set holds the truth or its alias, lambda 12", covered, 0.95),
        ScoreRow("  the same, all cases", covered_of_all),
        ScoreRow(
            "size of the credible set, the truth and its aliases as one, lambda 12",
            estimated_mean([credible_set_size_with_aliases_merged(r) for r in own]),
            most=1.4,
        ),
        *([ScoreRow("  oracle, so counted, lambda 12", estimated_mean(oracle))] if oracle else []),
        ScoreRow("wrong name stated above .9", estimated_share([_is_confidently_wrong(r) for r in done]), most=0.01),
        ScoreRow("expected calibration error", calibration_error(done)),
    ]


def _effects_with_rivals(singles: Sequence[Result]) -> list[Result]:
    """List the concealed effects of cases with one effect whose rivals are on file."""
    return [r["hidden"][0] for r in singles if "rival_nats" in r["hidden"][0]]


def _is_confidently_wrong(result: Result) -> bool:
    """Return whether a wrong effect, not an alias of the truth, has a probability above 0.9."""
    return is_confidently_wrong(result) and not are_names_right(result, leading_hypothesis(result, clean=True)[0])


def _rows_on_intervals(done: list[Result]) -> list[ScoreRow]:
    stated = [item for r in done for own in r["parameters"].values() for item in own.items()]
    others, per_run = ([i for name, i in stated if name.startswith("values[") is of_runs] for of_runs in (False, True))
    return [
        ScoreRow("95 % intervals of effect parameters cover", share_of_intervals_with_truth(others), 0.92, 0.98),
        *([ScoreRow("  of values per run", share_of_intervals_with_truth(per_run))] if per_run else []),
    ]


def gains_on_held_out_runs(result: Result, best: str) -> tuple[float, float] | None:
    """Return (gain of the repaired model, gain of model `best`) over the null in nats, summed over the held-out runs.

    Each is capped at 100. None if a run lacks a density under one of the three models.
    """
    own = [result["held_out"][run] for run in _RUNS]
    if any(model not in scores for scores in own for model in ("null", "repaired", best)):
        return None
    repaired, most = (sum(scores[model] - scores["null"] for scores in own) for model in ("repaired", best))
    return min(repaired, _MOST_NATS), min(most, _MOST_NATS)


def _shares_of_right_models_gain(results: Sequence[Result]) -> FloatArray:
    gains = [g for g in (gains_on_held_out_runs(r, "right") for r in results) if g is not None and g[1] >= _LEAST_NATS]
    return np.array([[repaired / right] for repaired, right in gains]).reshape(-1, 1)


def _rows_on_held_out_gains(done: list[Result]) -> list[ScoreRow]:
    named = [r for r in done if r["kind"] in ("single", "pair")]
    clean = [g[0] for g in (gains_on_held_out_runs(r, "true") for r in done if r["kind"] == "clean") if g is not None]
    shares = estimated_statistic(_shares_of_right_models_gain(named), lambda rows: float(np.median(rows)))
    every = [g[0] for g in (gains_on_held_out_runs(r, "true") for r in done) if g is not None]
    return [
        ScoreRow("held-out runs: median share of the right model's gain", shares, 0.95),
        ScoreRow("held-out worse than the null by over 3 nats", estimated_share([bool(g < -3.0) for g in every])),
        ScoreRow("  of those without an effect on the mean", estimated_share([bool(g < -3.0) for g in clean])),
    ]


def _rows_on_unlisted_laws(done: list[Result]) -> list[ScoreRow]:
    outside = [r for r in done if r["kind"] == "outside"]
    inside = [r for r in done if r["kind"] != "outside"]
    good = [_gains_as_much_as_true_law(r) for r in outside]
    told = [g or r["verdict"] == "unknown" for g, r in zip(good, outside, strict=True)]
    return [
        ScoreRow(
            "out of vocabulary, lambda 20: unknown, a right name, or 0.8 of the held-out gain",
            estimated_share(told),
            0.9,
        ),
        ScoreRow("  the same without unknown", estimated_share(good), 0.6),
        ScoreRow("  a formula found", estimated_share([bool(r["formula"]) for r in outside])),
        ScoreRow(
            "false unknown", estimated_share([r["verdict"] == "unknown" for r in inside if not is_out_of_vocabulary(r)])
        ),
    ]


def _gains_as_much_as_true_law(result: Result) -> bool:
    """Return whether the right name or an alias leads, or the repaired model gains 80 % of the right model's nats."""
    if (
        names_match(leading_hypothesis(result, clean=True)[0], right_names_of_each_effect(result, merged=True))
        and result["verdict"] != "unknown"
    ):
        return True
    gains = gains_on_held_out_runs(result, "right")
    return gains is not None and gains[1] >= _LEAST_NATS and gains[0] >= _AS_GOOD * gains[1]


def _rows_on_processor_time(done: list[Result]) -> list[ScoreRow]:
    return [
        ScoreRow(
            "processor time of a diagnosis, closed form (s)",
            estimated_mean([r["cpu_s"] for r in done if not r["law"]]),
            most=5.0,
        ),
        ScoreRow(
            "processor time of a diagnosis, differential equations (s)",
            estimated_mean([r["cpu_s"] for r in done if r["law"]]),
            most=20.0,
        ),
    ]
