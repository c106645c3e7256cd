"""A run of `probewise explore`: its checked options, its arm, its pictures."""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import webbrowser
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from probewise import experiment as experiments
from probewise._progress import progress_shown
from probewise._signals import reporting_what_is_kept
from probewise._writing import Drawings, StagedFiles, checked_output_directory
from probewise.calibration import FittedSensor, read_sensor, write_sensor
from probewise.cli import _bench
from probewise.cli import _common as common
from probewise.cli._arm import ArmName, parse_arm, read_or_shipped_geometry
from probewise.effects import spoken_name
from probewise.errors import FileError, ParameterError, did_you_mean, require
from probewise.experiment import Exploration, HiddenShape, read_journal
from probewise.recordings import read_recording, shipped, write_bytes_atomically
from probewise.report import exploration as report
from probewise.report.pictures import animated_gif
from probewise.scene import SHAPES, Card, Field
from probewise.verbs import calibrate, naive_levels

if TYPE_CHECKING:
    from probewise._arrays import FloatArray
    from probewise.arm import Geometry, Instrument, Reading
    from probewise.experiment import Experiment, Model, Step
    from probewise.inference import Naive
    from probewise.progress import Progress

_SHIPPED = "shipped_sensor.json"


@dataclass(frozen=True)
class Inputs:
    """Checked inputs of a run.

    `other` is the experiment under the sensor model `other_model`, which --both-models shows too; otherwise None.
    `geometry` is that of a LEGO arm, or the one that --geometry gives a simulated arm; otherwise None.
    """

    arm: ArmName
    geometry: Geometry | None
    sensor: FittedSensor
    field: Field
    experiment: Experiment
    model: Model
    other: Experiment | None
    other_model: Model
    streams: experiments.RandomStreams


def read_checked_inputs(arguments: argparse.Namespace) -> Inputs:
    """Read the files that the options name, check the options against each other, and build the experiment."""
    chosen = parse_arm(arguments.arm)
    if chosen.kind == "file" and arguments.geometry is not None:
        raise ParameterError("--geometry", str(arguments.geometry), "none with FILE.py, which defines its own reach")
    geometry = read_or_shipped_geometry(arguments) if chosen.is_lego or arguments.geometry is not None else None
    field = _checked_field(arguments.field, geometry)
    sensor = _shipped_sensor(arguments, chosen) if arguments.sensor is None else read_sensor(arguments.sensor)
    if chosen.is_lego and sensor.instrumentation.unit not in ("", "LEGO"):
        raise ParameterError("--sensor", str(arguments.sensor), "one that reads in LEGO units, as the brick does")
    streams = experiments.RandomStreams.spawned_from(np.random.default_rng(arguments.seed))
    shape = experiments.as_shape(arguments.shape, field)
    _refuse_settings_that_the_arm_lacks(arguments, geometry)
    cards = parse_cards(arguments.reference, field)
    if cards and (arguments.both_models or arguments.model == "naive" or arguments.method == "paper"):
        allowed = "none with --both-models, --model naive or --method paper"
        raise ParameterError("--reference", arguments.reference[0], allowed)
    levels = _naive_levels(arguments, chosen, sensor, rng=streams.levels)
    pose = partial(
        experiments.experiment_for,
        sensor,
        shape,
        field,
        method=arguments.method,
        utility=arguments.utility,
        nested_stop=arguments.nested_stop,
        orientations_rad=tuple(math.radians(turn) for turn in arguments.orientations or (0.0,)),
        repeats=arguments.repeats or (1,),
        cards=cards,
    )
    experiment = pose(
        model=arguments.model,
        naive=levels if arguments.model == "naive" else None,
        learn_sensor=arguments.learn_sensor,
        batch=arguments.batch,
        heights_mm=arguments.heights or (),
        trust=arguments.trust,
    )
    if chosen.may_differ_from_geometry and geometry is not None and geometry.accuracy is not None:
        fitted_arm = experiments.FittedArm.from_geometry_and_sensor(geometry, sensor)
        experiment = dataclasses.replace(experiment, fitted_arm=fitted_arm)
    other: Experiment | None = None
    other_model: Model = "naive" if arguments.model == "ssf" else "ssf"
    if arguments.both_models:
        other = pose(model=other_model, naive=levels if other_model == "naive" else None, trust=1.0)
    return Inputs(chosen, geometry, sensor, field, experiment, arguments.model, other, other_model, streams)


def _shipped_sensor(arguments: argparse.Namespace, chosen: ArmName) -> FittedSensor:
    """Calibrate the sensor of the recording that ships, and say so; a resumed run reads the one that it began with."""
    require(not chosen.is_real, "--sensor", "none", "the sensor model of this arm, as `probewise calibrate` writes it")
    if arguments.resume and (arguments.out / _SHIPPED).exists():
        return read_sensor(arguments.out / _SHIPPED)
    common.print_result("no --sensor: that of the recording that ships is calibrated", quiet=arguments.quiet)
    rng = np.random.default_rng(common.DEFAULT_SEED)
    return calibrate(read_recording(shipped("paper")), orders=(1,), rng=rng, progress=False).sensor


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


def _naive_levels(
    arguments: argparse.Namespace, chosen: ArmName, sensor: FittedSensor, *, rng: np.random.Generator
) -> Naive | None:
    """Return the paper's naive model's readings over black and white, with sds; None if it is not used."""
    common.refuse_nested_stop(arguments)
    wanted = arguments.method == "paper" and (arguments.model == "naive" or arguments.both_models)
    if arguments.levels is not None and not wanted:
        raise ParameterError("--levels", str(arguments.levels), "only with --method paper and --model naive")
    if not wanted:
        return None
    if arguments.levels is None and chosen.is_real:
        allowed = "a recording of readings over a black and a white sheet, for the naive model of the paper"
        raise ParameterError("--levels", "none", allowed)
    return naive_levels(sensor, None if arguments.levels is None else read_recording(arguments.levels), rng=rng)


class ArmAndTruth(NamedTuple):
    """An arm over a field; if it is simulated, with the true outline, (n_points, 2), and parameters by hypothesis name.

    `about` are the entries for the journal.
    """

    arm: Instrument
    outline_mm: FloatArray | None = None
    known: Mapping[str, float] | None = None
    about: Mapping[str, Any] = {}


def _open_arm_and_truth(arguments: argparse.Namespace, inputs: Inputs, taken: tuple[Reading, ...]) -> ArmAndTruth:
    """Open the chosen arm, to continue after the readings `taken`; with it, if simulated, return its true shape."""
    chosen, geometry, start_s = inputs.arm, inputs.geometry, taken[-1].time_s if taken else 0.0
    if chosen.is_real:
        require(arguments.truth is None, "--truth", arguments.truth, "none with a real arm, whose target is unknown")
        return ArmAndTruth(_bench.open_real_arm(chosen, geometry, start_s=start_s))
    hidden = parse_truth(arguments.truth, arguments.shape, inputs.field, rng=inputs.streams.truth)
    world, noise = experiments.world_like(inputs.sensor), inputs.streams.noise
    surface = experiments.with_cards(hidden.surface, inputs.experiment.cards)
    arm: Instrument
    if chosen.is_lego and geometry is not None:
        seed = noise + len(taken)  # a resumed run draws no noise a second time
        built = chosen.true_geometry_file(arguments.geometry)
        arm, _ = _bench.open_emulated_arm_and_bench(geometry, built, world, surface, seed=seed, start_s=start_s)
    else:
        scale = experiments.scale_of(inputs.sensor.instrumentation)
        arm = experiments.arm_over(
            world, surface, inputs.field, seed=noise, taken=taken, workspace=geometry, scale=scale
        )
    known = hidden.parameters_by_hypothesis_name(inputs.experiment.names)
    return ArmAndTruth(arm, hidden.outline_mm, known, {"hidden": hidden.journal_entry})


@dataclass
class Pictures:
    """The pictures of a run: draws each step as it arrives, and keeps steps and pictures for the report.

    `files` are the run's inputs, which stay when an earlier run's results are removed from `out`; `shadows` the other
    sensor model's steps on the same readings; `frames` has a PNG of each step, b"" where it could not be drawn.
    """

    out: Path
    inputs: Inputs
    live: bool
    truth_mm: FloatArray | None
    files: Sequence[Path] = ()
    steps: list[Step] = field(default_factory=list)
    shadows: list[Step] = field(default_factory=list)
    frames: list[bytes] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.drawings = Drawings(self.out)

    def draw_and_write(self, step: Step, shadow: Step | None) -> None:
        """Draw a step, with the other sensor model's (`shadow`), if any; write a PNG and, if `live`, the page."""
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
        if self.live and (page := self.drawings.draw("live.html", partial(self._live_page, step))):
            write_bytes_atomically(live, page)
            if len(self.frames) == 1:
                webbrowser.open(live.absolute().as_uri())

    def _live_page(self, step: Step) -> bytes:
        trust, earlier = self.inputs.experiment.trust, self.steps[:-1]
        page = report.live_page_html(step, self.frames[-1], earlier=earlier, trust=trust, draw=self.drawings.draw)
        return page.encode("utf-8", "backslashreplace")

    def _draw_frame(self, step: Step, shadow: Step | None) -> bytes:
        inputs, means = self.inputs, self.inputs.sensor.mean()
        poses = [(each.reading.pose, each.reading.value) for each in self.steps]
        readings = [(pose.x_mm, pose.y_mm, value) for pose, value in poses]
        levels = (means["I_min"], means["I_max"])
        if shadow is None or inputs.other is None:
            return report.robot_view_png(step, inputs.experiment, readings, levels=levels, truth_mm=self.truth_mm)
        views = {inputs.model: (step, inputs.experiment), inputs.other_model: (shadow, inputs.other)}
        titled = [("naive model", *views["naive"]), ("SSF model", *views["ssf"])]
        return report.robot_views_by_model_png(titled, readings, levels=levels, truth_mm=self.truth_mm)

    def write_results(
        self, result: Exploration, *, seed: int, known: Mapping[str, float] | None, progress: Progress
    ) -> list[str]:
        """Write result.json, posterior samples and sensor.json, then animation and report; return lines to print.

        The sensor is the one given, with the effect that the run found in it, if any; not what --learn-sensor learnt.
        """

        def write_files(stage: StagedFiles) -> None:
            stage.write("result.json", experiments.result_json(result))
            stage.write("samples.csv", experiments.samples_csv(result))
            rng = np.random.default_rng(seed)
            stage.write("sensor.json", experiments.repaired_sensor(self.inputs.sensor, result.last, rng=rng).to_json())

        page = partial(
            report.page_html,
            result,
            self.frames,
            seed=seed,
            model=self.inputs.model,
            truth=known,
            beside={self.inputs.other_model: self.shadows} if self.shadows else None,
            unit=self.inputs.sensor.instrumentation.unit,
            draw=self.drawings.draw,
        )
        animation = {"run.gif": lambda: animated_gif([frame for frame in self.frames if frame])}
        return self.drawings.write_results(
            write_files, animation, lambda _: page(), inputs=self.files, progress=progress
        )


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
    inputs = read_checked_inputs(arguments)
    journal = out / "journal.jsonl"
    if arguments.resume and not journal.exists():
        raise FileError(journal, "no such file", "a journal to resume; omit --resume to begin a new run")
    if journal.exists() and not arguments.resume:
        raise FileError(journal, "this journal exists already", "--resume to continue it, or another --out")
    before = read_journal(journal) if arguments.resume else None
    site = _open_arm_and_truth(arguments, inputs, () if before is None else before.readings)
    common.print_result(f"seed {arguments.seed}", quiet=arguments.quiet)
    if arguments.sensor is None:
        arguments.sensor = out / _SHIPPED
        out.mkdir(parents=True, exist_ok=True)
        write_sensor(inputs.sensor, arguments.sensor)
    _bench.warn_and_confirm_lowering(inputs.arm, site.arm, inputs.geometry)
    if inputs.geometry is not None and inputs.arm.may_differ_from_geometry:
        _bench.warn_if_place_sd_large(inputs.geometry, inputs.experiment.stop_sd_mm)
    read = [arguments.sensor, *([] if arguments.levels is None else common.tables_and_descriptions([arguments.levels]))]
    pictures = Pictures(out, inputs, arguments.live, site.outline_mm, read)
    steps, n_before = pictures.steps, 0 if before is None else len(before.entries)

    def kept_message() -> str:
        if not journal.exists():
            return "nothing was read"
        n_read = len(read_journal(journal).entries)
        return common.message_to_resume(journal, n_read, "reading", arguments, "--resume")

    def report_activity(doing: str) -> None:
        believed = f"; widest sd {steps[-1].largest_sd_mm:.1f} mm" if steps else ""
        progress("exploring", note=f"reading {len(steps) + 1} of at most {arguments.max_readings}, {doing}{believed}")

    about = {
        **experiments.sensor_entry(inputs.sensor, _path_relative_to_folder(out, arguments.sensor)),
        **experiments.geometry_entry(inputs.geometry),
        **site.about,
        "arm": arguments.arm.partition(":")[0],
    }
    with (
        reporting_what_is_kept(kept_message),
        progress_shown(quiet=arguments.quiet) as progress,
        site.arm as arm,
        closing(
            experiments.explore(
                _bench.InstrumentWithCallbacks(
                    arm,
                    lambda pose: report_activity(f"moving to ({pose.x_mm:.0f}, {pose.y_mm:.0f}) mm"),
                    lambda reading: report_activity(f"thinking about a reading of {reading.value:g}"),
                ),
                inputs.experiment,
                rng=inputs.streams.run,
                max_readings=arguments.max_readings,
                journal=before or journal,
                about=about,
            )
        ) as run,
    ):
        if n_before:
            progress("going through the journal", 0, n_before)
        else:
            report_activity("choosing its place")
        pairs: Iterable[tuple[Step, Step | None]] = ((step, None) for step in run)
        if inputs.other is not None:
            pairs = experiments.shadow_run(run, inputs.other, site.arm, rng=inputs.streams.shadow)
        for step, shadow in pairs:
            pictures.draw_and_write(step, shadow)
            if step.replayed:
                progress("going through the journal", step.number, n_before)
    result = Exploration(inputs.experiment, tuple(steps))
    with reporting_what_is_kept(kept_message, results=True), progress_shown(quiet=arguments.quiet) as progress:
        renamed = pictures.write_results(result, seed=arguments.seed, known=site.known, progress=progress)
    lines = _closing_lines(result, inputs, site, journal)
    return common.finish(pictures.drawings, *lines, *renamed, f"written to {out}", quiet=arguments.quiet)


def _closing_lines(result: Exploration, inputs: Inputs, site: ArmAndTruth, journal: Path) -> Iterator[str]:
    """Yield the closing lines: the shape, what its sds leave out, probable sensor faults, and errors if known."""
    yield result.summary()
    if inputs.geometry is not None and inputs.arm.may_differ_from_geometry and inputs.geometry.accuracy is None:
        yield "arm          nobody has fitted its geometry: its own error is not in these sds"
    if inputs.sensor.effects and inputs.arm.kind in ("simulated", "emulator"):
        effects = ", ".join(map(spoken_name, inputs.sensor.effects))
        yield f"note: the simulated arm has the sensor's SSF, levels and noise, but not its effects: {effects}"
    trust = inputs.experiment.trust
    missing = experiments.left_out_after_step(result.last, trust)
    if trust < 1:
        yield missing.sentence
    if missing.leading != experiments.CLEAN:
        yield f"what the readings say of the sensor: probewise diagnose {journal} --out DIAGNOSIS"
    if site.known is not None:
        yield f"error        {report.errors_text(result, site.known)}"


def _path_relative_to_folder(folder: Path, path: Path) -> str:
    """Return a file's path relative to a folder; the absolute path if it is on another drive."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # on another drive
        return str(path.absolute())
