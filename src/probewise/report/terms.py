"""Technical terms, each explained in the section that first uses it."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

from probewise.report.html import Markup, Section, element, paragraph

TERMS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "residual": (r"(?i)\bresiduals?\b", "recorded minus predicted reading"),
        "p": (r"\bp\s[=<]", "p-value: how often chance alone gives at least this, with nothing missing"),
        "SSF": (r"\bSSF\b", "spatial sensitivity function: how strongly the sensor sees each point beneath it"),
        "sd": (r"\bsds?\b", "standard deviation"),
        "rms": (r"\brms\b", "root of the mean square"),
        "nat": (r"\bnats?\b", "unit of evidence, a natural logarithm: 3 nats are odds of 20 to 1"),
        "held-out": (r"\bheld-out\b", "kept for testing: not used in the fit"),
        "λ": (
            r"λ|\blambda\b",
            "size of an effect: norm of its change in the readings after a full refit without it, in noise sds",
        ),
        "aliased": (
            r"(?i)\balias(es|ed)?\b",
            "two effects that change these readings in the same way, so that the readings cannot tell which it is",
        ),
        "cosine": (
            r"\bcosine\b",
            "1 where two effects change the readings in the same proportions, 0 where unrelated",
        ),
        "unknown": (r"\bunknown\b", "something that no effect which this program knows explains"),
    }
)
"""For each term: a pattern that finds its uses in a text, and its explanation."""


def explain_new_terms(content: str, known: set[str]) -> tuple[Markup, ...]:
    """Build the paragraph on an HTML text's terms not in `known`, empty if there is none; add the terms to `known`."""
    text = html.unescape(re.sub(r"<style.*?</style>|<[^>]*>", " ", content, flags=re.S))
    new: list[str] = []
    while text:  # an explanation may use a term itself
        found = [term for term, (pattern, _) in TERMS.items() if term not in known and re.search(pattern, text)]
        known.update(found)
        new += found
        text = " ".join(TERMS[term][1] for term in found)
    parts = [part for term in new for part in (element("b", term), f": {TERMS[term][1]}. ")]
    return (paragraph(*parts, class_="terms"),) if parts else ()


def sections_with_terms_explained(sections: Sequence[Section], known: set[str]) -> list[Section]:
    """Return the sections, each with a paragraph on the terms that it is the first to use; add them to `known`."""
    return [replace(s, body=(*s.body, *explain_new_terms(" ".join((s.heading, *s.body)), known))) for s in sections]
