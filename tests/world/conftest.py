"""A plan made by hand: a boundary out and back, plain white, and a scan along Y across a disc."""

import numpy as np
import pytest

from probewise.recordings import Disc, HalfPlane, Instrumentation, Plan, Uniform

NORMAL_RAD, OFFSET_MM = 0.1, 0.7


@pytest.fixture(scope="session")
def plan():
    x = np.arange(-20.0, 21.0, 2.0)
    still = np.zeros_like(x)
    places = [(x, still), (x[::-1], still), (x[::4], still[::4]), (still[::2], 1.5 * x[::2])]
    counts = [len(px) for px, _ in places]
    n_points = sum(counts)
    time_s = np.cumsum(np.where(np.arange(n_points) % 7 == 0, 3.0, 1.2))
    return Plan(
        x_mm=np.concatenate([px for px, _ in places]),
        y_mm=np.concatenate([py for _, py in places]),
        orientation_rad=np.repeat(np.radians([0, 90, 90, 30]), counts),
        time_s=time_s,
        scan=np.repeat(np.arange(4), counts),
        scan_names=("out", "back", "white", "along_y"),
        pattern=np.repeat([0, 0, 1, 2], counts),
        pattern_names=("boundary", "white", "disc"),
        patterns={"boundary": HalfPlane(NORMAL_RAD, OFFSET_MM), "white": Uniform(1.0), "disc": Disc((1.3, -0.4), 12.0)},
        covariates={"battery_mv": np.round(8300 - 2.0 * time_s)},
        instrumentation=Instrumentation(min=0.0, max=100.0, height_mm=14.0),
    )
