"""The page on working from Python runs as printed, and so do the examples of what it uses."""

import doctest
import re
from pathlib import Path

import pytest

from probewise import verbs
from probewise.recordings import plan

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "python.md"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::probewise.errors.DoubtfulResultWarning")
def test_the_page_runs_as_printed(capsys):
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, object] = {}
    exec(compile("\n".join(blocks), str(PAGE), "exec"), names)
    assert names["calibration"].sensor.n_gaussians in (1, 2)
    assert names["diagnosis"].verdict in capsys.readouterr().out
    assert len(names["run"].readings) == 5


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::probewise.errors.DoubtfulResultWarning")
def test_the_examples_of_the_verbs_run_as_printed():
    failed, attempted = doctest.testmod(verbs)
    assert (failed, attempted > 0) == (0, True)


def test_the_examples_of_plans_and_recordings_run_as_printed():
    failed, attempted = doctest.testmod(plan)
    assert (failed, attempted > 0) == (0, True)
