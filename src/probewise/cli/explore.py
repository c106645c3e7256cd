"""`probewise explore`: the robot chooses its own measurements until it knows the shape."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from probewise.cli._arm import (
    ARMS,
    InstrumentWithCallbacks,
    add_geometry,
    warn_and_confirm_lowering,
    warn_if_place_sd_large,
)
from probewise.cli._common import (
    MOST_BATCH,
    Verb,
    add_count_option,
    add_out_directory,
    add_path,
    add_seed_and_quiet,
    message_to_resume,
    parse_path,
    parse_positive_int,
    print_result,
)
from probewise.cli._output import checked_output_directory, tables_and_descriptions
from probewise.cli._stopping import reporting_what_is_kept
from probewise.errors import FileError, shown
from probewise.verbs import MAX_READINGS, METHOD, MODEL, SHAPE, UTILITY

if TYPE_CHECKING:
    from probewise.cli._explore_arm import ArmAndTruth
    from probewise.cli._explore_inputs import ExploreInputs
    from probewise.experiment import Exploration, Journal, Step


class _LazyShapeNames:
    """The names of all shapes, imported only when asked for: building the parser must not import numpy."""

    def __iter__(self) -> Iterator[str]:
        from probewise.scene import SHAPES

        return iter(SHAPES)

    def __contains__(self, name: object) -> bool:
        return name in tuple(self)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise explore`."""
    parser.add_argument("--sensor", type=parse_path, required=True, metavar="S.json", help="sensor model")
    add_out_directory(parser)
    parser.add_argument("--model", choices=("ssf", "naive"), default=MODEL, help="the robot's sensor model")
    parser.add_argument(
        "--method",
        choices=("particles", "paper"),
        default=METHOD,
        help="method of inference and choice: posterior samples reweighted after each reading (particles, default), or "
        "the paper's: a new nested sampling run after each reading, 50 diversified samples, entropy of their "
        "predictions, a Student-t or naive likelihood",
    )
    parser.add_argument(
        "--nested-stop",
        choices=("change", "remaining"),
        help="when nested sampling ends with --method paper: at a change of log evidence below 1e-8 (default), or "
        "where the log evidence can rise by 0.05 at most",
    )
    add_path(
        parser,
        "--levels",
        "REC.csv",
        "recording with readings over black and over white, from which the naive model of --method paper takes "
        "its levels and sds (a simulated arm reads both before it starts)",
    )
    parser.add_argument(
        "--shape",
        nargs="+",
        choices=_LazyShapeNames(),
        default=[SHAPE],
        metavar="SHAPE",
        help=f"possible shapes on the field, one or several of %(choices)s (default {SHAPE})",
    )
    parser.add_argument(
        "--truth",
        metavar="[SHAPE:]V,V,...",
        help="the true shape in the simulated world, a circle as X,Y,R in mm (default: drawn from the seed)",
    )
    parser.add_argument(
        "--field", metavar="W,H", help="width and height of the field in mm (default: the geometry's, or 1048,520)"
    )
    parser.add_argument(
        "--arm",
        default="simulated",
        metavar="ARM",
        help=f"where the readings come from: {ARMS} (default simulated)",
    )
    add_geometry(
        parser,
        "the file that ships; the simulated arm has its reach, and a sensor that turns with --orientations alone",
    )
    add_count_option(
        parser, "--max-readings", f"largest number of readings (default {MAX_READINGS})", default=MAX_READINGS
    )
    parser.add_argument(
        "--live", action="store_true", help="show the robot's view in a browser while it works (DIR/live.html)"
    )
    parser.add_argument(
        "--both-models",
        action="store_true",
        help="also show the posterior of the other sensor model from the same readings",
    )
    parser.add_argument(
        "--utility",
        metavar="NAME",
        help=f"acquisition function: {UTILITY} (default), information and, near the end, the probability that the "
        f"reading ends the run; information alone; the paper's entropy; information per-second of arm time, "
        f"information about:PARAMETER such as about:radius_mm, or on which-shape of several is present",
    )
    parser.add_argument(
        "--learn-sensor",
        action="store_true",
        help="infer the SSF's size and place and both levels together with the shape, with sensor.json as prior",
    )
    parser.add_argument(
        "--trust",
        type=float,
        metavar="P",
        help="prior probability that the sensor model leaves nothing out; below 1 the robot also infers which effects "
        "it leaves out (default 0.9; 1 with --model naive, --method paper, --learn-sensor, any --utility but "
        "finishing, or several shapes)",
    )
    parser.add_argument(
        "--reference",
        action="append",
        default=[],
        metavar="X,Y,W,H,ALBEDO",
        help="a card that lies on the field, its centre and size in mm, its albedo from 0 (as the field) to 1 (as the "
        "shape); may be given again",
    )
    add_count_option(parser, "--batch", "choose N readings at a time", default=1, most=MOST_BATCH)
    more = parser.add_argument_group("more than a place", "further choices, for an arm that supports them")
    more.add_argument(
        "--orientations", type=_parse_numbers, metavar="DEG,...", help="orientations to choose from, such as 0,45,90"
    )
    more.add_argument(
        "--heights", type=_parse_numbers, metavar="MM,...", help="reading heights to choose from, such as 10,14"
    )
    more.add_argument(
        "--repeats",
        type=_parse_counts,
        metavar="N,...",
        help="numbers of repeated readings to choose from, such as 1,2,4",
    )
    parser.add_argument("--resume", action="store_true", help="resume from the journal in DIR")
    add_seed_and_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Let the robot search; keep a journal and a picture of every step; write the report; return the exit status."""
    from contextlib import closing

    from probewise import experiment as posing
    from probewise._progress import progress_shown
    from probewise.cli._explore_arm import open_arm_and_truth
    from probewise.cli._explore_inputs import read_checked_inputs
    from probewise.cli._explore_pictures import Pictures
    from probewise.experiment import Exploration, explore, read_journal, shadow_run

    out = checked_output_directory(arguments.out, "journal.jsonl", "live.html", "frames")
    inputs = read_checked_inputs(arguments)
    journal = out / "journal.jsonl"
    before = _journal_to_resume(journal, resume=arguments.resume)
    site = open_arm_and_truth(arguments, inputs, () if before is None else before.readings)
    print_result(f"seed {arguments.seed}", quiet=arguments.quiet)
    warn_and_confirm_lowering(inputs.arm, site.arm, inputs.geometry)
    if inputs.geometry is not None and inputs.arm.may_differ_from_geometry:
        warn_if_place_sd_large(inputs.geometry, inputs.experiment.stop_sd_mm)
    read = [arguments.sensor, *([] if arguments.levels is None else tables_and_descriptions([arguments.levels]))]
    pictures = Pictures(out, inputs, arguments.live, site.outline_mm, read)
    steps = pictures.steps

    def kept_message() -> str:
        if not journal.exists():
            return "nothing was read"
        return message_to_resume(journal, len(read_journal(journal).entries), "reading", arguments, "--resume")

    def report_activity(doing: str) -> None:
        believed = f"; widest sd {steps[-1].largest_sd_mm:.1f} mm" if steps else ""
        progress("exploring", note=f"reading {len(steps) + 1} of at most {arguments.max_readings}, {doing}{believed}")

    n_before = 0 if before is None else len(before.entries)

    with (
        reporting_what_is_kept(kept_message),
        progress_shown(quiet=arguments.quiet) as progress,
        InstrumentWithCallbacks(
            site.arm,
            lambda pose: report_activity(f"moving to ({pose.x_mm:.0f}, {pose.y_mm:.0f}) mm"),
            lambda reading: report_activity(f"thinking about {reading.value:g}"),
        ) as reporting,
        closing(
            explore(
                reporting,
                inputs.experiment,
                rng=inputs.streams.run,
                max_readings=arguments.max_readings,
                journal=before or journal,
                about={
                    **posing.sensor_entry(inputs.sensor, _path_relative_to_folder(out, arguments.sensor)),
                    **posing.geometry_entry(inputs.geometry),
                    **site.about,
                    "arm": arguments.arm.partition(":")[0],
                },
            )
        ) as own,
    ):
        if n_before:
            progress("going through the journal", 0, n_before)
        else:
            report_activity("choosing its place")
        pairs: Iterable[tuple[Step, Step | None]] = ((step, None) for step in own)
        if inputs.other is not None:
            under = posing.ArmReachAndTravel.from_instrument(site.arm, inputs.other.grid)
            pairs = shadow_run(own, inputs.other, under, rng=inputs.streams.shadow)
        for step, shadow in pairs:
            pictures.draw_and_write(step, shadow)
            if step.replayed:
                progress("going through the journal", step.number, n_before)
    result = Exploration(inputs.experiment, tuple(steps))
    with reporting_what_is_kept(kept_message, results=True), progress_shown(quiet=arguments.quiet) as progress:
        stage = pictures.write_results(result, seed=arguments.seed, known=site.known, progress=progress)
    for line in _closing_lines(result, inputs, site, journal):
        print_result(line, quiet=arguments.quiet)
    for note in stage.notes_on_renamed_inputs:
        print_result(f"note: {note}", quiet=arguments.quiet)
    print_result(f"written to {out}", quiet=arguments.quiet)
    pictures.drawings.raise_if_any_failed()
    return 0


def _closing_lines(result: Exploration, inputs: ExploreInputs, site: ArmAndTruth, journal: Path) -> Iterator[str]:
    """Yield the closing lines: the shape found, what its sds leave out, probable sensor faults, and errors if known."""
    from probewise import experiment as posing
    from probewise.report import exploration as report

    yield result.summary()
    if inputs.geometry is not None and inputs.arm.may_differ_from_geometry and inputs.geometry.accuracy is None:
        yield "arm          nobody has fitted its geometry: its own error is not in these sds"
    trust = inputs.experiment.trust
    missing = posing.left_out_after_step(result.last, trust)
    if trust < 1:
        yield missing.sentence
    if missing.leading != posing.CLEAN:
        yield f"what the readings say of the sensor: probewise diagnose {journal} --out DIAGNOSIS"
    if site.known is not None:
        yield f"error        {report.errors_text(result, site.known)}"


def _path_relative_to_folder(folder: Path, path: Path) -> str:
    """Return a file's path relative to a folder; the absolute path if it is on another drive."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # on another drive
        return str(path.absolute())


def _parse_numbers(text: str) -> tuple[float, ...]:
    """Parse "A,B,..." to finite numbers, each once, for argparse."""
    try:
        values = tuple(float(cell) for cell in text.split(","))
    except ValueError:
        values = (math.nan,)
    if not all(map(math.isfinite, values)):
        raise argparse.ArgumentTypeError(f"{shown(text)} is not a list of numbers such as 0,45,90")
    return tuple(dict.fromkeys(values))


def _parse_counts(text: str) -> tuple[int, ...]:
    """Parse "N,M,...", integers above zero, each once, for argparse."""
    return tuple(dict.fromkeys(parse_positive_int(cell, most=1000) for cell in text.split(",")))


def _journal_to_resume(journal: Path, *, resume: bool) -> Journal | None:
    from probewise.experiment import read_journal

    if resume and not journal.exists():
        raise FileError(journal, "no such file", "a journal to resume; omit --resume to begin a new run")
    if not journal.exists():
        return None
    if not resume:
        raise FileError(journal, "this journal exists already", "--resume to continue it, or another --out")
    return read_journal(journal)


VERB = Verb("explore", "Let the robot find a shape, choosing each measurement itself.", add_arguments, run)
