"""The pages on Python and on any instrument run as printed, and so do the examples of what they use."""

import doctest
import re
from pathlib import Path

import pytest

from probewise import verbs
from probewise.recordings import plan

HOWTO = Path(__file__).parents[2] / "docs" / "howto"


def names_after_running(page, containing=""):
    blocks = re.findall(r"```python\n(.*?)```", (HOWTO / page).read_text(encoding="utf-8"), re.DOTALL)
    names = {}
    exec(compile("\n".join(block for block in blocks if containing in block), page, "exec"), names)
    return names


@pytest.mark.slow
def test_the_page_on_any_instrument_runs_as_printed(capsys):
    inquiry = names_after_running("instrument.md", "Inquiry(")["inquiry"]
    assert inquiry.settled
    assert "asked for 0.01" in capsys.readouterr().out
    assert abs(inquiry.posterior.mean()[0] - 3.37) < 5 * 0.01


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::probewise.errors.DoubtfulResultWarning")
def test_the_page_runs_as_printed(capsys):
    names = names_after_running("python.md")
    assert names["calibration"].sensor.n_gaussians in (1, 2)
    assert names["diagnosis"].verdict in capsys.readouterr().out
    assert len(names["run"].readings) == 5


@pytest.mark.parametrize("module", [pytest.param(verbs, marks=pytest.mark.slow), plan])
@pytest.mark.filterwarnings("ignore::probewise.errors.DoubtfulResultWarning")
def test_the_examples_run_as_printed(module):
    failed, attempted = doctest.testmod(module)
    assert (failed, attempted > 0) == (0, True)
