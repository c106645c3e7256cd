"""The page of a challenge (diagnoses of simulated cases): table of targets, confusion matrix, reliability diagram."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from probewise._words import count_with_noun
from probewise.proof.estimates import Estimate
from probewise.proof.plots import confusion_matrix, reliability_diagram
from probewise.proof.scoring import NOISE, are_names_right, confusion_counts, leading_hypothesis, reliability_bins
from probewise.proof.tables import ScoreRow, detected_and_named_by_effect, gains_on_held_out_runs, name_without_target
from probewise.recordings.table import csv_text_of_rows
from probewise.report.html import Draw, Markup, Section, definition_list, draw_or_raise, figure, page, paragraph, table
from probewise.report.plots.canvas import png
from probewise.report.words import typeset_numbers

Results = Sequence[Mapping[str, Any]]

_DECISIONS = {"met": "met", "missed": "missed", "open": "cannot decide", None: ""}


def summary_sentence(rows: Sequence[ScoreRow], n_cases: int) -> str:
    """Summarise a challenge in one sentence: number of cases; how many targets are met, missed and undecided."""
    n = {kind: sum(row.decision == kind for row in rows) for kind in ("met", "missed", "open")}
    return (
        f"{count_with_noun(n_cases, 'case')} of concealed physics: {count_with_noun(n['met'], 'target')} met, "
        f"{n['missed']} missed, {n['open']} undecided by so few cases."
    )


def target_table(rows: Sequence[ScoreRow]) -> Markup:
    """Build a challenge's table, a row per quantity: value found, 95 % interval, cases, target, whether it is met."""
    header = ("what", "found", "95 % interval", "of", "target", "decision")
    return table(
        header,
        (
            (
                _indented_row_name(row.name),
                _value_text(row.found) if row.found.n else "–",
                typeset_numbers(_interval_text(row.found)),
                str(row.found.n),
                _target_text(row),
                "undecided" if row.decision == "open" else _DECISIONS[row.decision],
            )
            for row in rows
        ),
    )


def _indented_row_name(name: str) -> str:
    """Write a row's name with spaces for underscores, indented by an em space, since HTML drops plain spaces."""
    own = name.lstrip()
    return "\u2003" * (len(name) > len(own)) + own.replace("_", " ")


def target_table_csv(rows: Sequence[ScoreRow]) -> str:
    """Return a challenge's table as CSV text: quantity, value, interval, cases, target's bounds, decision."""
    cells = []
    for row in rows:
        numbers, bounds = (row.found.value, row.found.low, row.found.high), (row.least, row.most)
        cells.append(
            [row.name.strip(), *map(_csv_cell, numbers), row.found.n, *map(_csv_cell, bounds), _DECISIONS[row.decision]]
        )
    return csv_text_of_rows(["what", "found", "low", "high", "n", "target_least", "target_most", "decision"], cells)


def page_html(
    results: Results,
    rows: Sequence[ScoreRow],
    *,
    command: str,
    systems: bool = False,
    draw: Draw = draw_or_raise,
) -> str:
    """Return the HTML of a challenge's page from the cases' results and the table's `rows`.

    `command` is the command line that made the results; `systems`: the cases are simulators, not light sensors;
    `draw` makes figures.
    """
    done = [r for r in results if "failed" not in r]
    sections = [Section("The table", (target_table(rows), _table_legend()))]
    if done:
        drawn = figure(
            draw(
                "confusion matrix",
                lambda: png(confusion_matrix(*confusion_counts(done, label=name_without_target if systems else str))),
            ),
            "Rows: what was concealed. Columns: the most probable hypothesis. An alias of the truth counts as the "
            "truth." + (" Targets are left out." if systems else ""),
        )
        sections.append(Section("Confusion matrix", (drawn,)))
        sections.append(
            Section("Case by case", (_case_table(results),))
            if systems
            else Section("Each effect at lambda 8", (_effect_table(done),))
        )
    failures = [(f"{r['kind']}, {r['at']}", r["failed"]) for r in results if "failed" in r]
    if failures:
        sections.append(Section("Cases that failed", (definition_list(failures),)))
    sections.append(Section("How it was made", (definition_list([("command", command)]),)))
    honest = figure(
        draw("reliability", lambda: png(reliability_diagram(reliability_bins(done)))),
        "How often the most probable hypothesis was right, against the probability stated for it, with 95 % intervals.",
    )
    return page(
        "How good a diagnosis is",
        answer=summary_sentence(rows, len(results)),
        key_figure=honest,
        sections=sections,
        terms_in=honest,
    )


def _effect_table(done: Results) -> Markup:
    return table(
        ("effect", "cases", "detected at alpha .01", "named first"),
        (
            (name, str(detected.n), *(f"{_value_text(e)} ({_interval_text(e)})" for e in (detected, named)))
            for name, (detected, named) in detected_and_named_by_effect(done).items()
        ),
    )


def _case_table(results: Results) -> Markup:
    return table(
        (
            "case",
            "system",
            "concealed",
            "lambda",
            "said",
            "probability",
            "right",
            "held-out gain, and that of the right model (nats)",
        ),
        (_case_cells(number, result) for number, result in enumerate(results)),
    )


def _case_cells(number: int, result: Mapping[str, Any]) -> tuple[str, ...]:
    concealed = " and ".join(h["name"] for h in result.get("hidden", ())) or result.get("noise_model", "")
    begun = (str(number), result.get("system", ""), concealed, f"{result['size']:g}" if result["size"] else "")
    if "failed" in result:
        return (*begun, f"failed: {result['failed']}", "", "no", "")
    names, probability = leading_hypothesis(result, clean=True)
    # Beside a concealed effect, all of which act on the mean, names of noise effects are ignored.
    physics = tuple(name for name in names if name not in NOISE) if result["hidden"] else names
    right = are_names_right(result, physics, noise=not result["hidden"])
    gains = gains_on_held_out_runs(result, "right")
    said = " and ".join(names) or "clean"
    return (
        *begun,
        said,
        f"{probability:.2f}",
        "yes" if right else "no",
        "" if gains is None else f"{gains[0]:.1f} of {gains[1]:.1f}",
    )


def _table_legend() -> Markup:
    return paragraph(
        "A target is met or missed only where the whole 95 % interval lies on one side of it; otherwise it is "
        "undecided. "
        "Intervals: Wilson for shares, Student's t for means, bootstrap for all others. "
        "Rows on detection and covariates count effects on the mean; those on held-out gain, cases with white noise. "
        "Aliases are effects that a plan of this many readings could tell apart by less than 3 nats."
    )


def _value_text(found: Estimate) -> str:
    return "no case" if not found.n else f"{found.value:.3g}"


def _interval_text(found: Estimate) -> str:
    return f"{found.low:.3g} to {found.high:.3g}" if math.isfinite(found.high - found.low) else ""


def _target_text(row: ScoreRow) -> str:
    if row.decision is None:
        return ""
    if math.isinf(row.least):
        return f"at most {row.most:g}"
    return f"at least {row.least:g}" if math.isinf(row.most) else f"{row.least:g} to {row.most:g}"


def _csv_cell(value: float) -> str:
    """Write a number as a cell of a CSV file; one that is not finite is empty."""
    return f"{value:.6g}" if math.isfinite(value) else ""
