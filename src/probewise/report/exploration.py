"""The page of an autonomous run: the shape found, and the robot's view at every step."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from functools import cache, partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from PIL import Image

from probewise._arrays import FloatArray
from probewise._words import count_with_noun, unit_after_number, unit_of_name
from probewise._writing import Output, StagedFiles
from probewise.effects import spoken_name
from probewise.errors import require
from probewise.experiment import (
    CLEAN,
    Experiment,
    Exploration,
    Step,
    estimated_shape,
    left_out_after_step,
    probability_of_length_off,
    repaired_sensor,
    result_json,
    samples_csv,
)
from probewise.experiment.result import WRONG_MM, stop_reason_with_checks
from probewise.report import html
from probewise.report.plots.canvas import PAGE_IN, AxesGrid, axes_of_frame, grid_of_axes, png, rendered_frame
from probewise.report.plots.probabilities import effect_probabilities_by_reading
from probewise.report.plots.search import draw_field_legend, information_gained, playing_field, posterior_widths
from probewise.report.words import (
    number_text,
    probability_text,
    range_text,
    typeset_numbers,
    value_with_error,
    words_without_unit,
)
from probewise.scene import outlines
from probewise.sensor import Chain
from probewise.verbs import DEFAULT_SEED

MODEL_NAMES = {"ssf": "SSF"}
_COLOURS = 256  # of a GIF
_ROUNDED = 5  # a divisor of 255, to which colours are rounded where the palette is chosen: it takes a third of the time
_FRAME_S, _LAST_S = 0.8, 3.0
_LEAST_SHOWN = 1e-3  # probability of an effect, to be listed in the table
_MOST_SHOWN = 6


def draw_robot_view(
    step: Step,
    experiment: Experiment,
    readings: Sequence[tuple[float, float, float]],
    *,
    levels: tuple[float, float],
    truth_mm: FloatArray | None = None,
    title: str = "",
    ax: Axes | None = None,
) -> Axes:
    """Draw the robot's view of the field after a step of an experiment, as in the paper; return the axes.

    `readings` are x_mm, y_mm and value up to this step, `levels` the readings over black and white; `truth_mm` is the
    true outline, (n_vertices, 2), where known.
    """
    seen = np.asarray(readings, dtype=np.float64).reshape(-1, 3)
    pose, drawn = step.next_pose, step.map
    return playing_field(
        drawn.image,
        drawn.grid.x_mm,
        drawn.grid.y_mm,
        outlines_mm=outlines(experiment.shape.region(step.samples)),
        places_mm=seen[:, :2],
        readings=seen[:, 2],
        levels=levels,
        next_mm=None if pose is None else (pose.x_mm, pose.y_mm),
        truth_mm=truth_mm,
        cards_mm=[card.corners_mm for card in experiment.cards],
        utility_label=drawn.label,
        title=title or f"after {count_with_noun(step.number, 'reading')}, {number_text(step.bits, 1)} bits known",
        ax=ax,
    )


def robot_view_png(
    step: Step,
    experiment: Experiment,
    readings: Sequence[tuple[float, float, float]],
    *,
    levels: tuple[float, float],
    truth_mm: FloatArray | None = None,
) -> bytes:
    """Draw the robot's view after one step, with its legend; return a PNG; parameters as in `draw_robot_view`."""
    (ax,) = axes_of_frame()
    draw_robot_view(step, experiment, readings, levels=levels, truth_mm=truth_mm, ax=ax)
    draw_field_legend(ax)
    return rendered_frame(ax)


def draw_view_after(run: Exploration, number: int, *, title: str = "", ax: Axes | None = None) -> Axes:
    """Draw the robot's view after the reading of this number, from 1; return the axes."""
    return draw_robot_view(run.steps[number - 1], run.experiment, **_seen(run, number), title=title, ax=ax)


def draw_last_view(run: Exploration) -> Axes:
    """Draw the robot's view at the end of a run, with its legend, in a figure of its own; return the axes."""
    ax = draw_view_after(run, len(run.steps))
    draw_field_legend(ax)
    return ax


def _seen(run: Exploration, number: int) -> dict[str, Any]:
    """Return the first readings of a run, their lowest and highest level, and the true outline if it is known."""
    readings, values = run.readings[:number], [r.value for r in run.readings]
    return {
        "readings": [(r.pose.x_mm, r.pose.y_mm, r.value) for r in readings],
        "levels": (min(values), max(values)),
        "truth_mm": None if run.hidden is None else run.hidden.outline_mm,
    }


def robot_views_by_model_png(
    views: Sequence[tuple[str, Step, Experiment]],
    readings: Sequence[tuple[float, float, float]],
    *,
    levels: tuple[float, float],
    truth_mm: FloatArray | None = None,
) -> bytes:
    """Draw several models' posteriors (title, step, experiment), one below the other; parameters as above."""
    axes = axes_of_frame(len(views))
    for ax, (title, step, experiment) in zip(axes, views, strict=True):
        known = f"{title}, {count_with_noun(step.number, 'reading')}, {number_text(step.bits, 1)} bits"
        draw_robot_view(step, experiment, readings, levels=levels, truth_mm=truth_mm, title=known, ax=ax)
    draw_field_legend(axes)
    return png(axes, dpi=75, tight=False)


def live_page_html(
    step: Step,
    picture: bytes,
    *,
    earlier: Sequence[Step] = (),
    trust: float = 1.0,
    draw: html.Draw = html.draw_or_raise,
) -> str:
    """Return the HTML of a running exploration's page after `step`; it reloads every second until the run ends.

    If `trust` in the sensor model is below 1, the probabilities of its possible faults follow, after each of the
    `earlier` steps and this one; `draw` makes their figure.
    """
    reason = stop_reason_with_checks((*earlier, step))
    state = "The robot works" if reason is None else f"The robot has stopped: {reason}"
    following = "" if step.next_pose is None else "Next, the robot reads at the green square. "
    found = html.figure(picture, f"{following}{step.summary()}.")
    every_s = None if step.stop_reason else 1
    sections = (_fault_section((*earlier, step), trust, draw),) if trust < 1 else ()
    return html.page("The robot's search", answer=f"{state}.", key_figure=found, sections=sections, reload_s=every_s)


def _fault_section(steps: Sequence[Step], trust: float, draw: html.Draw) -> html.Section:
    """Build the section on effects that the sensor model may leave out: their probabilities after each reading."""
    doubted = left_out_after_step(steps[-1], trust)
    beliefs = [{n or CLEAN: p for n, p in s.left_out.items()} for s in steps]
    shown = html.figure(
        draw("probabilities of faults", lambda: png(effect_probabilities_by_reading(beliefs))),
        "Probabilities of the sensor's possible faults after each reading.",
    )
    named = [(n, p) for n, p in doubted.probability.items() if p >= _LEAST_SHOWN][:_MOST_SHOWN]
    rows = (("nothing" if n == CLEAN else spoken_name(n), probability_text(p)) for n, p in named)
    listed = html.table(("left out", "probability"), rows)
    return html.Section("What the sensor model leaves out", (doubted.sentence, shown, listed))


def draw_widths_and_information(runs: Mapping[str, Sequence[Step]], *, target_mm: float = 4.0) -> AxesGrid:
    """Draw the widest posterior sd, and the information, after each step of each run by name; return axes, (1, 2)."""
    axes = grid_of_axes(1, 2, size_in=(PAGE_IN, 3.6))
    widths = {name: np.array([s.largest_sd_mm for s in steps]) for name, steps in runs.items()}
    posterior_widths(widths, target_mm=target_mm, ax=axes[0, 0])
    gained = {name: np.array([s.bits for s in steps]) for name, steps in runs.items()}
    information_gained(gained, about=next(iter(runs.values()))[-1].learns_of, ax=axes[0, 1])
    return axes


def animated_gif(frames: Sequence[bytes], *, frame_s: float = _FRAME_S, last_s: float = _LAST_S) -> bytes:
    """Join one or more PNGs of one size into an animated GIF that loops for ever."""
    require(frames, "frames", 0, "one picture or more")
    sheets = [Image.open(io.BytesIO(frame)).convert("RGB") for frame in frames]
    # One palette for all frames, or a colour would change; it covers the range of colours, whatever their frequency.
    seen = [np.array([colour for _, colour in sheet.getcolors(sheet.width * sheet.height) or []]) for sheet in sheets]
    levels = (255 // _ROUNDED + 1,) * 3
    codes = np.unique(np.ravel_multi_index(np.rint(np.concatenate(seen).T / _ROUNDED).astype(np.int64), levels))
    colours = (_ROUNDED * np.stack(np.unravel_index(codes, levels), axis=-1)).astype(np.uint8)
    palette = Image.fromarray(colours[None]).quantize(_COLOURS, method=Image.Quantize.MAXCOVERAGE)
    sheets = [sheet.quantize(palette=palette, dither=Image.Dither.NONE) for sheet in sheets]
    durations = [round(1000 * frame_s)] * (len(sheets) - 1) + [round(1000 * last_s)]
    out = io.BytesIO()
    sheets[0].save(out, "GIF", save_all=True, append_images=sheets[1:], duration=durations, loop=0)
    return out.getvalue()


def summary_sentence(run: Exploration) -> str:
    """Summarise an exploration: number of readings, the shape found and its parameters."""
    found = estimated_shape(run)
    several = f" (probability {probability_text(found.probability)})" if run.last.shapes else ""
    known = ", ".join(
        f"{words_without_unit(p.name)} {value_with_error(p.mean, p.sd, unit_of_name(p.name))}" for p in found.parameters
    )
    taken = count_with_noun(len(run.steps), "reading")
    opening = f"Found in {taken}:" if run.target_reached else f"Not found to the target precision in {taken}; so far"
    article = "an" if found.name[0] in "aeiou" else "a"
    return f"{opening} {article} {found.name}{several} with {known}."


def shape_table(run: Exploration, truth: Mapping[str, float] | None = None) -> html.Markup:
    """Build the table of the shape that an exploration found, with the arm's part of the sd and the truth, if known."""
    found, true = estimated_shape(run), truth or {}
    short = {name.removeprefix(f"{found.name}."): value for name, value in true.items()}
    arm = ("of it the arm's",) if run.arm_error is not None else ()
    return html.table(
        ("parameter", "unit", "mean", "sd", *arm, "95 % interval", *(("truth",) if truth else ())),
        (
            (
                words_without_unit(p.name),
                unit_of_name(p.name),
                *value_with_error(p.mean, p.sd).partition(" ± ")[::2],
                *(() if p.arm_sd is None else (f"{p.arm_sd:.2g}",)),
                typeset_numbers(range_text(*p.interval95)),
                *((f"{short[p.name]:.6g}" if p.name in short else "–",) if truth else ()),
            )
            for p in found.parameters
        ),
        caption=f"Posterior of the {found.name} after the last reading.",
    )


def steps_table(run: Exploration, unit: str = "LEGO") -> html.Markup:
    """Build an exploration's table of steps: place, reading (in `unit`), widest posterior sd, bits so far."""
    reading = f"reading ({unit_after_number(unit)})" if unit else "reading"
    without = "" if run.arm_error is None else " without the arm's own error"
    return html.table(
        ("number", "at (mm)", reading, f"widest sd{without} (mm)", "information so far (bits)"),
        (
            (
                str(s.number),
                f"{number_text(s.reading.pose.x_mm, 0)}, {number_text(s.reading.pose.y_mm, 0)}"
                f"{s.orientation_and_height_text}",
                f"{s.reading.value:g}",
                number_text(s.largest_sd_mm, 1),
                number_text(s.bits, 1),
            )
            for s in run.steps
        ),
    )


def page_html(
    run: Exploration,
    last_view: bytes,
    animation: bytes,
    *,
    seed: int | None,
    model: str,
    truth: Mapping[str, float] | None = None,
    beside: Mapping[str, Sequence[Step]] | None = None,
    unit: str = "LEGO",
    draw: html.Draw = html.draw_or_raise,
) -> str:
    """Return the HTML of an exploration's page.

    `last_view` is a PNG, `animation` a GIF of all steps; `truth` are the parameters of the true shape by name, where
    known; `beside` are steps of other sensor models, updated with the same readings, by the model's name; `draw` makes
    the curves.
    """
    said = {name: f"{MODEL_NAMES.get(name, name)} model" for name in (model, *(beside or {}))}
    runs = {said[model]: run.steps} | {said[name]: steps for name, steps in (beside or {}).items()}
    last, trust = run.last, run.experiment.trust
    shape: list[str | Mapping[str, str]] = [shape_table(run, truth)]
    if last.shapes:
        shape.append(html.table(("shape", "probability"), ((n, probability_text(p)) for n, p in last.shapes.items())))
    shape.append(_facts(run, MODEL_NAMES.get(model, model), seed))
    if last.sensor:
        sensor = [
            (words_without_unit(name), unit_of_name(name), *value_with_error(mean, sd).partition(" ± ")[::2])
            for name, (mean, sd) in last.sensor.items()
        ]
        shape.append(html.table(("parameter", "unit", "mean", "sd"), sensor, caption="The sensor, learnt along."))
    how_fast = (
        html.figure(
            draw("progress", lambda: png(draw_widths_and_information(runs, target_mm=run.experiment.stop_sd_mm))),
            "Left: widest posterior sd of a length after each reading; dashed: the target precision. Right: "
            f"information about {last.learns_of}, prior minus posterior differential entropy.",
        ),
        steps_table(run, unit),
    )
    sections = [
        html.Section("The shape and what it cost", (*shape, *(f"Doubtful: {note}." for note in run.notes))),
        *((_fault_section(run.steps, trust, draw),) if trust < 1 else ()),
        html.Section("How fast", how_fast),
        html.Section("Every step", (html.figure(animation, "The robot's view after each reading."),)),
    ]
    caption = (
        "The robot's view of the field after the last reading: at lighter places, a reading carries more information."
    )
    if beside:
        caption += (
            f" The {said[model]} chose the readings; the other panel shows the other model's posterior from the same "
            f"readings, and where it would read next."
        )
    return html.page(
        "The robot's search",
        answer=summary_sentence(run),
        key_figure=html.figure(last_view, caption),
        sections=sections,
    )


def _facts(run: Exploration, model: str, seed: int | None) -> dict[str, str]:
    """Return what a run is and cost, in words, by name."""
    p_value = run.last.p_value
    fits = "not tested: the most probable noise is not the declared one"
    if p_value is not None:
        fits = f"p = {p_value:.2g}: if the model is right, {100 * p_value:.0f} of 100 runs fit no better"
    gained = f"{number_text(run.last.bits, 1)} bits, {number_text(run.bits_per_reading, 2)} per reading"
    paper = f"{number_text(run.paper_bits_per_reading, 2)} bits per reading (25 bits over the readings)"
    off = probability_text(probability_of_length_off(run.experiment, run.posterior, WRONG_MM))
    return {
        "sensor model": model,
        "inference": run.experiment.inference_method.label,
        "stopped because": run.stop_reason,
        **({"concealed in the simulated world": run.concealed} if run.concealed else {}),
        "cost": f"{count_with_noun(len(run.steps), 'reading')}, {number_text(run.seconds, 0)} s of arm time",
        f"information about {run.last.learns_of}": gained,
        **({"the paper's count": paper} if run.target_reached else {}),
        f"probability that a length is off by over {WRONG_MM:g} mm": off,
        "fit of the best hypothesis": fits,
        **html.seed_fact(seed),
    }


def output_of(value: Exploration, *, seed: int | None = None) -> Output:
    """Return what is written of a search: result.json, samples.csv, sensor.json if known, every step, page.

    The sensor is the run's, with the effect that was found in it, if any; not what was learnt along.
    """
    known = None if value.hidden is None else value.hidden.parameters_by_hypothesis_name(value.experiment.names)

    @cache  # the animation has them too
    def frame(number: int) -> bytes:
        return robot_view_png(value.steps[number - 1], value.experiment, **_seen(value, number))

    frames = {f"frames/{k:03d}.png": partial(frame, k) for k in range(1, len(value.steps) + 1)}

    def write_files(stage: StagedFiles) -> None:
        stage.write("result.json", result_json(value))
        stage.write("samples.csv", samples_csv(value))
        if value.sensor is not None:
            rng = np.random.default_rng(DEFAULT_SEED if seed is None else seed)
            stage.write("sensor.json", repaired_sensor(value.sensor, value.last, rng=rng).to_json())

    def page(drawn: Mapping[str, bytes]) -> str:
        model = "ssf" if isinstance(value.experiment.model, Chain) else "naive"
        unit = "LEGO" if value.sensor is None else value.sensor.instrumentation.unit
        last = drawn[f"frames/{len(value.steps):03d}.png"]
        return page_html(value, last, drawn["run.gif"], seed=seed, model=model, truth=known, unit=unit)

    animation = {"run.gif": lambda: animated_gif([draw() for draw in frames.values()])}
    return Output(write_files, frames | animation, page, main="result.json")
