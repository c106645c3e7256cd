"""Kinds of dynamical systems, with a law in continuous time."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.proof.systems.designs import irregular_times, random_steps, random_waves
from probewise.proof.systems.kind import Columns, IrrelevantColumn, Law, Prior, SystemKind

Rng = np.random.Generator


def _tank_design(rng: Rng, n: int, regime: float) -> tuple[FloatArray, Columns]:
    return irregular_times(rng, n, 5.0), {
        "valve_v": random_steps(rng, n, np.array([0.0, 1.0, 2.0, 3.0, 4.0]) * regime, 9)
    }


TANK = SystemKind(
    name="tank",
    reading="level_cm",
    unit="cm",
    text="""# Water runs into a tank through a valve and out at the bottom, in proportion to the level.
import math

reading, unit = "level_cm", "cm"
time, run = "t_s", "run"
parameters = {"cm_per_v": ("log", 1, 50), "tau_s": ("log", 5, 500), "start_cm": (0, 40)}
per_run = ["start_cm"]
controls = ["valve_v"]
{noise}

def simulate(p, data):
    t, valve, run = data["t_s"], data["valve_v"], data["run"]
    out = []
    for k in range(len(t)):
        if k == 0 or run[k] != run[k - 1]:
            level = p["start_cm"][k]
        else:
            stays = math.exp(-(t[k] - t[k - 1]) / p["tau_s"])
            level = stays * level + (1 - stays) * p["cm_per_v"] * valve[k - 1]
        out.append(level)
    return out
""",
    priors={"cm_per_v": Prior("log", 1, 50), "tau_s": Prior("log", 5, 500), "start_cm": Prior("uniform", 0, 40)},
    per_run=("start_cm",),
    draw=lambda rng: {"cm_per_v": float(rng.uniform(5, 10)), "tau_s": float(rng.uniform(35, 90))},
    draw_run=lambda rng: {"start_cm": float(rng.uniform(5, 30))},
    design=_tank_design,
    decimals={"t_s": 2, "valve_v": 2},
    drives=("valve_v",),
    sd=0.04,
    law=Law(
        {"level": "start_cm"},
        lambda s, p, u: {"level": (p["cm_per_v"] * u["valve_v"] - s["level"]) / p["tau_s"]},
        lambda s, p, u: s["level"],
    ),
    logged=(
        IrrelevantColumn("water_c", 16, 1.0, 0.04, 2, 6.0),
        IrrelevantColumn("hall_c", 20, 0.8, 0.04, 2),
        IrrelevantColumn("supply_v", 12, 0.05, 0.01, 3),
    ),
    n_runs=4,
    defines_states=False,
)


def _filter_design(rng: Rng, n: int, regime: float) -> tuple[FloatArray, Columns]:
    return irregular_times(rng, n, 0.002), {
        "in_v": random_steps(rng, n, np.array([-2.0, -1.0, 0.5, 1.5, 3.0]) * regime, 10)
    }


FILTER = SystemKind(
    name="RC filter of two stages",
    reading="out_v",
    unit="V",
    run="burst",
    text="""# Two RC stages behind each other, with a buffer between them.
reading, unit = "out_v", "V"
time, run = "t_s", "burst"
parameters = {"gain": ("normal", 1.0, 0.1), "tau1_s": ("log", 0.0005, 0.008), "tau2_s": ("log", 0.008, 0.1)}
{noise}
states = {"first": 0.0, "second": 0.0}

def rates(s, p, u):
    charging = (p["gain"] * u["in_v"] - s["first"]) / p["tau1_s"]
    return {"first": charging, "second": (s["first"] - s["second"]) / p["tau2_s"]}

def observe(s, p, u):
    return s["second"]
""",
    priors={
        "gain": Prior("normal", 1.0, 0.1),
        # Swapped, the two stages do the same: their owner knows which is the fast one.
        "tau1_s": Prior("log", 0.0005, 0.008),
        "tau2_s": Prior("log", 0.008, 0.1),
    },
    draw=lambda rng: {
        "gain": float(rng.normal(1.0, 0.03)),
        "tau1_s": float(rng.uniform(0.003, 0.006)),
        "tau2_s": float(rng.uniform(0.010, 0.018)),
    },
    design=_filter_design,
    decimals={"t_s": 6, "in_v": 3},
    drives=("in_v",),
    sd=0.004,
    law=Law(
        {"first": 0.0, "second": 0.0},
        lambda s, p, u: {
            "first": (p["gain"] * u["in_v"] - s["first"]) / p["tau1_s"],
            "second": (s["first"] - s["second"]) / p["tau2_s"],
        },
        lambda s, p, u: s["second"],
    ),
    logged=(IrrelevantColumn("board_c", 30, 1.5, 0.04, 2, 8.0), IrrelevantColumn("rail_v", 12.0, 0.02, 0.004, 3)),
    n_runs=4,
    reading_decimals=5,
)


def _oscillator_design(rng: Rng, n: int, regime: float) -> tuple[FloatArray, Columns]:
    t = irregular_times(rng, n, 0.05)
    return t, {"force_n": random_waves(rng, t, 0.8 * regime, 2.5)}


OSCILLATOR = SystemKind(
    name="mass on a spring",
    reading="x_mm",
    unit="mm",
    text="""# A cart of 0.8 kg on a spring with a damper, pushed by a shaker.
reading, unit = "x_mm", "mm"
time, run = "t_s", "run"
parameters = {"k_n_m": ("log", 5, 500), "c_kg_s": ("log", 0.05, 5), "x0_m": ("normal", 0, 0.03)}
per_run = ["x0_m"]
{noise}
states = {"x": "x0_m", "v": 0.0}
hold = "linear"

def rates(s, p, u):
    return {"x": s["v"], "v": (u["force_n"] - p["k_n_m"] * s["x"] - p["c_kg_s"] * s["v"]) / 0.8}

def observe(s, p, u):
    return 1000 * s["x"]
""",
    priors={"k_n_m": Prior("log", 5, 500), "c_kg_s": Prior("log", 0.05, 5), "x0_m": Prior("normal", 0, 0.03)},
    per_run=("x0_m",),
    draw=lambda rng: {"k_n_m": float(rng.uniform(25, 70)), "c_kg_s": float(rng.uniform(0.4, 1.2))},
    draw_run=lambda rng: {"x0_m": float(rng.normal(0, 0.03))},
    design=_oscillator_design,
    decimals={"t_s": 4, "force_n": 4},
    drives=("force_n",),
    sd=0.15,
    law=Law(
        {"x": "x0_m", "v": 0.0},
        lambda s, p, u: {"x": s["v"], "v": (u["force_n"] - p["k_n_m"] * s["x"] - p["c_kg_s"] * s["v"]) / 0.8},
        lambda s, p, u: 1000 * s["x"],
        linear=True,
    ),
    logged=(IrrelevantColumn("air_c", 22, 0.8, 0.03, 2, 5.0), IrrelevantColumn("mains_v", 230, 1.0, 0.3, 1)),
    n_runs=4,
    reading_decimals=3,
)


def _servo_design(rng: Rng, n: int, regime: float) -> tuple[FloatArray, Columns]:
    return irregular_times(rng, n, 0.03), {
        "volts": random_steps(rng, n, np.array([-6.0, -3.0, 0.0, 2.0, 5.0]) * regime, 9)
    }


SERVO = SystemKind(
    name="DC motor",
    reading="angle_deg",
    unit="deg",
    text="""# A DC motor with an encoder.
reading, unit = "angle_deg", "deg"
time, run = "t_s", "run"
parameters = {"deg_s_v": ("log", 5, 500), "tau_s": ("log", 0.01, 1)}
controls = ["volts"]
{noise}
states = {"angle": 0.0, "speed": 0.0}

def rates(s, p, u):
    return {"angle": s["speed"], "speed": (p["deg_s_v"] * u["volts"] - s["speed"]) / p["tau_s"]}
""",
    priors={"deg_s_v": Prior("log", 5, 500), "tau_s": Prior("log", 0.01, 1)},
    draw=lambda rng: {"deg_s_v": float(rng.uniform(30, 70)), "tau_s": float(rng.uniform(0.08, 0.2))},
    design=_servo_design,
    decimals={"t_s": 4, "volts": 2},
    drives=("volts",),
    sd=0.8,
    law=Law(
        {"angle": 0.0, "speed": 0.0},
        lambda s, p, u: {"angle": s["speed"], "speed": (p["deg_s_v"] * u["volts"] - s["speed"]) / p["tau_s"]},
        lambda s, p, u: s["angle"],
    ),
    logged=(
        IrrelevantColumn("case_c", 33, 2.5, 0.05, 2, 10.0),
        IrrelevantColumn("bus_v", 9.0, 0.05, 0.01, 3),
        IrrelevantColumn("load_g", 120, 6, 0.5, 1),
    ),
    n_runs=5,
    reading_decimals=3,
)


def _reactor_design(rng: Rng, n: int, regime: float) -> tuple[FloatArray, Columns]:
    return irregular_times(rng, n, 9.0 * (1.4 if regime > 1 else 1.0)), {}


REACTOR = SystemKind(
    name="two reactions in a row",
    reading="absorbance",
    unit="AU",
    run="vial",
    text="""# A turns into B, B into C; B is seen in the spectrometer.
reading, unit = "absorbance", "AU"
time, run = "t_s", "vial"
parameters = {"k1_per_s": ("log", 0.0005, 0.5), "k2_per_s": ("log", 0.0005, 0.5), "dose": (0, 3)}
per_run = ["dose"]
{noise}
states = {"a": "dose", "b": 0.0}

def rates(s, p, u):
    made = p["k1_per_s"] * s["a"]
    return {"a": -made, "b": made - p["k2_per_s"] * s["b"]}

def observe(s, p, u):
    return s["b"]
""",
    priors={
        "k1_per_s": Prior("log", 0.0005, 0.5),
        "k2_per_s": Prior("log", 0.0005, 0.5),
        "dose": Prior("uniform", 0, 3),
    },
    per_run=("dose",),
    draw=lambda rng: {"k1_per_s": float(rng.uniform(0.018, 0.03)), "k2_per_s": float(rng.uniform(0.004, 0.008))},
    draw_run=lambda rng: {"dose": float(rng.uniform(0.7, 2.0))},
    design=_reactor_design,
    decimals={"t_s": 1},
    drives=(),
    sd=0.003,
    law=Law(
        {"a": "dose", "b": 0.0},
        lambda s, p, u: {"a": -p["k1_per_s"] * s["a"], "b": p["k1_per_s"] * s["a"] - p["k2_per_s"] * s["b"]},
        lambda s, p, u: s["b"],
    ),
    restarts_time=True,
    logged=(
        IrrelevantColumn("jacket_c", 30, 0.7, 0.04, 2, 4.0),
        IrrelevantColumn("stir_rpm", 500, 12, 4, 0),
        IrrelevantColumn("lamp_a", 0.8, 0.01, 0.001, 4),
    ),
    n_runs=5,
    reading_decimals=5,
)


def _predator_design(rng: Rng, n: int, regime: float) -> tuple[FloatArray, Columns]:
    return irregular_times(rng, n, 0.5), {"feed": random_steps(rng, n, np.array([0.6, 1.0, 1.4]) * regime, 15)}


PREDATOR = SystemKind(
    name="predator and prey",
    reading="prey_per_ml",
    unit="1/ml",
    run="flask",
    time="t_d",
    time_unit="day",
    text="""# Paramecia are fed, and eaten by didinia.
reading, unit = "prey_per_ml", "1/ml"
time, time_unit, run = "t_d", "day", "flask"
parameters = {"grow_per_d": ("log", 0.05, 5), "eat": ("log", 0.005, 0.5), "die_per_d": ("log", 0.05, 5)}
{noise}
states = {"prey": 20.0, "hunters": 5.0}

def rates(s, p, u):
    caught = p["eat"] * s["prey"] * s["hunters"]
    born = p["grow_per_d"] * u["feed"] * s["prey"]
    return {"prey": born - caught, "hunters": 0.3 * caught - p["die_per_d"] * s["hunters"]}
""",
    priors={"grow_per_d": Prior("log", 0.05, 5), "eat": Prior("log", 0.005, 0.5), "die_per_d": Prior("log", 0.05, 5)},
    draw=lambda rng: {
        "grow_per_d": float(rng.uniform(0.5, 0.9)),
        "eat": float(rng.uniform(0.06, 0.1)),
        "die_per_d": float(rng.uniform(0.4, 0.7)),
    },
    design=_predator_design,
    decimals={"t_d": 3, "feed": 2},
    drives=("feed",),
    sd=0.3,
    law=Law(
        {"prey": 20.0, "hunters": 5.0},
        lambda s, p, u: {
            "prey": p["grow_per_d"] * u["feed"] * s["prey"] - p["eat"] * s["prey"] * s["hunters"],
            "hunters": 0.3 * p["eat"] * s["prey"] * s["hunters"] - p["die_per_d"] * s["hunters"],
        },
        lambda s, p, u: s["prey"],
    ),
    logged=(
        IrrelevantColumn("room_c", 21, 0.8, 0.04, 2, 5.0),
        IrrelevantColumn("oxygen_mg_l", 7.5, 0.3, 0.05, 2),
        IrrelevantColumn("light_lx", 400, 15, 4, 0),
    ),
    n_runs=4,
    reading_decimals=3,
)

LAWS = (TANK, FILTER, OSCILLATOR, SERVO, REACTOR, PREDATOR)
