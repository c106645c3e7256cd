"""The pages of studies: how many readings each configuration needs, and robots with a concealed fault."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probewise._words import count_with_noun
from probewise.experiment import least_readings
from probewise.proof.concealed_study import ConcealedRow
from probewise.proof.configurations import REFERENCE, SearchConfiguration
from probewise.proof.estimates import LEAST_FOR_MEDIAN, Estimate
from probewise.proof.plots import (
    doubt_against_trust,
    effect_and_size_in_words,
    posterior_widths_of_runs,
    readings_needed,
)
from probewise.proof.study import Study, Summary
from probewise.proof.trial import experiment_of
from probewise.recordings.table import csv_text_of_rows
from probewise.report.html import (
    Draw,
    Markup,
    Section,
    definition_list,
    draw_or_raise,
    figure,
    fragment,
    page,
    paragraph,
    table,
)
from probewise.report.plots.canvas import png
from probewise.report.words import number_text, value_with_error

_COLUMNS: tuple[tuple[str, str], ...] = (
    ("reached", "share that reached the precision, 95 % interval"),
    ("mean", "mean readings, standard error (a miss counted as the limit)"),
    ("median", "median readings, 95 % interval"),
    ("to_white", "mean readings up to the first on white, standard error (none counted as the limit)"),
    ("after_white", "mean readings after the first on white, standard error"),
    ("bits_each", "bits per reading, standard error"),
    ("held", "share of 95 % intervals that hold the truth, standard error"),
    ("arm_s", "arm time (s), standard error"),
)
_INTERVALS = (
    "Readings that a run needs. The 95 % interval of the share is Wilson's, for the number of runs beside it; that of "
    f"the median lies between two of the runs, and takes {LEAST_FOR_MEDIAN} of them."
)


def summary_sentence(study: Study) -> str:
    """Summarise a study's first row: mean and median readings, and the share of runs that reached the precision."""
    row, found = next(iter(study.table().items()))
    share = "All" if found.reached.value == 1 else f"{number_text(100 * found.reached.value, 1)} % of the"
    return (
        f"{row.name[0].upper()}{row.name[1:]}: {value_with_error(found.mean.value, _half_width(found.mean))} readings "
        f"on average, median {found.median.value:g}. {share} {found.n_runs} runs reached the precision asked for."
    )


def result_tables(study: Study) -> Markup:
    """Build two tables, a line for each row of the study: readings needed; information, errors, and time spent."""
    readings = (
        "row",
        "runs",
        "reached (95 % interval)",
        "mean",
        "median (95 % interval)",
        "up to the first on white",
        "after it",
    )
    worth = (
        "row",
        "bits per reading",
        "error (mm)",
        "sure and wrong (expected, limit)",
        "95 % intervals that hold",
        "arm time (s)",
        "processor time per decision (s)",
    )
    lines = [(_readings_row(row, found), _information_row(row, found)) for row, found in study.table().items()]
    return fragment(
        table(readings, (first for first, _ in lines), caption=_INTERVALS),
        table(worth, (second for _, second in lines), caption="Information per reading, errors of the runs, and cost."),
    )


def lower_bound_table(study: Study) -> Markup | None:
    """Build the table of lower bounds, for any strategy, on mean readings up to the first on white, and after it.

    Measured means are beside; None if no row has default options (but for circles and noise) and the correct model.
    """
    lines = []
    for row, found in study.table().items():
        if row == replace(REFERENCE, population=row.population, noise_sd=row.noise_sd):
            least = least_readings(experiment_of(row), rng=np.random.default_rng(0))
            search = _bits_over_capacity(least.search_bits, least.search_capacity_bits)
            refinement = _bits_over_capacity(least.refinement_bits, least.capacity_bits)
            lines.append(
                (
                    row.name,
                    search,
                    _estimate_with_error_text(found.to_white),
                    refinement,
                    _estimate_with_error_text(found.after_white),
                )
            )
    header = (
        "row",
        "up to white, at least (bits over bits per reading)",
        "measured",
        "from there, at least",
        "measured",
    )
    return table(header, lines) if lines else None


def table_csv(study: Study) -> str:
    """Return a study's table as CSV text: estimates with bounds; processor times, which vary, are left out."""
    bounds = [f"{name}{end}" for name, _ in _COLUMNS for end in ("", "_low", "_high")]
    rows = []
    for row, found in study.table().items():
        estimates = [getattr(found, name) for name, _ in _COLUMNS]
        values = [value for e in estimates for value in (e.value, e.low, e.high)]
        values += [found.error_mm, found.wrong, found.wrong_expected, found.wrong_limit]
        rows.append([row.name, found.n_runs, *(f"{v:.6g}" if math.isfinite(v) else "" for v in values)])
    return csv_text_of_rows(["row", "runs", *bounds, "error_mm", "wrong", "wrong_expected", "wrong_limit"], rows)


def page_html(study: Study, *, command: str, draw: Draw = draw_or_raise) -> str:
    """Return the HTML of a study's page; `command` is the command line that made the study, `draw` makes figures."""
    summaries = study.table()
    curves = {
        row.name: [np.asarray(t["widest_mm"], dtype=np.float64) for t in study.trials[row]]
        for row in summaries
        if (row.utility == REFERENCE.utility or row.method == "paper")
        and row.noise_sd == 1.0
        and row.width == 1.0
        and row.batch == 1
    }
    needed = figure(
        draw("readings needed", lambda: png(readings_needed({row.name: found for row, found in summaries.items()}))),
        f"Readings until every length is known to 4 mm, of at most {study.max_readings}; a miss counts as that many.",
    )
    sections = [Section("The table", (result_tables(study), _table_legend()))]
    if curves:
        drawn = figure(
            draw("widths", lambda: png(posterior_widths_of_runs(curves))),
            "Widest posterior sd of a length against the number of readings; a run that has ended keeps its last "
            "width.",
        )
        sections.insert(0, Section("How fast", (drawn,)))
    least = lower_bound_table(study)
    if least is not None:
        bounds = paragraph(
            "Bits needed over the capacity of a reading in bits. Up to the first reading on white, a reading answers "
            "yes or no, with the largest probability of yes that any place has; after that, the capacity is the "
            "sensor's."
        )
        sections.append(Section("Lower bound for any strategy", (least, bounds)))
    sections.append(Section("How it was made", (definition_list([("command", command)]),)))
    return page("How many measurements?", answer=summary_sentence(study), key_figure=needed, sections=sections)


def _table_legend() -> Markup:
    return paragraph(
        "± is the standard error. Every row uses the same circles and the same noise. On white: "
        "a reading at least a tenth of the way from dark to bright. Error: of the worst length, median over the runs "
        "that reached the target precision. Sure and wrong: stopped with a length off by more than 12 mm, with the "
        "number that the runs' own posteriors predict and the number that chance exceeds in one study in a hundred."
    )


def _readings_row(row: SearchConfiguration, found: Summary) -> tuple[str, ...]:
    reached = found.reached
    return (
        row.name,
        str(found.n_runs),
        f"{number_text(100 * reached.value, 1)} % "
        f"({number_text(100 * reached.low, 1)} to {number_text(100 * reached.high, 1)})",
        _estimate_with_error_text(found.mean),
        _value_with_interval(found.median),
        _estimate_with_error_text(found.to_white),
        _estimate_with_error_text(found.after_white),
    )


def _value_with_interval(estimate: Estimate) -> str:
    return f"{estimate.value:g}" + (
        f" ({estimate.low:g} to {estimate.high:g})" if math.isfinite(estimate.low) else " (too few runs)"
    )


def _information_row(row: SearchConfiguration, found: Summary) -> tuple[str, ...]:
    return (
        row.name,
        _estimate_with_error_text(found.bits_each),
        number_text(found.error_mm, 1),
        f"{count_with_noun(found.wrong, 'run')} ({number_text(found.wrong_expected, 1)}, {found.wrong_limit})",
        _percent_with_error_text(found.held),
        _estimate_with_error_text(found.arm_s),
        number_text(found.cpu_s, 2),
    )


def _bits_over_capacity(bits: float, capacity_bits: float) -> str:
    return f"{number_text(bits / capacity_bits, 1)} = {number_text(bits, 1)} / {number_text(capacity_bits, 2)}"


def _estimate_with_error_text(estimate: Estimate) -> str:
    half = _half_width(estimate)
    return value_with_error(estimate.value, half) if half > 0 else number_text(estimate.value, 1)


def _percent_with_error_text(estimate: Estimate) -> str:
    scaled = Estimate(100 * estimate.value, 100 * estimate.low, 100 * estimate.high)
    return f"{_estimate_with_error_text(scaled)} %" if math.isfinite(estimate.value) else "–"


def _half_width(estimate: Estimate) -> float:
    return 0.5 * (estimate.high - estimate.low)


def concealed_summary_sentence(rows: Sequence[ConcealedRow]) -> str:
    """Count in one sentence the runs that ended by the robot's rule but over 12 mm off: at full trust, and at less."""
    wrong = {
        doubts: _sure_and_wrong_text([row for row in rows if (row.trust < 1) == doubts]) for doubts in (True, False)
    }
    return (
        f"Sure and wrong: {wrong[False]} where the robot trusts its sensor, {wrong[True]} where it doubts it, "
        "on the same circles with the same noise."
    )


def concealed_page_html(rows: Sequence[ConcealedRow], *, command: str, draw: Draw = draw_or_raise) -> str:
    """Return the HTML of the page of a study of concealed effects; parameters as in `page_html`."""
    drawn = figure(
        draw("doubt against trust", lambda: png(doubt_against_trust(rows))),
        "Each row conceals one effect from an otherwise exact sensor model; bars are 95 % intervals. Sure and wrong: "
        "the robot has ended its search with a length off by more than 12 mm. Dashed: what the intervals promise.",
    )
    sections = [
        Section("The table", (_doubt_against_trust_table(rows), _concealed_table_legend())),
        Section("How it was made", (definition_list([("command", command)]),)),
    ]
    return page(
        "A robot with a concealed fault", answer=concealed_summary_sentence(rows), key_figure=drawn, sections=sections
    )


def _sure_and_wrong_text(rows: Sequence[ConcealedRow]) -> str:
    n_wrong = sum(round(row.sure_and_wrong.value * row.runs) for row in rows)
    return f"{n_wrong} of {count_with_noun(sum(row.runs for row in rows), 'run')}"


def _doubt_against_trust_table(rows: Sequence[ConcealedRow]) -> Markup:
    header = (
        "concealed",
        "runs",
        "readings, median",
        "sure and wrong",
        "intervals that hold",
        "noticed",
        "in the credible set",
        "names in it",
        "seconds per decision",
    )
    doubting = {(row.concealed, row.size): row for row in rows if row.trust < 1}
    trusting = {(row.concealed, row.size): row for row in rows if row.trust == 1}
    pairs = [(row, trusting[key]) for key, row in doubting.items()]
    return table(
        header,
        (
            (
                effect_and_size_in_words(doubts),
                str(doubts.runs),
                f"{doubts.readings:g} | {trusts.readings:g}",
                *(
                    f"{getattr(doubts, name).value:.2f} | {getattr(trusts, name).value:.2f}"
                    for name in ("sure_and_wrong", "intervals_hold", "noticed")
                ),
                f"{doubts.in_credible_set.value:.2f}",
                f"{doubts.names:g}",
                f"{doubts.cpu_s_median:.2g} | {trusts.cpu_s_median:.2g}",
            )
            for doubts, trusts in pairs
        ),
    )


def _concealed_table_legend() -> Markup:
    return paragraph(
        "Before the bar: the robot doubts its sensor; after it: it trusts it. Noticed: something left out is the most "
        "probable, or the readings do not fit. In the credible set: what is concealed is among the fewest explanations "
        "that hold 95 %. Seconds of processor time. The file concealed.csv has the intervals of all shares."
    )
