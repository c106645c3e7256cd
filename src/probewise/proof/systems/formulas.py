"""Kinds of static systems, whose reading depends only on the row's columns."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.proof.systems.designs import irregular_times, random_steps, sweep_there_and_back
from probewise.proof.systems.kind import Columns, IrrelevantColumn, Prior, SystemKind

Rng = np.random.Generator


def _bath_design(rng: Rng, n: int, regime: float) -> tuple[FloatArray, Columns]:
    t = irregular_times(rng, n, 4.0)
    return t, {"bath_c": rng.uniform(35, 55) * regime + 0.2 * np.sin(t / rng.uniform(9, 20))}


BATH = SystemKind(
    name="thermometer in a bath",
    reading="probe_c",
    unit="degC",
    run="dip",
    text="""# A thermometer is dipped from room temperature into a warm bath.
import numpy as np

reading, unit = "probe_c", "degC"
time, run = "t_s", "dip"
parameters = {"tau_s": ("log", 3, 300), "start_c": ("normal", 21, 3), "scale": ("normal", 1.0, 0.1)}
per_run = ["start_c"]
{noise}

def simulate(p, data):
    gone = np.exp(-data["t_s"] / p["tau_s"])
    return p["scale"] * data["bath_c"] * (1 - gone) + p["start_c"] * gone
""",
    priors={"tau_s": Prior("log", 3, 300), "start_c": Prior("normal", 21, 3), "scale": Prior("normal", 1.0, 0.1)},
    per_run=("start_c",),
    draw=lambda rng: {"tau_s": float(rng.uniform(18, 45)), "scale": float(rng.normal(1.0, 0.01))},
    draw_run=lambda rng: {"start_c": float(rng.normal(21, 2))},
    design=_bath_design,
    decimals={"t_s": 2, "bath_c": 2},
    drives=("bath_c",),
    sd=0.05,
    formula=lambda p, u: (
        p["scale"] * u["bath_c"] * (1 - np.exp(-u["t_s"] / p["tau_s"])) + p["start_c"] * np.exp(-u["t_s"] / p["tau_s"])
    ),
    restarts_time=True,
    logged=(
        IrrelevantColumn("room_c", 21.5, 0.8, 0.03, 2, 4.0),
        IrrelevantColumn("stir_rpm", 300, 15, 3, 0),
        IrrelevantColumn("rh_pct", 45, 3, 0.3, 1),
    ),
    n_runs=5,
)


def _cup_design(rng: Rng, n: int, regime: float) -> tuple[FloatArray, Columns]:
    t = irregular_times(rng, n, 1.3)
    return t, {"room_c": rng.uniform(18, 24) * (1.25 if regime > 1 else 1.0) + 0.5 * np.sin(t / rng.uniform(10, 25))}


CUP = SystemKind(
    name="cooling cup",
    reading="tea_c",
    unit="degC",
    run="cup",
    time="t_min",
    time_unit="min",
    text="""# Tea cools in a cup, one cup after the other.
from numpy import exp

reading, unit = "tea_c", "degC"
time, time_unit = "t_min", "min"
run = "cup"
parameters = {"tau_min": ("log", 5, 300), "hot_c": ("normal", 75, 15)}
per_run = ["hot_c"]
controls = ["room_c"]
{noise}

def simulate(p, data):
    return data["room_c"] + (p["hot_c"] - data["room_c"]) * exp(-data["t_min"] / p["tau_min"])
""",
    priors={"tau_min": Prior("log", 5, 300), "hot_c": Prior("normal", 75, 15)},
    per_run=("hot_c",),
    draw=lambda rng: {"tau_min": float(rng.uniform(25, 60))},
    draw_run=lambda rng: {"hot_c": float(rng.normal(76, 6))},
    design=_cup_design,
    decimals={"t_min": 2, "room_c": 2},
    drives=("room_c",),
    sd=0.12,
    formula=lambda p, u: u["room_c"] + (p["hot_c"] - u["room_c"]) * np.exp(-u["t_min"] / p["tau_min"]),
    restarts_time=True,
    logged=(
        IrrelevantColumn("rh_pct", 50, 4, 0.4, 1),
        IrrelevantColumn("fill_ml", 240, 6, 0.4, 1),
        IrrelevantColumn("baro_hpa", 1012, 2, 0.1, 1),
    ),
    n_runs=5,
    reading_decimals=3,
)


def _photodiode_design(rng: Rng, n: int, regime: float) -> tuple[FloatArray, Columns]:
    far = 90.0 * (1.5 if regime > 1 else 1.0)
    return irregular_times(rng, n, 1.0), {"dist_mm": sweep_there_and_back(rng, n, 20.0, far)}


PHOTODIODE = SystemKind(
    name="photodiode against distance",
    reading="diode_mv",
    unit="mV",
    run="sweep",
    time=None,
    text="""# A lamp on a rail is moved to and from a photodiode.
reading, unit = "diode_mv", "mV"
run = "sweep"
parameters = {"dark_mv": ("normal", 0, 5), "power": ("log", 1e4, 1e7), "behind_mm": (0, 30)}
{noise}
vectorized = True

def simulate(p, data):
    return p["dark_mv"] + p["power"] / (data["dist_mm"] + p["behind_mm"]) ** 2
""",
    priors={"dark_mv": Prior("normal", 0, 5), "power": Prior("log", 1e4, 1e7), "behind_mm": Prior("uniform", 0, 30)},
    draw=lambda rng: {
        "dark_mv": float(rng.normal(0, 2)),
        "power": float(rng.uniform(2e5, 5e5)),
        "behind_mm": float(rng.uniform(8, 20)),
    },
    design=_photodiode_design,
    decimals={"dist_mm": 2},
    drives=("dist_mm",),
    sd=0.4,
    formula=lambda p, u: p["dark_mv"] + p["power"] / (u["dist_mm"] + p["behind_mm"]) ** 2,
    logged=(
        IrrelevantColumn("board_c", 27, 1.5, 0.05, 2, 6.0),
        IrrelevantColumn("rail_v", 5.0, 0.01, 0.002, 4),
        IrrelevantColumn("rh_pct", 42, 3, 0.3, 1),
    ),
    n_runs=5,
    reading_decimals=3,
)


def _flow_design(rng: Rng, n: int, regime: float) -> tuple[FloatArray, Columns]:
    most = 12.0 * regime
    return irregular_times(rng, n, 6.0), {
        "flow_lpm": random_steps(rng, n, np.linspace(0.5, most, 11), 4) * rng.uniform(0.97, 1.03, n)
    }


FLOW = SystemKind(
    name="orifice flow meter",
    reading="drop_kpa",
    unit="kPa",
    run="series",
    text="""# The pressure drop over an orifice grows as the square of the flow through it.
reading, unit = "drop_kpa", "kPa"
time, run = "t_s", "series"
parameters = {"zero_kpa": ("normal", 0, 0.5), "k": ("log", 0.01, 1)}
controls = ["flow_lpm"]
{noise}

def simulate(p, data):
    return p["zero_kpa"] + p["k"] * data["flow_lpm"] ** 2
""",
    priors={"zero_kpa": Prior("normal", 0, 0.5), "k": Prior("log", 0.01, 1)},
    draw=lambda rng: {"zero_kpa": float(rng.normal(0, 0.2)), "k": float(rng.uniform(0.08, 0.2))},
    design=_flow_design,
    decimals={"t_s": 1, "flow_lpm": 3},
    drives=("flow_lpm",),
    sd=0.03,
    formula=lambda p, u: p["zero_kpa"] + p["k"] * u["flow_lpm"] ** 2,
    logged=(
        IrrelevantColumn("water_c", 18, 1.5, 0.05, 2, 8.0),
        IrrelevantColumn("pump_v", 24, 0.1, 0.02, 3),
        IrrelevantColumn("baro_hpa", 1009, 2, 0.1, 1),
    ),
    n_runs=4,
)


def _lens_design(rng: Rng, n: int, regime: float) -> tuple[FloatArray, Columns]:
    low, high = (440, 640) if regime == 1 else (400, 700)
    return irregular_times(rng, n, 9.0), {"nm": sweep_there_and_back(rng, n, low, high)}


LENS = SystemKind(
    name="dispersion of a lens",
    reading="focus_mm",
    unit="mm",
    run=None,
    text="""# The focal length of a lens against the wavelength (Cauchy).
reading, unit = "focus_mm", "mm"
time = "t_s"
parameters = {"radius_mm": ("normal", 100, 2), "b_um2": (0.0, 0.02)}
{noise}

def simulate(p, data):
    index = 1.504 + p["b_um2"] / (data["nm"] / 1000) ** 2
    return p["radius_mm"] / (2 * (index - 1))
""",
    priors={"radius_mm": Prior("normal", 100, 2), "b_um2": Prior("uniform", 0, 0.02)},
    draw=lambda rng: {"radius_mm": float(rng.normal(100, 0.5)), "b_um2": float(rng.uniform(0.003, 0.008))},
    design=_lens_design,
    decimals={"t_s": 1, "nm": 1},
    drives=("nm",),
    sd=0.01,
    formula=lambda p, u: p["radius_mm"] / (2 * (1.504 + p["b_um2"] / (u["nm"] / 1000) ** 2 - 1)),
    logged=(
        IrrelevantColumn("glass_c", 22, 1.2, 0.03, 2, 7.0),
        IrrelevantColumn("lamp_w", 40, 0.3, 0.05, 2),
        IrrelevantColumn("baro_hpa", 1015, 2, 0.1, 1),
    ),
    n_runs=3,
)


def _ph_design(rng: Rng, n: int, regime: float) -> tuple[FloatArray, Columns]:
    levels = np.linspace(4, 9, 8) if regime == 1 else np.linspace(2.5, 11, 8)
    t = irregular_times(rng, n, 15.0)
    warm = rng.uniform(18, 32) + (12 if regime > 1 else 0) + 1.5 * np.sin(t / rng.uniform(80, 300))
    return t, {"buffer_ph": random_steps(rng, n, levels, 5) + 0.02 * rng.standard_normal(n), "probe_c": warm}


PH = SystemKind(
    name="pH probe",
    reading="cell_mv",
    unit="mV",
    run="day",
    text="""# A glass electrode in buffers (Nernst).
reading, unit = "cell_mv", "mV"
time, run = "t_s", "day"
parameters = {"e0_mv": ("normal", 0, 30), "slope_mv": ("normal", 58, 3)}
{noise}

def simulate(p, data):
    kelvin = data["probe_c"] + 273.15
    return p["e0_mv"] - p["slope_mv"] * kelvin / 298.15 * (data["buffer_ph"] - 7)
""",
    priors={"e0_mv": Prior("normal", 0, 30), "slope_mv": Prior("normal", 58, 3)},
    draw=lambda rng: {"e0_mv": float(rng.normal(0, 12)), "slope_mv": float(rng.uniform(56, 60))},
    design=_ph_design,
    decimals={"t_s": 1, "buffer_ph": 3, "probe_c": 2},
    drives=("buffer_ph", "probe_c"),
    sd=0.5,
    formula=lambda p, u: p["e0_mv"] - p["slope_mv"] * (u["probe_c"] + 273.15) / 298.15 * (u["buffer_ph"] - 7),
    logged=(IrrelevantColumn("salt_g_l", 3.0, 0.15, 0.02, 3), IrrelevantColumn("rh_pct", 48, 3, 0.3, 1)),
    n_runs=4,
    reading_decimals=3,
)

FORMULAS = (BATH, CUP, PHOTODIODE, FLOW, LENS, PH)
