"""Display of results in a notebook; the packages that define the results need not import plotting.

A result's class derives from `ShowsItself`; `report.notebook`, higher in the layers, registers its renderer. It is
found by its name when a result is first displayed, since it loads plotting.
"""

from __future__ import annotations

import functools
import importlib
from typing import Any


@functools.singledispatch
def render_html(value: object) -> str:
    """Return a result as an HTML fragment; of a type without a registered renderer, the text of its `str`."""
    import html

    return f"<pre>{html.escape(str(value))}</pre>"


class ShowsItself:
    """Base of results that display themselves: HTML in a notebook, the text of `summary()` in a terminal and as `str`.

    The `repr`, which lists, debuggers and error messages show, is one line.
    """

    __slots__ = ()

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        # IPython prefers a class's own __repr__ to a base's _repr_pretty_; dataclass leaves a __repr__ that is there.
        cls._repr_pretty_ = ShowsItself._repr_pretty_  # type: ignore[method-assign]
        if "__repr__" not in cls.__dict__:
            cls.__repr__ = ShowsItself.__repr__  # type: ignore[method-assign]

    def __str__(self) -> str:
        summary = getattr(self, "summary", None)
        return str(summary()) if callable(summary) else f"<{type(self).__name__}>"

    def __repr__(self) -> str:
        try:
            said = str(self)
        except Exception:  # what is half made is shown in tracebacks and debuggers too
            return f"<{type(self).__name__}>"
        first_line = " ".join(said.partition("\n")[0].split())
        return said if said.startswith("<") else f"<{type(self).__name__}: {first_line}>"

    def _repr_html_(self) -> str:
        importlib.import_module("probewise.report.notebook")
        import numpy as np  # it is loaded by the time there is a result

        with np.errstate(divide="warn", over="warn", under="ignore", invalid="warn"):  # whatever np.seterr says
            return render_html(self)

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        printer.text(str(self))
