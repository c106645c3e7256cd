"""The pages of studies and challenges: what each run or case contributes to, as tables, figures and a sentence."""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias, TypeVar

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray, IntArray
from probewise._words import count_with_noun
from probewise.diagnosis.words import effect_has_words, effect_in_words
from probewise.experiment import least_readings
from probewise.proof import study, tables
from probewise.proof.campaign import LEAST_FOR_MEDIAN, Estimate, Result
from probewise.proof.concealed_study import ConcealedRow, ConcealedTrial, concealed_csv, concealed_rows
from probewise.recordings.table import csv_text_of_rows
from probewise.report.html import Draw, Markup, Section, definition_list, figure, fragment, page, paragraph, table
from probewise.report.plots import canvas
from probewise.report.plots.search import set_up_width_axes
from probewise.report.words import number_text, typeset_numbers, value_with_error

_BAND = (0.16, 0.84)


def posterior_widths_of_runs(runs: Mapping[str, Sequence[FloatArray]], *, target_mm: float = 4.0) -> canvas.AxesGrid:
    """Draw the widest posterior sd after each reading: median and middle 68 % of the runs, one panel per row.

    Thin lines are the medians of the other panels. A run that has ended keeps its last width.

    `runs`: for each row, by name, the widest posterior sd after each reading of every run, (n_readings,), mm.
    """
    n_columns = min(len(runs), 2)
    n_rows = -(-len(runs) // max(n_columns, 1))
    size_in = (canvas.PAGE_IN if n_columns == 2 else 6.8, 0.5 + 2.9 * n_rows)
    axes = canvas.grid_of_axes(n_rows, n_columns, size_in=size_in, sharex=True, sharey=True)
    longest = {name: max(len(w) for w in of_row) for name, of_row in runs.items()}
    widths = {
        name: np.array([np.pad(w, (0, longest[name] - len(w)), mode="edge") for w in of_row])
        for name, of_row in runs.items()
    }
    number = {name: np.arange(1.0, own.shape[1] + 1) for name, own in widths.items()}
    for ax, (name, own) in zip(axes.flat, widths.items(), strict=False):
        for other, more in widths.items():
            if other != name:
                label = "median of another panel"
                ax.plot(number[other], np.median(more, axis=0), color=canvas.GREY, linewidth=0.9, label=label)
        low, high = np.quantile(own, _BAND, axis=0)
        ax.fill_between(
            number[name], low, high, color=canvas.BLUE, alpha=0.2, linewidth=0, label="middle 68 % of the runs"
        )
        ax.plot(number[name], np.median(own, axis=0), color=canvas.BLUE, linewidth=1.8, label="median")
        set_up_width_axes(ax, target_mm)
        ax.set_title(f"{name} ({count_with_noun(len(own), 'run')})", fontsize="medium", loc="left")
        ax.label_outer()
    for ax in list(axes.flat)[len(runs) :]:
        ax.set_visible(False)
        axes.flat[len(runs) - n_columns].xaxis.set_tick_params(labelbottom=True)
        axes.flat[len(runs) - n_columns].set_xlabel("number of readings")
    canvas.legend_below(axes)
    return axes


def _value_and_whiskers(estimates: Sequence[Estimate]) -> tuple[FloatArray, FloatArray]:
    """Return values, (n,), and whiskers down and up, (2, n): rounding may put an end a hair inside the value."""
    value, low, high = (np.array([getattr(e, k) for e in estimates]) for k in ("value", "low", "high"))
    return value, np.maximum([value - low, high - value], 0.0)


def readings_needed(rows: Mapping[str, study.Summary]) -> canvas.AxesGrid:
    """Draw mean and median readings needed in each row of a study, in all and after the first reading on white.

    `rows` are drawn from the top in this order. Returns axes, (1, 2).
    """
    names = ["\n".join(textwrap.wrap(name, 30)) for name in rows]
    n_lines = sum(1 + name.count("\n") for name in names)
    axes = canvas.grid_of_axes(1, 2, size_in=(canvas.PAGE_IN, 1.5 + 0.2 * len(names) + 0.16 * n_lines), sharey=True)
    y = np.arange(len(names))
    for ax, parts, title in (
        (axes[0, 0], (("mean", canvas.BLUE, "o", -0.14), ("median", canvas.VERMILLION, "s", 0.14)), "in all"),
        (axes[0, 1], (("after_white", canvas.BLUE, "o", 0.0),), "after the first on white"),
    ):
        for part, colour, marker, shift in parts:
            value, whiskers = _value_and_whiskers([getattr(summary, part) for summary in rows.values()])
            known = "median, 95 % interval" if np.isfinite(whiskers).any() else "median"
            label = "mean ± standard error" if part != "median" else known
            style = {"fmt": marker, "color": colour, "markersize": 5, "capsize": 3, "label": label}
            ax.errorbar(value, y + shift, xerr=whiskers, **style)
        ax.set_xlim(left=0)
        ax.grid(axis="x", color=canvas.GREY, alpha=0.25)
        ax.set_yticks(y, names)
        canvas.label_axes(ax, x="number of readings", y="", title=title)
    # Half a row of margin at either end, also for a single row.
    axes[0, 0].set_ylim(len(names) - 0.5, -0.5)
    canvas.legend_below(axes)
    return axes


def reliability_diagram(bins: Sequence[tuple[float, Estimate]]) -> Axes:
    """Draw the share of right diagnoses against the stated probability, with Wilson intervals and numbers of cases."""
    ax = canvas.grid_of_axes(1, 1, size_in=(5.2, 5.0))[0, 0]
    ax.plot([0, 1], [0, 1], color=canvas.GREY, linewidth=0.9, linestyle="--", label="honest")
    value, whiskers = _value_and_whiskers([right for _, right in bins])
    at = np.array([stated for stated, _ in bins])
    ax.errorbar(at, value, yerr=whiskers, fmt="o", color=canvas.BLUE, markersize=5, capsize=3, label="found, 95 %")
    for stated, right in bins:
        place = {"xytext": (6, -3), "textcoords": "offset points", "fontsize": canvas.SMALL_PT}
        ax.annotate(str(right.n), (stated, right.value), **place)
    ax.set(xlim=(0, 1.04), ylim=(-0.02, 1.04), aspect="equal")
    canvas.legend_above(ax)
    return canvas.label_axes(ax, x="probability stated", y="share that was right")


def confusion_matrix(truths: Sequence[str], said: Sequence[str], counts: IntArray) -> Axes:
    """Draw the number of cases by truth and answer, (n_truths, n_said), shaded by its share of the row."""
    ax = canvas.grid_of_axes(1, 1, size_in=(3.0 + 0.34 * len(said), 2.4 + 0.3 * len(truths)))[0, 0]
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    ax.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for (row, column), n in np.ndenumerate(counts):
        if n:
            colour = "white" if shares[row, column] > 0.6 else canvas.BLACK
            ax.text(column, row, str(n), ha="center", va="center", fontsize=canvas.SMALL_PT, color=colour)
    ax.set_xticks(np.arange(len(said)), said, rotation=60, ha="right", rotation_mode="anchor", fontsize=canvas.SMALL_PT)
    ax.set_yticks(np.arange(len(truths)), truths, fontsize=canvas.SMALL_PT)
    return canvas.label_axes(ax, x="most probable", y="concealed")


_PANELS = (
    ("sure_and_wrong", "sure and wrong", "share of the runs"),
    ("intervals_hold", "95 % intervals that hold", "share of the intervals"),
    ("readings", "readings, median", "number"),
)


def effect_and_size_in_words(row: ConcealedRow) -> str:
    """Name a row: the concealed effect in words and, if it has one, its size."""
    name = effect_in_words(row.concealed) if effect_has_words(row.concealed) else row.concealed.replace("_", " ")
    return name if row.size is None else f"{name}, {row.size:g}"


def doubt_against_trust(rows: Sequence[ConcealedRow]) -> canvas.AxesGrid:
    """Compare doubt in the sensor model with trust: runs sure and wrong, intervals that hold, median readings.

    `rows` are drawn from the top in this order. Returns axes, (1, 3).
    """
    names = list(dict.fromkeys(effect_and_size_in_words(row) for row in rows))
    axes = canvas.grid_of_axes(1, 3, size_in=(canvas.PAGE_IN, 1.7 + 0.32 * len(names)), sharey=True)
    arms: Mapping[str, tuple[list[ConcealedRow], str, str, float]] = {
        "trusts its sensor": ([row for row in rows if row.trust == 1], canvas.VERMILLION, "s", 0.15),
        "doubts its sensor": ([row for row in rows if row.trust < 1], canvas.BLUE, "o", -0.15),
    }
    for ax, (field, title, x) in zip(axes[0], _PANELS, strict=True):
        for label, (those, colour, marker, shift) in arms.items():
            y = np.array([names.index(effect_and_size_in_words(row)) for row in those]) + shift
            values = [getattr(row, field) for row in those]
            style = {"fmt": marker, "color": colour, "markersize": 4.5, "label": label}
            if all(isinstance(value, Estimate) for value in values):
                value, whiskers = _value_and_whiskers(values)
                ax.errorbar(value, y, xerr=whiskers, capsize=2.5, **style)
            else:
                ax.errorbar(values, y, **style)
        ax.set_xlim(*((0, None) if field == "readings" else (-0.03, 1.03)))
        if field == "intervals_hold":
            ax.axvline(0.95, color=canvas.GREY, linewidth=0.9, linestyle="--")
        ax.grid(axis="x", color=canvas.GREY, alpha=0.25)
        ax.set_yticks(np.arange(len(names)), names)
        canvas.label_axes(ax, x=x, y="", title=title)
    axes[0, 0].set_ylim(len(names) - 0.5, -0.5)
    canvas.legend_below(axes)
    return axes


T = TypeVar("T")


@dataclass(frozen=True)
class CampaignPage:
    """What a campaign's results come to: a table as CSV text, the HTML, given what makes figures, and a sentence."""

    table: str
    html: Callable[[Draw], str]
    sentence: str


Columns: TypeAlias = Mapping[str, Callable[[T], str]]
"""Columns of a table: header, and the cell as a function of what its row is about."""


def table_of(columns: Columns[T], rows: Iterable[T], *, caption: str = "") -> Markup:
    """Return the table of some rows for a page."""
    return table(tuple(columns), (tuple(cell(row) for cell in columns.values()) for row in rows), caption=caption)


def study_page(results: Mapping[study.Trial, Result], *, command: str) -> CampaignPage:
    """Return what a study comes to; `command` is the command line that made it."""
    found, own, first = study.summaries(results), study.trials_by_row(results), next(iter(results))
    sentence = study_sentence(found)
    usual = (
        row
        for row in found
        if (row.utility == study.REFERENCE.utility or row.method == "paper")
        and (row.noise_sd, row.width, row.batch) == (1.0, 1.0, 1)
    )
    curves = {row.name: [np.asarray(t["widest_mm"], dtype=np.float64) for t in own[row]] for row in usual}

    def html(draw: Draw) -> str:
        needed = figure(
            draw("readings needed", lambda: canvas.png(readings_needed({row.name: own for row, own in found.items()}))),
            f"Readings until every length is known to 4 mm, of at most {first.max_readings}; a miss counts as that "
            "many.",
        )
        needs = (
            "Readings that a run needs. The 95 % interval of the share is Wilson's, for the number of runs beside it; "
            f"that of the median lies between two of the runs, and takes {LEAST_FOR_MEDIAN} of them."
        )
        both = (
            table_of(_READINGS, found.items(), caption=needs),
            table_of(_WORTH, found.items(), caption="Information per reading, errors of the runs, and cost."),
        )
        sections = [Section("The table", (fragment(*both), paragraph(_STUDY_LEGEND)))]
        if curves:
            drawn = figure(
                draw("widths", lambda: canvas.png(posterior_widths_of_runs(curves))),
                "Widest posterior sd of a length against the number of readings; a run that has ended keeps its last "
                "width.",
            )
            sections.insert(0, Section("How fast", (drawn,)))
        if (least := lower_bound_table(found)) is not None:
            sections.append(Section("Lower bound for any strategy", (least, paragraph(_BOUNDS))))
        sections.append(_how_it_was_made(command))
        return page("How many measurements?", answer=sentence, key_figure=needed, sections=sections)

    return CampaignPage(study_csv(found), html, sentence)


def _how_it_was_made(command: str) -> Section:
    return Section("How it was made", (definition_list([("command", command)]),))


_BOUNDS = (
    "Bits needed over the capacity of a reading in bits. Up to the first reading on white, a reading answers yes or "
    "no, with the largest probability of yes that any place has; after that, the capacity is the sensor's."
)
_STUDY_LEGEND = (
    "± is the standard error. Every row uses the same circles and the same noise. On white: "
    "a reading at least a tenth of the way from dark to bright. Error: of the worst length, median over the runs "
    "that reached the target precision. Sure and wrong: stopped with a length off by more than 12 mm, with the "
    "number that the runs' own posteriors predict and the number that chance exceeds in one study in a hundred."
)


def study_sentence(table: Mapping[study.SearchConfiguration, study.Summary]) -> str:
    """Summarise a study's first row: mean and median readings, and the share of runs that reached the precision."""
    row, found = next(iter(table.items()))
    share = "All" if found.reached.value == 1 else f"{number_text(100 * found.reached.value, 1)} % of the"
    return (
        f"{row.name[0].upper()}{row.name[1:]}: {value_with_error(found.mean.value, found.mean.half_width)} readings "
        f"on average, median {found.median.value:g}. {share} {found.n_runs} runs reached the precision asked for."
    )


Row: TypeAlias = tuple[study.SearchConfiguration, study.Summary]

_READINGS: Columns[Row] = {
    "row": lambda r: r[0].name,
    "runs": lambda r: str(r[1].n_runs),
    "reached (95 % interval)": lambda r: (
        f"{number_text(100 * r[1].reached.value, 1)} % "
        f"({number_text(100 * r[1].reached.low, 1)} to {number_text(100 * r[1].reached.high, 1)})"
    ),
    "mean": lambda r: _with_error(r[1].mean),
    "median (95 % interval)": lambda r: (
        f"{r[1].median.value:g}"
        + (f" ({r[1].median.low:g} to {r[1].median.high:g})" if math.isfinite(r[1].median.low) else " (too few runs)")
    ),
    "up to the first on white": lambda r: _with_error(r[1].to_white),
    "after it": lambda r: _with_error(r[1].after_white),
}
_WORTH: Columns[Row] = {
    "row": lambda r: r[0].name,
    "bits per reading": lambda r: _with_error(r[1].bits_each),
    "error (mm)": lambda r: number_text(r[1].error_mm, 1),
    "sure and wrong (expected, limit)": lambda r: (
        f"{count_with_noun(r[1].wrong, 'run')} ({number_text(r[1].wrong_expected, 1)}, {r[1].wrong_limit})"
    ),
    "95 % intervals that hold": lambda r: (
        f"{_with_error(r[1].held, scale=100)} %" if math.isfinite(r[1].held.value) else "–"
    ),
    "arm time (s)": lambda r: _with_error(r[1].arm_s),
    "processor time per decision (s)": lambda r: number_text(r[1].cpu_s, 2),
}


def lower_bound_table(found: Mapping[study.SearchConfiguration, study.Summary]) -> Markup | None:
    """Build the table of lower bounds, for any strategy, on mean readings up to the first on white, and after it.

    Measured means are beside; None if no row has default options (but for circles and noise) and the correct model.
    """

    def over(bits: float, capacity: float) -> str:
        return f"{number_text(bits / capacity, 1)} = {number_text(bits, 1)} / {number_text(capacity, 2)}"

    lines = []
    for row, own in found.items():
        if row == replace(study.REFERENCE, population=row.population, noise_sd=row.noise_sd):
            least = least_readings(study.experiment_of(row), rng=np.random.default_rng(0))
            search = over(least.search_bits, least.search_capacity_bits), _with_error(own.to_white)
            after = over(least.refinement_bits, least.capacity_bits), _with_error(own.after_white)
            lines.append((row.name, *search, *after))
    places = "up to white, at least (bits over bits per reading)", "from there, at least"
    return table(("row", places[0], "measured", places[1], "measured"), lines) if lines else None


def study_csv(table: Mapping[study.SearchConfiguration, study.Summary]) -> str:
    """Return a study's table as CSV text: estimates with bounds; processor times, which vary, are left out."""
    estimates = ("reached", "mean", "median", "to_white", "after_white", "bits_each", "held", "arm_s")
    ends, others = ("value", "low", "high"), ("error_mm", "wrong", "wrong_expected", "wrong_limit")
    rows = []
    for row, found in table.items():
        values = [getattr(getattr(found, name), end) for name in estimates for end in ends]
        values += [getattr(found, name) for name in others]
        rows.append([row.name, found.n_runs, *map(_csv_cell, values)])
    bounds = [f"{name}{end}" for name in estimates for end in ("", "_low", "_high")]
    return csv_text_of_rows(["row", "runs", *bounds, *others], rows)


def _with_error(estimate: Estimate, *, scale: float = 1.0) -> str:
    value, half = scale * estimate.value, scale * estimate.half_width
    return value_with_error(value, half) if half > 0 else number_text(value, 1)


def concealed_page(results: Mapping[ConcealedTrial, Result], *, command: str) -> CampaignPage:
    """Return what a study of concealed effects comes to; `command` is the command line that made it."""
    rows, forms = concealed_rows(results), concealed_rows(results, by_form=True)

    def sure_and_wrong(doubts: bool) -> str:
        own = [row for row in rows if (row.trust < 1) == doubts]
        n_wrong = sum(round(row.sure_and_wrong.value * row.runs) for row in own)
        return f"{n_wrong} of {count_with_noun(sum(row.runs for row in own), 'run')}"

    sentence = (
        f"Sure and wrong: {sure_and_wrong(False)} where the robot trusts its sensor, {sure_and_wrong(True)} where it "
        "doubts it, on the same circles with the same noise."
    )

    def html(draw: Draw) -> str:
        drawn = figure(
            draw("doubt against trust", lambda: canvas.png(doubt_against_trust(rows))),
            "Each row conceals one effect from an otherwise exact sensor model; bars are 95 % intervals. Sure and "
            "wrong: the robot has ended its search with a length off by more than 12 mm. Dashed: what the intervals "
            "promise.",
        )
        sections = [Section("The table", (_doubt_against_trust_table(rows), paragraph(_CONCEALED_LEGEND)))]
        if len({row.concealed for row in forms}) > 1:
            sections.append(Section("By form", (_doubt_against_trust_table(forms), paragraph(_FORMS))))
        sections.append(_how_it_was_made(command))
        return page("A robot with a concealed fault", answer=sentence, key_figure=drawn, sections=sections)

    return CampaignPage(concealed_csv(rows), html, sentence)


_FORMS = (
    "In the list: concealed as the robot's rivals have it. Another form: as a rival of the same name, which is right, "
    "does not have it. In no list: no name is right, and only noticing counts."
)


def _of_both(name: str) -> Callable[[tuple[ConcealedRow, ConcealedRow]], str]:
    return lambda pair: " | ".join(f"{getattr(row, name).value:.2f}" for row in pair)


_PAIRS: Columns[tuple[ConcealedRow, ConcealedRow]] = {
    "concealed": lambda pair: effect_and_size_in_words(pair[0]),
    "runs": lambda pair: str(pair[0].runs),
    "readings, median": lambda pair: " | ".join(f"{row.readings:g}" for row in pair),
    "sure and wrong": _of_both("sure_and_wrong"),
    "intervals that hold": _of_both("intervals_hold"),
    "noticed": _of_both("noticed"),
    "in the credible set": lambda pair: f"{pair[0].in_credible_set.value:.2f}" if pair[0].in_credible_set.n else "–",
    "names in it": lambda pair: f"{pair[0].names:g}",
    "seconds per decision": lambda pair: " | ".join(f"{row.cpu_s_median:.2g}" for row in pair),
}


def _doubt_against_trust_table(rows: Sequence[ConcealedRow]) -> Markup:
    doubting, trusting = (
        {(r.concealed, r.size): r for r in rows if (r.trust < 1) is doubts} for doubts in (True, False)
    )
    return table_of(_PAIRS, [(row, trusting[key]) for key, row in doubting.items()])


_CONCEALED_LEGEND = (
    "Before the bar: the robot doubts its sensor; after it: it trusts it. Noticed: something left out is the most "
    "probable, or the readings do not fit. In the credible set: what is concealed is among the fewest explanations "
    "that hold 95 %. Seconds of processor time. The file concealed.csv has the intervals of all shares."
)


def challenge_page(
    results: tables.Results,
    score: Callable[[tables.Results], Sequence[tables.ScoreRow]],
    *,
    command: str,
    systems: bool,
) -> CampaignPage:
    """Return what a challenge comes to, by the `score` of its cases; `command` is the command line that made it.

    `systems`: the cases are simulators, not light sensors.
    """
    rows, done = score(results), [r for r in results if "failed" not in r]
    sentence = challenge_sentence(rows, len(results))

    def html(draw: Draw) -> str:
        sections = [Section("The table", (table_of(_TARGETS, rows), paragraph(_CHALLENGE_LEGEND)))]
        if done:
            counts = partial(tables.confusion_counts, done, label=tables.name_without_target if systems else str)
            drawn = figure(
                draw("confusion matrix", lambda: canvas.png(confusion_matrix(*counts()))),
                "Rows: what was concealed. Columns: the most probable hypothesis. An alias of the truth counts as the "
                "truth." + (" Targets are left out." if systems else ""),
            )
            sections.append(Section("Confusion matrix", (drawn,)))
            if systems:
                held_out = "held-out gain, and that of the right model (nats)"
                names = ("case", "system", "concealed", "lambda", "said", "probability", "right", held_out)
                cases = table(names, itertools.starmap(_case_cells, enumerate(results)))
                sections.append(Section("Case by case", (cases,)))
            else:
                sections.append(Section("Each effect at lambda 8", (_effect_table(done),)))
        failures = [(f"{r['kind']}, {r['at']}", r["failed"]) for r in results if "failed" in r]
        if failures:
            sections.append(Section("Cases that failed", (definition_list(failures),)))
        honest = figure(
            draw("reliability", lambda: canvas.png(reliability_diagram(tables.reliability_bins(done)))),
            "How often the most probable hypothesis was right, against the probability stated for it, with 95 % "
            "intervals.",
        )
        sections.append(_how_it_was_made(command))
        return page("How good a diagnosis is", answer=sentence, key_figure=honest, sections=sections, with_terms=True)

    return CampaignPage(challenge_csv(rows), html, sentence)


_CHALLENGE_LEGEND = (
    "A target is met or missed only where the whole 95 % interval lies on one side of it; otherwise it is undecided. "
    "Intervals: Wilson for shares, Student's t for means, order statistics for medians, bootstrap for all others. "
    "Rows on detection and covariates count effects on the mean; those on held-out gain, cases with white noise. "
    "Aliases are effects that a plan of this many readings could tell apart by less than 3 nats."
)


def challenge_sentence(rows: Sequence[tables.ScoreRow], n_cases: int) -> str:
    """Summarise a challenge in one sentence: number of cases; how many targets are met, missed and undecided."""
    n = {kind: sum(row.decision == kind for row in rows) for kind in ("met", "missed", "open")}
    return (
        f"{count_with_noun(n_cases, 'case')} of concealed physics: {count_with_noun(n['met'], 'target')} met, "
        f"{n['missed']} missed, {n['open']} undecided by so few cases."
    )


_TARGETS: Columns[tables.ScoreRow] = {
    # Indented by an em space, since HTML drops plain spaces.
    "what": lambda row: "\u2003" * row.name.startswith(" ") + row.name.lstrip().replace("_", " "),
    "found": lambda row: _value_text(row.found) if row.found.n else "–",
    "95 % interval": lambda row: typeset_numbers(_interval_text(row.found)),
    "of": lambda row: str(row.found.n),
    "target": lambda row: _target_text(row),
    "decision": lambda row: {"open": "undecided", None: ""}.get(row.decision, str(row.decision)),
}


def challenge_csv(rows: Sequence[tables.ScoreRow]) -> str:
    """Return a challenge's table as CSV text: quantity, value, interval, cases, target's bounds, decision."""
    cells = []
    for row in rows:
        numbers = map(_csv_cell, (row.found.value, row.found.low, row.found.high))
        decision = {"open": "cannot decide", None: ""}.get(row.decision, row.decision)
        cells.append([row.name.strip(), *numbers, row.found.n, *map(_csv_cell, (row.least, row.most)), decision])
    return csv_text_of_rows(["what", "found", "low", "high", "n", "target_least", "target_most", "decision"], cells)


def _effect_table(done: tables.Results) -> Markup:
    return table(
        ("effect", "cases", "detected at alpha .01", "named first"),
        (
            (name, str(detected.n), *(f"{_value_text(e)} ({_interval_text(e)})" for e in (detected, named)))
            for name, (detected, named) in tables.detected_and_named_by_effect(done).items()
        ),
    )


def _case_cells(number: int, result: Result) -> tuple[str, ...]:
    concealed = " and ".join(h["name"] for h in result.get("hidden", ())) or result.get("noise_model", "")
    begun = (str(number), result.get("system", ""), concealed, f"{result['size']:g}" if result["size"] else "")
    if "failed" in result:
        return (*begun, f"failed: {result['failed']}", "", "no", "")
    names, probability = tables.leading_hypothesis(result, clean=True)
    # Beside a concealed effect, all of which act on the mean, names of noise effects are ignored.
    physics = tuple(name for name in names if name not in tables.NOISE) if result["hidden"] else names
    right = tables.are_names_right(result, physics, noise=not result["hidden"])
    gains = tables.gains_on_held_out_runs(result)
    said = " and ".join(names) or "clean"
    return (
        *begun,
        said,
        f"{probability:.2f}",
        "yes" if right else "no",
        "" if gains is None else f"{gains[0]:.1f} of {gains[1]:.1f}",
    )


def _value_text(found: Estimate) -> str:
    return "no case" if not found.n else f"{found.value:.3g}"


def _interval_text(found: Estimate) -> str:
    return f"{found.low:.3g} to {found.high:.3g}" if math.isfinite(found.high - found.low) else ""


def _target_text(row: tables.ScoreRow) -> str:
    if row.decision is None:
        return ""
    if math.isinf(row.least):
        return f"at most {row.most:g}"
    return f"at least {row.least:g}" if math.isinf(row.most) else f"{row.least:g} to {row.most:g}"


def _csv_cell(value: float) -> str:
    return f"{value:.6g}" if math.isfinite(value) else ""
