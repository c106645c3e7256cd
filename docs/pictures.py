"""Make the pictures of the README, the front page and the how-to pages, and the sentences beside them, from the demo.

    python docs/pictures.py

Runs `probewise demo` with its default seed, takes four of its figures into `docs/_static`, and its first answers;
runs the investigation of docs/howto/investigate.md, and takes its bars; draws the arm of the shipped geometry.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from probewise.arm import read_geometry, shipped_geometry_path
from probewise.report.plots import png
from probewise.report.plots.apparatus import draw_arm_lengths

STATIC = Path(__file__).parent / "_static"
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
    draw_arm()


def draw_arm() -> None:
    """Draw the arm of the shipped geometry with its lengths."""
    (STATIC / "arm.png").write_bytes(png(draw_arm_lengths(read_geometry(shipped_geometry_path()))))


if __name__ == "__main__":
    main()
