"""A heater of two parameters, each run from a start of its own, small enough for a test."""

import dataclasses

import numpy as np

from probewise.systems import FittedSystem, Noise, RunTable, Simulator, System
from probewise.systems.forms import ReferenceFit, bind_forms

FILE = """\
import numpy as np
reading, unit = "temp_c", "degC"
time, run = "t_s", "run"
parameters = {"tau_s": ("log", 1, 1000), "gain": (0, 10), "start_c": ("normal", 20, 5)}
per_run = ["start_c"]
controls = ["power_w"]
noise = {"sd": 0.05}

def simulate(p, data):
    return p["start_c"] + p["gain"] * data["power_w"] * (1 - np.exp(-data["t_s"] / p["tau_s"]))
"""


def simulate(p, data):
    return p["start_c"] + p["gain"] * data["power_w"] * (1 - np.exp(-data["t_s"] / p["tau_s"]))


def heater(**options) -> Simulator:
    given = {
        "reading": "temp_c",
        "unit": "degC",
        "parameters": {"tau_s": ("log", 1, 1000), "gain": (0, 10), "start_c": ("normal", 20, 5)},
        "simulate": simulate,
        "time": "t_s",
        "run": "run",
        "per_run": ("start_c",),
        "controls": ("power_w",),
        "noise": Noise(sd=0.05),
    }
    return Simulator(**{**given, **options})


def runs(starts=(20.0, 21.0, 19.0), *, names="123", rng=None, n=12) -> RunTable:
    """One run for each start, at 2 W, 4 W, 3 W ...; noise of sd 0.05 where an rng is given."""
    time = np.tile(np.arange(0.0, 5.0 * n, 5.0), len(starts))
    power = np.repeat([2.0, 4.0, 3.0, 5.0][: len(starts)], n)
    run = np.repeat(list(names[: len(starts)]), n)
    room = np.repeat(22.0 + 0.1 * np.arange(len(starts)), n)
    temp = np.repeat(starts, n) + 3.0 * power * (1 - np.exp(-time / 15.0))
    if rng is not None:
        temp = temp + 0.05 * rng.standard_normal(len(temp))
    return RunTable({"run": run, "t_s": time, "power_w": power, "room_c": room, "temp_c": temp}, "t_s", "run")


TABLE = runs()
SIMULATOR = dataclasses.replace(heater(), fingerprint="abc", source="heater.py")
ABOUT = ReferenceFit(System.of(SIMULATOR, TABLE), TABLE, np.array([0.5, -0.4, 0.0, 0.2, -0.2]), 0.05)


def known_model(simulator, values, known=None, *, sd=0.1, **more):
    """A model of parameters that are known exactly, by name, those of an effect as "effect.parameter"."""
    effects = tuple(dict.fromkeys(name.rpartition(".")[0] for name in values if "." in name))
    samples = np.tile([*values.values()], (500, 1))
    return FittedSystem(simulator, tuple(values), samples, np.full(500, sd), effects=effects, known=known, **more)


def fitted(effects=(), *, seed=0):
    """Samples about a setting, with as many columns as the effects have parameters."""
    forms = bind_forms(ABOUT)
    chain = ABOUT.system.chain(TABLE, [forms[name] for name in effects])
    middle = {"tau_s": 15.0, "gain": 3.0, "start_c[1]": 20.0, "start_c[2]": 21.0, "start_c[3]": 19.0}
    at = [middle.get(name, 0.1) for name in chain.names]
    samples = np.array(at) * (1 + 0.01 * np.random.default_rng(seed).standard_normal((500, len(at))))
    return FittedSystem(
        SIMULATOR,
        names=tuple(chain.names),
        samples=samples,
        noise_sd=np.full(500, 0.05),
        effects=tuple(effect.name for effect in chain.effects),
        known=ABOUT.stored if effects else None,
        level=(20.0, 30.0),
    )
