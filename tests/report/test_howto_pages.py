"""The pages on Python and on any instrument run as printed, and so do the examples of what they use."""

import doctest
import re
from pathlib import Path

import pytest

from probewise import verbs
from probewise.recordings import plan

HOWTO = Path(__file__).parents[2] / "docs" / "howto"


def names_after_running(page, containing="", without="\0"):
    blocks = re.findall(r"```python\n(.*?)```", (HOWTO / page).read_text(encoding="utf-8"), re.DOTALL)
    names, wanted = {}, (block for block in blocks if containing in block and without not in block)
    exec(compile("\n".join(wanted), page, "exec"), names)
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
    names = names_after_running("python.md", without="pandas")
    assert names["calibration"].sensor.n_gaussians in (1, 2)
    assert names["diagnosis"].verdict in capsys.readouterr().out
    assert len(names["run"].readings) == 5


@pytest.mark.slow
def test_the_page_diagnoses_a_data_frame_as_printed(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pandas")
    monkeypatch.chdir(tmp_path)
    names = names_after_running("python.md", "pandas")
    assert names["diagnosis"].combination == ("loss_per_c",)
    assert "loss_per_c.value" in names["repaired"].names
    assert {"mean", "sd"} <= set(names["predicted"].columns)
    assert "named" in capsys.readouterr().out


@pytest.mark.parametrize("module", [pytest.param(verbs, marks=pytest.mark.slow), plan])
@pytest.mark.filterwarnings("ignore::probewise.errors.DoubtfulResultWarning")
def test_the_examples_run_as_printed(module):
    failed, attempted = doctest.testmod(module)
    assert (failed, attempted > 0) == (0, True)
