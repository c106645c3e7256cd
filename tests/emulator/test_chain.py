"""From a ruler's geometry to a circle and a diagnosis, by the commands of the docs alone, on an arm built otherwise."""

import json
import re

import pytest

from probewise.arm import shipped_geometry_path
from probewise.cli import main
from probewise.experiment.result import WRONG_MM

pytestmark = pytest.mark.slow

BUILT = {  # of the arm that is there, 2 degrees and 3 mm beside the file
    "base": {"x_mm": 527, "y_mm": 577, "shoulder_forward_mm": 43, "shoulder_height_mm": 117},
    "links": {"upper_mm": 353, "lower_mm": 347},
    "joints.base": {"home_deg": -88},
    "joints.shoulder": {"home_deg": 88},
    "joints.elbow": {"home_deg": -22},
}
TRUTH = {"x_mm": 600.0, "y_mm": 250.0, "radius_mm": 80.0}


def built_otherwise(text):
    for table, numbers in BUILT.items():
        head, mark, rest = text.partition(f"[{table}]")
        for name, number in numbers.items():
            rest, n = re.subn(rf"^{name} = [-\d.]+", f"{name} = {number}", rest, count=1, flags=re.MULTILINE)
            assert n == 1
        text = head + mark + rest
    return text


@pytest.mark.usefixtures("quick_frames")
def test_an_arm_that_is_built_otherwise_finds_the_circle_and_never_touches_the_table(tmp_path, monkeypatch, capsys):
    """It is not wrong as the studies count it; over nine seeds 20 of 27 intervals of 95 % hold, so none is asked."""
    monkeypatch.chdir(tmp_path)
    text = shipped_geometry_path().read_text(encoding="utf-8")
    (tmp_path / "my_arm.toml").write_text(text, encoding="utf-8")
    (tmp_path / "true.toml").write_text(built_otherwise(text), encoding="utf-8")
    arm = ("--arm", "emulator:true.toml")

    def run(*words):
        assert main([*words]) == 0, words
        said = capsys.readouterr()
        assert "through the table" not in said.err
        assert "may touch the table" not in said.err
        return said.out

    run("sheets", "marks", "--geometry", "my_arm.toml", "--out", "marks.pdf")
    assert "placed to" in run("arm", "fit-geometry", "--geometry", "my_arm.toml", *arm, "--out", "fitted.toml")
    run("sheets", "paper", "--out", "sheets.pdf")
    run("arm", "record", "paper", "--out", "mine.csv", "--geometry", "fitted.toml", *arm)
    run("calibrate", "mine.csv", "--out", "my_sensor", "--method", "quick", "--orders", "1", "2")
    truth = ",".join(f"{number:g}" for number in TRUTH.values())
    said = run(
        *("explore", "--sensor", "my_sensor/sensor.json", "--geometry", "fitted.toml", *arm, "--trust", "1"),
        *("--truth", truth, "--out", "found"),
    )
    assert "of these sds its own error makes up" in said
    run("diagnose", "mine.csv", "--out", "diagnosis")
    result = json.loads((tmp_path / "found" / "result.json").read_text(encoding="utf-8"))
    assert result["known"]
    for parameter in result["shape"]["parameters"]:
        assert 0 < parameter["arm_sd"] < parameter["sd"]
        assert abs(parameter["mean"] - TRUTH[parameter["name"]]) < WRONG_MM
    diagnosis = json.loads((tmp_path / "diagnosis" / "diagnosis.json").read_text(encoding="utf-8"))
    # Heights scatter by a quarter of a millimetre and places with them: what a diagnosis makes of that differs by seed.
    assert diagnosis["verdict"] in ("clean", "noise", "named", "cannot_tell", "unknown")
    assert sum(hypothesis["probability"] for hypothesis in diagnosis["hypotheses"]) == pytest.approx(1.0, abs=0.01)
