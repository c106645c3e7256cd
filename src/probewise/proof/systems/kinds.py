"""Kinds of system: simulator file, which the world reads too, and experimental design; static or with a law."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from probewise._arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class SystemTable:
    """Rows in order of time; every array is (n_points,).

    `columns`: numeric columns by name, including time; `run`: number, from 0, of each row's run among all runs of a
    case including held-out ones; `time`: name of the time column; None if none was recorded; `n_runs`: number of runs
    of the case, including held-out ones.
    """

    columns: Mapping[str, FloatArray]
    run: IntArray
    time: str | None
    n_runs: int

    def __len__(self) -> int:
        return len(self.run)

    @cached_property
    def t(self) -> FloatArray:
        """Recorded time in the table's unit, or the index of the row if there is none."""
        return np.arange(float(len(self))) if self.time is None else self.columns[self.time]

    @cached_property
    def rows_by_run(self) -> Sequence[IntArray]:
        """Row indices of each run that has rows here, by run number."""
        found = (np.flatnonzero(self.run == k) for k in range(self.n_runs))
        return [rows for rows in found if rows.size]

    @cached_property
    def time_since_start(self) -> FloatArray:
        """Time since the first row of the run, (n_points,)."""
        out = np.empty(len(self))
        for rows in self.rows_by_run:
            out[rows] = self.t[rows] - self.t[rows[0]]
        return out

    @cached_property
    def median_gap(self) -> float:
        """Median time from a row to the next of its run, over all runs."""
        return float(np.median(np.concatenate([np.diff(self.t[rows]) for rows in self.rows_by_run])))

    @property
    def duration(self) -> float:
        """Largest minus smallest recorded time."""
        return float(np.ptp(self.t))

    def select_rows(self, kept: FloatArray | IntArray) -> SystemTable:
        """Return the table of the rows `kept` (indices); runs keep their numbers."""
        return replace(self, columns={name: values[kept] for name, values in self.columns.items()}, run=self.run[kept])


Values: TypeAlias = Mapping[str, Any]
"""Parameters, states or columns by name: arrays that broadcast."""

Columns: TypeAlias = dict[str, FloatArray]


@dataclass(frozen=True)
class Law:
    """A law in continuous time: `rates` of the states and what is `read`, functions of states, parameters and columns.

    `start`: initial value of each state: the name of a parameter, or a number; `linear`: whether inputs are
    interpolated linearly between rows; otherwise they are held.
    """

    start: Mapping[str, str | float]
    rates: Callable[[Values, Values, Values], dict[str, Any]]
    read: Callable[[Values, Values, Values], Any]
    linear: bool = False


Range: TypeAlias = tuple[float, float] | tuple[str, float, float]
"""Ends of a uniform distribution, or "normal" with mean and sd."""


def draw_values(ranges: Mapping[str, Range], rng: np.random.Generator) -> dict[str, float]:
    """Draw a value from each of these distributions, by name."""
    return {name: float(rng.normal(*of[1:]) if of[0] == "normal" else rng.uniform(*of)) for name, of in ranges.items()}


@dataclass(frozen=True, eq=False)
class SystemKind:
    """A kind of system.

    What the simulator file states is taken from its `text`, which is as a user would provide it; `{noise}` stands for
    its line on noise: names of the predicted column (`reading`), of those of `time` and runs, if any, of parameters,
    and which have a value in each run; its `law`, whose states and rates the file defines unless it integrates by
    itself, or its `formula`.
    """

    name: str
    text: str
    shared: Mapping[str, Range]  # true parameters
    gap: float  # mean time between rows
    # Columns from (rng, times of a run from 0, regime): 1, or larger for a run with inputs beyond the others' range.
    design: Callable[[np.random.Generator, FloatArray, float], Columns]
    decimals: Mapping[str, int]  # of time and of the designed columns, which the law or formula uses
    sd: float  # of a reading's white noise
    of_run: Mapping[str, Range] = field(default_factory=dict)  # true parameters with a value in each run
    stated_law: Law | None = None  # of a file that integrates by itself
    restarts_time: bool = False
    stretched: float = 1.0  # factor on the gap in a run beyond the others' range
    # Irrelevant columns: a random walk about a middle, scaled, plus noise of an sd in each row; then come the decimals,
    # and what shifts the middle in the last held-out run, if anything does.
    logged: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    n_runs: int = 5  # that are not held out
    reading_decimals: int = 4

    reading: str = field(init=False)
    time: str | None = field(init=False)
    run: str | None = field(init=False)
    per_run: tuple[str, ...] = field(init=False)
    parameters: tuple[str, ...] = field(init=False)
    law: Law | None = field(init=False)
    formula: Callable[[Values, Values], Any] = field(init=False)  # of parameters and columns; None beside states

    def __post_init__(self) -> None:
        file: dict[str, Any] = {}
        exec(self.text.replace("{noise}\n", ""), file)
        law, start = self.stated_law, file.get("states", {})
        if "rates" in file:
            first = next(iter(start))
            read = file.get("observe", lambda s, p, u: s[first])
            law = Law(start, file["rates"], read, linear=file.get("hold") == "linear")
        vars(self).update({name: file.get(name) for name in ("reading", "time", "run")})
        vars(self).update({name: tuple(file.get(name, ())) for name in ("per_run", "parameters")})
        vars(self).update(law=law, formula=file.get("simulate"))

    @property
    def drives(self) -> tuple[str, ...]:
        """Columns that the law or formula uses, except time."""
        return tuple(name for name in self.decimals if name != self.time)

    @property
    def column_decimals(self) -> dict[str, int]:
        """Decimals of each column of the table, and of the reading."""
        logged = {name: int(about[3]) for name, about in self.logged.items()}
        return {**self.decimals, **logged, self.reading: self.reading_decimals}


_PAUSE = 0.15  # pause between runs, as a share of the first run's length


def random_steps(rng: np.random.Generator, t: FloatArray, levels: FloatArray, length: int) -> FloatArray:
    """Return random levels, none twice in succession, each held for 0.5 to 2 times `length` rows, shape of `t`."""
    out: list[float] = []
    while len(out) < len(t):
        choices = [level for level in levels if not out or level != out[-1]]
        out += [float(rng.choice(choices))] * int(rng.integers(max(length // 2, 2), 2 * length))
    return np.array(out[: len(t)])


def random_waves(rng: np.random.Generator, t: FloatArray, size: float, fastest: float) -> FloatArray:
    """Return a sum of four sinusoids at times `t`, frequencies 0.1 to 1 times `fastest`, rms `size`; shape of `t`."""
    hz = fastest * rng.uniform(0.1, 1.0, 4)
    waves = np.sin(2 * np.pi * hz[:, None] * t + rng.uniform(0, 2 * np.pi, 4)[:, None])
    return np.asarray(size * waves.sum(axis=0) / np.sqrt(2.0))


def sweep_there_and_back(rng: np.random.Generator, t: FloatArray, low: float, high: float) -> FloatArray:
    """Return a rising and then a falling sweep between `low` and `high` in random steps, shape of `t`."""
    up = len(t) // 2
    first, second = np.sort(rng.uniform(0, 1, up)), np.sort(rng.uniform(0, 1, len(t) - up))[::-1]
    return np.asarray(low + (high - low) * np.concatenate([first, second]))


def design_runs(kind: SystemKind, *, rng: np.random.Generator) -> SystemTable:
    """Return the table of all runs of a case; the last two are held out, the last one is in a new range of inputs."""
    n_runs = kind.n_runs + 2
    each = int(np.clip(rng.integers(150, 420) // kind.n_runs, 24, 120))
    columns: dict[str, list[FloatArray]] = {}
    run: list[FloatArray] = []
    clock = 0.0
    for k in range(n_runs):
        n = int(each * rng.uniform(0.8, 1.2))
        regime, stretched = (1.5, kind.stretched) if k == n_runs - 1 else (1.0, 1.0)
        t = np.concatenate([[0.0], np.cumsum(kind.gap * stretched * rng.uniform(0.6, 1.4, n - 1))])
        whole = kind.design(rng, t, regime)
        if not kind.restarts_time:
            t = t + clock
            clock = float(t[-1]) + _PAUSE * float(t[-1] - t[0]) * rng.uniform(0.5, 1.5) + float(t[1] - t[0])
        for name, (middle, wander, jitter, _, *beyond) in kind.logged.items():
            walk = np.cumsum(rng.standard_normal(n)) / np.sqrt(n) + rng.standard_normal()
            shifted = middle + sum(beyond) * (regime > 1)
            whole[name] = shifted + wander * walk + jitter * rng.standard_normal(n)
        if kind.time is not None:
            whole[kind.time] = t
        for name, values in whole.items():
            columns.setdefault(name, []).append(np.round(values, kind.column_decimals[name]))
        run.append(np.full(n, k))
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    return SystemTable(joined, np.concatenate(run).astype(np.int64), kind.time, n_runs)


BATH = SystemKind(
    name="thermometer in a bath",
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
    shared={"tau_s": (18, 45), "scale": ("normal", 1.0, 0.01)},
    of_run={"start_c": ("normal", 21, 2)},
    gap=4.0,
    design=lambda rng, t, regime: {"bath_c": rng.uniform(35, 55) * regime + 0.2 * np.sin(t / rng.uniform(9, 20))},
    decimals={"t_s": 2, "bath_c": 2},
    sd=0.05,
    restarts_time=True,
    logged={"room_c": (21.5, 0.8, 0.03, 2, 4.0), "stir_rpm": (300, 15, 3, 0), "rh_pct": (45, 3, 0.3, 1)},
)


CUP = SystemKind(
    name="cooling cup",
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
    shared={"tau_min": (25, 60)},
    of_run={"hot_c": ("normal", 76, 6)},
    gap=1.3,
    design=lambda rng, t, regime: {
        "room_c": rng.uniform(18, 24) * (1.25 if regime > 1 else 1.0) + 0.5 * np.sin(t / rng.uniform(10, 25))
    },
    decimals={"t_min": 2, "room_c": 2},
    sd=0.12,
    restarts_time=True,
    logged={"rh_pct": (50, 4, 0.4, 1), "fill_ml": (240, 6, 0.4, 1), "baro_hpa": (1012, 2, 0.1, 1)},
    reading_decimals=3,
)


PHOTODIODE = SystemKind(
    name="photodiode against distance",
    text="""# A lamp on a rail is moved to and from a photodiode.
reading, unit = "diode_mv", "mV"
run = "sweep"
parameters = {"dark_mv": ("normal", 0, 5), "power": ("log", 1e4, 1e7), "behind_mm": (0, 30)}
{noise}
vectorized = True

def simulate(p, data):
    return p["dark_mv"] + p["power"] / (data["dist_mm"] + p["behind_mm"]) ** 2
""",
    shared={"dark_mv": ("normal", 0, 2), "power": (2e5, 5e5), "behind_mm": (8, 20)},
    gap=1.0,
    design=lambda rng, t, regime: {"dist_mm": sweep_there_and_back(rng, t, 20.0, 90.0 * regime)},
    decimals={"dist_mm": 2},
    sd=0.4,
    logged={"board_c": (27, 1.5, 0.05, 2, 6.0), "rail_v": (5.0, 0.01, 0.002, 4), "rh_pct": (42, 3, 0.3, 1)},
    reading_decimals=3,
)


FLOW = SystemKind(
    name="orifice flow meter",
    text="""# The pressure drop over an orifice grows as the square of the flow through it.
reading, unit = "drop_kpa", "kPa"
time, run = "t_s", "series"
parameters = {"zero_kpa": ("normal", 0, 0.5), "k": ("log", 0.01, 1)}
controls = ["flow_lpm"]
{noise}

def simulate(p, data):
    return p["zero_kpa"] + p["k"] * data["flow_lpm"] ** 2
""",
    shared={"zero_kpa": ("normal", 0, 0.2), "k": (0.08, 0.2)},
    gap=6.0,
    design=lambda rng, t, regime: {
        "flow_lpm": random_steps(rng, t, np.linspace(0.5, 12.0 * regime, 11), 4) * rng.uniform(0.97, 1.03, len(t))
    },
    decimals={"t_s": 1, "flow_lpm": 3},
    sd=0.03,
    logged={"water_c": (18, 1.5, 0.05, 2, 8.0), "pump_v": (24, 0.1, 0.02, 3), "baro_hpa": (1009, 2, 0.1, 1)},
    n_runs=4,
)


LENS = SystemKind(
    name="dispersion of a lens",
    text="""# The focal length of a lens against the wavelength (Cauchy).
reading, unit = "focus_mm", "mm"
time = "t_s"
parameters = {"radius_mm": ("normal", 100, 2), "b_um2": (0.0, 0.02)}
{noise}

def simulate(p, data):
    index = 1.504 + p["b_um2"] / (data["nm"] / 1000) ** 2
    return p["radius_mm"] / (2 * (index - 1))
""",
    shared={"radius_mm": ("normal", 100, 0.5), "b_um2": (0.003, 0.008)},
    gap=9.0,
    design=lambda rng, t, regime: {"nm": sweep_there_and_back(rng, t, *((440, 640) if regime == 1 else (400, 700)))},
    decimals={"t_s": 1, "nm": 1},
    sd=0.01,
    logged={"glass_c": (22, 1.2, 0.03, 2, 7.0), "lamp_w": (40, 0.3, 0.05, 2), "baro_hpa": (1015, 2, 0.1, 1)},
    n_runs=3,
)


def _ph_design(rng: np.random.Generator, t: FloatArray, regime: float) -> Columns:
    levels = np.linspace(4, 9, 8) if regime == 1 else np.linspace(2.5, 11, 8)
    warm = rng.uniform(18, 32) + (12 if regime > 1 else 0) + 1.5 * np.sin(t / rng.uniform(80, 300))
    return {"buffer_ph": random_steps(rng, t, levels, 5) + 0.02 * rng.standard_normal(len(t)), "probe_c": warm}


PH = SystemKind(
    name="pH probe",
    text="""# A glass electrode in buffers (Nernst).
reading, unit = "cell_mv", "mV"
time, run = "t_s", "day"
parameters = {"e0_mv": ("normal", 0, 30), "slope_mv": ("normal", 58, 3)}
{noise}

def simulate(p, data):
    kelvin = data["probe_c"] + 273.15
    return p["e0_mv"] - p["slope_mv"] * kelvin / 298.15 * (data["buffer_ph"] - 7)
""",
    shared={"e0_mv": ("normal", 0, 12), "slope_mv": (56, 60)},
    gap=15.0,
    design=_ph_design,
    decimals={"t_s": 1, "buffer_ph": 3, "probe_c": 2},
    sd=0.5,
    logged={"salt_g_l": (3.0, 0.15, 0.02, 3), "rh_pct": (48, 3, 0.3, 1)},
    n_runs=4,
    reading_decimals=3,
)

FORMULAS = (BATH, CUP, PHOTODIODE, FLOW, LENS, PH)


TANK = SystemKind(
    name="tank",
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
    shared={"cm_per_v": (5, 10), "tau_s": (35, 90)},
    of_run={"start_cm": (5, 30)},
    gap=5.0,
    design=lambda rng, t, regime: {"valve_v": random_steps(rng, t, np.array([0.0, 1.0, 2.0, 3.0, 4.0]) * regime, 9)},
    decimals={"t_s": 2, "valve_v": 2},
    sd=0.04,
    stated_law=Law(
        {"level": "start_cm"},
        lambda s, p, u: {"level": (p["cm_per_v"] * u["valve_v"] - s["level"]) / p["tau_s"]},
        lambda s, p, u: s["level"],
    ),
    logged={"water_c": (16, 1.0, 0.04, 2, 6.0), "hall_c": (20, 0.8, 0.04, 2), "supply_v": (12, 0.05, 0.01, 3)},
    n_runs=4,
)


FILTER = SystemKind(
    name="RC filter of two stages",
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
    shared={"gain": ("normal", 1.0, 0.03), "tau1_s": (0.003, 0.006), "tau2_s": (0.010, 0.018)},
    gap=0.002,
    design=lambda rng, t, regime: {"in_v": random_steps(rng, t, np.array([-2.0, -1.0, 0.5, 1.5, 3.0]) * regime, 10)},
    decimals={"t_s": 6, "in_v": 3},
    sd=0.004,
    logged={"board_c": (30, 1.5, 0.04, 2, 8.0), "rail_v": (12.0, 0.02, 0.004, 3)},
    n_runs=4,
    reading_decimals=5,
)


OSCILLATOR = SystemKind(
    name="mass on a spring",
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
    shared={"k_n_m": (25, 70), "c_kg_s": (0.4, 1.2)},
    of_run={"x0_m": ("normal", 0, 0.03)},
    gap=0.05,
    design=lambda rng, t, regime: {"force_n": random_waves(rng, t, 0.8 * regime, 2.5)},
    decimals={"t_s": 4, "force_n": 4},
    sd=0.15,
    logged={"air_c": (22, 0.8, 0.03, 2, 5.0), "mains_v": (230, 1.0, 0.3, 1)},
    n_runs=4,
    reading_decimals=3,
)


SERVO = SystemKind(
    name="DC motor",
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
    shared={"deg_s_v": (30, 70), "tau_s": (0.08, 0.2)},
    gap=0.03,
    design=lambda rng, t, regime: {"volts": random_steps(rng, t, np.array([-6.0, -3.0, 0.0, 2.0, 5.0]) * regime, 9)},
    decimals={"t_s": 4, "volts": 2},
    sd=0.8,
    logged={"case_c": (33, 2.5, 0.05, 2, 10.0), "bus_v": (9.0, 0.05, 0.01, 3), "load_g": (120, 6, 0.5, 1)},
    reading_decimals=3,
)


REACTOR = SystemKind(
    name="two reactions in a row",
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
    shared={"k1_per_s": (0.018, 0.03), "k2_per_s": (0.004, 0.008)},
    of_run={"dose": (0.7, 2.0)},
    gap=9.0,
    stretched=1.4,
    design=lambda rng, t, regime: {},
    decimals={"t_s": 1},
    sd=0.003,
    restarts_time=True,
    logged={"jacket_c": (30, 0.7, 0.04, 2, 4.0), "stir_rpm": (500, 12, 4, 0), "lamp_a": (0.8, 0.01, 0.001, 4)},
    reading_decimals=5,
)


PREDATOR = SystemKind(
    name="predator and prey",
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
    shared={"grow_per_d": (0.5, 0.9), "eat": (0.06, 0.1), "die_per_d": (0.4, 0.7)},
    gap=0.5,
    design=lambda rng, t, regime: {"feed": random_steps(rng, t, np.array([0.6, 1.0, 1.4]) * regime, 15)},
    decimals={"t_d": 3, "feed": 2},
    sd=0.3,
    logged={"room_c": (21, 0.8, 0.04, 2, 5.0), "oxygen_mg_l": (7.5, 0.3, 0.05, 2), "light_lx": (400, 15, 4, 0)},
    n_runs=4,
    reading_decimals=3,
)

LAWS = (TANK, FILTER, OSCILLATOR, SERVO, REACTOR, PREDATOR)
