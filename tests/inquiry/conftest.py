"""Discs under the package's own sensor, and inputs of utilities made of numbers."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from probewise.inquiry import Designs, DirectForecast, Grid, Readout, UtilityInput, forecast_of
from probewise.scene import Circle, HypothesisScene
from probewise.sensor import Chain, FixedLevels, FixedMixture, NaiveSensor


def disc_chain(n_nodes=64, circle=None):
    mixture = FixedMixture(
        [0.7, 0.3], [[0.5, 1.5], [-1.0, 1.0]], [[[16.0, 2.0], [2.0, 6.25]], [[9.0, 0.0], [0.0, 20.0]]]
    )
    return Chain(mixture, FixedLevels(10.0, 60.0), HypothesisScene(circle or Circle()), n_nodes=n_nodes)


def naive_sensor():
    return NaiveSensor(FixedLevels(10.0, 60.0), HypothesisScene(Circle()))


def circles(n, seed=0):
    return Circle().prior.from_unit_cube(np.random.default_rng(seed).random((n, 3)))


@dataclass(frozen=True)
class Listed:
    """Reads what stands in a table: theta is the row's number, x_mm the column's."""

    table: tuple[tuple[float, ...], ...]
    names: tuple[str, ...] = ("row",)

    def predict(self, theta, plan):
        return np.array(self.table)[theta[:, 0].astype(int)][:, np.rint(plan.x_mm).astype(int)]


def listed(table, *, noise_sd=1.0, step=1.0, weight=None, repeats=(1,), cost_s=None):
    """Input of utilities: hypotheses whose readings are given, (n_hypotheses, n_places): a grid of two equal rows."""
    table = np.asarray(table, dtype=float)
    n, n_x = table.shape
    designs = Designs(Grid(n_x - 1.0, 1.0, n_x, 2), repeats=repeats)
    theta = np.arange(float(n))[:, None]
    rows = np.flatnonzero(np.arange(len(designs)) % (2 * n_x) < n_x)
    return UtilityInput(
        DirectForecast(Listed(tuple(map(tuple, table)))),
        Readout(noise_sd, step),
        theta,
        np.full(n, 1.0 / n) if weight is None else np.asarray(weight, dtype=float),
        theta,
        designs,
        designs.plan("field"),
        rows,
        np.ones(rows.size) if cost_s is None else np.asarray(cost_s, dtype=float),
    )


def over_discs(model, theta, *, grid=None, orientations_rad=(0.0,), readout=None):
    designs = Designs(grid or Grid(), orientations_rad)
    n = len(theta)
    rows = np.arange(len(designs))
    return UtilityInput(
        forecast_of(model),
        readout or Readout(1.0),
        theta,
        np.full(n, 1.0 / n),
        theta[:50],
        designs,
        designs.plan("field"),
        rows,
        np.ones(len(designs)),
    )


@pytest.fixture
def made():
    return SimpleNamespace(
        chain=disc_chain, naive=naive_sensor, circles=circles, listed=listed, over_discs=over_discs, sensor=Listed
    )
