"""
Five systems, and what their simulators leave out
=================================================

Shows one diagnosis for five kinds of instrument: a load cell, an ozone monitor, a linear stage, a thermometer and a
photodiode. The first two are real, from the Statistical Reference Datasets of NIST, which are in the public domain:
Pontius's calibration of a load cell, 40 readings in two passes, and Norris's of an ozone monitor, 36 readings. NIST
fits the first with a parabola and the second with a line; the simulator of both is a line. The other three are recorded
here with one effect concealed in each, which no simulator knows.
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
# The ozone monitor of Norris: what it shows (ppm) beside a standard (ppm), in the order of recording.

SHOWN_AND_STANDARD_PPM = """
.1 .2 338.8 337.4 118.1 118.2 888.0 884.6 9.2 10.1 228.1 226.5 668.5 666.3 998.5 996.3 449.1 448.6 778.9 777.0
559.2 558.2 .3 .4 .1 .6 778.1 775.5 668.8 666.9 339.3 338.0 448.9 447.5 10.8 11.6 557.7 556.0 228.3 228.1 998.0 995.8
888.8 887.6 119.6 120.2 .3 .3 .6 .3 557.6 556.8 339.3 339.1 888.0 887.2 998.5 999.0 778.9 779.0 10.2 11.1 117.6 118.3
228.9 229.2 668.4 669.1 449.2 448.9 .2 .5
"""
ozone_monitor = Simulator(
    "shown_ppm",
    "ppm",
    {"offset_ppm": (-20, 20), "slope": (0.5, 1.5)},
    noise=Noise(step=0.1),
    simulate=lambda p, data: p["offset_ppm"] + p["slope"] * data["standard_ppm"],
)
shown_ppm, standard_ppm = np.array(SHOWN_AND_STANDARD_PPM.split(), dtype=float).reshape(-1, 2).T
comparison = {"standard_ppm": standard_ppm, "shown_ppm": shown_ppm}

# %%
# Three are recorded here. The stage has backlash; the thermometer lags behind the bath; the photodiode's amplifier
# saturates at 2.5 V.

N = 120
TIME_S = 10.0 * np.arange(N)
noisy = partial(rng.normal, size=N)

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
# The same call for each. After a colon, a name says on which parameter or column the effect acts, as in "steps:slope".
# Names that these readings cannot tell apart are given together.

systems = {
    "load cell (NIST, Pontius)": (load_cell, passes, passes["load_lb"], "load (lb)"),
    "ozone monitor (NIST, Norris)": (ozone_monitor, comparison, np.arange(36), "row, in the order of recording"),
    "linear stage": (stage, stage_recording, TIME_S, "time (s)"),
    "thermometer": (thermometer, bath_recording, TIME_S, "time (s)"),
    "photodiode": (photodiode, diode_recording, distance_mm, "distance (mm)"),
}
found = {name: diagnose_system(own, table, rng=rng) for name, (own, table, _, _) in systems.items()}
for name, diagnosis in found.items():
    print(f"{name}: {diagnosis.verdict}\n  {diagnosis.reason}")

# %%
# The residuals of each simulator, and those of the repaired one.

fig, axes = plt.subplots(len(systems), 1, figsize=(8, 11))
for ax, (name, (own, _, covariate, label)) in zip(axes, systems.items(), strict=True):
    ax.axhline(0.0, color="0.8", linewidth=1)
    ax.plot(covariate, found[name].before.residuals, "o", markersize=3, color="tab:orange", label="as written down")
    ax.plot(covariate, found[name].after.residuals, "o", markersize=3, color="tab:blue", label="repaired")
    ax.set_title(f"{name}: {' or '.join(found[name].credible[:2])}", loc="left", fontsize=10)
    ax.set_xlabel(label)
    ax.set_ylabel(f"residual ({own.unit})")
axes[-1].legend(frameon=False, loc="lower right")
fig.tight_layout()
