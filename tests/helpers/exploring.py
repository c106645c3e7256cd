"""A whole run as a value, and an arm over a known shape."""

from dataclasses import replace

import numpy as np

from probewise.arm import Reading
from probewise.experiment import Exploration, explore
from probewise.inquiry import Grid


def run(arm, experiment, *, hidden=None, **options):
    about = {"about": {"hidden": hidden.journal_entry}} if hidden is not None else {}
    return Exploration(experiment, tuple(explore(arm, experiment, **about, **options)), hidden)


class ChainArm:
    """Reads a chain over a true shape, rounded, with noise by place."""

    def __init__(self, chain, truth):
        self.chain, self.truth = chain, np.array([truth])

    def reachable(self, places_mm):
        return np.ones(len(places_mm), bool)

    def orientation_rad(self, places_mm):
        return np.zeros(len(places_mm))

    def travel_s(self, start, places_mm):
        return np.ones(len(places_mm))

    def measure(self, pose):
        plan = Grid(2.0, 2.0, 2, 2).plan("field").take(np.array([0]))
        plan = replace(plan, x_mm=np.array([pose.x_mm]), y_mm=np.array([pose.y_mm]))
        noise = np.random.default_rng([int(1000 * pose.x_mm), int(1000 * pose.y_mm)]).standard_normal()
        return Reading(float(np.rint(self.chain.predict(self.truth, plan)[0, 0] + noise)), pose, 0.0)
