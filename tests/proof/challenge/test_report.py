"""The page of a challenge and its files."""

import json

import pytest

from probewise.cli import main
from probewise.proof import pages as report
from probewise.proof.challenge import Task
from probewise.proof.tables import score
from probewise.report.html import draw_or_raise

from ..conftest import case, outside, single


@pytest.fixture
def results():
    failed = {"kind": "pair", "size": 12.0, "other_noise": False, "failed": "no <plan>", "at": "drawing"}
    return [case(), case(p=0.6), single(), single(said=["halo"]), outside(), failed]


def test_the_page_stands_alone_and_tells_of_failures(results):
    page = report.challenge_page(results, score, command="probewise challenge", systems=False).html(draw_or_raise)
    assert "no &lt;plan&gt;" in page
    assert page.count("data:image/png;base64,") == 2
    assert "http://" not in page


def test_the_verb_scores_what_its_file_holds(results, tmp_path, capsys):
    from probewise import __version__

    out = tmp_path / "out"
    out.mkdir()
    lines = [{"format": "campaign/1", "settings": {"challenge": __version__, "seed": 5}}]
    lines += [{"key": Task(5, k).key, "result": r} for k, r in enumerate(results)]
    (out / "cases.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert main(["challenge", "--cases", "6", "--seed", "5", "--out", str(out)]) == 0
    assert "6 cases" in capsys.readouterr().out
    assert (out / "table.csv").read_text().startswith("what,found")
    assert "probewise challenge --cases 6 --seed 5" in (out / "report.html").read_text()
