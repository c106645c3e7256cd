"""Make the pictures of the README, the front page and the how-to pages, and the sentences beside them, from the demo.

    python docs/pictures.py

Runs `probewise demo` with its default seed, takes four of its figures into `docs/_static`, and its first answers;
runs the investigation of docs/howto/investigate.md, and takes its bars; diagnoses the pendulum of
examples/plot_pendulum.py, and draws a release under the verdict; draws the arm of the shipped geometry, and the
figure of examples/plot_resonance.py.
"""

from __future__ import annotations

import json
import runpy
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from probewise.arm import read_geometry, shipped_geometry_path
from probewise.diagnosis import diagnose_system, generators_of_diagnosis
from probewise.report.diagnosis_figures import before_and_after
from probewise.report.plots import draw_arm_lengths, png
from probewise.report.plots.canvas import figure_of
from probewise.report.words import typeset_numbers
from probewise.systems import read_simulator, read_table_for
from probewise.verbs import DEFAULT_SEED

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
    resonance = runpy.run_path(str(EXAMPLES / "plot_resonance.py"))
    (STATIC / "resonance.png").write_bytes(png(resonance["fig"], dpi=70))


def diagnose_pendulum(folder: Path) -> None:
    """Diagnose the pendulum as the README does; keep the figure of one release under the verdict, and the sentence."""
    swings, law = folder / "swings.csv", EXAMPLES / "simulators" / "pendulum.py"
    subprocess.run([sys.executable, str(EXAMPLES / "plot_pendulum.py"), "--out", str(swings)], check=True)
    rng, *_ = generators_of_diagnosis(DEFAULT_SEED)
    simulator = read_simulator(law)
    found = diagnose_system(simulator, read_table_for(simulator, swings), rng=rng)
    axes = before_and_after(found)
    said = typeset_numbers(found.reason.partition(" (p =")[0])
    figure_of(axes).suptitle(f"Verdict: {said}", x=0.02, ha="left", fontweight="bold", fontsize=9)
    (STATIC / "pendulum.png").write_bytes(png(axes, dpi=130))
    kept = {"verdict": found.verdict, "combination": list(found.combination), "reason": found.reason}
    (STATIC / "pendulum.json").write_text(json.dumps(kept, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def draw_arm() -> None:
    """Draw the arm of the shipped geometry with its lengths."""
    (STATIC / "arm.png").write_bytes(png(draw_arm_lengths(read_geometry(shipped_geometry_path()))))


if __name__ == "__main__":
    main()
