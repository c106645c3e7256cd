"""`probewise explore`: the robot chooses its own measurements until it knows the shape."""

from __future__ import annotations

import argparse
import math
import os
import webbrowser
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from probewise import experiment as experiments
from probewise._arrays import FloatArray
from probewise._signals import reporting_what_is_kept
from probewise._writing import Drawings, checked_output_directory
from probewise.arm import Geometry, Instrument, Reach, Reading
from probewise.calibration import FittedSensor, read_sensor
from probewise.cli import _bench
from probewise.cli._common import finish, message_to_resume, progress_of, say
from probewise.cli._inputs import read_or_shipped_geometry, tables_and_descriptions
from probewise.cli._options import parse_finite_numbers, parse_numbers, refuse_options
from probewise.effects import spoken_name
from probewise.errors import FileError, ParameterError, did_you_mean, require
from probewise.experiment import Experiment, Exploration, HiddenShape, ModelName, Step, read_journal
from probewise.inference import Naive
from probewise.investigation import NOTHING, parse_concealed
from probewise.progress import Progress
from probewise.recordings import read_recording, shipped
from probewise.report import exploration as report
from probewise.scene import SHAPES, Card, Field
from probewise.verbs import DEFAULT_SEED, calibrate, naive_levels

_SHIPPED, _MAIN = "shipped_sensor.json", "result.json"


def run(arguments: argparse.Namespace) -> int:
    """Let the robot search; keep a journal and a picture of every step; write the report; return the exit status."""
    main = "" if arguments.resume else _MAIN  # a run goes on where it is, whatever was written beside it
    out = checked_output_directory(arguments.out, "journal.jsonl", "live.html", "frames", main=main)
    search = Search(arguments)
    journal = out / "journal.jsonl"
    if arguments.resume and not journal.exists():
        raise FileError(journal, "no such file", "a journal to resume; omit --resume to begin a new run")
    if journal.exists() and not arguments.resume:
        raise FileError(journal, "this journal exists already", "--resume to continue it, or another --out")
    before = read_journal(journal) if arguments.resume else None
    instrument, about_truth = search.open_arm(() if before is None else before.readings)
    say(arguments, f"seed {arguments.seed}")
    if arguments.sensor is None:
        arguments.sensor = out / _SHIPPED
        if search.shipped:
            search.write(_SHIPPED, search.shipped.encode())
    _bench.confirm_lowering(search.arm, instrument, search.geometry)
    if search.as_built is not None:
        _bench.warn_if_place_sd_large(search.as_built, search.experiment.stop_sd_mm)
    steps, n_before = search.steps, 0 if before is None else len(before.entries)

    kept_message = partial(
        message_to_resume, journal, lambda: len(read_journal(journal).entries), "reading", arguments, "--resume"
    )
    try:
        sensor_file = Path(os.path.relpath(arguments.sensor, out)).as_posix()
    except ValueError:  # on another drive
        sensor_file = str(arguments.sensor.absolute())
    about = {
        **experiments.sensor_entry(search.sensor, sensor_file),
        **experiments.geometry_entry(search.geometry),
        **about_truth,
        "arm": arguments.arm.partition(":")[0],
    }
    with (
        reporting_what_is_kept(kept_message),
        progress_of(arguments) as progress,
        instrument as arm,
        closing(
            experiments.explore(
                arm,
                search.experiment,
                rng=search.streams.run,
                max_readings=arguments.max_readings,
                journal=before or journal,
                about=about,
            )
        ) as found,
    ):
        progress(*(("going through the journal", 0, n_before) if n_before else ("taking the first readings",)))
        pairs: Iterable[tuple[Step, Step | None]] = ((step, None) for step in found)
        if search.other is not None:
            pairs = experiments.shadow_run(found, search.other, instrument, rng=search.streams.shadow)
        for step, shadow in pairs:
            search.draw_and_write(step, shadow)
            if step.replayed:
                progress("going through the journal", step.number, n_before)
            else:
                note = f"reading {step.number} of at most {arguments.max_readings}"
                progress("exploring", note=f"{note}; widest sd {step.largest_sd_mm:.1f} mm")
    concealed = arguments.conceal or ""
    result = Exploration(search.experiment, tuple(steps), sensor=search.sensor, concealed=concealed)
    with reporting_what_is_kept(kept_message, results=True), progress_of(arguments) as progress:
        search.write_results(result, progress=progress)
    lines = search.closing_lines(result, journal)
    return finish(arguments, search.drawings, *lines, f"written to {out}")


class Search:
    """One search: its checked options, its arm, the pictures of its steps, which the report shows.

    `other` is the experiment under the sensor model `other_model`, which --both-models shows too; otherwise None.
    `geometry` is that of a LEGO arm, or the one that --geometry gives a simulated arm; otherwise None; `as_built` that
    of an arm that may be built otherwise, None for any other. With a simulated arm, `truth_mm` is the true outline,
    (n_points, 2), and `known` the true parameters by the hypotheses' names.
    `shadows` are the other model's steps on the same readings; `frames` has a PNG of each step, b"" where it could not
    be drawn.
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        """Read the files that the options name, check the options against each other, and build the experiment."""
        self.arguments, self.arm = arguments, _bench.parse_arm(arguments.arm)
        self.out, self.drawings = arguments.out, Drawings(arguments.out)
        self.steps: list[Step] = []
        self.shadows: list[Step] = []
        self.frames: list[bytes] = []
        self.shipped = ""  # content of the file of a sensor that is calibrated here
        self.truth_mm: FloatArray | None = None
        self.known: Mapping[str, float] | None = None
        with_geometry = self.arm.is_lego or (arguments.geometry is not None and self.arm.kind != "file")
        self.geometry = read_or_shipped_geometry(arguments) if with_geometry else None
        _refuse_contradictions(arguments, self.arm, self.geometry)
        self.concealed = parse_concealed(arguments.conceal or NOTHING, "--conceal")
        self.field = _checked_field(arguments.field, self.geometry)
        self.sensor = self._shipped_sensor() if arguments.sensor is None else read_sensor(arguments.sensor)
        if self.arm.is_lego and self.sensor.instrumentation.unit not in ("", "LEGO"):
            raise ParameterError("--sensor", str(arguments.sensor), "one that reads in LEGO units, as the brick does")
        self.streams = experiments.RandomStreams.spawned_from(np.random.default_rng(arguments.seed))
        shape = experiments.as_shape(arguments.shape, self.field)
        cards = parse_cards(arguments.reference, self.field)
        levels = self._naive_levels()

        def pose(model: ModelName, **more: Any) -> Experiment:
            return experiments.experiment_for(
                self.sensor,
                shape,
                self.field,
                method=arguments.method,
                model=model,
                naive=levels if model == "naive" else None,
                utility=arguments.utility,
                nested_stop=arguments.nested_stop,
                orientations_rad=tuple(math.radians(turn) for turn in arguments.orientations or (0.0,)),
                repeats=arguments.repeats or (1,),
                cards=cards,
                **more,
            )

        self.model: ModelName = arguments.model
        self.experiment = pose(
            self.model,
            learn_sensor=arguments.learn_sensor,
            batch=arguments.batch,
            heights_mm=arguments.heights or (),
            trust=arguments.trust,
        )
        self.as_built = self.geometry if self.arm.may_differ_from_geometry else None
        if self.as_built is not None and self.as_built.accuracy is not None:
            fitted_arm = experiments.FittedArm.from_geometry_and_sensor(self.as_built, self.sensor)
            self.experiment = replace(self.experiment, fitted_arm=fitted_arm)
        self.other_model: ModelName = "naive" if self.model == "ssf" else "ssf"
        self.other = pose(self.other_model, trust=1.0) if arguments.both_models else None

    def _shipped_sensor(self) -> FittedSensor:
        """Calibrate the sensor of the recording that ships, and say so; a resumed run reads the one it began with."""
        arguments, allowed = self.arguments, "the sensor model of this arm, as `probewise calibrate` writes it"
        require(not self.arm.is_real, "--sensor", "none", allowed)
        if arguments.resume and (arguments.out / _SHIPPED).exists():
            return read_sensor(arguments.out / _SHIPPED)
        say(arguments, "no --sensor: that of the recording that ships is calibrated")
        rng = np.random.default_rng(DEFAULT_SEED)
        made = calibrate(read_recording(shipped("paper")), orders=(1,), rng=rng, progress=False)
        self.shipped = made.sensor.to_json()
        # As a resumed run reads it: the field is normalised once more, in its last digit.
        return FittedSensor.from_json(self.shipped)

    def _naive_levels(self) -> Naive | None:
        """Return the paper's naive model's readings over black and white, with sds; None if it is not used."""
        arguments = self.arguments
        if arguments.method != "paper" or not (arguments.model == "naive" or arguments.both_models):
            return None
        if arguments.levels is None and self.arm.is_real:
            allowed = "a recording of readings over a black and a white sheet, for the naive model of the paper"
            raise ParameterError("--levels", "none", allowed)
        levels = None if arguments.levels is None else read_recording(arguments.levels)
        return naive_levels(self.sensor, levels, rng=self.streams.levels)

    def open_arm(self, taken: tuple[Reading, ...]) -> tuple[Instrument, Mapping[str, Any]]:
        """Open the arm, to continue after the readings `taken`; return it and what a journal says of a true shape."""
        arguments, start_s = self.arguments, taken[-1].time_s if taken else 0.0
        if self.arm.is_real:
            return _bench.open_arm(self.arm, self.geometry, start_s=start_s)[0], {}
        hidden = parse_truth(arguments.truth, arguments.shape, self.field, rng=self.streams.truth)
        self.truth_mm = hidden.outline_mm
        self.known = hidden.parameters_by_hypothesis_name(self.experiment.names)
        world = experiments.world_like(self.sensor, self.concealed)
        arm, _ = _bench.open_arm(
            self.arm,
            self.geometry,
            arguments.geometry,
            (world, experiments.scale_of(self.sensor.instrumentation)),
            experiments.with_cards(hidden.surface, self.experiment.cards),
            reach=self.geometry or Reach((self.field.width_mm, self.field.height_mm)),
            seed=self.streams.noise,
            start_s=start_s,
            taken=taken,
        )
        return arm, {"hidden": hidden.journal_entry, **({"concealed": arguments.conceal} if arguments.conceal else {})}

    @property
    def files(self) -> list[Path]:
        """The run's input files, which stay where they are when results of an earlier run are removed."""
        levels = self.arguments.levels
        return [self.arguments.sensor, *([] if levels is None else tables_and_descriptions([levels]))]

    def write(self, name: str, content: bytes) -> bytes:
        """Write a file that is there before the run ends, and return its content."""
        with self.drawings.staged(_MAIN) as stage:
            stage.write(name, content)
        return content

    def draw_and_write(self, step: Step, shadow: Step | None) -> None:
        """Draw a step, with the other sensor model's (`shadow`), if any; write a PNG and, with --live, the page."""
        self.steps.append(step)
        if shadow is not None:
            self.shadows.append(shadow)
        if step.number == 1 and not step.replayed:
            with self.drawings.staged(_MAIN, inputs=self.files, adds=False):
                pass  # which removes what an earlier run wrote, so that two runs do not mix

        def draw_and_write(name: str, drawer: Callable[[], bytes]) -> bytes:
            drawn = self.drawings.draw(name, drawer)
            return drawn and self.drawings.draw(name, lambda: self.write(name, drawn))  # a full disk ends no search

        def live_page() -> bytes:
            trust, earlier = self.experiment.trust, self.steps[:-1]
            page = report.live_page_html(step, self.frames[-1], earlier=earlier, trust=trust, draw=self.drawings.draw)
            return page.encode("utf-8", "backslashreplace")

        self.frames.append(draw_and_write(f"frames/{step.number:03d}.png", lambda: self._draw_frame(step, shadow)))
        if self.arguments.live and draw_and_write("live.html", live_page) and step.number == 1:
            webbrowser.open((self.out / "live.html").absolute().as_uri())

    def _draw_frame(self, step: Step, shadow: Step | None) -> bytes:
        means = self.sensor.mean()
        readings = [(r.pose.x_mm, r.pose.y_mm, r.value) for r in (each.reading for each in self.steps)]
        levels = (means["I_min"], means["I_max"])
        if shadow is None or self.other is None:
            return report.robot_view_png(step, self.experiment, readings, levels=levels, truth_mm=self.truth_mm)
        views = {self.model: (step, self.experiment), self.other_model: (shadow, self.other)}
        titled = [("naive model", *views["naive"]), ("SSF model", *views["ssf"])]
        return report.robot_views_by_model_png(titled, readings, levels=levels, truth_mm=self.truth_mm)

    def write_results(self, result: Exploration, *, progress: Progress) -> None:
        """Write the files of a search, then animation and report; each step's picture is there already."""
        seed = self.arguments.seed

        def page(drawn: Mapping[str, bytes]) -> str:
            return report.page_html(
                result,
                self.frames[-1],
                drawn["run.gif"],
                seed=seed,
                model=self.model,
                truth=self.known,
                beside={self.other_model: self.shadows} if self.shadows else None,
                unit=self.sensor.instrumentation.unit,
                draw=self.drawings.draw,
            )

        animation = {"run.gif": lambda: report.animated_gif([frame for frame in self.frames if frame])}
        made = report.output_of(result, seed=seed)._replace(drawers=animation, page=page)
        self.drawings.write_results(made, inputs=self.files, adds=True, progress=progress)

    def closing_lines(self, result: Exploration, journal: Path) -> Iterator[str]:
        """Yield the closing lines: the shape, what its sds leave out, probable sensor faults, and errors if known."""
        yield result.summary()
        if self.as_built is not None and self.as_built.accuracy is None:
            yield "arm          nobody has fitted its geometry: its own error is not in these sds"
        effects = ", ".join(spoken_name(effect.name) for effect in self.sensor.effects_on_new_scans)
        if effects and not self.arm.is_real:
            yield f"note: the simulated arm has the sensor's SSF, levels and noise, but not its effects: {effects}"
        if experiments.left_out_after_step(result.last, self.experiment.trust).leading != experiments.CLEAN:
            yield f"what the readings say of the sensor: probewise diagnose {journal} --out DIAGNOSIS"
        if self.known is not None:
            yield f"truth        {', '.join(f'{name} {value:.5g}' for name, value in self.known.items())}"


def _refuse_contradictions(arguments: argparse.Namespace, arm: _bench.ArmName, geometry: Geometry | None) -> None:
    """Raise ParameterError for an option that does not go with the arm (with the geometry of a LEGO arm) or another."""
    naive = arguments.both_models or arguments.model == "naive"
    if arm.kind == "file":
        refuse_options(arguments, "FILE.py, which defines its own reach", "geometry")
    if arm.is_real:
        refuse_options(arguments, "a real arm, whose target is unknown", "truth")
    if arm.kind != "simulated":
        refuse_options(arguments, "any arm but the simulated one", "conceal")
    if geometry is not None:
        refuse_options(arguments, "the LEGO arm, no joint of which turns its sensor", "orientations")
        if arguments.heights != (read_mm := geometry.read_height_mm,):
            what = f"the LEGO arm but {read_mm:g}: it reads that many mm above the surface"
            refuse_options(arguments, what, "heights")
    elif arguments.both_models:
        refuse_options(arguments, "--both-models, since the naive model has no height", "heights")
    if not (naive and arguments.method == "paper"):
        refuse_options(arguments, "any but --method paper and --model naive", "levels")


def _checked_field(text: str | None, geometry: Geometry | None) -> Field:
    """Return the field given as "WIDTH,HEIGHT" (mm), else the geometry's, with which it agrees, else the paper's."""
    of_arm = None if geometry is None else Field(*geometry.field_mm)
    if text is None:
        return of_arm or Field()
    field = Field(*parse_finite_numbers("--field", text, 2, "WIDTH,HEIGHT in mm, such as 1048,520"))
    near = of_arm or field
    require(near == field, "--field", text, f"{near.width_mm:g},{near.height_mm:g}, the geometry's; or none")
    return field


def parse_cards(texts: Sequence[str], field: Field) -> tuple[Card, ...]:
    """Parse each "X,Y,WIDTH,HEIGHT,ALBEDO": a card on the field, of known albedo, centred at (X, Y) in mm."""
    cards = []
    for text in texts:
        allowed = "X,Y,WIDTH,HEIGHT,ALBEDO: centre and size in mm, albedo from 0 to 1, such as 100,80,60,40,1"
        card = Card(*parse_finite_numbers("--reference", text, 5, allowed))
        low, high = card.corners_mm.min(axis=0), card.corners_mm.max(axis=0)
        on_field = min(low) >= 0 and high[0] <= field.width_mm and high[1] <= field.height_mm
        allowed = f"a card on the field of {field.width_mm:g} x {field.height_mm:g} mm"
        require(on_field, "--reference", text, allowed)
        cards.append(card)
    return tuple(cards)


def parse_truth(
    text: str | None, names: Sequence[str], field: Field, *, rng: np.random.Generator, option: str = "--truth"
) -> HiddenShape:
    """Parse the true shape from "[SHAPE:]V,V,...", without SHAPE the first of `names`; None: draw it from the prior."""
    if text is None:
        return HiddenShape.drawn_from_prior({name: SHAPES[name](field) for name in names}, rng=rng)
    name, _, listed = text.rpartition(":")
    name = name or names[0]
    if name not in SHAPES:
        allowed = f"a shape of {', '.join(SHAPES)} before the colon{did_you_mean(name, SHAPES)}"
        raise ParameterError(option, text, allowed)
    shape, theta = SHAPES[name](field), np.array(parse_numbers(listed))
    wanted = shape.prior.names
    require(len(theta) == len(wanted), option, text, f"{len(wanted)} numbers, {','.join(wanted)}")
    return HiddenShape.from_parameters(name, shape, theta, called=f"{option} {text}")
