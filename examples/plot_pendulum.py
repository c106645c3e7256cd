"""
My pendulum does not swing as it should
=======================================

Shows how a simulator of one's own is diagnosed. The pendulum here is slowed down by the air, by the square of its
speed; the simulator in ``simulators/pendulum.py`` knows only friction in proportion to the speed. The recording is
made by SciPy's integrator, which shares no code with what explains it. With ``--out swings.csv`` it is only written,
for the command line.
"""

# %%
import argparse
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

from probewise.diagnosis import diagnose_system
from probewise.systems import Law, RunTable, Simulator, run_table_csv

seed = 4
print(f"seed {seed}")

# %%
# The recording: three releases, from 60, -35 and 50 degrees; the angle 20 times per second, with noise of 0.1 degrees.

LENGTH_M, FRICTION_PER_S, DRAG_PER_RAD = 0.9, 0.05, 0.08
TIME_S = np.arange(0.0, 4.0, 0.05)


def swing(start_deg: float) -> np.ndarray:
    def rates(t, state):
        phi, omega = state
        slowed = FRICTION_PER_S * omega + DRAG_PER_RAD * abs(omega) * omega
        return [omega, -9.81 / LENGTH_M * np.sin(phi) - slowed]

    start = [np.radians(start_deg), 0.0]
    return np.degrees(solve_ivp(rates, (0, TIME_S[-1]), start, t_eval=TIME_S, rtol=1e-9, atol=1e-9).y[0])


rng = np.random.default_rng(seed)
releases = [60.0, -35.0, 50.0]
swings = {
    "release": np.repeat(["A", "B", "C"], len(TIME_S)),
    "t_s": np.tile(TIME_S, len(releases)),
    "room_c": np.repeat([21.3, 21.6, 21.9], len(TIME_S)),
    "angle_deg": np.concatenate([swing(start) for start in releases]) + 0.1 * rng.standard_normal(3 * len(TIME_S)),
}

parser = argparse.ArgumentParser()
parser.add_argument("--out", type=Path)
out = parser.parse_args(sys.argv[1:] if sys.argv[0].endswith("plot_pendulum.py") else []).out
if out is not None:
    out.write_text(run_table_csv(RunTable(swings, "t_s", "release")), encoding="utf-8")
    sys.exit()  # the rest shows what the command line does with this file

# %%
# The simulator: a law of motion, here from Python; ``simulators/pendulum.py`` says the same in a file.


def rates(s, p, u):
    return {"phi": s["omega"], "omega": -9.81 / p["length_m"] * np.sin(s["phi"]) - p["friction_per_s"] * s["omega"]}


pendulum = Simulator(
    reading="angle_deg",
    unit="deg",
    time="t_s",
    run="release",
    parameters={"length_m": (0.2, 2.0), "friction_per_s": (0.0, 1.0), "start_rad": ("normal", 0.0, 1.0)},
    per_run=["start_rad"],
    noise={"sd": 0.1},
    law=Law({"phi": "start_rad", "omega": 0.0}, rates, lambda s, p, u: np.degrees(s["phi"])),
)

# %%
diagnosis = diagnose_system(pendulum, swings, rng=rng)
print(diagnosis.summary())

# %%
fig, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True)
first = swings["release"] == "A"
axes[0].plot(TIME_S, swings["angle_deg"][first], "k.", markersize=3, label="recorded")
axes[0].plot(TIME_S, diagnosis.after.readings[first], color="tab:blue", label="repaired")
axes[0].set_ylabel("angle (deg)")
axes[1].plot(TIME_S, diagnosis.before.residuals[first], ".", color="tab:orange", label="as written down")
axes[1].plot(TIME_S, diagnosis.after.residuals[first], ".", color="tab:blue", label="repaired")
axes[1].set_ylabel("residual (deg)")
axes[1].set_xlabel("time since the first release (s)")
for ax in axes:
    ax.legend(frameon=False, loc="upper right")
fig.tight_layout()
