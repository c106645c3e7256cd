"""The page of an autonomous run: what the robot found, and its view at every step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray
from probewise.experiment import Experiment, Exploration, Step
from probewise.report.html import Markup, Section, definition_list, figure, page, paragraph, table
from probewise.report.plots import grid_of_axes, information_gained, playing_field, png, posterior_widths
from probewise.report.words import count, number, signed
from probewise.scene import AnyOf, outlines

__all__ = ["answer", "errors_text", "frame", "frame_of_both", "live_page", "steps_table", "view", "write_page"]


def view(
    step: Step,
    experiment: Experiment,
    readings: Sequence[tuple[float, float, float]],
    *,
    levels: tuple[float, float],
    truth_mm: FloatArray | None = None,
    title: str = "",
    ax: Axes | None = None,
) -> Axes:
    """Draw the robot's view of the field after a step (the paper's picture).

    Parameters
    ----------
    step, experiment
        What is believed, of which shape.
    readings
        x_mm, y_mm and value of the readings up to this step.
    levels
        Readings over black and white.
    truth_mm
        Outline of what lies there, shape (n_vertices, 2), where it is known.
    title
        Title; the number of readings without.
    ax
        Axes to draw on; a new figure without.
    """
    seen = np.asarray(readings, dtype=np.float64).reshape(-1, 3)
    pose = step.next_pose
    return playing_field(
        step.map.image,
        experiment.grid.x_mm,
        experiment.grid.y_mm,
        outlines_mm=outlines(experiment.shape.region(step.samples)),
        places_mm=seen[:, :2],
        readings=seen[:, 2],
        levels=levels,
        next_mm=None if pose is None else (pose.x_mm, pose.y_mm),
        truth_mm=truth_mm,
        utility_label=step.map.label,
        title=title or f"after {count(step.number, 'reading')}, {number(step.bits, 1)} bits known",
        ax=ax,
    )


def frame(
    step: Step,
    experiment: Experiment,
    readings: Sequence[tuple[float, float, float]],
    *,
    levels: tuple[float, float],
    truth_mm: FloatArray | None = None,
) -> bytes:
    """Draw the picture of one step as a PNG."""
    return png(view(step, experiment, readings, levels=levels, truth_mm=truth_mm), dpi=90)


def frame_of_both(
    views: Sequence[tuple[str, Step, Experiment]],
    readings: Sequence[tuple[float, float, float]],
    *,
    levels: tuple[float, float],
    truth_mm: FloatArray | None = None,
) -> bytes:
    """Draw what several sensor models make of the same readings side by side (the paper's panels) as a PNG.

    Each view is a title, a step and the experiment it belongs to; the rest is as in `view`.
    """
    axes = grid_of_axes(1, len(views), size_in=(7.2 * len(views), 4.2))
    for ax, (title, step, experiment) in zip(axes[0], views, strict=True):
        known = f"{title}, {count(step.number, 'reading')}, {number(step.bits, 1)} bits"
        view(step, experiment, readings, levels=levels, truth_mm=truth_mm, title=known, ax=ax)
    return png(axes, dpi=75)


def live_page(step: Step, picture: bytes) -> str:
    """Write the page that shows a run while it works: it loads itself anew every second until the run is over."""
    state = "The robot works" if step.stop_reason is None else f"The robot has stopped: {step.stop_reason}"
    found = figure(picture, f"Next, the robot reads at the green place. {step.summary()}.")
    every_s = None if step.stop_reason else 1
    return page("The robot's search", answer=f"{state}.", key_figure=found, sections=(), reload_s=every_s)


def errors_text(step: Step, truth: Mapping[str, float]) -> str:
    """Say how far from the truth the estimates are."""
    return ", ".join(
        f"{_plain(name)} {signed(float(mean) - truth[name], _decimals(name))} ± {number(float(sd), _decimals(name))}"
        for name, mean, sd in zip(step.names, step.mean, step.sd, strict=True)
        if name in truth and np.isfinite(mean)
    )


def answer(run: Exploration) -> str:
    """Say in one sentence what was found."""
    what = found_shape(run)
    known = ", ".join(
        f"{_plain(name)} {number(float(mean), _decimals(name))} ± {number(float(sd), _decimals(name))}{_unit(name)}"
        for name, mean, sd in zip(run.last.names, run.last.mean, run.last.sd, strict=True)
        if np.isfinite(mean) and name != "shape"
    )
    if not run.reached:
        return f"Not found to the precision asked for in {count(len(run.steps), 'reading')}: {known}."
    return f"Found in {count(len(run.steps), 'reading')}: {what} with {known}."


def found_shape(run: Exploration) -> str:
    """Name the shape; of a set of shapes the most probable, with its share of the posterior."""
    shape = run.experiment.shape
    if not isinstance(shape, AnyOf):
        return "a " + type(shape).__name__.replace("RegularPolygon", "regular polygon").lower()
    which = shape.which(run.posterior.theta[:, run.experiment.shape_columns])
    share = np.bincount(which, weights=run.posterior.weight, minlength=len(shape.labels))
    best = int(np.argmax(share))
    return f"a {shape.labels[best]} (probability {number(float(share[best]), 3)})"


def steps_table(run: Exploration) -> Markup:
    """Build the table of steps: where, what, what was then known."""
    return table(
        ("reading", "at (mm)", "value", "widest sd (mm)", "bits so far"),
        (
            (
                str(s.number),
                f"{number(s.reading.pose.x_mm, 0)}, {number(s.reading.pose.y_mm, 0)}{s.stance}",
                f"{s.reading.value:g}",
                number(s.widest_mm, 1),
                number(s.bits, 1),
            )
            for s in run.steps
        ),
    )


def write_page(
    run: Exploration,
    frames: Sequence[bytes],
    *,
    seed: int,
    model: str,
    truth: Mapping[str, float] | None = None,
    beside: Mapping[str, Sequence[Step]] | None = None,
) -> str:
    """Write the whole page.

    Parameters
    ----------
    run
        The run.
    frames
        PNG of each step.
    seed, model
        Seed of the run and name of the sensor model.
    truth
        Parameters of what lay there, by name, where it is known.
    beside
        What other sensor models made of the same readings, step by step, by name of the model.
    """
    runs = {f"{model} model": run.steps} | {f"{name} model": steps for name, steps in (beside or {}).items()}
    facts = [
        ("sensor model", model),
        ("stopped because", run.stop_reason),
        ("information", f"{number(run.last.bits, 1)} bits, {number(run.bits_per_reading, 2)} a reading"),
        ("the paper's count", f"{number(run.paper_bits_per_reading, 2)} bits a reading (25 bits over the readings)"),
        ("fit of the best hypothesis", f"p = {run.last.p_value:.2g}"),
        ("seed", str(seed)),
    ]
    if truth:
        facts.insert(2, ("error against the truth", errors_text(run.last, truth)))
    sections = [
        Section("The run", (definition_list(facts), *(paragraph(f"Doubtful: {note}.") for note in run.notes))),
        Section(
            "How fast",
            (
                figure(
                    png(
                        posterior_widths(
                            {name: np.array([s.widest_mm for s in steps]) for name, steps in runs.items()},
                            target_mm=run.experiment.stop_sd_mm,
                        )
                    ),
                    "Widest posterior sd after each reading, and the precision asked for.",
                ),
                figure(
                    png(information_gained({name: np.array([s.bits for s in steps]) for name, steps in runs.items()})),
                    "Information about the shape: prior minus posterior differential entropy.",
                ),
                steps_table(run),
            ),
        ),
        Section(
            "Every step",
            tuple(
                figure(picture, f"Reading {s.number}: {s.reading.value:g}.")
                for s, picture in zip(run.steps[:-1], frames[:-1], strict=True)
            ),
        ),
    ]
    caption = (
        "The robot's view of the field: in copper where a reading would tell most, blue the 50 hypotheses drawn from "
        "what is believed, squares the readings by their brightness, green the place chosen next"
        + (", dashed white what really lies there." if truth else ".")
        + (f" Beside it what the {' and the '.join(beside)} model makes of the same readings." if beside else "")
    )
    return page("The robot's search", answer=answer(run), key_figure=figure(frames[-1], caption), sections=sections)


def _plain(name: str) -> str:
    return name.removesuffix("_mm").removesuffix("_rad").replace("_", " ").replace(".", " ")


def _decimals(name: str) -> int:
    """Decimals of a parameter: an angle in radians needs more than a length in mm."""
    return 3 if name.endswith("_rad") else 1


def _unit(name: str) -> str:
    return " mm" if name.endswith("_mm") else " rad" if name.endswith("_rad") else ""
