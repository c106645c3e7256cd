"""How results show themselves: text, HTML in a notebook, a picture, a page; tables as data frames.

A result's class derives from `ShowsItself`, of a verb's result from `Reported`. What draws and writes it is in
`report`, higher in the layers, and loaded by name when it is first needed: it loads plotting.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any


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

    def plot(self) -> Any:
        """Draw the result's main picture; return its matplotlib axes, or an array of them.

        Raises ParameterError if a result of this kind has no picture.
        """
        return importlib.import_module("probewise.report.results").drawing_of(self)

    def _repr_html_(self) -> str:
        import numpy as np  # it is loaded by the time there is a result

        with np.errstate(divide="warn", over="warn", under="ignore", invalid="warn"):  # whatever np.seterr says
            return str(importlib.import_module("probewise.report.results").html_of(self))

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        printer.text(str(self))


class Reported(ShowsItself):
    """Base of the results of verbs, which have a page."""

    __slots__ = ()

    def to_html(self, *, seed: int | None = None) -> str:
        """Return the command's report.html: one page with its figures inside; it states the `seed` if given."""
        return str(importlib.import_module("probewise.report.results").page_of(self, seed=seed))

    def save(self, folder: str | Path, *, seed: int | None = None) -> Path:
        """Write the files that the command writes with `--out`, figures and report.html too; return the folder.

        The folder is made if missing; earlier results there are replaced, all or none, and other files of their names
        get new ones (report_kept.html). With the `seed` of the result's random generator the files are those of the
        command; without it the report states none.

        Raises
        ------
        ParameterError
            If a file is in the way, or the folder holds results of another verb.
        FileError
            If the folder cannot be written to.
        NotDrawnError
            If a figure could not be drawn; everything else is complete.
        """
        return Path(importlib.import_module("probewise.report.results").save(self, folder, seed=seed))
