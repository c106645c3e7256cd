"""The page on any instrument runs as printed."""

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "instrument.md"


@pytest.mark.slow
def test_the_page_runs_as_printed(capsys):
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (block,) = (block for block in blocks if "Inquiry(" in block)
    names: dict[str, object] = {}
    exec(compile(block, str(PAGE), "exec"), names)
    inquiry = names["inquiry"]
    assert inquiry.settled
    assert "asked for 0.01" in capsys.readouterr().out
    assert abs(inquiry.posterior.mean()[0] - 3.37) < 5 * 0.01
