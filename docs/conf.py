"""Build the documentation: `sphinx-build -W docs docs/_build/html`."""

from __future__ import annotations

import importlib
import io
import tomllib
from contextlib import redirect_stdout
from pathlib import Path

from probewise import __version__
from probewise.cli import VERBS, main

HERE = Path(__file__).parent
TASKS = ("check", "fit-geometry", "heights", "home", "jog", "read", "record", "scan")  # of `probewise arm`

project = "probewise"
author = "the probewise authors"
copyright = "the probewise authors"
version = release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "numpydoc",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = [
    "_build",
    "api/help.md",
    "gallery/**/*.md5",
    "gallery/**/*.ipynb",
    "gallery/**/*.py",
    "**/sg_execution_times.rst",
    "sg_execution_times.rst",
]
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3

templates_path = ["_templates"]
html_theme = "furo"
html_title = f"probewise {__version__}"
html_static_path = ["_static"]
html_css_files = ["code.css"]
smartquotes_action = "qe"  # an option keeps its two hyphens in prose

LEADS: dict[str, list[str]] = tomllib.loads((HERE / "reference" / "leads.toml").read_text(encoding="utf-8"))

autosummary_generate = True
autosummary_context = {"leads": LEADS}
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

sphinx_gallery_conf = {
    "examples_dirs": str(HERE.parent / "examples"),
    "gallery_dirs": "gallery",
    "filename_pattern": r"plot_",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "show_memory": False,
    "min_reported_time": 1000,
}


def write_help(app: object) -> None:
    """Write what `--help` says to a page that the reference includes, so that it cannot fall behind."""
    folder = HERE / "api"
    folder.mkdir(parents=True, exist_ok=True)
    page = []
    for name in ("", *VERBS, *(f"arm {task}" for task in TASKS)):
        text = io.StringIO()
        with redirect_stdout(text):
            main([*name.split(), "--help"])
        heading = f"## {name}\n\n" if name else ""
        page.append(f"{heading}```text\n{text.getvalue()}```\n")
    (folder / "help.md").write_text("\n".join(page), encoding="utf-8")


def lead_with_what_people_call(app: object) -> None:
    """Order the public names of a package, which its page follows: first what people call, then the helpers."""
    for package, first in LEADS.items():
        module = importlib.import_module(package)
        unknown = sorted(set(first) - set(module.__all__))
        if unknown:
            raise ValueError(f"docs/reference/leads.toml: {package} has no public name {unknown[0]}")
        module.__all__ = [*first, *(name for name in module.__all__ if name not in first)]


def setup(app: object) -> None:
    """Prepare what the pages are made of before they are read."""
    app.connect("builder-inited", write_help)  # type: ignore[attr-defined]
    app.connect("builder-inited", lead_with_what_people_call)  # type: ignore[attr-defined]
