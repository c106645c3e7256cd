"""A block that slides down a chute against drag until it meets an end stop; its law knows neither."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from probewise.diagnosis import diagnose_system
from probewise.systems import Law, Simulator

SLOPES_DEG = (6.0, 10.0, 14.0, 20.0)
DRAG_PER_M, STOP_M = 0.25, 2.4


def _recorded(rng):
    """35 readings of each slope by SciPy's integrator, in centimetres with a noise of 1 cm."""
    parts = []
    for slope_deg in SLOPES_DEG:
        t = np.append(0.0, 3 / 34 * (np.arange(34) + rng.uniform(0.1, 1.0, 34)))
        pull = 9.81 * np.sin(np.radians(slope_deg))
        x = solve_ivp(
            lambda _, s, pull=pull: [s[1], pull - 0.35 * s[1] - DRAG_PER_M * abs(s[1]) * s[1]],
            (0.0, 3.1), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-11,
        ).y[0]  # fmt: skip
        parts.append((np.full(35, slope_deg), t, 100 * np.minimum(x, STOP_M) + rng.normal(0, 1.0, 35)))
    return dict(zip(("slope_deg", "t_s", "x_cm"), map(np.concatenate, zip(*parts, strict=True)), strict=True))


@pytest.mark.slow
def test_a_drag_is_found_beside_the_stop_behind_which_the_law_alone_slides_on():
    """About the law alone no drag is seen; beside the stop another gravity in one run was named at .98."""
    table = {**_recorded(np.random.default_rng(511)), "go": np.repeat(np.arange(4.0), 35)}
    law = Law(
        {"x": 0.0, "v": 0.0},
        lambda s, p, u: {"x": s["v"], "v": p["g"] * np.sin(np.radians(u["slope_deg"])) - p["damp"] * s["v"]},
        lambda s, p, u: 100 * s["x"],
    )
    prior = {"damp": (0.0, 3.0), "g": ("normal", 9.81, 0.02)}
    chute = Simulator("x_cm", "cm", prior, law=law, time="t_s", run="go", noise={"sd": 1.0})
    found = diagnose_system(chute, table, rng=np.random.default_rng(1))
    likely = [set(h.effects) for h in found.hypotheses if h.probability > 0.05]
    assert likely
    assert all(names in ({"limit:x", "drag:v"}, {"limit:x", "quadratic:v:v"}) for names in likely)  # one law: v > 0
    stop = next(effect for effect in found.effects if effect.name == "limit:x").parameters[0]
    assert abs(stop.mean - STOP_M) < 4 * stop.sd
