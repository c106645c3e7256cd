"""A small world of its own: a circle, two sensors in closed form, an arm that needs no simulation."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import ndtr

from probewise.arm.instrument import Pose, Reading
from probewise.errors import LinkError
from probewise.experiment import Experiment
from probewise.inquiry import Grid
from probewise.priors import Product, Uniform


@dataclass(frozen=True)
class SmallCircle:
    radius_mm: tuple[float, float] = (20.0, 150.0)
    width_mm: float = 400.0
    height_mm: float = 300.0

    @property
    def prior(self):
        return Product(
            {
                "x_mm": Uniform(0.0, self.width_mm),
                "y_mm": Uniform(0.0, self.height_mm),
                "radius_mm": Uniform(*self.radius_mm),
            }
        )

    def region(self, theta):
        raise NotImplementedError  # the sensors below know circles in closed form


@dataclass(frozen=True)
class EdgeSensor:
    """Reads 10 on black, 60 on white; `blur_mm` softens the edge, 0 gives the naive sensor."""

    blur_mm: float = 8.0
    names: tuple[str, ...] = ("x_mm", "y_mm", "radius_mm")

    def predict(self, theta, plan):
        x, y, radius = theta[:, 0:1], theta[:, 1:2], theta[:, 2:3]
        inside = radius - np.hypot(plan.x_mm - x, plan.y_mm - y)
        return 10.0 + 50.0 * (ndtr(inside / self.blur_mm) if self.blur_mm else (inside >= 0))


@dataclass(frozen=True)
class Gaussian:
    sd: float = 1.0

    def log_prob(self, readings, predicted):
        z = (readings - predicted) / self.sd
        return -0.5 * (z**2).sum(axis=1) - readings.size * np.log(self.sd * np.sqrt(2 * np.pi))


@dataclass
class QuickArm:
    """Reads the sensor over a true circle; the noise depends on the place alone, so that a new arm reads the same."""

    truth: tuple[float, float, float] = (250.0, 140.0, 60.0)
    sensor: EdgeSensor = field(default_factory=EdgeSensor)
    reach_mm: float = 1e9
    fail_at: int = 0
    poses: list = field(default_factory=list)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None

    def reachable(self, places_mm):
        return np.hypot(places_mm[:, 0] - 200.0, places_mm[:, 1]) <= self.reach_mm

    def orientation_rad(self, places_mm):
        return np.zeros(len(places_mm))

    def travel_s(self, start, places_mm):
        return 1.0 + np.hypot(places_mm[:, 0] - start.x_mm, places_mm[:, 1] - start.y_mm) / 100.0

    def measure(self, pose: Pose) -> Reading:
        self.poses.append(pose)
        if len(self.poses) == self.fail_at:
            raise LinkError("the brick does not answer")
        place = SimpleNamespace(x_mm=np.array([pose.x_mm]), y_mm=np.array([pose.y_mm]))
        noise = np.random.default_rng([int(pose.x_mm * 1000), int(pose.y_mm * 1000)]).standard_normal()
        value = float(np.rint(self.sensor.predict(np.array([self.truth]), place)[0, 0] + noise))
        return Reading(value, pose, 10.0 * pose.x_mm, {"battery_mv": 7900.0})


def small_experiment(**changes):
    blur_mm = changes.pop("blur_mm", 8.0)
    options = {
        "shape": SmallCircle(),
        "model": EdgeSensor(blur_mm),
        "likelihood": Gaussian(),
        "noise_sd": 1.0,
        "grid": Grid(400.0, 300.0, 26, 20),
        "n_live": 40,
        "n_samples": 20,
        "n_particles": 600,
    }
    return Experiment(**{**options, **changes})


@pytest.fixture
def small(small_for_all):
    return small_for_all


@pytest.fixture(scope="session")
def small_for_all():
    return SimpleNamespace(
        circle=SmallCircle, sensor=EdgeSensor, gaussian=Gaussian, arm=QuickArm, experiment=small_experiment
    )
