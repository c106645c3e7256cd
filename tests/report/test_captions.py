"""Pages of a search, a calibration and a study: what a caption names is in its picture, what is said has its error."""

import base64
import io
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from hand_made import hand_made_sensor
from PIL import Image
from small_search import arm_and_experiment

from probewise.calibration import predict
from probewise.experiment import (
    Exploration,
    estimated_shape,
    explore,
    probability_of_length_off,
    result_json,
    samples_csv,
)
from probewise.recordings import read_recording, shipped
from probewise.report import calibration as calibration_report
from probewise.report import exploration
from probewise.report.plots.canvas import axes_of_frame
from probewise.scene import outlines

TRUTH = np.array([[600.0, 260.0, 120.0]])
COLOURS = {
    "green": (0, 224, 138),
    "blue": (63, 167, 255),
    "white": (255, 255, 255),
    "red": (213, 60, 30),
    "orange": (230, 159, 0),
    "grey": (140, 140, 140),
    "copper": (184, 115, 51),
    "purple": (204, 121, 167),
}


def searched(n_readings):
    rng = np.random.default_rng(4)
    arm, experiment = arm_and_experiment(tuple(TRUTH[0]), rng)
    with arm:
        return Exploration(experiment, tuple(explore(arm, experiment, rng=rng, max_readings=n_readings)))


@pytest.fixture(scope="module")
def run():
    return searched(2)


@pytest.fixture(scope="module")
def frames(run):
    places = [(r.pose.x_mm, r.pose.y_mm, r.value) for r in run.readings]
    outline = outlines(run.experiment.shape.region(TRUTH))[0]
    return [
        exploration.robot_view_png(step, run.experiment, places[: step.number], levels=(10.0, 60.0), truth_mm=outline)
        for step in run.steps
    ]


def test_a_plotted_view_is_in_a_figure_of_its_own(run):
    first, second = run.plot(), run.plot()
    assert {first.figure.number, second.figure.number} <= {*plt.get_fignums()}
    assert first.figure is not second.figure
    plt.close("all")


def test_a_frame_in_the_axes_of_the_one_before_is_the_frame_in_new_axes(run, frames):
    axes_of_frame.cache_clear()
    places = [(r.pose.x_mm, r.pose.y_mm, r.value) for r in run.readings]
    outline = outlines(run.experiment.shape.region(TRUTH))[0]
    last = exploration.robot_view_png(run.last, run.experiment, places, levels=(10.0, 60.0), truth_mm=outline)
    assert last == frames[-1] != frames[0]


def test_frames_of_both_models_have_the_field_at_the_same_place(run):
    left = []
    for step in run.steps:
        views = [(name, step, run.experiment) for name in ("naive model", "SSF model")]
        frame = exploration.robot_views_by_model_png(views, [(r.pose.x_mm, 0, 0) for r in run.readings], levels=(0, 60))
        left.append(np.asarray(Image.open(io.BytesIO(frame)))[:, :50])  # the ticks along y
    np.testing.assert_array_equal(*left)


def pictures_with_captions(page):
    for found in re.findall(r"<figure>.*?</figure>", page, flags=re.S):
        image = base64.b64decode(re.search(r"base64,([^\"]+)", found)[1])
        yield image, re.sub("<[^>]+>", "", found.partition("<figcaption>")[2])


def named_but_not_there(page):
    missing = []
    for image, caption in pictures_with_captions(page):
        pixels = np.asarray(Image.open(io.BytesIO(image)).convert("RGB")).reshape(-1, 3).astype(int)
        for name, colour in COLOURS.items():
            if re.search(rf"\b{name}\b", caption.lower()) and (np.abs(pixels - colour).max(axis=1) < 30).sum() < 20:
                missing.append((name, caption))
    return missing


@pytest.mark.slow
def test_the_page_of_a_search_names_no_colour_that_is_not_there(run, frames):
    page = exploration.page_html(run, frames[-1], frames[-1], seed=4, model="ssf")
    assert named_but_not_there(page) == []
    for step, frame in zip(run.steps, frames, strict=True):
        assert named_but_not_there(exploration.live_page_html(step, frame)) == []
    assert "green" in exploration.live_page_html(run.steps[0], frames[0])
    assert "green" not in exploration.live_page_html(run.last, frames[-1])


def test_the_page_of_a_search_gives_the_shape_with_its_errors_and_what_it_cost(run, frames):
    page = exploration.page_html(run, frames[-1], frames[-1], seed=4, model="ssf", truth={"x_mm": 600.0, "y_mm": 260.0})
    text = re.sub("<[^>]+>", " ", page)
    found = estimated_shape(run)
    for parameter in found.parameters:
        assert parameter.name.removesuffix("_mm") in text
    assert f"{run.seconds:.0f} s of arm time" in text
    assert "95 % interval" in text
    assert "600" in text
    assert re.search(r"a circle with x [\d.]+ ± [\d.]+ mm", page)


def test_widths_beside_a_result_that_counts_the_arms_error_say_that_they_lack_it(run):
    assert "without the arm" not in exploration.steps_table(run)
    last = replace(run.last, arm_error=SimpleNamespace(sd=np.ones(3)))
    known = replace(run, steps=(*run.steps[:-1], last))
    assert "widest sd without the arm&#x27;s own error (mm)" in exploration.steps_table(known)


def test_result_json_says_what_was_found_and_samples_csv_holds_the_posterior(run):
    document = json.loads(result_json(run), parse_constant=pytest.fail)
    assert list(document) == [
        "format",
        "readings",
        "stop_reason",
        "known",
        "shape",
        "chance_off_12mm",
        "left_out",
        "notes",
        "bits",
        "seconds",
    ]
    assert (document["format"], document["readings"], document["known"]) == ("exploration/1", 2, False)
    assert document["stop_reason"] == run.stop_reason
    assert document["shape"]["name"] == "circle"
    rows = np.genfromtxt(io.StringIO(samples_csv(run)), delimiter=",", names=True)
    assert rows.dtype.names == ("weight", "x_mm", "y_mm", "radius_mm")
    weight = rows["weight"]
    assert weight.sum() == pytest.approx(1.0, abs=1e-4)
    off = np.zeros(len(rows), dtype=bool)
    for parameter in document["shape"]["parameters"]:
        values = rows[parameter["name"]]
        mean = weight @ values
        assert parameter["mean"] == pytest.approx(mean, abs=0.01)
        assert parameter["sd"] == pytest.approx(np.sqrt(weight @ (values - mean) ** 2), abs=0.01)
        low, high = parameter["interval95"]
        assert weight[(values >= low) & (values <= high)].sum() == pytest.approx(0.95, abs=0.02)
        off |= np.abs(values - mean) > 12.0
    assert document["chance_off_12mm"] == pytest.approx(weight[off].sum(), abs=1e-3)
    assert probability_of_length_off(run.experiment, run.posterior, 1e6) == 0.0


@pytest.mark.slow
def test_the_page_of_a_calibration_names_what_is_there_and_prints_no_error_of_zero():
    recording = read_recording(shipped("paper"))
    sensor = hand_made_sensor()
    found = SimpleNamespace(sensor=sensor, orders=sensor.orders, fields={1: sensor.field, 2: sensor.field})
    prediction = predict(sensor, recording.plan, recording.readings)
    drawn = {n: draw() for n, draw in calibration_report.figure_drawers(found, recording, prediction).items()}
    page = calibration_report.page_html(found, recording, prediction, drawn, seed=0)
    assert named_but_not_there(page) == []
    text = re.sub("<[^>]+>", " ", page)
    assert not re.search(r"± 0\.?0*(?![\d.])", text)
    for name in ("centre u", "sd long", "sd short", "angle", "A_1"):
        assert name in text
    assert "median" in text
    # The one sample far off makes the sd of A_1; median and interval do not know of it.
    assert sensor.sd()["A_1"] > 0.02
    cells = re.search(r"A_1</td>.*?</tr>", page)[0]
    assert "0.031" in cells
    assert f"{sensor.sd()['A_1']:.3f}" not in cells
