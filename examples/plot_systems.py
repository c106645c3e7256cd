"""
Five systems, and what their simulators leave out
=================================================

Shows one diagnosis for five kinds of instrument: a load cell, an oven, a linear stage, a thermometer and a filter. The
load cell is real: Pontius's calibration of a load cell, 40 readings in two passes, from the Statistical Reference
Datasets of NIST, which are in the public domain. NIST fits it with a parabola; the simulator here is a straight line.
The other four are recorded here with one effect concealed in each, which no simulator knows.
"""

# %%
from functools import partial

import matplotlib.pyplot as plt
import numpy as np

from probewise.diagnosis import diagnose_system
from probewise.systems import Noise, Simulator

seed = 11
rng = np.random.default_rng(seed)
print(f"seed {seed}")

# %%
# The load cell of Pontius: deflection (in) at loads (lb) in steps of 150,000.

DEFLECTION_IN = """
.11019 .21956 .32949 .43899 .54803 .65694 .76562 .87487 .98292 1.09146 1.20001 1.30822 1.41599 1.52399 1.63194 1.73947
1.84646 1.95392 2.06128 2.16844 .11052 .22018 .32939 .43886 .54798 .65739 .76596 .87474 .98300 1.09150 1.20004 1.30818
1.41613 1.52408 1.63159 1.73965 1.84696 1.95445 2.06177 2.16829
"""
load_cell = Simulator(
    reading="deflection_in",
    unit="in",
    run="pass",
    parameters={"zero_in": (-0.1, 0.1), "in_per_mlb": (0.5, 1.0)},
    noise=Noise(step=1e-5),
    simulate=lambda p, data: p["zero_in"] + p["in_per_mlb"] * data["load_lb"] / 1e6,
)
passes = {
    "load_lb": np.tile(150_000.0 * np.arange(1, 21), 2),
    "pass": np.repeat(["1", "2"], 20),
    "deflection_in": np.array(DEFLECTION_IN.split(), dtype=float),
}

# %%
# Four are recorded here. The temperature of the oven's room varies, which its simulator does not use; the stage has
# backlash; the thermometer lags behind the bath; the photodiode's amplifier saturates at 2.5 V.

N = 120
TIME_S = 10.0 * np.arange(N)
noisy = partial(rng.normal, size=N)

room_c = 20 + 2 * np.sin(TIME_S / 300) + 0.2 * noisy(0, 1)
power_w = np.repeat(rng.uniform(0, 80, N // 10), 10)
oven_recording = {"t_s": TIME_S, "power_w": power_w, "room_c": room_c}
oven_recording["temp_c"] = 22 + 0.9 * power_w + 0.8 * (room_c - 20) + noisy(0, 0.5)
oven = Simulator(
    "temp_c",
    "degC",
    {"start_c": (0, 50), "gain_c_per_w": (0, 3)},
    time="t_s",
    simulate=lambda p, data: p["start_c"] + p["gain_c_per_w"] * data["power_w"],
)

asked_mm = 40 + 40 * np.sin(TIME_S / 110) + 15 * np.sin(TIME_S / 37)
half_mm, there_mm = 0.06, [asked_mm[0]]
for asked in asked_mm[1:]:
    there_mm.append(float(np.clip(there_mm[-1], asked - half_mm, asked + half_mm)))
stage_recording = {"t_s": TIME_S, "asked_mm": asked_mm, "scale_mm": 1.002 * np.array(there_mm) + 0.3 + noisy(0, 0.02)}
stage = Simulator(
    "scale_mm",
    "mm",
    {"zero_mm": (-2, 2), "factor": (0.9, 1.1)},
    time="t_s",
    simulate=lambda p, data: p["zero_mm"] + p["factor"] * data["asked_mm"],
)

bath_c = np.repeat(rng.uniform(10, 60, N // 12), 12)
shown_c = [bath_c[0]]
for bath in bath_c[1:]:
    shown_c.append(bath + (shown_c[-1] - bath) * np.exp(-10 / 8.0))
bath_recording = {"t_s": TIME_S, "bath_c": bath_c, "shown_c": np.array(shown_c) + noisy(0, 0.3)}
thermometer = Simulator(
    "shown_c",
    "degC",
    {"zero_c": (-5, 5), "factor": (0.9, 1.1)},
    time="t_s",
    simulate=lambda p, data: p["zero_c"] + p["factor"] * data["bath_c"],
)

distance_mm = rng.permutation(np.linspace(20, 120, N))
diode_recording = {"distance_mm": distance_mm}
diode_recording["volts"] = np.minimum(0.1 + 2500 / distance_mm**2, 2.5) + noisy(0, 0.02)
photodiode = Simulator(
    "volts",
    "V",
    {"dark_v": (0, 1), "v_mm2": (100, 10_000)},
    simulate=lambda p, data: p["dark_v"] + p["v_mm2"] / data["distance_mm"] ** 2,
)

# %%
# The same call for each. After a colon, a name says on which column or parameter the effect acts, as in
# "sensitivity:room_c". Names that these readings cannot tell apart are given together.

systems = {
    "load cell (NIST, Pontius)": (load_cell, passes, "load_lb", "load (lb)"),
    "oven": (oven, oven_recording, "room_c", "room (degC)"),
    "linear stage": (stage, stage_recording, "t_s", "time (s)"),
    "thermometer": (thermometer, bath_recording, "t_s", "time (s)"),
    "photodiode": (photodiode, diode_recording, "distance_mm", "distance (mm)"),
}
found = {name: diagnose_system(own, table, rng=rng) for name, (own, table, _, _) in systems.items()}
for name, diagnosis in found.items():
    print(f"{name}: {diagnosis.verdict}\n  {diagnosis.reason}")

# %%
# The residuals of each simulator, and those of the repaired one.

fig, axes = plt.subplots(len(systems), 1, figsize=(8, 11))
for ax, (name, (own, table, column, label)) in zip(axes, systems.items(), strict=True):
    repair = found[name].repair
    ax.axhline(0.0, color="0.8", linewidth=1)
    ax.plot(table[column], repair.before.residuals, "o", markersize=3, color="tab:orange", label="as written down")
    ax.plot(table[column], repair.after.residuals, "o", markersize=3, color="tab:blue", label="repaired")
    ax.set_title(f"{name}: {' or '.join(found[name].judged.credible[:2])}", loc="left", fontsize=10)
    ax.set_xlabel(label)
    ax.set_ylabel(f"residual ({own.unit})")
axes[-1].legend(frameon=False, loc="lower right")
fig.tight_layout()
