"""Every plot function: pyplot knows its figure, its type can be read."""

import io
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.text import Text
from PIL import Image

from probewise.arm.geometry_file import read_geometry, shipped_geometry_path
from probewise.nested import run
from probewise.priors import Product, Uniform
from probewise.proof import pages as of_campaigns
from probewise.proof.campaign import Estimate, estimated_share
from probewise.proof.concealed_study import ConcealedRow
from probewise.recordings import read_recording, shipped
from probewise.report import plots
from probewise.sensor import SSFField

X, Y = np.linspace(4, 1044, 66), np.linspace(4, 516, 33)


class Bell:
    """Six parameters, as many as fit a page; C_1 has long numbers."""

    prior = Product({n: Uniform(-0.5, 0.5) for n in ("a_1", "u_1", "v_1", "A_1", "B_1", "C_1")})

    def log_likelihood(self, theta):
        return -0.5 * ((theta / 0.012) ** 2).sum(axis=1)


@pytest.fixture(scope="module")
def result():
    return run(Bell(), rng=np.random.default_rng(0), n_live=100)


@pytest.fixture(scope="module")
def recording():
    return read_recording(shipped("paper"))


def blob():
    x = np.arange(-20.0, 21.0)
    return SSFField(np.exp(-(x[None, :] ** 2) / 32 - x[:, None] ** 2 / 18), 1.0, (-20.0, -20.0))


def field(**more):
    utility = np.tile(np.linspace(0.0, 1.0, X.size), (Y.size, 1))
    utility[:3, :5] = np.nan
    return {
        "utility": utility,
        "x_mm": X,
        "y_mm": Y,
        "outlines_mm": [np.array([[300.0, 200.0], [400.0, 300.0], [500.0, 200.0], [300.0, 200.0]])],
        "places_mm": np.array([[100.0, 300.0], [200.0, 300.0]]),
        "readings": np.array([10.0, 60.0]),
        "levels": (10.0, 60.0),
        "next_mm": (700.0, 300.0),
        "truth_mm": np.array([[300.0, 100.0], [400.0, 200.0], [500.0, 100.0], [300.0, 100.0]]),
        "utility_label": "information about rectangle.width_mm (bits) per second",
    } | more


def row(mean):
    return SimpleNamespace(**{k: Estimate(mean, mean - 2, mean + 2) for k in ("mean", "median", "after_white")})


ROWS = {"inside, naive": row(16.0), "inside, SSF, believed 30% too narrow, learning it": row(9.0)}
CONCEALED = [
    ConcealedRow(name, size, trust, 30, 11.0, 12.0, *[Estimate(0.5, 0.3, 0.7)] * 5, 2.0, 0.5, 1.0)
    for name, size in (("nothing", None), ("hysteresis", 4.0), ("quantisation", 5.0))
    for trust in (0.9, 1.0)
]
RUNS = {name: [np.geomspace(300, 3, 10 + k) for k in range(4)] for name in ("inside, SSF", "anywhere, naive", "more")}
DOUBT = [{"clean": 0.9, "lag": 0.1}, {"clean": 0.2, "lag": 0.7, "halo": 0.1}]
WIDTHS = {"naive model": np.geomspace(300, 3, 26), "SSF model": np.geomspace(300, 3, 16)}
EFFECTS = [f"an_effect_of_a_long_name_{k}" for k in range(24)]

FIGURES = {
    "corner_plot": lambda s: plots.corner_plot(s.result),
    "trace_plot": lambda s: plots.trace_plot(s.result),
    "insertion_plot": lambda s: plots.insertion_plot(s.result),
    "run_plot": lambda s: plots.run_plot(s.result),
    "playing_field": lambda s: plots.playing_field(**field()),
    "reach_map": lambda s: plots.reach_map(field()["utility"], X, Y, axis_mm=(524.0, 580.0)),
    "spatial_sensitivity": lambda s: plots.spatial_sensitivity(blob()),
    "ssf_by_n_gaussians": lambda s: plots.ssf_by_n_gaussians(
        dict.fromkeys((1, 2, 3), blob()), {1: -389.8, 2: -394.0, 3: -397.7}, {1: 0.02, 2: 0.5, 3: 0.6}
    ),
    "effect_probabilities_by_reading": lambda s: plots.effect_probabilities_by_reading(DOUBT),
    "posterior_widths": lambda s: plots.posterior_widths(WIDTHS),
    "information_gained": lambda s: plots.information_gained({k: np.arange(16.0) for k in WIDTHS}),
    "readings_by_orientation": lambda s: plots.readings_by_orientation(s.recording),
    "predicted_and_recorded_by_scan": lambda s: plots.predicted_and_recorded_by_scan(
        s.recording, s.recording.readings, np.ones(len(s.recording))
    ),
    "standardised_residuals": lambda s: plots.standardised_residuals(
        s.recording, s.recording.readings, s.recording.readings
    ),
    "readings_needed": lambda s: of_campaigns.readings_needed(ROWS),
    "readings_needed, one row": lambda s: of_campaigns.readings_needed({"inside, naive": row(16.0)}),
    "doubt_against_trust": lambda s: of_campaigns.doubt_against_trust(CONCEALED),
    "posterior_widths_of_runs": lambda s: of_campaigns.posterior_widths_of_runs(RUNS),
    "posterior_widths_of_runs, one": lambda s: of_campaigns.posterior_widths_of_runs(
        {"inside, SSF": RUNS["inside, SSF"]}
    ),
    "hypothesis_probabilities": lambda s: plots.hypothesis_probabilities(EFFECTS[:3], [0.5, 0.3, 0.2]),
    "probabilities_by_round": lambda s: plots.probabilities_by_round(
        {
            "round 1: 408 readings": dict(zip(EFFECTS[:8], (0.3, 0.2, 0.2, 0.1, 0.1, 0.05, 0.03, 0.02), strict=True)),
            "round 2: 78 more": {EFFECTS[1]: 0.97, EFFECTS[0]: 0.03},
        }
    ),
    "audit_matrix": lambda s: plots.audit_matrix(
        EFFECTS, ["fine", "aliased", "invisible"] * 8, np.full((24, 24), 0.995), alias=0.99
    ),
    "draw_arm_lengths": lambda s: plots.draw_arm_lengths(read_geometry(shipped_geometry_path())),
    "reliability_diagram": lambda s: of_campaigns.reliability_diagram(
        [(0.15, estimated_share([True] * 3 + [False] * 17)), (0.5, estimated_share([True] * 11 + [False] * 9))]
    ),
    "recorded_against_predicted": lambda s: plots.recorded_against_predicted(
        np.arange(40.0), np.arange(40.0) + 0.3, np.ones(40), label="temp_c", unit="degC"
    ),
    "confusion_matrix": lambda s: of_campaigns.confusion_matrix(["a", "b"], ["a", "b"], np.array([[3, 1], [0, 4]])),
}


def test_every_plot_function_is_here():
    others = {"AxesGrid", "PAGE_IN", "SMALL_PT", "draw_field_legend", "grid_of_axes", "png", "stack_of_axes", "svg"}
    of_a_diagnosis = {  # laid out by `svg`, and drawn by the tests of its pages
        "residual_autocorrelation",
        "heldout_gain_by_scan",
        "readings_modulo_step",
        "mean_residuals_along",
        "scan_with_residuals",
        "readings_in_order",
        "residuals_against_covariates",
        "spread_by_level",
        "residual_histogram",
    }
    assert {name.partition(",")[0] for name in FIGURES} == {
        *plots.__all__,
        *("confusion_matrix", "doubt_against_trust", "posterior_widths_of_runs", "readings_needed"),
        "reliability_diagram",
    } - others - of_a_diagnosis


@pytest.mark.slow
@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_is_pyplots_and_can_be_read(name, result, recording):
    drawn = FIGURES[name](SimpleNamespace(result=result, recording=recording))
    figure = next(ax for ax in np.atleast_1d(drawn).flat if ax is not None).figure
    assert plt.gcf() is figure
    out = io.BytesIO()
    plt.savefig(out, dpi=20)
    assert np.asarray(Image.open(out).convert("L")).std() > 1.0
    assert smallest_type_pt(figure) >= 8.5
    plots.png(figure, dpi=20)
    assert plt.get_fignums() == []


def smallest_type_pt(figure):
    """As a page shows it: drawn with a tight box and shrunk to the page's width where it is wider."""
    width_in = figure.get_tightbbox().width + 0.2  # matplotlib's margin around it
    shown = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip()]
    return min(t.get_fontsize() for t in shown) * min(1.0, plots.PAGE_IN / width_in)


@pytest.mark.slow
def test_drawing_on_given_axes_opens_no_figure():
    sheet = plt.figure()
    one = sheet.add_subplot()
    assert plots.posterior_widths(WIDTHS, ax=one) is one
    assert plt.get_fignums() == [sheet.number]
    plots.png(one, dpi=20)
    assert plt.get_fignums() == [sheet.number]
