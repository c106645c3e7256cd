"""A printer's gantry from its first recording to a circle, by the commands of the docs and a person's two hands."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("serial")
pytest.importorskip("tty")

from marlin import Marlin

from probewise.cli import main
from probewise.cli._bench import shifted_pattern
from probewise.recordings import Disc, paper_plan
from probewise.world import World
from probewise.world.spots import Blob, gaussian_spot

pytestmark = [pytest.mark.slow, pytest.mark.single_case]

EXAMPLE = Path(__file__).parents[2] / "examples" / "instruments" / "printer.py"
ORIGIN_MM = (110.0, 110.0)
CIRCLE = Disc((125.0, 95.0), 55.0)
SPOT = gaussian_spot([Blob(share=1.0, center_mm=(0.0, 1.0), sd_mm=(3.0, 2.0), correlation=0.0)])
WORLD = World(SPOT, black=140.0, white=840.0, noise_sd=8.0)


class Person:
    """Reads what is asked, lays the sheet or turns the sensor, presses Enter."""

    encoding = "utf-8"

    def __init__(self, say):
        self.surface, self.turned_rad, self.asked = CIRCLE, 0.0, []
        self._say, self._heard = say, ""
        self._rng = np.random.default_rng(7)

    def write(self, text):
        self._heard += text
        return self._say(text)

    def flush(self):
        return None

    def isatty(self):
        return False

    def readline(self):
        request, self._heard = self._heard, ""
        self.asked.append(request)
        if sheet := re.search(r"Lay sheet '(\w+)', its origin at \(110, 110\) mm", request):
            self.surface = shifted_pattern(paper_plan().patterns[sheet[1]], ORIGIN_MM)
        elif turn := re.search(r"Turn the sensor on its mount to (-?[\d.]+) degrees", request):
            self.turned_rad = np.radians(float(turn[1]))
        else:
            raise AssertionError(request)
        return "\n"

    def light(self, x_mm, y_mm, height_mm):
        assert height_mm == 12.0
        value = WORLD.read(self.surface, x_mm, y_mm, self.turned_rad, time_s=0.0, rng=self._rng)
        return round(min(max(value, 0.0), 1023.0))


def test_record_calibrate_explore_and_diagnose_with_the_printer(tmp_path, monkeypatch, capsys):
    person = Person(sys.stderr.write)
    monkeypatch.setattr(sys, "stdin", person)
    monkeypatch.setattr(sys, "stderr", person)
    monkeypatch.chdir(tmp_path)

    def run(*words):
        assert main([*words]) == 0, words
        return capsys.readouterr().out

    with Marlin(person.light) as printer:
        text = EXAMPLE.read_text(encoding="utf-8")
        for old, new in (
            ("/dev/ttyUSB0", printer.line.path),
            ("/dev/ttyACM0", printer.sensor.path),
            ("RESTART_S, PATIENCE_S", "RESTART_S, PATIENCE_S, TRIES = 0.05, 2.0, 4  #"),
        ):
            text = text.replace(old, new)
        (tmp_path / "printer.py").write_text(text, encoding="utf-8")
        own = ("--arm", "printer.py")
        settings = ("--unit", "counts", "--range", "0,1023", "--step", "1")
        run("arm", "record", "paper", "--out", "mine.csv", *own, "--origin-mm", "110,110", *settings)
        assert len(person.asked) == 10  # five sheets, four turns, and at the start how the sensor stands
        run("calibrate", "mine.csv", "--out", "my_sensor", "--method", "quick", "--orders", "1", "2")
        person.surface, person.turned_rad = CIRCLE, 0.0
        run("explore", "--sensor", "my_sensor/sensor.json", *own, "--field", "220,220", "--out", "found")
        run("diagnose", "mine.csv", "--out", "diagnosis")
    run("diagnose", "found/journal.jsonl", "--out", "of_run")
    result = json.loads((tmp_path / "found" / "result.json").read_text(encoding="utf-8"))
    assert result["known"]
    for parameter, true in zip(result["shape"]["parameters"], (125.0, 95.0, 55.0), strict=True):
        assert abs(parameter["mean"] - true) < 4 * parameter["sd"]
    diagnosed, of_run = (
        json.loads((tmp_path / name / "diagnosis.json").read_text(encoding="utf-8")) for name in ("diagnosis", "of_run")
    )
    assert diagnosed["verdict"] == "clean"
    credible = result["left_out"]["credible_set"]
    assert credible[0] == "clean"
    assert "clean" in of_run["credible_set"]
    assert set(of_run["hypotheses"][0]["effects"] or ["clean"]) <= set(credible)
