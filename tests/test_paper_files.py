"""The paper's method in eight files and a ninth: each opens with its section, and imports little beside the others."""

import ast
import re
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "probewise"
PAPER = (
    "arm.instrument",
    "scene.shapes",
    "sensor.naive",
    "inference.likelihoods",
    "nested.sampler",
    "nested.diversify",
    "inquiry.entropy",
    "experiment.paper",
    "calibration.paper",
)
BESIDE = {
    "_arrays",
    "_kinds",
    "errors",
    "priors",
    "recordings.plan",  # where readings are taken
    "scene.regions",  # eq. 1 to 3, for many circles at once
    "scene.scenes",
    "sensor.stages",  # what a sensor model is
    "sensor.chain",  # the SSF model
    "inference.problem",  # prior, model, likelihood and readings
    "nested.problem",
    "nested.moves",
    "nested.evidence",
    "nested.result",
    "nested.weights",
    "nested.save",
    "nested.check",
    "nested.importance",
    "inquiry.grid",
    "inquiry.forecast",
    "arm.carry_out",  # readings as a recording
    "calibration.fields",
    "calibration.priors",
}
"""What the nine may import beside each other, NumPy and SciPy."""


def tree(name):
    return ast.parse((SOURCE / (name.replace(".", "/") + ".py")).read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", PAPER)
def test_a_file_of_the_paper_opens_with_its_section(name):
    opening = ast.get_docstring(tree(name)).split("\n\n")
    assert re.search(r'[Pp]aper, .*"[A-Z][^"]+"', " ".join(opening[:2]).replace("\n", " "))


@pytest.mark.parametrize("name", PAPER)
def test_a_file_of_the_paper_imports_little(name):
    """A package whose names are re-exported stands for the file of the same folder."""
    folders = {known.split(".")[0] for known in (*PAPER, *BESIDE)} | {"recordings"}
    imported = {
        node.module.removeprefix("probewise.")
        for node in ast.walk(tree(name))
        if isinstance(node, ast.ImportFrom) and node.module.startswith("probewise")
    }
    assert imported - set(PAPER) - BESIDE - folders == set()
