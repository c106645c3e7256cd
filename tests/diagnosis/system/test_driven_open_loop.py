"""A strongly driven law is off by thousands of noise sds without what it leaves out."""

import math

import numpy as np
import pytest

from probewise.diagnosis import diagnose_system
from probewise.systems import Law, Simulator

MASS, VISCOUS, DRY, OFFSET = 95.0, 200.0, 20.0, -3.0  # kg, N s/m, N, N
GAP, SD, N_ROWS, FINE = 0.05, 1e-4, 200, 1e-4  # s, m, rows, s


@pytest.fixture(scope="module")
def positioning():
    """A drive with dry friction and an offset of its force, moved in a loop; small explicit steps."""
    q = v = 0.0
    time, force, position = GAP * np.arange(N_ROWS), [], []
    for t in time:
        wanted = 0.12 * math.sin(2 * math.pi * t / 5) + 0.05 * math.sin(2 * math.pi * t / 1.9)
        push = 1500.0 * (wanted - q) - 100.0 * v
        force.append(push)
        position.append(q)
        for _ in range(round(GAP / FINE)):
            v += FINE * (push - VISCOUS * v - DRY * math.tanh(v / 1e-5) - OFFSET) / MASS
            q += FINE * v
    noise = np.random.default_rng(4).normal(0.0, SD, N_ROWS)
    return {"t_s": time, "force_n": np.array(force), "q_m": np.array(position) + noise}


@pytest.mark.single_case
@pytest.mark.slow
def test_friction_and_an_offset_are_found_in_a_positioning_system_that_runs_away_without_them(positioning):
    bare = Simulator(
        "q_m",
        "m",
        {"mass": ("log", 20, 500), "viscous": ("log", 20, 1000)},
        law=Law(
            {"q": 0.0, "v": 0.0},
            lambda s, p, u: {"q": s["v"], "v": (u["force_n"] - p["viscous"] * s["v"]) / p["mass"]},
        ),
        time="t_s",
    )
    found = diagnose_system(bare, positioning, rng=np.random.default_rng(1))
    # A constant term of the rate and an offset of the force are the same thing.
    named = {effect.name: effect.parameters[0] for effect in found.effects}
    leading = {name for hypothesis in found.hypotheses[:2] for name in hypothesis.effects}
    assert leading == {"friction:v", "forcing:v", "input_offset:force_n"}
    friction, offset = named["friction:v"], named["input_offset:force_n"]
    assert friction.mean == pytest.approx(DRY / MASS, abs=4 * friction.sd)
    assert offset.mean == pytest.approx(-OFFSET, abs=4 * offset.sd)
    assert found.improvement.rms_before > 100 * SD
    assert found.improvement.rms_after < 1.2 * SD
