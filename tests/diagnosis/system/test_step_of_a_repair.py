"""The step of the integration follows the repaired law, whose residuals are far smaller than those of the law alone."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from probewise.diagnosis import diagnose_system
from probewise.systems import Law, Simulator

TIMES = np.linspace(0.0, 8.0, 41)  # about five rows a period
SD = 1e-4


@pytest.fixture(scope="module")
def swings():
    """A spring of stiffness 36 that hardens with 20 x^3, by scipy's own integrator."""
    noise = np.random.default_rng(3)
    exact = solve_ivp(
        lambda t, s: [s[1], -36.0 * s[0] - 20.0 * s[0] ** 3 - 0.1 * s[1]],
        (0.0, TIMES[-1]),
        [1.0, 0.0],
        t_eval=TIMES,
        rtol=1e-10,
        atol=1e-12,
    )
    return exact.y[0] + noise.normal(0.0, SD, len(TIMES))


@pytest.mark.slow
def test_a_law_that_needs_finer_steps_once_it_is_repaired_gets_them(swings):
    spring = Simulator(
        "x_m",
        "m",
        {"k": ("log", 10, 100), "c": (0, 1)},
        law=Law(
            {"x": 1.0, "v": 0.0},
            lambda s, p, u: {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"]},
        ),
        time="t_s",
    )
    stages = []

    def told(stage, *numbers, **note):
        stages.append(stage)

    found = diagnose_system(spring, {"t_s": TIMES, "x_m": swings}, rng=np.random.default_rng(1), progress=told)
    assert any("once more" in stage for stage in stages)
    assert found.verdict == "named"
    assert found.combination == ("cubic:v:x",)
    cubic = next(effect for effect in found.effects if effect.name == "cubic:v:x")
    a = cubic.parameters[0]
    assert a.mean == pytest.approx(20.0, abs=4 * a.sd)
    assert found.improvement.rms_after < 2 * SD
