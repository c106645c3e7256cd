"""Make the pictures of the README, the front page and the how-to pages, and the sentences beside them, from the demo.

    python docs/pictures.py

Runs `probewise demo` with its default seed, takes four of its figures into `docs/_static`, and its first answers;
runs the investigation of docs/howto/investigate.md, and takes its bars; diagnoses the pendulum of
examples/plot_pendulum.py, and takes a figure and the sentence; draws the arm of the shipped geometry.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from probewise.arm import read_geometry, shipped_geometry_path
from probewise.report.plots import png
from probewise.report.plots.apparatus import draw_arm_lengths

STATIC = Path(__file__).parent / "_static"
EXAMPLES = Path(__file__).parents[1] / "examples"
TAKEN = {
    "equal_readings.png": "playing_field.png",
    "before_after.png": "mismatch.png",
    "doubt.png": "doubt.png",
    "belief.png": "belief.png",
    "answers.json": "pictures.json",
}
INVESTIGATION = ["investigate", "--arm", "simulated", "--plan", "paper", "--truth", "backlash:0.5", "--seed", "4"]


def main() -> None:
    """Run demo and investigation, and keep what is shown."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "demo"
        subprocess.run([sys.executable, "-m", "probewise", "demo", "--out", str(out)], check=True)
        for name, kept in TAKEN.items():
            shutil.copyfile(out / name, STATIC / kept)
        out = Path(folder) / "investigation"
        subprocess.run([sys.executable, "-m", "probewise", *INVESTIGATION, "--out", str(out)], check=True)
        shutil.copyfile(out / "by_round.png", STATIC / "by_round.png")
        diagnose_pendulum(Path(folder))
    draw_arm()


def diagnose_pendulum(folder: Path) -> None:
    """Diagnose the pendulum as the README does; keep the figure of one release, and the sentence."""
    swings, out = folder / "swings.csv", folder / "pendulum"
    subprocess.run([sys.executable, str(EXAMPLES / "plot_pendulum.py"), "--out", str(swings)], check=True)
    by = ["--simulator", str(EXAMPLES / "simulators" / "pendulum.py"), "--out", str(out)]
    subprocess.run([sys.executable, "-m", "probewise", "diagnose", str(swings), *by], check=True)
    shutil.copyfile(out / "before_after.svg", STATIC / "pendulum.svg")
    found = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    kept = {name: found[name] for name in ("verdict", "combination", "reason")}
    (STATIC / "pendulum.json").write_text(json.dumps(kept, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def draw_arm() -> None:
    """Draw the arm of the shipped geometry with its lengths."""
    (STATIC / "arm.png").write_bytes(png(draw_arm_lengths(read_geometry(shipped_geometry_path()))))


if __name__ == "__main__":
    main()
