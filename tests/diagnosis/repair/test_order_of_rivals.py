"""The same seed gives the same repaired model in every process."""

import os
import subprocess
import sys

import pytest

_DIAGNOSIS_OF_EQUAL_RIVALS = """
import numpy as np
from probewise.diagnosis import diagnose_system, repaired_of
from probewise.systems import Simulator

rng = np.random.default_rng(3)
x, k = rng.normal(size=(2, 40))
table = {"x": x, "k": k, "y": 1 + x + 0.6 * k + 0.1 * rng.normal(size=40)}
simulator = Simulator(
    "y", "V", dict.fromkeys("abcd", (-5, 5)), simulate=lambda p, u: sum(map(p.get, "abcd")) + u["x"], vectorized=True
)
found = diagnose_system(simulator, table, rng=np.random.default_rng(1))
print(sorted(h.probability for h in found.judged.hypotheses)[-5:])
print(repaired_of(found).to_json())
"""


@pytest.mark.slow
def test_the_repaired_model_is_the_same_whatever_order_python_gives_to_sets():
    """Four parameters of one sum, which may each depend on a column: rivals of equal probability, in random order."""
    one, other = (
        subprocess.run(
            [sys.executable, "-c", _DIAGNOSIS_OF_EQUAL_RIVALS],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    )
    probabilities = [float(text) for text in one.partition("\n")[0].strip("[]").split(",")]
    assert min(probabilities) > 0.15
    assert one == other
