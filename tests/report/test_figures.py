"""Every plot function: pyplot knows its figure, its texts can be read, and it shows the data that it is given."""

import io
import itertools
import subprocess
import sys
from types import SimpleNamespace

import matplotlib as mpl
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
from probewise.recordings import Recording, paper_plan, read_recording, shipped
from probewise.report import plots
from probewise.report.exploration import animated_gif
from probewise.report.plots import canvas
from probewise.report.plots.readings import tracks_and_single_rows
from probewise.report.residual_means import mean_residuals
from probewise.sensor import SSFField

X_MM, Y_MM = np.linspace(4, 1044, 66), np.linspace(4, 516, 33)


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
    utility = np.tile(np.linspace(0.0, 1.0, X_MM.size), (Y_MM.size, 1))
    utility[:3, :5] = np.nan
    return {
        "utility": utility,
        "x_mm": X_MM,
        "y_mm": Y_MM,
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

X, NOISE = np.linspace(0.0, 10.0, 200), np.random.default_rng(0).standard_normal(200)
LONG = "noise that grows with the signal and an effect with a long name"
SCAN = [("as calibrated", X), ("repaired", np.sin(X))]


def means(**options):
    return mean_residuals(X, np.sin(X), 0.1 * np.sin(X), sd=1.0, **options)


FIGURES = {
    "corner_plot": lambda s: plots.corner_plot(s.result),
    "trace_plot": lambda s: plots.trace_plot(s.result),
    "insertion_plot": lambda s: plots.insertion_plot(s.result),
    "run_plot": lambda s: plots.run_plot(s.result),
    "playing_field": lambda s: plots.playing_field(**field()),
    "reach_map": lambda s: plots.reach_map(field()["utility"], X_MM, Y_MM, axis_mm=(524.0, 580.0)),
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
    "mean_residuals_along": lambda s: plots.mean_residuals_along(
        means(), label="X (mm)", unit="V", each=(X, np.sin(X)), window=(2.0, 3.0)
    ),
    "mean_residuals_along, of categories": lambda s: plots.mean_residuals_along(
        mean_residuals(np.repeat(np.arange(4.0), 50), NOISE, None, sd=1.0), label="scan", unit="V", names=EFFECTS[:4]
    ),
    "scan_with_residuals": lambda s: plots.scan_with_residuals(X, np.sin(X), SCAN, label="X (mm)", unit="V"),
    "residuals_against_covariates": lambda s: plots.residuals_against_covariates(
        [("time (s)", X), ("reading (V)", NOISE)], [("as calibrated", NOISE)], unit="V"
    ),
    "heldout_gain_by_scan": lambda s: plots.heldout_gain_by_scan([("edge_0", 0.5), ("edge_90", -0.1)], 0.2, 0.05),
    "residual_autocorrelation": lambda s: plots.residual_autocorrelation(NOISE, np.repeat([0, 1], 100), rho=0.3),
    "spread_by_level": lambda s: plots.spread_by_level(X, NOISE, unit="V", model_sd=np.ones(200)),
    "residual_histogram": lambda s: plots.residual_histogram(NOISE, 1.0),
    "readings_modulo_step": lambda s: plots.readings_modulo_step(np.round(NOISE, 1), 0.1, unit="V"),
    "readings_in_order": lambda s: plots.readings_in_order(s.recording),
    "hypothesis_probabilities, long": lambda s: plots.hypothesis_probabilities([f"{LONG} and {LONG}", "b"], [0.6, 0.4]),
    **{
        f"probabilities_by_round, {n} long": lambda s, n=n: plots.probabilities_by_round(
            {"round 1: 30 readings": {f"{' and '.join([LONG] * n)}, number {k}": 1 / 9 for k in range(9)}}
        )
        for n in (1, 2, 5)
    },
}


def test_every_plot_function_is_here():
    others = {"AxesGrid", "PAGE_IN", "SMALL_PT", "draw_field_legend", "grid_of_axes", "png", "stack_of_axes", "svg"}
    of_campaigns = {"confusion_matrix", "doubt_against_trust", "posterior_widths_of_runs", "readings_needed"}
    assert {name.partition(",")[0] for name in FIGURES} == {
        *plots.__all__,
        *of_campaigns,
        "reliability_diagram",
    } - others


@pytest.mark.slow
@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_is_pyplots_and_can_be_read(name, result, recording):
    drawn = FIGURES[name](SimpleNamespace(result=result, recording=recording))
    every = [ax for ax in np.atleast_1d(drawn).flat if ax is not None]
    figure = every[0].figure
    assert plt.gcf() is figure
    out = io.BytesIO()
    plt.savefig(out)
    assert np.asarray(Image.open(out).convert("L")).std() > 1.0
    width_in = figure.get_tightbbox().width + 0.2  # a page shrinks it to its width
    texts = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip()]
    assert min(t.get_fontsize() for t in texts) * min(1.0, plots.PAGE_IN / width_in) >= 8.5
    every = [ax for ax in every if ax.get_visible()]
    assert any(ax.get_xlabel() for ax in every)  # ticks that are names have none
    assert no_text_is_cut_off_or_over_another(figure, every)
    plots.png(figure, dpi=20)
    assert plt.get_fignums() == []


def no_text_is_cut_off_or_over_another(figure, every):
    """Of all but turned ticks, whose boxes reach further than they do; a legend above axes is not over data."""
    shown = [*(t for ax in every for t in (ax.xaxis.label, ax.yaxis.label)), *figure.texts]
    for ax in every:
        for side, axis in enumerate((ax.xaxis, ax.yaxis)):
            low, high = sorted(axis.get_view_interval())
            ticks = [t for t in axis.get_majorticklabels() if low <= t.get_position()[side] <= high]
            shown += [t for t in ticks if t.get_rotation() % 90 == 0]
    legends = [*filter(None, (ax.get_legend() for ax in every)), *figure.legends]
    shown += [t for legend in legends for t in legend.get_texts()]
    boxes = [t.get_window_extent() for t in shown if t.get_visible() and t.get_text().strip()]
    ground = figure.bbox.padded(2)
    assert all(ground.x0 <= b.x0 and b.x1 <= ground.x1 and ground.y0 <= b.y0 and b.y1 <= ground.y1 for b in boxes)
    return not any(one.padded(-1).overlaps(other.padded(-1)) for one, other in itertools.combinations(boxes, 2))


@pytest.mark.slow
def test_drawing_on_given_axes_opens_no_figure():
    sheet = plt.figure()
    one = sheet.add_subplot()
    assert plots.posterior_widths(WIDTHS, ax=one) is one
    assert plt.get_fignums() == [sheet.number]
    plots.png(one, dpi=20)
    assert plt.get_fignums() == [sheet.number]


def test_readings_without_a_unit_have_no_empty_brackets():
    ax = plots.mean_residuals_along(means(), label="time (s)", unit="")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time (s)", "mean residual")


def test_the_papers_plan_has_four_lines_and_four_readings_alone():
    found, alone = tracks_and_single_rows(paper_plan())
    assert [len(t.rows) for t in found] == [101] * 4
    assert [t.label for t in found] == ["0°", "90°", "180°", "270°"]
    assert len(alone) == 4
    for track in found:
        np.testing.assert_allclose(np.sort(track.along_mm), np.arange(-50.0, 51.0), atol=1e-9)


def test_predictions_get_a_panel_a_scan_and_one_for_the_readings_alone(recording):
    axes = plots.predicted_and_recorded_by_scan(recording, recording.readings, np.ones(len(recording)))
    assert sum(ax.get_visible() for ax in axes.flat) == 5
    plan = read_recording(shipped("concealed")).plan
    many = Recording(plan, np.full(len(plan), 30.0))
    axes = plots.predicted_and_recorded_by_scan(many, many.readings, np.ones(len(many)))
    assert sum(ax.get_visible() for ax in axes.flat) <= 8


def test_the_field_shows_readings_by_brightness_and_the_next_place():
    ax = plots.playing_field(**field())
    squares, green = ax.collections[1:]
    np.testing.assert_allclose(squares.get_facecolors()[:, :3], [[0, 0, 0], [1, 1, 1]])
    np.testing.assert_allclose(green.get_offsets(), [[700.0, 300.0]])
    assert "mm" in ax.get_xlabel()


@pytest.mark.slow
def test_probabilities_that_are_not_drawn_one_by_one_are_added_up():
    ax = plots.hypothesis_probabilities([str(k) for k in range(20)], np.full(20, 0.05), most=8)
    widths = [bar.get_width() for bar in ax.patches]
    assert len(widths) == 9
    assert sum(widths) == pytest.approx(1.0)


@pytest.mark.parametrize("mounted_deg", [180.0, 0.0, 77.0])
def test_the_colours_span_the_angles_that_there_are_also_across_180_degrees(mounted_deg):
    """The sensor turns by less than half a turn over the field, however it is mounted."""
    x, y = X_MM[::2], Y_MM[::2]
    geometry = read_geometry(shipped_geometry_path())
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    standing = geometry.orientation_rad(places) + np.radians(mounted_deg - 180.0)
    held = np.where(geometry.contains(places), (standing + np.pi) % (2 * np.pi) - np.pi, np.nan).reshape(y.size, x.size)
    ax = plots.reach_map(held, x, y, axis_mm=geometry.axis_mm)
    low, high = ax.images[0].get_clim()
    assert 150 < high - low < 180
    drawn = np.ma.filled(ax.images[0].get_array(), np.nan)
    np.testing.assert_allclose(np.exp(1j * np.radians(drawn)), np.exp(1j * held), atol=1e-9)
    ax.figure.canvas.draw()
    ticks = [label.get_text() for label in ax.child_axes[-1].get_yticklabels()]
    assert len(ticks) >= 10
    assert all(-180 <= float(tick.replace("−", "-")) <= 180 for tick in ticks)


def test_frames_follow_each_other():
    red, blue = io.BytesIO(), io.BytesIO()
    Image.new("RGB", (8, 6), "red").save(red, "PNG")
    Image.new("RGB", (8, 6), "blue").save(blue, "PNG")
    moving = Image.open(io.BytesIO(animated_gif([red.getvalue(), blue.getvalue()], frame_s=0.5, last_s=2.0)))
    assert (moving.n_frames, moving.size, moving.info["loop"]) == (2, (8, 6), 0)
    for k, (duration, colour) in enumerate([(500, (255, 0, 0)), (2000, (0, 0, 255))]):
        moving.seek(k)
        assert (moving.info["duration"], moving.convert("RGB").getpixel((6, 3))) == (duration, colour)


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


def test_rounded_readings_lie_on_their_lattice():
    ax = plots.readings_modulo_step(np.round(NOISE, 1), 0.1, unit="V")
    counts = [bar.get_height() for bar in ax.containers[0]]
    assert max(counts) == 200
    assert np.argmax(counts) == 20


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


def test_the_autocorrelation_of_interleaved_runs_is_that_of_each():
    runs = np.random.default_rng(2).standard_normal((2, 40)).cumsum(axis=1)
    apart, mixed = (
        plots.residual_autocorrelation(values, scan).get_lines()[-1].get_ydata()
        for values, scan in ((runs.ravel(), np.repeat([0, 1], 40)), (runs.T.ravel(), np.tile([0, 1], 40)))
    )
    np.testing.assert_allclose(mixed, apart)
