"""Figures of a diagnosis: every axis has its unit, nothing lies over data, files stay small and are the same again."""

import itertools
import subprocess
import sys

import matplotlib as mpl
import numpy as np
import pytest

from probewise.report import plots
from probewise.report.plots import canvas
from probewise.report.residual_means import mean_residuals

X = np.linspace(0.0, 10.0, 200)


def means(**options):
    return mean_residuals(X, np.sin(X), 0.1 * np.sin(X), sd=1.0, **options)


def drawn():
    rng = np.random.default_rng(0)
    noise, scan = rng.standard_normal(200), np.repeat([0, 1], 100)
    return {
        "means": plots.mean_residuals_along(means(), label="X (mm)", unit="V", each=(X, np.sin(X)), window=(2.0, 3.0)),
        "scan": plots.scan_with_residuals(
            X, np.sin(X), [("as calibrated", X), ("repaired", np.sin(X))], label="X (mm)", unit="V"
        ),
        "clouds": plots.residuals_against_covariates([("time (s)", X)], [("as calibrated", noise)], unit="V"),
        "gain": plots.heldout_gain_by_scan([("edge_0", 0.5), ("edge_90", -0.1)], 0.2, 0.05),
        "neighbours": plots.residual_autocorrelation(noise, scan, rho=0.3),
        "spread": plots.spread_by_level(X, noise, unit="V", model_sd=np.ones(200)),
        "tails": plots.residual_histogram(noise, 1.0),
        "lattice": plots.readings_modulo_step(np.round(noise, 1), 0.1, unit="V"),
    }


@pytest.fixture(scope="module")
def figures():
    return drawn()


@pytest.fixture(scope="module")
def images(figures):
    return {name: plots.svg(drawing) for name, drawing in figures.items()}


def test_every_axis_says_what_it_carries(figures):
    for name, drawing in figures.items():
        for ax in np.atleast_1d(drawing):
            assert ax.get_ylabel(), name
        assert np.atleast_1d(drawing)[-1].get_xlabel(), name


def test_readings_without_a_unit_have_no_empty_brackets():
    ax = plots.mean_residuals_along(means(), label="time (s)", unit="")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time (s)", "mean residual")


@pytest.mark.slow
def test_no_legend_lies_over_data(figures, images):
    for name, drawing in figures.items():
        assert images[name]
        for ax in np.atleast_1d(drawing):
            legend = ax.get_legend()
            if legend is not None:
                assert legend.get_window_extent().y0 >= ax.get_window_extent().y1 - 1, name
                assert legend.get_window_extent().x1 <= ax.figure.bbox.x1, name


def test_a_legend_beside_long_names_below_it_is_whole_and_ticks_stand_apart():
    axes = canvas.stack_of_axes([2.7, 2.0])
    shifted = mean_residuals(X - 5.006, np.sin(X), 0.1 * np.sin(X), sd=1.0)
    plots.mean_residuals_along(shifted, label="dq", unit="Nm", window=(-1.0, 1.0), ax=axes[0])
    plots.hypothesis_probabilities(["another height of the sensor above the surface in some scans"], [1.0], ax=axes[1])
    assert plots.svg(axes)
    sheet, ax = axes[0].figure, axes[0]
    assert ax.get_legend().get_window_extent().x1 <= sheet.bbox.x1
    ticks = [label.get_window_extent() for label in ax.get_xticklabels() if label.get_text()]
    assert all(first.x1 < second.x0 for first, second in itertools.pairwise(ticks))


def test_the_same_drawing_gives_the_same_bytes():
    first, second = (plots.svg(plots.heldout_gain_by_scan([("edge_0", 0.5)], 0.2, 0.05)) for _ in range(2))
    assert first == second


def test_a_name_is_drawn_as_it_is_written_whatever_style_is_set():
    """Neither as a formula, nor by LaTeX, which may not be there; powers along a logarithmic axis are formulas."""
    with mpl.rc_context({"text.usetex": True}):
        ax = canvas.axes_or_new(None)
        ax.plot([1, 1000])
        ax.set(yscale="log", xlabel=r"$\frac{1}$ of $5 in a_b, %")
        drawn = canvas.svg(ax).decode()
    assert r"$\frac{1}$ of $5 in a_b, %" in drawn
    assert r"$\mathdefault{10^{2}}$" in drawn


def test_rounded_readings_lie_on_their_lattice(figures):
    counts = [bar.get_height() for bar in figures["lattice"].containers[0]]
    assert max(counts) == 200
    assert np.argmax(counts) == 20


def test_neighbours_of_ar_1_noise_are_correlated_by_rho():
    rng, rho = np.random.default_rng(1), 0.6
    noise = rng.standard_normal(4000)
    for k in range(1, 4000):
        noise[k] += rho * noise[k - 1]
    ax = plots.residual_autocorrelation(noise, np.zeros(4000, dtype=int))
    (found,) = (line for line in ax.lines if line.get_label() == "residuals")
    # The standard error is about 1 / sqrt(4000).
    np.testing.assert_allclose(found.get_ydata()[:2], [rho, rho**2], atol=0.08)


@pytest.mark.slow
def test_a_diagnosis_needs_no_plotting_library():
    """A second of its start alone is a fifth of what a whole diagnosis may take."""
    asked = "import sys, probewise.cli.diagnose, probewise.diagnosis; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True).stdout.split()
    assert not {"matplotlib", "scipy.stats", "scipy.spatial", "scipy.optimize"} & set(loaded)


def test_processes_that_search_load_no_plotting_library():
    asked = "import sys, probewise.cli.demo; sys.exit(' '.join({'matplotlib', 'scipy.stats'} & {*sys.modules}) or 0)"
    assert subprocess.run([sys.executable, "-c", asked], check=False).returncode == 0


def test_a_covariate_of_few_values_has_points_with_bars_and_no_line():
    """Neighbours of equal size would give several means at one value: a saw-tooth."""
    voltage, noise = np.repeat([3.0, 5.0, 12.0], 60), np.random.default_rng(2).standard_normal(180)
    found = mean_residuals(voltage, noise, None, sd=1.0)
    np.testing.assert_array_equal(found.at, [3.0, 5.0, 12.0])
    np.testing.assert_allclose(found.before, [noise[voltage == v].mean() for v in found.at])
    (running,) = plots.residuals_against_covariates([("voltage (V)", voltage)], [("fitted", noise)], unit="V")
    for ax in (plots.mean_residuals_along(found, label="voltage (V)", unit="V"), running):
        means = [line for line in ax.lines if len(line.get_xdata()) == 3]  # and the caps of bars
        assert means
        assert all(line.get_linestyle() == "None" for line in means)
        assert ax.containers
