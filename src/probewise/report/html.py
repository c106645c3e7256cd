"""Self-contained pages: escaped elements, embedded figures, one style sheet, nothing from outside."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

__all__ = ["Markup", "Section", "definition_list", "element", "figure", "fragment", "page", "paragraph", "table"]


class Markup(str):
    """Text that is HTML already; every other text is escaped where it enters a page."""

    __slots__ = ()


@dataclass(frozen=True)
class Section:
    """One part of a page under its own heading."""

    heading: str
    body: tuple[Markup, ...]


def element(tag: str, *children: str, **attributes: str) -> Markup:
    """Build one element; a trailing underscore of an attribute's name is dropped (`class_`)."""
    written = "".join(f' {name.rstrip("_")}="{html.escape(value)}"' for name, value in attributes.items())
    return Markup(f"<{tag}{written}>{fragment(*children)}</{tag}>")


def fragment(*children: str) -> Markup:
    """Join children, escaping those that are plain text."""
    return Markup("".join(c if isinstance(c, Markup) else html.escape(c) for c in children))


def paragraph(*children: str, class_: str = "") -> Markup:
    """Build a paragraph."""
    return element("p", *children, class_=class_) if class_ else element("p", *children)


def table(header: Sequence[str], rows: Iterable[Sequence[str]], *, caption: str = "") -> Markup:
    """Build a table; cells that look like numbers are set right, in figures of one width."""
    head = element("tr", *(element("th", cell, scope="col") for cell in header))
    body = [element("tr", *(_cell(cell) for cell in row)) for row in rows]
    title = (element("caption", caption),) if caption else ()
    inner = element("table", *title, element("thead", head), element("tbody", *body))
    return element("div", inner, class_="scroll")


def _cell(text: str) -> Markup:
    is_number = bool(text) and (text.lstrip("-−+<≈ ")[:1].isdigit())
    return element("td", text, class_="number") if is_number else element("td", text)


def definition_list(pairs: Iterable[tuple[str, str]]) -> Markup:
    """Build a list of terms, each with its value."""
    return element("dl", *(fragment(element("dt", term), element("dd", value)) for term, value in pairs))


def figure(image: bytes, caption: str, *, alt: str = "") -> Markup:
    """Embed a PNG or an SVG; the caption is the text for those who cannot see it unless `alt` is given."""
    kind = "svg+xml" if image.startswith(b"<svg") else "png"
    source = f"data:image/{kind};base64," + base64.b64encode(image).decode("ascii")
    shown = Markup(f'<img src="{source}" alt="{html.escape(alt or caption)}">')
    return element("figure", shown, element("figcaption", caption))


def page(
    title: str, *, answer: str, key_figure: Markup, sections: Sequence[Section], reload_s: int | None = None
) -> str:
    """Build a page whose first screen is the answer in one sentence and the picture that shows it.

    Parameters
    ----------
    title
        What the page is about.
    answer
        The answer in one sentence.
    key_figure
        The picture to go with it, from `figure`.
    sections
        Everything else, in reading order.
    reload_s
        Load the page anew after so many seconds; None: never.
    """
    body = fragment(
        element("header", element("h1", title), paragraph(answer, class_="answer")),
        key_figure,
        *(element("section", element("h2", s.heading), *s.body) for s in sections),
    )
    again = () if reload_s is None else (Markup(f'<meta http-equiv="refresh" content="{reload_s}">'),)
    head = fragment(
        *again,
        Markup('<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'),
        element("title", title),
        element("style", Markup(_STYLE)),
    )
    document = element("html", element("head", head), element("body", element("main", body)), lang="en")
    return f"<!doctype html>\n{document}\n"


_STYLE = """
:root { color-scheme: light; --ink: #1b1b1b; --soft: #5a5a5a; --line: #d8d8d8; --paper: #ffffff; --accent: #0072b2; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.55 system-ui, Roboto, sans-serif; }
main { max-width: 60rem; margin: 0 auto; padding: 1rem 1.1rem 4rem; }
h1 { font-size: 1.05rem; font-weight: 600; color: var(--soft); margin: .3rem 0 0; }
h2 { font-size: 1.25rem; margin: 2.4rem 0 .5rem; border-top: 1px solid var(--line); padding-top: 1.1rem; }
p.answer { font-size: 1.45rem; line-height: 1.3; font-weight: 600; margin: .3rem 0 1rem; max-width: 46rem; }
figure { margin: .8rem 0 1.2rem; }
figure img { display: block; max-width: 100%; height: auto; }
figcaption, caption { color: var(--soft); font-size: .9rem; text-align: left; margin-top: .35rem; max-width: 46rem; }
p { max-width: 46rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .6rem 0 1rem; font-size: .95rem; }
th, td { padding: .3rem .9rem .3rem 0; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
td.number { font-variant-numeric: tabular-nums; white-space: nowrap; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1.2rem; font-size: .95rem; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
code, pre { font: .9em ui-monospace, Menlo, Consolas, monospace; }
pre { overflow-x: auto; background: #f5f5f5; padding: .7rem .9rem; }
@media (max-width: 34rem) {
  p.answer { font-size: 1.2rem; } dl { grid-template-columns: 1fr; } dt { margin-top: .4rem; }
  figure { overflow-x: auto; } figure img[src^="data:image/svg"] { min-width: 42rem; max-width: none; }
}
@media print { main { max-width: none; padding: 0; } h2, figure, table { break-inside: avoid; } }
"""
