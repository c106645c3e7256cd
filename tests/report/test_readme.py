"""What somebody who has just arrived reads is true: the loop, the sentences, the install lines, the words."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from probewise import experiment
from probewise.cli import main
from probewise.diagnosis import diagnose, generators_of_diagnosis
from probewise.experiment import loop
from probewise.experiment.judgement import is_target_reached
from probewise.recordings import read_recording, shipped
from probewise.report.words import typeset_numbers

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
INDEX = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
QUOTED = json.loads((ROOT / "docs" / "_static" / "pictures.json").read_text(encoding="utf-8"))
PENDULUM = json.loads((ROOT / "docs" / "_static" / "pendulum.json").read_text(encoding="utf-8"))
LAW = (ROOT / "examples" / "simulators" / "pendulum.py").read_text(encoding="utf-8")


def plain(text):
    return " ".join(text.replace("**", "").replace("*", "").replace("> ", "").split())


@pytest.mark.slow
def test_the_printed_loop_is_the_one_that_the_robot_runs(monkeypatch):
    """The printed lines and `explore`, given the same randomness, take the same readings to the last bit."""
    page = (ROOT / "docs" / "howto" / "python.md").read_text(encoding="utf-8")
    (code,) = (block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "experiment.begin" in block)
    code = "import numpy as np\n" + code  # of the page's first block
    setup, rest = code.split("\nrng = ")
    printed = {}
    exec(compile(code, "python.md", "exec"), printed)
    again = {}
    exec(compile(setup, "python.md", "exec"), again)
    rng = eval(rest.splitlines()[0], again)
    monkeypatch.setattr(loop, "_rng_of_reading", lambda seed, number: rng)
    steps = list(experiment.explore(again["robot"], printed["asked"], rng=rng, max_readings=4))
    taken = [(r.pose, r.value) for r in printed["state"].readings]
    assert [(s.reading.pose, s.reading.value) for s in steps] == taken[:4]
    last = printed["info"]
    assert is_target_reached(printed["asked"], last.sd, last.shapes)
    assert abs((last.mean - [600.0, 260.0, 90.0]) / last.sd).max() < 4


def test_the_law_of_the_readme_is_in_the_file_that_it_names():
    (law,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert law in LAW


def test_the_front_page_quotes_what_the_demo_said_when_its_pictures_were_made():
    assert plain(QUOTED["equal_readings"]) in plain(INDEX)
    assert QUOTED["combination"] == QUOTED["concealed"]
    assert QUOTED["verdict"] == "named"


@pytest.mark.slow
def test_the_demo_and_the_command_say_the_same_of_the_shipped_recording():
    rng, *_ = generators_of_diagnosis(QUOTED["seed"])
    found = diagnose(read_recording(shipped("concealed")), rng=rng)
    assert typeset_numbers(found.reason) == QUOTED["reason"]


def test_the_readme_quotes_what_was_said_of_the_pendulum_when_its_picture_was_made():
    said, p_value = PENDULUM["reason"].split(" (p = ")
    assert float(p_value.removesuffix(").")) < 1e-100
    assert f"> {plain(typeset_numbers(said))} (p below 10⁻¹⁰⁰)." in README
    assert (PENDULUM["verdict"], PENDULUM["combination"]) == ("named", ["drag:omega"])


@pytest.mark.slow
def test_the_readme_quotes_what_the_command_says_of_the_pendulum(tmp_path):
    """The README's two commands; the last digit of a sampled mean and of a tiny p-value depends on the processor."""
    swings, example = tmp_path / "swings.csv", ROOT / "examples" / "plot_pendulum.py"
    subprocess.run([sys.executable, example, "--out", swings], check=True, capture_output=True)
    law = str(ROOT / "examples" / "simulators" / "pendulum.py")
    assert main(["diagnose", str(swings), "--simulator", law, "--out", str(tmp_path / "pendulum"), "--quiet"]) == 0
    found = json.loads((tmp_path / "pendulum" / "diagnosis.json").read_text(encoding="utf-8"))
    assert found["combination"] == PENDULUM["combination"]
    said, quoted = (reason.partition(" (p =")[0] for reason in (found["reason"], PENDULUM["reason"]))
    words, value, error = re.fullmatch(r"(.* = )(\S+) ± (\S+)", said).groups()
    quoted_words, quoted_value, quoted_error = re.fullmatch(r"(.* = )(\S+) ± (\S+)", quoted).groups()
    assert (words, error) == (quoted_words, quoted_error)
    assert abs(float(value) - float(quoted_value)) < 0.2 * float(error)
    assert found["p_value"] < 1e-100


@pytest.mark.parametrize(("page", "n_pictures"), [("README.md", 4), ("docs/index.md", 3)])
def test_pictures_that_the_front_pages_show_are_there(page, n_pictures):
    shown = re.findall(r"(?:!\[.*?\]\(|```\{figure\} )([^)\s]+)", (ROOT / page).read_text(encoding="utf-8"))
    assert len(shown) == n_pictures
    assert all(((ROOT / page).parent / name).is_file() for name in shown)


@pytest.mark.parametrize("page", [README, INDEX], ids=["README", "index"])
@pytest.mark.parametrize(
    ("word", "meaning"),
    [
        (r"\bSSF\b", "spatial sensitivity function"),
        (r"\blambda\b|λ", "standard deviations of the noise"),
        (r"\bnats?\b", "unit of natural log probability"),
        (r"\balias", "by less than 3 nats"),
    ],
    ids=["SSF", "lambda", "nat", "alias"],
)
def test_a_word_of_the_trade_is_explained_where_it_first_stands(page, word, meaning):
    prose = plain(re.sub(r"```\w+\n.*?```|!\[.*?\]|:alt: [^\n]*", "", page, flags=re.DOTALL))
    first = re.search(word, prose)
    assert first is None or meaning in prose[max(first.start() - 120, 0) : first.end() + 330]


def test_no_notebook_shows_evidences_that_do_not_decide():
    """An example that says "too close to call" teaches nothing about the number of Gaussians."""
    shown = {path.name: path.read_text(encoding="utf-8") for path in (ROOT / "examples").glob("*.ipynb")}
    assert "ln(Z1 / Z2) = " in shown["calibrate.ipynb"]
    assert [name for name, text in shown.items() if "too close to call" in text] == []


def test_no_line_installs_from_an_index_that_does_not_have_this_package():
    """It is not published: extras are installed from a clone (`-e ".[nxt]"`), packages by their own names."""
    read = [README, *(p.read_text(encoding="utf-8") for p in ROOT.glob("*.md"))]
    for folder, kinds in (("docs", "md rst py"), ("examples", "py rst ipynb"), ("src", "py"), ("benchmarks", "py md")):
        read += [p.read_text(encoding="utf-8") for kind in kinds.split() for p in (ROOT / folder).rglob(f"*.{kind}")]
    assert not [found for text in read for found in re.findall(r"pip install[^\n]*?['\" ]probewise\b.*", text)]
    assert not [found for text in read for found in re.findall(r"probewise\[\w+\]", text)]
