"""Pictures of a run of nested sampling show its numbers."""

import dataclasses

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from scipy.stats import binom

from probewise.errors import ParameterError
from probewise.nested import run
from probewise.nested.result import Samples
from probewise.priors import Product, Uniform
from probewise.report import plots


class Bell:
    def __init__(self, *names):
        self.prior = Product({name: Uniform(-5.0, 5.0) for name in names})

    def log_likelihood(self, theta):
        return -0.5 * ((theta - 1.0) ** 2).sum(axis=1)


class Fixed:
    prior = Product({})

    def log_likelihood(self, theta):
        return np.zeros(len(theta))


@pytest.fixture(scope="module")
def result():
    return run(Bell("x_mm", "angle_rad", "I_min"), rng=np.random.default_rng(0), n_live=100)


def bell_samples(n_params, n=600):
    theta = np.random.default_rng(1).normal(size=(n, n_params))
    names = tuple(f"p{i}" for i in range(n_params))
    return Samples(names, theta, -0.5 * (theta**2).sum(axis=1), np.full(n, -np.log(n)), -3.0, 0.1, float(n), n)


@pytest.mark.slow
@pytest.mark.parametrize("n_params", [1, 2, 10])
def test_a_corner_has_each_parameter_and_each_pair(n_params):
    axes = plots.corner_plot(bell_samples(n_params))
    assert axes.shape == (n_params, n_params)
    drawn = [[ax is not None for ax in row] for row in axes]
    assert np.array_equal(drawn, np.tril(np.ones((n_params, n_params), dtype=bool)))
    assert [ax.get_xlabel() for ax in axes[-1]] == [f"p{i}" for i in range(n_params)]
    assert [ax.get_ylabel() for ax in axes[1:, 0]] == [f"p{i}" for i in range(1, n_params)]
    assert all(ax.get_xlim() == axes[-1, k].get_xlim() for k in range(n_params) for ax in axes[k:, k])
    if n_params < 10:
        assert plots.png(axes, dpi=30).startswith(b"\x89PNG")


def test_chosen_parameters_are_drawn_in_their_order(result):
    axes = plots.corner_plot(result, parameters=["I_min", "x_mm"])
    assert [ax.get_xlabel() for ax in axes[-1]] == ["I min", "x (mm)"]
    assert plots.trace_plot(result, parameters=["angle_rad"])[1, 0].get_ylabel() == "angle (rad)"
    for wrong in (["y_mm"], []):
        with pytest.raises(ParameterError, match="parameters is"):
            plots.corner_plot(result, parameters=wrong)
    with pytest.raises(ParameterError, match="nothing to draw"):
        plots.trace_plot(run(Fixed(), rng=np.random.default_rng(0)))


@pytest.mark.slow
def test_a_parameter_that_does_not_vary_is_drawn_too(result):
    theta = np.array(result.theta)
    theta[:, 0] = 3.0
    still = dataclasses.replace(result, theta=theta)
    assert plots.png(plots.corner_plot(still), dpi=30).startswith(b"\x89PNG")
    assert plots.png(plots.trace_plot(still), dpi=30).startswith(b"\x89PNG")


def test_insertion_ranks_are_counted_against_a_band_of_all_bars(result):
    ax = plots.insertion_plot(result)
    bars = [p for p in ax.patches if p.get_width() < 0.5]
    heights = np.array([p.get_height() for p in bars])
    n, n_bars = result.insertion_rank.size, len(bars)
    assert heights.sum() == pytest.approx(n)
    band = next(p for p in ax.patches if p not in bars)
    low, high = band.get_y(), band.get_y() + band.get_height()
    # Of uniform ranks about 1 % of the histograms leave the band: 20 of 2000, twice that never.
    counts = np.random.default_rng(3).multinomial(n, np.full(n_bars, 1 / n_bars), size=2000)
    left = ((counts < low) | (counts > high)).any(axis=1).sum()
    assert left < 40
    assert binom.cdf(low - 1, n, 1 / n_bars) < 0.01 / n_bars
    assert "p = " in ax.get_xlabel()


def test_the_course_of_a_run_ends_at_its_evidence(result):
    axes = plots.run_plot(result)
    assert [ax.get_ylabel() for ax in axes[:, 0]] == ["ln likelihood", "posterior per nat", "live points", "ln Z"]
    assert axes[3, 0].lines[0].get_ydata()[-1] == pytest.approx(result.log_z)
    assert axes[2, 0].lines[0].get_ydata().max() == 100
    assert any(isinstance(c, PolyCollection) for c in axes[1, 0].collections)
