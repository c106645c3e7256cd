"""The page of a study: how many measurements each way of looking needs."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import replace

import numpy as np

from probewise.experiment import least_readings
from probewise.report.html import Markup, Section, definition_list, figure, page, paragraph, table
from probewise.report.plots import png, readings_needed, widths_of_runs
from probewise.report.words import count, number
from probewise.study import REFERENCE, Estimate, Row, Study, Summary, experiment_of

__all__ = ["answer", "table_csv", "table_of_bounds", "table_of_rows", "write_page"]

_COLUMNS: tuple[tuple[str, str], ...] = (
    ("reached", "share that reached the precision, 95 % interval"),
    ("mean", "mean readings, standard error (a miss counted as the limit)"),
    ("median", "median readings, 95 % interval"),
    ("to_white", "mean readings up to the first on white, standard error (none counted as the limit)"),
    ("after_white", "mean readings after the first on white, standard error"),
    ("bits_each", "bits a reading, standard error"),
    ("held", "share of 95 % intervals that hold the truth, standard error"),
    ("arm_s", "arm time (s), standard error"),
)


def answer(study: Study) -> str:
    """Say in one sentence what the first row needs."""
    summaries = study.table()
    row, found = next(iter(summaries.items()))
    return (
        f"{row.name}: {number(found.mean.value, 1)} ± {number(_half(found.mean), 1)} readings on average, "
        f"median {found.median.value:g}; {number(100 * found.reached.value, 1)} % of {found.n_runs} circles reached."
    )


def table_of_rows(study: Study) -> Markup:
    """Build the table, one line a row."""
    header = (
        "row",
        "runs",
        "reached",
        "mean",
        "median (95 %)",
        "to white",
        "after white",
        "bits a reading",
        "error (mm)",
        "sure and wrong (expected, limit)",
        "95 % intervals hold",
        "arm time (s)",
        "cpu a decision (s)",
    )
    return table(header, (_line(row, found) for row, found in study.table().items()))


def table_of_bounds(study: Study) -> Markup:
    """Build the table of the fewest readings that any strategy could do with on average, beside what was measured."""
    lines = []
    for row, found in study.table().items():
        if row == replace(REFERENCE, population=row.population, noise_sd=row.noise_sd):
            least = least_readings(experiment_of(row), rng=np.random.default_rng(0))
            search = _over(least.search_bits, least.search_capacity_bits)
            refinement = _over(least.refinement_bits, least.capacity_bits)
            lines.append((row.name, search, _shown(found.to_white), refinement, _shown(found.after_white)))
    header = ("row", "to white, at least (bits over bits a reading)", "measured", "from there, at least", "measured")
    return table(header, lines)


def table_csv(study: Study) -> str:
    """Write the table as CSV: every estimate with its bounds; processor times are left out, since no two runs agree."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    bounds = [f"{name}{end}" for name, _ in _COLUMNS for end in ("", "_low", "_high")]
    writer.writerow(["row", "runs", *bounds, "error_mm", "wrong", "wrong_expected", "wrong_limit"])
    for row, found in study.table().items():
        estimates = [getattr(found, name) for name, _ in _COLUMNS]
        values = [value for e in estimates for value in (e.value, e.low, e.high)]
        values += [found.error_mm, found.wrong, found.wrong_expected, found.wrong_limit]
        writer.writerow([row.name, found.n_runs, *(f"{v:.6g}" if math.isfinite(v) else "" for v in values)])
    return text.getvalue()


def write_page(study: Study, *, command: str) -> str:
    """Write the whole page; `command` is what made it."""
    summaries = study.table()
    curves = {
        row.name: [np.asarray(t["widest_mm"], dtype=np.float64) for t in study.trials[row]]
        for row in summaries
        if row.utility == REFERENCE.utility and row.noise_sd == 1.0 and row.width == 1.0 and row.batch == 1
    }
    needed = figure(
        png(readings_needed({row.name: found for row, found in summaries.items()})),
        f"Readings until every length is known to 4 mm, of at most {study.max_readings}; a miss counts as that many.",
    )
    sections = [Section("The table", (table_of_rows(study), _legend()))]
    if curves:
        drawn = figure(
            png(widths_of_runs(curves)),
            "Widest posterior sd against the number of readings: median and middle 68 % of the runs.",
        )
        sections.insert(0, Section("How fast", (drawn,)))
    bounds = paragraph(
        "Bits needed over the most that a reading can carry. Until the first reading on white that is a yes or no, "
        "yes as often as the best place is covered; from there to the precision asked for, the sensor's capacity."
    )
    sections.append(Section("The least that any strategy needs", (table_of_bounds(study), bounds)))
    sections.append(Section("How it was made", (definition_list([("command", command)]),)))
    return page("How many measurements?", answer=answer(study), key_figure=needed, sections=sections)


def _legend() -> Markup:
    return paragraph(
        "Every row looks for the same circles and meets the same noise. Sure and wrong: stopped with a length off by "
        "more than 12 mm, beside the number that the runs' own posteriors expect and the one that chance exceeds in "
        "one study of a hundred."
    )


def _line(row: Row, found: Summary) -> tuple[str, ...]:
    return (
        row.name,
        str(found.n_runs),
        f"{number(100 * found.reached.value, 1)} % ({number(100 * found.reached.low, 1)} to "
        f"{number(100 * found.reached.high, 1)})",
        _shown(found.mean),
        f"{found.median.value:g} ({found.median.low:g} to {found.median.high:g})",
        _shown(found.to_white),
        _shown(found.after_white),
        _shown(found.bits_each, 2),
        number(found.error_mm, 1),
        f"{count(found.wrong, 'run')} ({number(found.wrong_expected, 1)}, {found.wrong_limit})",
        f"{number(100 * found.held.value, 1)} ± {number(100 * _half(found.held), 1)} %",
        _shown(found.arm_s, 0),
        number(found.cpu_s, 2),
    )


def _over(bits: float, capacity_bits: float) -> str:
    return f"{number(bits / capacity_bits, 1)} = {number(bits, 1)} / {number(capacity_bits, 2)}"


def _shown(estimate: Estimate, digits: int = 1) -> str:
    return f"{number(estimate.value, digits)} ± {number(_half(estimate), digits)}"


def _half(estimate: Estimate) -> float:
    return 0.5 * (estimate.high - estimate.low)
