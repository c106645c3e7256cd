"""What does a diagnosis say of recordings of the emulated LEGO arm, where nothing is concealed?

    python benchmarks/arm_clean.py --seeds 10 --out docs/results/arm_clean.json

The paper's plan, carried out by the driver on the emulator, with the play of the shipped geometry and without any. The
plan's origin lies elsewhere for each seed, so that counts round otherwise. What is left out is then only what the arm
itself adds: motors count whole degrees.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
from functools import partial
from pathlib import Path

import numpy as np

from probewise.arm import carry_out, read_geometry, recording_of_readings, shipped_geometry_path
from probewise.cli._bench import ArmName, open_arm, plan_for_lego_arm
from probewise.diagnosis import diagnose
from probewise.proof.campaign import estimated_share
from probewise.recordings import Recording, paper_plan, read_recording, write_recording


def recording(file: Path, folder: Path, *, seed: int) -> tuple[Recording, np.ndarray]:
    """Record the plan; return what is on file, and place told minus true place and height minus 14 mm, (n, 3)."""
    geometry = read_geometry(file)
    plan = plan_for_lego_arm(paper_plan(), geometry)
    origin_mm = (524 + 0.37 * seed, 260 + 0.61 * seed)
    arm, bench = open_arm(ArmName("emulator"), geometry, file, seed=seed)
    stands, read = [], arm.read_here
    arm.read_here = lambda: (stands.append(bench.stand()), read())[1]  # type: ignore[method-assign,misc]
    with arm:
        readings = list(
            carry_out(arm, plan, origin_mm=origin_mm, ask=partial(bench.carry_out_request, plan.patterns, origin_mm))
        )
    found = recording_of_readings(plan, readings)
    off = np.array(
        [
            (x - stand.x_mm + origin_mm[0], y - stand.y_mm + origin_mm[1], stand.height_mm - geometry.read_height_mm)
            for x, y, stand in zip(found.plan.x_mm, found.plan.y_mm, stands, strict=True)
        ]
    )
    path = folder / "recording.csv"
    write_recording(found, path)
    return read_recording(path), off


def share(hits: list[bool]) -> list[float]:
    """Give a share with its 95 % Wilson interval."""
    found = estimated_share(hits)
    return [found.value, round(found.low, 3), round(found.high, 3)]


def main() -> None:
    """Record, diagnose and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    document: dict[str, object] = {"seeds": given.seeds}
    text = shipped_geometry_path().read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for label, play in (("with play", None), ("without play", "0")):
            file = folder / "arm.toml"
            file.write_text(text if play is None else re.sub(r"play_deg = [\d.]+", f"play_deg = {play}", text))
            said, offs = [], []
            for seed in range(1, given.seeds + 1):
                found, off = recording(file, folder, seed=seed)
                diagnosis = diagnose(found, rng=np.random.default_rng(seed))
                said.append({"verdict": diagnosis.verdict, "of": list(diagnosis.combination), "p": diagnosis.p_value})
                offs.append(off)
                print(label, seed, said[-1], flush=True)
            off = np.concatenate(offs)
            verdicts = [each["verdict"] for each in said]
            document[label] = {
                "clean": share([verdict == "clean" for verdict in verdicts]),
                "clean or noise": share([verdict in ("clean", "noise") for verdict in verdicts]),
                "place told minus true, mean x, y (mm)": off[:, :2].mean(axis=0).round(3).tolist(),
                "place told minus true, sd x, y (mm)": off[:, :2].std(axis=0).round(3).tolist(),
                "height minus that asked, sd (mm)": float(off[:, 2].std().round(3)),
                "diagnoses": said,
            }
    given.out.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
