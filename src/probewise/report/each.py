"""The page of many diagnoses: what ails each device, sorted, with a link to its report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from urllib.parse import quote

from probewise._words import count_with_noun
from probewise.diagnosis.words import hypothesis_in_words
from probewise.recordings.table import number_text
from probewise.report.html import Section, element, figure, page, table
from probewise.report.plots.canvas import BLUE, stack_of_axes, svg

_ORDER = ("named", "unknown", "cannot_tell", "noise", "clean", "refused")


@dataclass(frozen=True)
class DeviceRow:
    """A recording's verdict, the names of its effects, size lambda, probability, p-value, and what was said of it.

    The verdict is "refused" if it could not be diagnosed; numbers are then None.
    """

    device: str
    verdict: str
    name: str = ""
    size_lambda: float | None = None
    probability: float | None = None
    p_value: float | None = None
    says: str = ""

    @property
    def ails(self) -> str:
        """What ails it, in words: the named effects; of another verdict that, and the most probable effects."""
        words = hypothesis_in_words(self.name.split(" + ")) if self.name else ""
        verdict = self.verdict.replace("_", " ")
        return words if self.verdict in ("named", "noise") else f"{verdict}: perhaps {words}" if words else verdict


def in_order(rows: Sequence[DeviceRow]) -> list[DeviceRow]:
    """Sort by verdict, then by how many devices have the same effects, the largest effects first."""
    alike = Counter(row.name for row in rows)
    return sorted(
        rows,
        key=lambda row: (_ORDER.index(row.verdict), -alike[row.name], row.name, -(row.size_lambda or 0.0), row.device),
    )


def columns_of(rows: Sequence[DeviceRow]) -> dict[str, Sequence[str]]:
    """Return the columns of table.csv, in the order of the page."""
    names = ("device", "verdict", "name", "size_lambda", "probability", "p_value", "says")
    cells = {name: [getattr(row, name) for row in in_order(rows)] for name in names}
    return {
        name: [v if isinstance(v, str) else "" if v is None else number_text(v) for v in values]
        for name, values in cells.items()
    }


def summary(rows: Sequence[DeviceRow]) -> str:
    """Say how many devices have what, most frequent first."""
    counts = _counts(rows)
    return f"{count_with_noun(len(rows), 'recording')}: {', '.join(f'{ails} ({n})' for ails, n in counts)}"


def _counts(rows: Sequence[DeviceRow]) -> list[tuple[str, int]]:
    return Counter(row.ails for row in in_order(rows)).most_common()


def counts_svg(rows: Sequence[DeviceRow]) -> bytes:
    """Draw the number of devices by what ails them; return an SVG."""
    counts = _counts(rows)[::-1]
    (ax,) = stack_of_axes([0.7 + 0.3 * len(counts)])
    ax.barh([ails for ails, _ in counts], [n for _, n in counts], color=BLUE)
    ax.set_xlabel("recordings")
    ax.xaxis.get_major_locator().set_params(integer=True)
    return svg(ax)


def page_html(rows: Sequence[DeviceRow], drawn: Mapping[str, bytes], *, seed: int) -> str:
    """Return the HTML of the page; reports lie in a folder of each device's name."""

    def cells(row: DeviceRow) -> tuple[str, ...]:
        link = element("a", row.device, href=f"{quote(row.device)}/report.html")
        numbers = ("" if v is None else f"{v:.3g}" for v in (row.size_lambda, row.probability, row.p_value))
        device = row.device if row.verdict == "refused" else link
        return device, row.verdict, row.ails if row.name else "", *numbers, row.says

    header = ("device", "verdict", "what it is", "size λ", "probability", "p", "in words")
    return page(
        "Many recordings, diagnosed one by one",
        answer=f"{summary(rows)}.",
        key_figure=figure(drawn["counts.svg"], "Number of recordings by what ails them."),
        sections=[
            Section("Each recording", (table(header, map(cells, in_order(rows))),)),
            Section("This run", ({"recordings": str(len(rows)), "seed": str(seed)},)),
        ],
    )
