"""The page of a study of concealed effects: the robot that trusts its sensor model, and the one that doubts it."""

from __future__ import annotations

from collections.abc import Sequence

from probewise._words import count_with_noun
from probewise.proof.plots import doubt_against_trust, effect_and_size_in_words
from probewise.proof.study import ConcealedRow
from probewise.report.html import Markup, Section, definition_list, figure, page, paragraph, table
from probewise.report.plots.canvas import png


def summary_sentence(rows: Sequence[ConcealedRow]) -> str:
    """Count in one sentence the runs that ended by the robot's rule but over 12 mm off: at full trust, and at less."""
    wrong = {
        doubts: _sure_and_wrong_text([row for row in rows if (row.trust < 1) == doubts]) for doubts in (True, False)
    }
    return (
        f"Sure and wrong: {wrong[False]} where the robot trusts its sensor, {wrong[True]} where it doubts it, "
        "on the same circles with the same noise."
    )


def page_html(rows: Sequence[ConcealedRow], *, command: str) -> str:
    """Return the HTML of the page of a study of concealed effects; `command` is the command line that made it."""
    drawn = figure(
        png(doubt_against_trust(rows)),
        "Each row conceals one effect from an otherwise exact sensor model; bars are 95 % intervals. Sure and wrong: "
        "the robot has ended its search with a length off by more than 12 mm. Dashed: what the intervals promise.",
    )
    sections = [
        Section("The table", (_doubt_against_trust_table(rows), _table_legend())),
        Section("How it was made", (definition_list([("command", command)]),)),
    ]
    return page("A robot with a concealed fault", answer=summary_sentence(rows), key_figure=drawn, sections=sections)


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


def _table_legend() -> Markup:
    return paragraph(
        "Before the bar: the robot doubts its sensor; after it: it trusts it. Noticed: something left out is the most "
        "probable, or the readings do not fit. In the credible set: what is concealed is among the fewest explanations "
        "that hold 95 %. Seconds of processor time. The file concealed.csv has the intervals of all shares."
    )
