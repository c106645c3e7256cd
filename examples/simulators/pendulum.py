"""A pendulum as one writes it down at first: gravity, and friction in proportion to its speed."""

import numpy as np

reading, unit = "angle_deg", "deg"
time, run = "t_s", "release"
parameters = {"length_m": (0.2, 2.0), "friction_per_s": (0.0, 1.0), "start_rad": ("normal", 0.0, 1.0)}
per_run = ["start_rad"]
noise = {"sd": 0.1}
states = {"phi": "start_rad", "omega": 0.0}


def rates(s, p, u):
    return {"phi": s["omega"], "omega": -9.81 / p["length_m"] * np.sin(s["phi"]) - p["friction_per_s"] * s["omega"]}


def observe(s, p, u):
    return np.degrees(s["phi"])
