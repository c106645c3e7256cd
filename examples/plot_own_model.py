"""
Your own model, your own effect
===============================

Shows that nothing in the diagnosis is about light sensors: two water tanks, one above the other, a pump that
fills the upper one, a level meter in the lower one. The model is Torricelli's law twice. What it leaves out,
the upper tank overflows, is an effect of one class; that the meter stops at 10 V is in the vocabulary.

The recording is simulated here. With ``--data cascaded_tanks.csv``, the measured benchmark of
nonlinearbenchmark.org ("cascaded tanks"), the same script diagnoses the real tanks.
"""

# %%
import argparse
import csv
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

import matplotlib.pyplot as plt
import numpy as np

from probewise.diagnosis import OwnModel, Parameters, diagnose
from probewise.effects import VOCABULARY, Extent, NamedEffect
from probewise.priors import LogUniform, Product, Uniform
from probewise.recordings import Instrumentation, Plan, Recording
from probewise.recordings import Uniform as Plain
from probewise.report import plots
from probewise.sensor import Stage

# %%
# The model: any callable of parameters and plan. Each parameter is an array (n_samples, 1), by its name; the pump's
# voltage is a column of the plan. Where no brim is given the upper tank has none: that is the model without the effect.

STEPS = 2  # of the integration, for each reading


def two_tanks(parameters: Parameters, plan: Plan) -> np.ndarray:
    """Level of the lower tank in volts, (n_samples, n_points); the outflow is as the root of the level."""
    p = {name: value[:, 0] for name, value in parameters.items()}
    brim, caught = p.get("brim_v", np.inf), p.get("caught", 0.0)
    upper, lower = p["upper_0_v"].copy(), p["lower_0_v"].copy()
    pump_v, gaps_s = plan.covariates["pump_v"], np.diff(plan.time_s, append=plan.time_s[-1])
    out = np.empty((len(upper), len(plan)))
    for k, gap_s in enumerate(gaps_s):
        out[:, k] = lower
        dt = gap_s / STEPS
        for _ in range(STEPS):
            falling = p["k_upper"] * np.sqrt(upper)
            lower = lower + dt * (falling - p["k_lower"] * np.sqrt(lower + p["outlet_v"]))
            upper = upper + dt * (p["k_pump"] * pump_v[k] - falling)
            spilt = np.maximum(upper - brim, 0.0)  # over the brim; a share of it falls into the lower tank
            upper, lower = np.maximum(upper - spilt, 0.0), np.maximum(lower + caught * spilt, 0.0)
    return out


PRIOR = Product(
    {
        "k_pump": LogUniform(0.01, 0.5),
        "k_upper": LogUniform(0.005, 0.5),
        "k_lower": LogUniform(0.005, 0.5),
        "outlet_v": Uniform(0.0, 5.0),  # how far below the meter's zero the lower tank runs out
        "upper_0_v": Uniform(0.1, 10.0),
        "lower_0_v": Uniform(0.1, 10.0),
    }
)


# %%
# The effect: one class. It acts on the parameters (``Stage.SCENE``: what there is), adding two of its own.


@dataclass(frozen=True)
class Overflow(NamedEffect[Parameters]):
    """The upper tank runs over at its brim, and a share of what is spilt falls into the lower one."""

    highest_v: float

    name: ClassVar[str] = "overflow"
    stage: ClassVar[Stage] = Stage.SCENE
    units: ClassVar[tuple[str, ...]] = ("V", "1")
    covariates: ClassVar[tuple[str, ...]] = ("time", "level")
    amplitudes: ClassVar[tuple[int, ...]] = ()

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        return cls(extent.high)

    @property
    def prior(self) -> Product:
        return Product({"brim_v": Uniform(0.3 * self.highest_v, 1.5 * self.highest_v), "caught": Uniform(0.0, 1.0)})

    def apply(self, value: Parameters, theta: np.ndarray, plan: Plan) -> Parameters:
        return {**value, "brim_v": theta[:, :1], "caught": theta[:, 1:2]}

    def bank(self) -> np.ndarray:
        levels = self.highest_v * np.linspace(0.35, 1.35, 9)
        return np.array([[[level, share]] for level in levels for share in (0.1, 0.5, 0.9)])

    def sentence(self, mean: np.ndarray, sd: np.ndarray) -> str:
        return (
            f"the upper tank runs over at {mean[0]:.2f} ± {sd[0]:.2f} V, "
            f"and {100 * mean[1]:.0f} ± {100 * sd[1]:.0f} % of that falls into the lower one"
        )


# %%
# The recording: the measured one if it is given, else one simulated with both effects, the overflow and the meter's
# limit. It is divided into eight pieces, which stand for scans, so that each in turn can be held out.


def tanks(pump_v: np.ndarray, readings_v: np.ndarray, gap_s: float) -> Recording:
    n = len(pump_v)
    plan = Plan(
        x_mm=np.zeros(n),
        y_mm=np.zeros(n),
        orientation_rad=np.zeros(n),
        time_s=gap_s * np.arange(n),
        scan=np.arange(n) * 8 // n,
        scan_names=tuple(f"piece_{k}" for k in range(1, 9)),
        pattern=np.zeros(n, dtype=int),
        pattern_names=("tanks",),
        patterns={"tanks": Plain(1.0)},
        covariates={"pump_v": pump_v},
        instrumentation=Instrumentation(unit="V", sensor="level meter of the lower tank"),
    )
    return Recording(plan, readings_v)


def simulated(rng: np.random.Generator) -> Recording:
    """256 readings of tanks that run over at 8 V, by a meter that stops at 10 V with noise of 0.03 V."""
    time_s = 4.0 * np.arange(256)
    phases = rng.uniform(0, 2 * np.pi, 12)
    waves = np.sin(2 * np.pi * np.outer(time_s, np.arange(1, 13)) / 512 + phases).sum(axis=1)
    pump_v = np.clip(3.4 + 0.9 * waves, 0.5, 7.0)
    truth = dict(
        k_pump=0.05, k_upper=0.06, k_lower=0.05, outlet_v=0.8, upper_0_v=4.0, lower_0_v=5.0, brim_v=8.0, caught=0.4
    )
    plan = tanks(pump_v, np.zeros(256), 4.0).plan
    level_v = two_tanks({name: np.array([[value]]) for name, value in truth.items()}, plan)[0]
    return Recording(plan, np.minimum(level_v, 10.0) + 0.03 * rng.standard_normal(256))


def measured(path: Path) -> tuple[Recording, Recording]:
    """The benchmark's records to fit and to test on."""
    rows = list(csv.DictReader(path.open(encoding="utf-8")))
    columns = {name: np.array([float(row[name]) for row in rows]) for name in ("uEst", "yEst", "uVal", "yVal")}
    gap_s = float(rows[0]["Ts"])
    return tanks(columns["uEst"], columns["yEst"], gap_s), tanks(columns["uVal"], columns["yVal"], gap_s)


parser = argparse.ArgumentParser()
parser.add_argument("--data", type=Path)
data = parser.parse_args(sys.argv[1:] if sys.argv[0].endswith("plot_own_model.py") else []).data
seed = 1
print(f"seed {seed}")
if data is None:
    print("no --data: the tanks are simulated")
    recording = simulated(np.random.default_rng(seed))
else:
    recording, _ = measured(data)

# %%
# The same machinery as for a light sensor: the model is the null, the effect stands beside the vocabulary.

model = OwnModel(two_tanks, PRIOR)
diagnosis = diagnose(
    recording, null=model, effects={**VOCABULARY, "overflow": Overflow}, rng=np.random.default_rng(seed)
)
print(diagnosis.summary())

# %%
fig, (above, below) = plt.subplots(2, 1, figsize=(8, 6), sharex=True)
time_s = recording.plan.time_s
above.plot(time_s, recording.readings, "k.", markersize=2, label="recorded")
above.plot(time_s, diagnosis.repair.before.readings, color="tab:red", label="two tanks")
above.plot(time_s, diagnosis.repair.after.readings, color="tab:blue", label="repaired")
above.set_ylabel("level of the lower tank (V)")
above.legend(frameon=False)
plots.residuals_against(
    time_s, diagnosis.repair.before.residuals, diagnosis.repair.after.residuals, label="time (s)", unit="V", ax=below
)
fig.tight_layout()
