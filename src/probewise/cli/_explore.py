"""A run of `probewise explore`: its checked options, its arm, its pictures."""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import webbrowser
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from probewise import experiment as experiments
from probewise._arrays import FloatArray
from probewise._progress import progress_shown
from probewise._signals import reporting_what_is_kept
from probewise._writing import Drawings, StagedFiles, checked_output_directory
from probewise.arm import Geometry, Instrument, Reading
from probewise.calibration import FittedSensor, read_sensor, write_sensor
from probewise.cli import _bench
from probewise.cli import _common as common
from probewise.cli._arm import parse_arm, read_or_shipped_geometry
from probewise.effects import spoken_name
from probewise.errors import FileError, ParameterError, did_you_mean, require
from probewise.experiment import Experiment, Exploration, HiddenShape, Model, Step, read_journal
from probewise.inference import Naive
from probewise.progress import Progress
from probewise.recordings import read_recording, shipped, write_bytes_atomically
from probewise.report import exploration as report
from probewise.report.pictures import animated_gif
from probewise.scene import SHAPES, Card, Field
from probewise.verbs import calibrate, naive_levels

_SHIPPED = "shipped_sensor.json"


class Run:
    """One run of `probewise explore`: its checked options, its arm, the pictures of its steps, which the report shows.

    `other` is the experiment under the sensor model `other_model`, which --both-models shows too; otherwise None.
    `geometry` is that of a LEGO arm, or the one that --geometry gives a simulated arm; otherwise None. With a simulated
    arm, `truth_mm` is the true outline, (n_points, 2), and `known` the true parameters by the hypotheses' names.
    `shadows` are the other model's steps on the same readings; `frames` has a PNG of each step, b"" where it could not
    be drawn.
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        """Read the files that the options name, check the options against each other, and build the experiment."""
        self.arguments, self.arm = arguments, parse_arm(arguments.arm)
        self.out, self.drawings = arguments.out, Drawings(arguments.out)
        self.steps: list[Step] = []
        self.shadows: list[Step] = []
        self.frames: list[bytes] = []
        self.truth_mm: FloatArray | None = None
        self.known: Mapping[str, float] | None = None
        if self.arm.kind == "file" and arguments.geometry is not None:
            raise ParameterError(
                "--geometry", str(arguments.geometry), "none with FILE.py, which defines its own reach"
            )
        with_geometry = self.arm.is_lego or arguments.geometry is not None
        self.geometry = read_or_shipped_geometry(arguments) if with_geometry else None
        self.field = _checked_field(arguments.field, self.geometry)
        self.sensor = self._shipped_sensor() if arguments.sensor is None else read_sensor(arguments.sensor)
        if self.arm.is_lego and self.sensor.instrumentation.unit not in ("", "LEGO"):
            raise ParameterError("--sensor", str(arguments.sensor), "one that reads in LEGO units, as the brick does")
        self.streams = experiments.RandomStreams.spawned_from(np.random.default_rng(arguments.seed))
        shape = experiments.as_shape(arguments.shape, self.field)
        _refuse_settings_that_the_arm_lacks(arguments, self.geometry)
        cards = parse_cards(arguments.reference, self.field)
        if cards and (arguments.both_models or arguments.model == "naive" or arguments.method == "paper"):
            allowed = "none with --both-models, --model naive or --method paper"
            raise ParameterError("--reference", arguments.reference[0], allowed)
        levels = self._naive_levels()
        pose = partial(
            experiments.experiment_for,
            self.sensor,
            shape,
            self.field,
            method=arguments.method,
            utility=arguments.utility,
            nested_stop=arguments.nested_stop,
            orientations_rad=tuple(math.radians(turn) for turn in arguments.orientations or (0.0,)),
            repeats=arguments.repeats or (1,),
            cards=cards,
        )
        self.model: Model = arguments.model
        self.experiment: Experiment = pose(
            model=self.model,
            naive=levels if self.model == "naive" else None,
            learn_sensor=arguments.learn_sensor,
            batch=arguments.batch,
            heights_mm=arguments.heights or (),
            trust=arguments.trust,
        )
        self.is_as_built = self.geometry is not None and self.arm.may_differ_from_geometry
        if self.is_as_built and self.geometry is not None and self.geometry.accuracy is not None:
            fitted_arm = experiments.FittedArm.from_geometry_and_sensor(self.geometry, self.sensor)
            self.experiment = dataclasses.replace(self.experiment, fitted_arm=fitted_arm)
        self.other: Experiment | None = None
        self.other_model: Model = "naive" if self.model == "ssf" else "ssf"
        if arguments.both_models:
            self.other = pose(model=self.other_model, naive=levels if self.other_model == "naive" else None, trust=1.0)

    def _shipped_sensor(self) -> FittedSensor:
        """Calibrate the sensor of the recording that ships, and say so; a resumed run reads the one it began with."""
        arguments, allowed = self.arguments, "the sensor model of this arm, as `probewise calibrate` writes it"
        require(not self.arm.is_real, "--sensor", "none", allowed)
        if arguments.resume and (arguments.out / _SHIPPED).exists():
            return read_sensor(arguments.out / _SHIPPED)
        common.print_result("no --sensor: that of the recording that ships is calibrated", quiet=arguments.quiet)
        rng = np.random.default_rng(common.DEFAULT_SEED)
        return calibrate(read_recording(shipped("paper")), orders=(1,), rng=rng, progress=False).sensor

    def _naive_levels(self) -> Naive | None:
        """Return the paper's naive model's readings over black and white, with sds; None if it is not used."""
        arguments = self.arguments
        common.refuse_nested_stop(arguments)
        wanted = arguments.method == "paper" and (arguments.model == "naive" or arguments.both_models)
        if arguments.levels is not None and not wanted:
            raise ParameterError("--levels", str(arguments.levels), "only with --method paper and --model naive")
        if not wanted:
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
            require(
                arguments.truth is None, "--truth", arguments.truth, "none with a real arm, whose target is unknown"
            )
            return _bench.open_real_arm(self.arm, self.geometry, start_s=start_s), {}
        hidden = parse_truth(arguments.truth, arguments.shape, self.field, rng=self.streams.truth)
        self.truth_mm = hidden.outline_mm
        self.known = hidden.parameters_by_hypothesis_name(self.experiment.names)
        world, noise = experiments.world_like(self.sensor), self.streams.noise
        surface = experiments.with_cards(hidden.surface, self.experiment.cards)
        arm: Instrument
        if self.arm.is_lego and self.geometry is not None:
            seed = noise + len(taken)  # a resumed run draws no noise a second time
            built = self.arm.true_geometry_file(arguments.geometry)
            arm, _ = _bench.open_emulated_arm_and_bench(
                self.geometry, built, world, surface, seed=seed, start_s=start_s
            )
        else:
            scale = experiments.scale_of(self.sensor.instrumentation)
            arm = experiments.arm_over(
                world, surface, self.field, seed=noise, taken=taken, workspace=self.geometry, scale=scale
            )
        return arm, {"hidden": hidden.journal_entry}

    @property
    def files(self) -> list[Path]:
        """The run's input files, which stay where they are when results of an earlier run are removed."""
        levels = self.arguments.levels
        return [self.arguments.sensor, *([] if levels is None else common.tables_and_descriptions([levels]))]

    def draw_and_write(self, step: Step, shadow: Step | None) -> None:
        """Draw a step, with the other sensor model's (`shadow`), if any; write a PNG and, with --live, the page."""
        self.steps.append(step)
        if shadow is not None:
            self.shadows.append(shadow)
        name = f"{step.number:03d}.png"
        self.frames.append(self.drawings.draw(f"frames/{name}", partial(self._draw_frame, step, shadow)))
        if step.number == 1 and not step.replayed:
            remove_earlier_results(self.out, self.files)
        folder, live = self.out / "frames", self.out / "live.html"
        folder.mkdir(exist_ok=True)
        if self.frames[-1]:
            write_bytes_atomically(folder / name, self.frames[-1])
        if self.arguments.live and (page := self.drawings.draw("live.html", partial(self._live_page, step))):
            write_bytes_atomically(live, page)
            if len(self.frames) == 1:
                webbrowser.open(live.absolute().as_uri())

    def _live_page(self, step: Step) -> bytes:
        trust, earlier = self.experiment.trust, self.steps[:-1]
        page = report.live_page_html(step, self.frames[-1], earlier=earlier, trust=trust, draw=self.drawings.draw)
        return page.encode("utf-8", "backslashreplace")

    def _draw_frame(self, step: Step, shadow: Step | None) -> bytes:
        means, poses = self.sensor.mean(), [(each.reading.pose, each.reading.value) for each in self.steps]
        readings = [(pose.x_mm, pose.y_mm, value) for pose, value in poses]
        levels = (means["I_min"], means["I_max"])
        if shadow is None or self.other is None:
            return report.robot_view_png(step, self.experiment, readings, levels=levels, truth_mm=self.truth_mm)
        views = {self.model: (step, self.experiment), self.other_model: (shadow, self.other)}
        titled = [("naive model", *views["naive"]), ("SSF model", *views["ssf"])]
        return report.robot_views_by_model_png(titled, readings, levels=levels, truth_mm=self.truth_mm)

    def write_results(self, result: Exploration, *, progress: Progress) -> list[str]:
        """Write result.json, posterior samples and sensor.json, then animation and report; return lines to print.

        The sensor is the one given, with the effect that the run found in it, if any; not what --learn-sensor learnt.
        """
        seed = self.arguments.seed

        def write_files(stage: StagedFiles) -> None:
            stage.write("result.json", experiments.result_json(result))
            stage.write("samples.csv", experiments.samples_csv(result))
            rng = np.random.default_rng(seed)
            stage.write("sensor.json", experiments.repaired_sensor(self.sensor, result.last, rng=rng).to_json())

        page = partial(
            report.page_html,
            result,
            self.frames,
            seed=seed,
            model=self.model,
            truth=self.known,
            beside={self.other_model: self.shadows} if self.shadows else None,
            unit=self.sensor.instrumentation.unit,
            draw=self.drawings.draw,
        )
        animation = {"run.gif": lambda: animated_gif([frame for frame in self.frames if frame])}
        return self.drawings.write_results(
            write_files, animation, lambda _: page(), inputs=self.files, progress=progress
        )

    def closing_lines(self, result: Exploration, journal: Path) -> Iterator[str]:
        """Yield the closing lines: the shape, what its sds leave out, probable sensor faults, and errors if known."""
        yield result.summary()
        if self.is_as_built and self.geometry is not None and self.geometry.accuracy is None:
            yield "arm          nobody has fitted its geometry: its own error is not in these sds"
        effects = ", ".join(spoken_name(effect.name) for effect in self.sensor.effects_on_new_scans)
        if effects and self.arm.kind in ("simulated", "emulator"):
            yield f"note: the simulated arm has the sensor's SSF, levels and noise, but not its effects: {effects}"
        trust = self.experiment.trust
        missing = experiments.left_out_after_step(result.last, trust)
        if trust < 1:
            yield missing.sentence
        if missing.leading != experiments.CLEAN:
            yield f"what the readings say of the sensor: probewise diagnose {journal} --out DIAGNOSIS"
        if self.known is not None:
            yield f"error        {report.errors_text(result, self.known)}"


def _refuse_settings_that_the_arm_lacks(arguments: argparse.Namespace, geometry: Geometry | None) -> None:
    """Raise ParameterError if the arm, or the naive model, has not these orientations or heights."""
    refused = {}
    if geometry is not None:
        refused["orientations"] = "none with the LEGO arm, no joint of which turns its sensor"
        if arguments.heights != (geometry.read_height_mm,):
            refused["heights"] = (
                f"none with the LEGO arm but {geometry.read_height_mm:g}: it reads that many mm above the surface"
            )
    elif arguments.both_models:
        refused["heights"] = "none with --both-models, since the naive model has no height"
    for option, allowed in refused.items():
        if (values := getattr(arguments, option)) is not None:
            raise ParameterError(f"--{option}", ",".join(f"{value:g}" for value in values), allowed)


def _checked_field(text: str | None, geometry: Geometry | None) -> Field:
    """Return the field given as "WIDTH,HEIGHT" (mm), else the geometry's, with which it agrees, else the paper's."""
    of_arm = None if geometry is None else Field(*geometry.field_mm)
    if text is None:
        return of_arm or Field()
    numbers = common.parse_numbers(text)
    require(len(numbers) == 2, "--field", text, "WIDTH,HEIGHT in mm, such as 1048,520")
    field = Field(*numbers)
    if of_arm not in (None, field):
        raise ParameterError("--field", text, f"{of_arm.width_mm:g},{of_arm.height_mm:g}, the geometry's; or none")
    return field


def parse_cards(texts: Sequence[str], field: Field) -> tuple[Card, ...]:
    """Parse each "X,Y,WIDTH,HEIGHT,ALBEDO": a card on the field, of known albedo, centred at (X, Y) in mm."""
    cards = []
    for text in texts:
        numbers = common.parse_numbers(text)
        if len(numbers) != 5:
            allowed = "X,Y,WIDTH,HEIGHT,ALBEDO: centre and size in mm, albedo from 0 to 1, such as 100,80,60,40,1"
            raise ParameterError("--reference", text, allowed)
        card = Card(*numbers)
        low, high = card.corners_mm.min(axis=0), card.corners_mm.max(axis=0)
        if min(low) < 0 or high[0] > field.width_mm or high[1] > field.height_mm:
            allowed = f"a card on the field of {field.width_mm:g} x {field.height_mm:g} mm"
            raise ParameterError("--reference", text, allowed)
        cards.append(card)
    return tuple(cards)


def parse_truth(text: str | None, names: Sequence[str], field: Field, *, rng: np.random.Generator) -> HiddenShape:
    """Parse the true shape from "[SHAPE:]V,V,...", without SHAPE the first of `names`; None: draw it from the prior."""
    if text is None:
        return HiddenShape.drawn_from_prior({name: SHAPES[name](field) for name in names}, rng=rng)
    name, _, listed = text.rpartition(":")
    name = name or names[0]
    if name not in SHAPES:
        allowed = f"a shape of {', '.join(SHAPES)} before the colon{did_you_mean(name, SHAPES)}"
        raise ParameterError("--truth", text, allowed)
    shape, theta = SHAPES[name](field), np.array(common.parse_numbers(listed))
    wanted = shape.prior.names
    require(len(theta) == len(wanted), "--truth", text, f"{len(wanted)} numbers, {','.join(wanted)}")
    return HiddenShape.from_parameters(name, shape, theta, called=f"--truth {text}")


def remove_earlier_results(out: Path, files: Sequence[Path]) -> None:
    """Remove the results of an earlier run from `out`, but none of `files`, so that two runs do not mix."""
    # Without a result.json, a sensor.json is none of these results, but perhaps somebody's calibration.
    of_machine = ("result.json", "samples.csv", "sensor.json") if (out / "result.json").exists() else ()
    spared = {os.path.realpath(path) for path in files}
    for pattern in ("report.html", "run.gif", "live.html", "frames/[0-9]*.png", *of_machine):
        for path in out.glob(pattern):
            if os.path.realpath(path) not in spared:
                path.unlink()


def explore(arguments: argparse.Namespace) -> int:
    """Let the robot search; keep a journal and a picture of every step; write the report; return the exit status."""
    out = checked_output_directory(arguments.out, "journal.jsonl", "live.html", "frames")
    run = Run(arguments)
    journal = out / "journal.jsonl"
    if arguments.resume and not journal.exists():
        raise FileError(journal, "no such file", "a journal to resume; omit --resume to begin a new run")
    if journal.exists() and not arguments.resume:
        raise FileError(journal, "this journal exists already", "--resume to continue it, or another --out")
    before = read_journal(journal) if arguments.resume else None
    instrument, about_truth = run.open_arm(() if before is None else before.readings)
    common.print_result(f"seed {arguments.seed}", quiet=arguments.quiet)
    if arguments.sensor is None:
        arguments.sensor = out / _SHIPPED
        out.mkdir(parents=True, exist_ok=True)
        write_sensor(run.sensor, arguments.sensor)
    _bench.warn_and_confirm_lowering(run.arm, instrument, run.geometry)
    if run.is_as_built and run.geometry is not None:
        _bench.warn_if_place_sd_large(run.geometry, run.experiment.stop_sd_mm)
    steps, n_before = run.steps, 0 if before is None else len(before.entries)

    def kept_message() -> str:
        if not journal.exists():
            return "nothing was read"
        n_read = len(read_journal(journal).entries)
        return common.message_to_resume(journal, n_read, "reading", arguments, "--resume")

    def report_activity(doing: str) -> None:
        believed = f"; widest sd {steps[-1].largest_sd_mm:.1f} mm" if steps else ""
        progress("exploring", note=f"reading {len(steps) + 1} of at most {arguments.max_readings}, {doing}{believed}")

    about = {
        **experiments.sensor_entry(run.sensor, _path_relative_to_folder(out, arguments.sensor)),
        **experiments.geometry_entry(run.geometry),
        **about_truth,
        "arm": arguments.arm.partition(":")[0],
    }
    with (
        reporting_what_is_kept(kept_message),
        progress_shown(quiet=arguments.quiet) as progress,
        instrument as arm,
        closing(
            experiments.explore(
                _bench.InstrumentWithCallbacks(
                    arm,
                    lambda pose: report_activity(f"moving to ({pose.x_mm:.0f}, {pose.y_mm:.0f}) mm"),
                    lambda reading: report_activity(f"thinking about a reading of {reading.value:g}"),
                ),
                run.experiment,
                rng=run.streams.run,
                max_readings=arguments.max_readings,
                journal=before or journal,
                about=about,
            )
        ) as found,
    ):
        if n_before:
            progress("going through the journal", 0, n_before)
        else:
            report_activity("choosing its place")
        pairs: Iterable[tuple[Step, Step | None]] = ((step, None) for step in found)
        if run.other is not None:
            pairs = experiments.shadow_run(found, run.other, instrument, rng=run.streams.shadow)
        for step, shadow in pairs:
            run.draw_and_write(step, shadow)
            if step.replayed:
                progress("going through the journal", step.number, n_before)
    result = Exploration(run.experiment, tuple(steps))
    with reporting_what_is_kept(kept_message, results=True), progress_shown(quiet=arguments.quiet) as progress:
        renamed = run.write_results(result, progress=progress)
    lines = run.closing_lines(result, journal)
    return common.finish(run.drawings, *lines, *renamed, f"written to {out}", quiet=arguments.quiet)


def _path_relative_to_folder(folder: Path, path: Path) -> str:
    """Return a file's path relative to a folder; the absolute path if it is on another drive."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # on another drive
        return str(path.absolute())
