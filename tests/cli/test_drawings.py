"""A figure that fails loses no result: what machines read is on disk before anything is drawn."""

from concurrent.futures import Executor, Future
from functools import partial

import numpy as np
import pytest
from heater import FILE, runs
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG

from probewise._signals import Stopped
from probewise._writing import Drawings, Output
from probewise.cli import main
from probewise.errors import NotDrawnError
from probewise.proof import concealed_study
from probewise.report.plots.canvas import axes_of_frame
from probewise.systems import run_table_csv

DIAGNOSIS = ("diagnosis.json", "sensor.json", "calibrated.json", "report.html")
# Of each command, the files that it leaves where no figure can be drawn.
COMMANDS = {
    "audit small.csv": ("audit.json", "cure_plan.csv", "cure_plan.json", "report.html"),
    "audit data.csv --simulator heater.py": ("audit.json", "report.html"),
    "fit data.csv --simulator heater.py": ("fit.json", "fitted.json", "samples.csv", "report.html"),
    "explore --sensor sensor.json --truth 500,250,90 --max-readings 2 --live": (
        *("journal.jsonl", "result.json", "samples.csv", "sensor.json", "live.html", "report.html"),
    ),
    "study --circles 2 --max-readings 2 --model naive --workers 1": ("trials.jsonl", "table.csv", "report.html"),
    "study --concealed --circles 1 --clean 1 --size gross --max-readings 2 --workers 1": (
        "concealed.jsonl",
        "concealed.csv",
        "report.html",
    ),
    "challenge --cases 1 --workers 1": ("cases.jsonl", "table.csv", "report.html"),
    "calibrate small.csv --orders 1 --live 16": ("sensor.json", "report.html"),
    "diagnose small.csv": DIAGNOSIS,
    "diagnose data.csv --simulator heater.py": (
        *("diagnosis.json", "repaired.json", "calibrated.json", "report.html"),
    ),
    "investigate --plan small.csv --truth nothing --rounds 1": (
        *(*DIAGNOSIS, "recording.csv", "recording.json", "rounds/settings.json"),
        *(f"rounds/{name}" for name in ("1.csv", "1.json", "1_plan.csv", "1_plan.json")),
    ),
}


class InThisProcess(Executor):
    """Workers that the changes of a test reach."""

    def submit(self, work, *arguments, **keywords):
        future = Future()
        future.set_result(work(*arguments, **keywords))
        return future


@pytest.fixture
def folder(monkeypatch, tmp_path, recording_file, sensor_file):
    """What the commands read, where they run; a study is of few concealed effects, and no browser opens."""
    (tmp_path / "heater.py").write_text(FILE)
    (tmp_path / "data.csv").write_text(run_table_csv(runs(rng=np.random.default_rng(2))))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("webbrowser.open", lambda url: None)
    monkeypatch.setattr("probewise.cli._executor.worker_pool", lambda n: InThisProcess())
    few = partial(concealed_study.concealed_study, effects=("backlash", "saturation"))
    monkeypatch.setattr(concealed_study, "concealed_study", few)
    return tmp_path


QUICK = ("audit data.csv", "explore", "study --circles")


@pytest.mark.parametrize(
    "command", [pytest.param(words, marks=[] if words.startswith(QUICK) else pytest.mark.slow) for words in COMMANDS]
)
def test_a_command_that_cannot_draw_writes_the_rest_says_so_in_a_line_and_exits_1(command, folder, monkeypatch, capsys):
    def fail(*_, **__):
        raise KeyError(0.0)

    monkeypatch.setattr(FigureCanvasAgg, "draw", fail)
    monkeypatch.setattr(FigureCanvasSVG, "print_svg", fail)
    axes_of_frame.cache_clear()  # with what an earlier test drew once for all frames
    verb, *words = command.split()
    assert main([verb, *words, "--out", "out", "--quiet"]) == 1
    *_, said = capsys.readouterr().err.splitlines()
    assert said.startswith(f"probewise {verb}: could not draw ")
    assert "(KeyError: 0.0)" in said
    out = folder / "out"
    assert {
        path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file() and path.name[0] != "."
    } == set(COMMANDS[command])


JOURNALS = ("journal.jsonl", "trials.jsonl", "concealed.jsonl", "cases.jsonl", "rounds")  # continued, or refused


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(words, marks=[] if words.startswith(QUICK[0]) or words.endswith("--live") else pytest.mark.slow)
        for words in (*COMMANDS, "diagnose data.csv --simulator heater.py --each", "explore --max-readings 1")
    ],
)
def test_a_persons_file_of_any_name_that_a_verb_writes_survives(command, folder, capsys):
    """Also what a person made of a result; what nobody has touched is replaced."""
    verb, *words = command.split()

    def names_in(out):
        names = [path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()]
        return sorted(name for name in names if "/." not in f"/{name}" and not name.startswith(JOURNALS))

    plain, out = folder / "plain", folder / "out"
    assert main([verb, *words, "--out", "plain", "--quiet"]) == 0
    written = names_in(plain)
    for name in written:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(f"mine {name}")
    for again in range(1 if any((plain / name).exists() for name in JOURNALS) else 2):
        assert main([verb, *words, "--out", "out"]) == 0
        left = names_in(out)
        assert set(written) < set(left)
        assert len(left) == 2 * len(written)
        found = sorted(text for text in ((out / name).read_bytes() for name in left) if text.startswith(b"mine "))
        assert found == sorted(f"mine {name}".encode() for name in written)
        assert ("note: what was " in capsys.readouterr().out) is not again


def test_one_figure_that_fails_leaves_the_others(tmp_path):
    drawings = Drawings(tmp_path)
    drawers = {"first.svg": lambda: b"first", "second.svg": lambda: 1 // 0, "third.svg": lambda: b"third"}
    drawings.write_results(Output(lambda stage: None, drawers, lambda drawn: f"page with {sorted(drawn.values())}"))
    assert {path.name: path.read_text() for path in tmp_path.iterdir() if path.name[0] != "."} == {
        "first.svg": "first",
        "third.svg": "third",
        "report.html": "page with [b'', b'first', b'third']",
    }
    with pytest.raises(NotDrawnError, match=r"^could not draw second\.svg \(ZeroDivisionError: .*\); everything else"):
        drawings.raise_if_any_failed()


def test_a_page_that_cannot_be_written_is_one_that_is_not_drawn(tmp_path):
    (tmp_path / "report.html").mkdir()
    with pytest.raises(NotDrawnError, match=r"a directory of that name .*; the results are in .*, without figures"):
        Drawings(tmp_path).write_results(Output(lambda stage: None, {}, lambda drawn: "page"))


def test_an_interruption_while_figures_are_drawn_says_where_the_results_are(tmp_path):
    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(Stopped, match=r"the results are in .*, without figures and report"):
        Drawings(tmp_path).write_results(Output(lambda stage: None, {"first.svg": interrupt}, lambda drawn: ""))
    assert not [path for path in tmp_path.iterdir() if path.name[0] != "."]
