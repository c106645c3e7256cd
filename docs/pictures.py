"""Make the pictures of the README and of the front page, and the sentences that stand with them, from the demo.

    python docs/pictures.py

Runs `probewise demo` with its default seed, takes two of its figures into `docs/_static`, and its first answers;
draws the arm of the shipped geometry.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from probewise.arm import read_geometry, shipped_geometry
from probewise.report.plots import png
from probewise.report.plots.apparatus import arm_lengths

STATIC = Path(__file__).parent / "_static"
TAKEN = {
    "equal_readings.png": "playing_field.png",
    "before_after.png": "mismatch.png",
    "answers.json": "pictures.json",
}


def main() -> None:
    """Run the demo and keep what is shown."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "demo"
        subprocess.run([sys.executable, "-m", "probewise", "demo", "--out", str(out)], check=True)
        for name, kept in TAKEN.items():
            shutil.copyfile(out / name, STATIC / kept)
    draw_arm()


def draw_arm() -> None:
    """Draw the arm of the shipped geometry with its lengths."""
    (STATIC / "arm.png").write_bytes(png(arm_lengths(read_geometry(shipped_geometry()))))


if __name__ == "__main__":
    main()
