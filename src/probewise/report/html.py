"""Self-contained HTML pages: escaped elements, embedded figures, technical terms explained at the end."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

_FEWEST_LISTED = 4  # sections from which on a page has a list of contents


class Markup(str):
    """Text that is HTML already; every other text is escaped where it enters a page."""

    __slots__ = ()


@dataclass(frozen=True)
class Section:
    """One part of a page under its own heading; `parts` follow its body under headings a level lower.

    Of the body, text that is no HTML yet becomes a paragraph, and a mapping a list of terms with their values.
    """

    heading: str
    body: Sequence[str | Mapping[str, str]]
    parts: Sequence[Section] = ()

    @property
    def elements(self) -> tuple[Markup, ...]:
        """The body as HTML."""
        texts = (definition_list(p.items()) if isinstance(p, Mapping) else p for p in self.body)
        return tuple(text if isinstance(text, Markup) else paragraph(text) for text in texts)


def element(tag: str, *children: str, **attributes: str) -> Markup:
    """Build an element of escaped or `Markup` children; `class_` stands for class, underscores for hyphens."""
    named = ((name.rstrip("_").replace("_", "-"), html.escape(value)) for name, value in attributes.items())
    written = "".join(f' {name}="{value}"' for name, value in named)
    return Markup(f"<{tag}{written}>{fragment(*children)}</{tag}>")


def fragment(*children: str) -> Markup:
    """Join children into one Markup, escaping those that are plain text."""
    return Markup("".join(c if isinstance(c, Markup) else html.escape(c) for c in children))


def paragraph(*children: str, class_: str = "") -> Markup:
    """Build a paragraph, with the CSS class `class_` if given."""
    return element("p", *children, class_=class_) if class_ else element("p", *children)


def table(header: Sequence[str], rows: Iterable[Sequence[str]], *, caption: str = "") -> Markup:
    """Build a table, one cell per heading in each row (else ValueError)."""
    head = element("tr", *(element("th", cell, scope="col") for cell in header))
    body = [element("tr", *(element("td", cell) for cell, _ in zip(row, header, strict=True))) for row in rows]
    title = (element("caption", caption),) if caption else ()
    return element("div", element("table", *title, element("thead", head), element("tbody", *body)), class_="scroll")


def details(summary: str, *content: Markup) -> Markup:
    """Build a part of a page that is folded away under its summary."""
    return element("details", element("summary", summary), *content)


def notes_in_words(notes: Iterable[str]) -> tuple[str, ...]:
    """Write a sentence for each note on a run."""
    return tuple(f"Note: {note}." for note in notes)


def definition_list(pairs: Iterable[tuple[str, str]]) -> Markup:
    """Build a list of terms, each with its value."""
    return element("dl", *(fragment(element("dt", term), element("dd", value)) for term, value in pairs))


Draw: TypeAlias = Callable[[str, Callable[[], bytes]], bytes]
"""Takes a figure's name and what draws it, and returns the figure; b"" if it could not be drawn."""


def seed_fact(seed: int | None) -> dict[str, str]:
    """Return the seed of a run as a row of its facts; none if it is not known."""
    return {} if seed is None else {"seed": str(seed)}


def draw_or_raise(name: str, drawer: Callable[[], bytes]) -> bytes:
    """Return what `drawer` returns; what it raises is raised."""
    return drawer()


def figure(image: bytes, caption: str) -> Markup:
    """Build a figure that embeds a PNG, a GIF or an SVG; b"" could not be drawn."""
    if not image:
        return element("figure", paragraph("This figure could not be drawn."), element("figcaption", caption))
    kind = "svg+xml" if image.startswith(b"<svg") else "gif" if image.startswith(b"GIF") else "png"
    source = f"data:image/{kind};base64," + base64.b64encode(image).decode("ascii")
    shown = element("div", Markup(f'<img src="{source}" alt="{html.escape(caption)}">'), class_="drawing")
    return element("figure", shown, element("figcaption", caption))


def figures(drawn: Mapping[str, bytes], captions: Mapping[str, str]) -> dict[str, Markup]:
    """Build the figures that have a caption, by file name."""
    return {name: figure(drawn[name], caption) for name, caption in captions.items() if name in drawn}


def page(
    title: str,
    *,
    answer: str,
    key_figure: Markup,
    sections: Sequence[Section],
    with_terms: bool = False,
    reload_s: int | None = None,
) -> str:
    """Return the HTML of a page whose first screen is the answer in one sentence and the picture that shows it.

    A table of contents precedes the sections, which are in reading order, if there are four or more, parts included.
    `with_terms` adds what technical terms mean. The page is loaded again after `reload_s` seconds; None: never.
    """
    listed = sum(1 + len(s.parts) for s in sections) >= _FEWEST_LISTED
    entries = (_contents_entry(s, str(k)) for k, s in enumerate(sections, start=1))
    body = fragment(
        element("header", element("h1", title), paragraph(answer, class_="answer")),
        key_figure,
        *([element("nav", element("ol", *entries), aria_label="contents")] if listed else []),
        *(_section_element(s, str(k), 2) for k, s in enumerate(sections, start=1)),
        *([details("What the terms mean", definition_list(_TERMS.items()))] if with_terms else []),
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


def _section_element(section: Section, number: str, level: int) -> Markup:
    parts = (_section_element(part, f"{number}.{k}", level + 1) for k, part in enumerate(section.parts, start=1))
    heading = element(f"h{level}", section.heading)
    return element("section", heading, *section.elements, *parts, id=f"part-{number}")


def _contents_entry(section: Section, number: str) -> Markup:
    parts = [_contents_entry(part, f"{number}.{k}") for k, part in enumerate(section.parts, start=1)]
    link = element("a", section.heading, href=f"#part-{number}")
    return element("li", link, element("ol", *parts)) if parts else element("li", link)


_TERMS = {
    "residual": "recorded minus predicted reading",
    "p": "p-value: how often chance alone gives at least this, with nothing missing",
    "SSF": "spatial sensitivity function: how strongly the sensor sees each point beneath it",
    "sd": "standard deviation",
    "rms": "root of the mean square",
    "nat": "unit of evidence, a natural logarithm: 3 nats are odds of 20 to 1",
    "held-out": "kept for testing: not used in the fit",
    "λ": "size of an effect: norm of its change in the readings after a full refit without it, in noise sds",
    "aliased": "two effects that change these readings in the same way while they are small",
    "cosine": "1 where two effects change the readings in the same proportions, 0 where unrelated",
    "unknown": "something that no effect which this program knows explains",
}

_STYLE = """
:root { color-scheme: light; --ink: #1b1b1b; --soft: #5a5a5a; --line: #d8d8d8; --paper: #ffffff; --accent: #0072b2; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.55 system-ui, Roboto, sans-serif; }
main { max-width: 60rem; margin: 0 auto; padding: 1rem 1.1rem 4rem; }
h1 { font-size: 1.05rem; font-weight: 600; color: var(--soft); margin: .3rem 0 0; }
h2 { font-size: 1.25rem; margin: 2.4rem 0 .5rem; border-top: 1px solid var(--line); padding-top: 1.1rem; }
h3 { font-size: 1.02rem; margin: 1.6rem 0 .3rem; }
nav { margin: 1.4rem 0; padding: .7rem 1rem .8rem; background: #f5f5f5; }
nav > ol { columns: 2 20rem; margin: 0; padding-left: 1.2rem; } nav li { break-inside: avoid; font-weight: 600; }
nav ol ol { margin: 0 0 .5rem; padding-left: 0; list-style: none; }
nav ol ol li { font-weight: 400; font-size: .95rem; }
a { color: var(--accent); }
p.answer { font-size: 1.45rem; line-height: 1.3; font-weight: 600; margin: .3rem 0 1rem; max-width: 46rem; }
figure { margin: .8rem 0 1.2rem; }
figure img { display: block; max-width: 100%; height: auto; }
figcaption, caption { color: var(--soft); font-size: .9rem; text-align: left; margin-top: .35rem; max-width: 46rem; }
p { max-width: 46rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .6rem 0 1rem; font-size: .95rem; }
th, td { padding: .3rem .9rem .3rem 0; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
td { font-variant-numeric: tabular-nums; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1.2rem; font-size: .95rem; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
code, pre { font: .9em ui-monospace, Menlo, Consolas, monospace; }
pre { overflow-x: auto; background: #f5f5f5; padding: .7rem .9rem; }
@media (max-width: 34rem) {
  p.answer { font-size: 1.2rem; } dl { grid-template-columns: 1fr; } dt { margin-top: .4rem; }
  .drawing { overflow-x: auto; } .drawing img { min-width: 34rem; max-width: none; }
}
@media print { main { max-width: none; padding: 0; } h2, figure, table { break-inside: avoid; } }
"""
