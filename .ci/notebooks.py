"""Make and execute the notebooks in examples/, outputs kept; with --check, only run those that stand there."""

from __future__ import annotations

import argparse
from pathlib import Path

import nbformat
from nbclient import NotebookClient

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def cells_of(script: Path) -> nbformat.NotebookNode:
    """Turn a script of `# %%` cells into a notebook: comment lines at a cell's start become its text."""
    notebook = nbformat.v4.new_notebook()
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    for number, part in enumerate(script.read_text(encoding="utf-8").split("# %%\n")[1:]):
        lines = part.strip("\n").split("\n")
        n_text = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
        text = "\n".join(line.removeprefix("#").removeprefix(" ") for line in lines[:n_text])
        code = "\n".join(lines[n_text:]).strip("\n")
        if text:
            notebook.cells.append(nbformat.v4.new_markdown_cell(text, id=f"text-{number}"))
        if code:
            notebook.cells.append(nbformat.v4.new_code_cell(code, id=f"code-{number}"))
    return notebook


def execute(notebook: nbformat.NotebookNode) -> None:
    """Run every cell in a fresh kernel; an error in a cell is an error here."""
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(EXAMPLES)}}
    ).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # times of day: they would change on every run


def main() -> None:
    """Make or check every notebook."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="run the notebooks as they stand and write nothing")
    check = parser.parse_args().check
    for script in sorted((EXAMPLES / "notebooks").glob("*.py")):
        target = EXAMPLES / f"{script.stem}.ipynb"
        notebook = nbformat.read(target, as_version=4) if check else cells_of(script)
        execute(notebook)
        if not check:
            nbformat.write(notebook, target)
        print(f"{target.name}: {sum(c.cell_type == 'code' for c in notebook.cells)} cells ran")


if __name__ == "__main__":
    main()
