"""How results show themselves in a notebook: the values stand low, the pictures high.

A value derives from `ShowsItself` and knows nothing of pages or plots; `report.notebook`,
which stands above, registers how to draw it. The first display imports that module.
"""

from __future__ import annotations

import functools
import html
import importlib

__all__ = ["ShowsItself", "render_html"]


@functools.singledispatch
def render_html(value: object) -> str:
    """Render a value as an HTML fragment; types without a renderer show their repr."""
    return f"<pre>{html.escape(repr(value))}</pre>"


class ShowsItself:
    """Give a value the `_repr_html_` that notebooks look for."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        importlib.import_module("probewise.report.notebook")
        return render_html(self)
