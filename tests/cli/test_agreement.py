"""A run that doubts its sensor and the diagnosis of its journal: the first name of each is credible to the other.

Where nothing is concealed they agree in tests/arm/test_printer_chain.py.
"""

import json

import pytest

from probewise.cli import main

ARM = """
import numpy as np
from probewise.recordings import Disc
from probewise.world import Blob, saturation, World, gaussian_spot

def connect():
    return Arm()

class Arm:
    n = 0

    def __init__(self):
        spot = gaussian_spot([Blob(1.0, (0.0, 1.5), (4.0, 2.5))])
        self.world = World(spot, black=10.0, white=60.0, noise_sd=0.6, concealed=(saturation(40.0),))

    def measure(self, pose):
        self.n += 1
        rng = np.random.default_rng([5150, self.n])
        value = self.world.read(Disc((600.0, 260.0), 120.0), pose.x_mm, pose.y_mm, time_s=8.0 * self.n, rng=rng)
        return {"value": value, "time_s": 8.0 * self.n}
"""


@pytest.mark.single_case
@pytest.mark.slow
@pytest.mark.usefixtures("quick_frames")
def test_a_run_and_the_diagnosis_of_its_journal_agree(sensor_file, tmp_path):
    name, arm, run, found = "saturation", tmp_path / "arm.py", tmp_path / "run", tmp_path / "found"
    arm.write_text(ARM)
    words = ("explore", "--sensor", sensor_file, "--arm", arm, "--out", run, "--seed", 5150, "--quiet")
    assert main([str(word) for word in words]) == 0
    assert main([str(word) for word in ("diagnose", run / "journal.jsonl", "--out", found, "--quiet")]) == 0
    said = json.loads((run / "result.json").read_text())["left_out"]
    diagnosed = json.loads((found / "diagnosis.json").read_text())
    assert said["credible_set"][0] == name
    assert name in diagnosed["credible_set"]
    assert set(diagnosed["hypotheses"][0]["effects"]) <= set(said["credible_set"])
