"""`probewise explore`: the robot chooses its own measurements until it knows the shape."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probewise.cli._arm import (
    ARMS,
    ArmName,
    Telling,
    add_geometry,
    geometry_of,
    open_emulated,
    open_nxt,
    open_own,
    parse_arm,
    require_choices,
    warn_of_clearance,
)
from probewise.cli._common import Verb, a_path, add_common, add_out_directory, keeps, positive_int, say
from probewise.cli._output import check_out_directory, staged
from probewise.cli._stopping import require_going_on, saying_what_is_kept
from probewise.errors import FileError, ParameterError
from probewise.verbs import MAX_READINGS, METHOD, MODEL, SHAPE, UTILITY

if TYPE_CHECKING:
    import numpy as np

    from probewise.arm import Geometry, Instrument
    from probewise.calibration import FittedSensor
    from probewise.experiment import Journal, Model, Step
    from probewise.inference import Naive
    from probewise.scene import Field

__all__ = ["VERB"]

SHAPE_NAMES = ("circle", "ellipse", "rectangle", "triangle", "hexagon")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Fill the verb's parser."""
    parser.add_argument("--sensor", type=a_path, required=True, metavar="S.json", help="sensor model")
    add_out_directory(parser)
    parser.add_argument("--model", choices=("ssf", "naive"), default=MODEL, help="what the robot takes its sensor for")
    parser.add_argument(
        "--method",
        choices=("particles", "paper"),
        default=METHOD,
        help="how the robot infers and chooses: with samples that it carries from reading to reading (particles, "
        "default), or as in the paper: nested sampling anew after each reading, 50 samples diversified, the entropy of "
        "what they predict, a Student-t or naive likelihood",
    )
    parser.add_argument(
        "--nested-stop",
        choices=("change", "remaining"),
        help="when nested sampling ends with --method paper: at a change of log evidence below 1e-8 (default), or "
        "where the log evidence can rise by 0.05 at most",
    )
    parser.add_argument(
        "--levels",
        type=a_path,
        metavar="REC.csv",
        help="recording with readings over black and over white, which the naive model of --method paper takes its "
        "levels and sds from (a simulated arm reads both before it starts)",
    )
    parser.add_argument(
        "--shape",
        nargs="+",
        choices=SHAPE_NAMES,
        default=[SHAPE],
        metavar="SHAPE",
        help=f"what may lie on the field, one or several of {', '.join(SHAPE_NAMES)} (default {SHAPE})",
    )
    parser.add_argument(
        "--truth",
        metavar="[SHAPE:]V,V,...",
        help="what the simulated world hides, a circle as X,Y,R in mm (default: drawn from the seed)",
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
    add_geometry(parser, "the file that ships; the simulated arm has its reach, and a sensor that does not turn")
    parser.add_argument(
        "--max-readings",
        type=positive_int,
        default=MAX_READINGS,
        metavar="N",
        help=f"stop here at the latest (default {MAX_READINGS})",
    )
    parser.add_argument(
        "--live", action="store_true", help="show the robot's view in a browser while it works (DIR/live.html)"
    )
    parser.add_argument(
        "--both-models",
        action="store_true",
        help="show beside the robot's view what the other sensor model makes of the same readings",
    )
    parser.add_argument(
        "--utility",
        metavar="NAME",
        help=f"what a reading is worth: information and, {UTILITY} (default), near the end whether it ends the run; "
        "information alone; the paper's entropy; information per-second of arm time, "
        "information about:PARAMETER such as about:radius_mm, or on which-shape of several lies there",
    )
    parser.add_argument(
        "--learn-sensor",
        action="store_true",
        help="infer the SSF's size and place and both levels along with the shape, from what sensor.json says of them",
    )
    parser.add_argument(
        "--trust",
        type=float,
        metavar="P",
        help="probability that the sensor model leaves nothing out; below 1 the robot weighs what it may leave out "
        "along with the shape (default 0.9; 1 with --model naive, --learn-sensor, --utility or several shapes)",
    )
    parser.add_argument(
        "--reference",
        action="append",
        default=[],
        metavar="X,Y,W,H,ALBEDO",
        help="a card that lies on the field, its centre and size in mm, its albedo from 0 (as the field) to 1 (as the "
        "shape); may be given again",
    )
    parser.add_argument("--batch", type=positive_int, default=1, metavar="N", help="choose N readings at a time")
    more = parser.add_argument_group("more than a place", "what else the robot may choose, of an arm that can")
    more.add_argument(
        "--orientations", type=_numbers, metavar="DEG,...", help="how the sensor may be turned, such as 0,45,90"
    )
    more.add_argument(
        "--heights", type=_numbers, metavar="MM,...", help="how high above the surface it may read, such as 10,14"
    )
    more.add_argument(
        "--repeats", type=_counts, metavar="N,...", help="how often it may read on the spot, such as 1,2,4"
    )
    parser.add_argument("--resume", action="store_true", help="go on from the journal in DIR")
    add_common(parser)


def run(arguments: argparse.Namespace) -> int:
    """Measure, infer, inquire; keep a journal and a picture of every step."""
    import webbrowser
    from contextlib import closing
    from functools import partial

    import numpy as np

    from probewise import experiment as posing
    from probewise._progress import progress_shown
    from probewise.calibration import read_sensor
    from probewise.cli._geometry import parse_cards, parse_truth
    from probewise.experiment import Exploration, beside, explore, read_journal
    from probewise.recordings import write_bytes_atomically, write_text_atomically
    from probewise.report import exploration as report
    from probewise.report.animation import gif

    out = check_out_directory(arguments.out)
    chosen = parse_arm(arguments.arm)
    if chosen.kind == "file" and arguments.geometry is not None:
        raise ParameterError(
            "--geometry", str(arguments.geometry), "none with FILE.py, which says itself what it reaches"
        )
    geometry = geometry_of(arguments) if chosen.is_lego or arguments.geometry is not None else None
    field = _field(arguments.field, geometry)
    sensor = read_sensor(arguments.sensor)
    if chosen.is_lego and sensor.instrumentation.unit not in ("", "LEGO"):
        raise ParameterError("--sensor", str(arguments.sensor), "one that reads in LEGO units, as the brick does")
    streams = posing.Streams.of(np.random.default_rng(arguments.seed))
    shape = posing.shape_named(arguments.shape, field)
    orientations_rad, heights_mm, repeats = _choices(arguments, geometry)
    cards = parse_cards(arguments.reference, field)
    if cards and (arguments.both_models or arguments.model == "naive" or arguments.method == "paper"):
        allowed = "none with --both-models, --model naive or --method paper"
        raise ParameterError("--reference", arguments.reference[0], allowed)
    levels_read = _levels(arguments, chosen, sensor, rng=streams.levels)
    pose_it = partial(
        posing.pose_experiment,
        sensor,
        shape,
        field,
        method=arguments.method,
        utility=arguments.utility,
        nested_stop=arguments.nested_stop,
        orientations_rad=orientations_rad,
        repeats=repeats,
        cards=cards,
    )
    experiment = pose_it(
        model=arguments.model,
        naive=levels_read if arguments.model == "naive" else None,
        learn_sensor=arguments.learn_sensor,
        batch=arguments.batch,
        heights_mm=heights_mm,
        trust=arguments.trust,
    )
    other_model: Model = "naive" if arguments.model == "ssf" else "ssf"
    other = None
    if arguments.both_models:
        other = pose_it(model=other_model, naive=levels_read if other_model == "naive" else None, trust=1.0)
    journal = out / "journal.jsonl"
    before = _before(journal, resume=arguments.resume)
    taken = () if before is None else before.readings
    arm: Instrument
    start_s = taken[-1].time_s if taken else 0.0
    truth_mm, known = None, None
    about: dict[str, Any] = posing.sensor_named(sensor, _seen_from(out, arguments.sensor))
    if chosen.kind in ("nxt", "file"):
        if arguments.truth is not None:
            raise ParameterError("--truth", arguments.truth, "none with a real arm: what lies there is for it to find")
        if chosen.kind == "file":
            arm = open_own(chosen.where, start_s=start_s)
        elif geometry is not None:
            arm = open_nxt(chosen.where, geometry, start_s=start_s)
    else:
        hidden = parse_truth(arguments.truth, arguments.shape, field, rng=streams.truth)
        world, surface = posing.world_like(sensor), posing.with_cards(hidden.surface, cards)
        if chosen.is_lego and geometry is not None:
            built = chosen.built_as(arguments.geometry)
            arm, _ = open_emulated(geometry, built, world, surface, seed=streams.noise, start_s=start_s)
        else:
            scale = posing.scale_of(sensor.instrumentation)
            arm = posing.arm_over(
                world, surface, field, seed=streams.noise, taken=taken, workspace=geometry, scale=scale
            )
        truth_mm, known = hidden.outline_mm, hidden.named_as(experiment.names)
        about = {**about, "hidden": hidden.document}
    means = sensor.mean()
    levels = (means["I_min"], means["I_max"])
    say(f"seed {arguments.seed}", quiet=arguments.quiet)
    if geometry is not None and chosen.is_apart:
        warn_of_clearance(geometry)
    folder = out / "frames"
    steps: list[Step] = []
    others: list[Step] = []
    frames, readings = [], []

    def kept() -> str:
        if not journal.exists():
            return "nothing was read"
        return keeps(journal, len(read_journal(journal).entries), "reading", arguments, "--resume")

    def tell(doing: str) -> None:
        believed = f"; widest sd {steps[-1].widest_mm:.1f} mm" if steps else ""
        progress("exploring", note=f"reading {len(steps) + 1}, {doing}{believed}")

    with (
        saying_what_is_kept(kept),
        progress_shown(quiet=arguments.quiet) as progress,
        Telling(
            arm,
            lambda pose: tell(f"moving to ({pose.x_mm:.0f}, {pose.y_mm:.0f}) mm"),
            lambda reading: tell(f"thinking about {reading.value:g}"),
        ) as telling,
        closing(
            explore(
                telling,
                experiment,
                rng=streams.run,
                max_readings=arguments.max_readings,
                journal=before or journal,
                about={**about, "arm": arguments.arm.partition(":")[0]},
            )
        ) as own,
    ):
        require_choices(arm, arguments.orientations, arguments.heights)
        progress("exploring", note="choosing the first place")
        pairs: Iterable[tuple[Step, Step | None]] = ((step, None) for step in own)
        if other is not None:
            pairs = beside(own, other, posing.Field.under(arm, other.grid), rng=streams.shadow)
        for step, shadow in pairs:
            steps.append(step)
            pose = step.reading.pose
            readings.append((pose.x_mm, pose.y_mm, step.reading.value))
            if shadow is None or other is None:
                frames.append(report.frame(step, experiment, readings, levels=levels, truth_mm=truth_mm))
            else:
                others.append(shadow)
                views = {arguments.model: (step, experiment), other_model: (shadow, other)}
                titled = [("naive model", *views["naive"]), ("SSF model", *views["ssf"])]
                frames.append(report.frame_of_both(titled, readings, levels=levels, truth_mm=truth_mm))
            require_going_on()  # a signal may have spoilt the picture
            if step.number == 1 and not step.replayed:
                _remove_pictures(out)
            folder.mkdir(exist_ok=True)
            write_bytes_atomically(folder / f"{step.number:03d}.png", frames[-1])
            if arguments.live:
                live = report.live_page(step, frames[-1], earlier=steps[:-1], trust=experiment.trust)
                write_text_atomically(out / "live.html", live)
                if len(frames) == 1:
                    webbrowser.open((out / "live.html").absolute().as_uri())
    result = Exploration(experiment, tuple(steps))
    drawing = progress_shown(quiet=arguments.quiet)
    with saying_what_is_kept(kept, results=True), drawing as progress, staged(out) as stage:
        progress("drawing the report")
        page = report.write_page(
            result,
            frames,
            seed=arguments.seed,
            model=arguments.model,
            truth=known,
            beside={other_model: others} if others else None,
        )
        write_text_atomically(stage / "report.html", page)
        write_bytes_atomically(stage / "run.gif", gif(frames))
        write_text_atomically(stage / "result.json", posing.result_json(result))
        write_text_atomically(stage / "samples.csv", posing.samples_csv(result))
        learnt = posing.repaired(sensor, result.last, rng=np.random.default_rng(arguments.seed))
        write_text_atomically(stage / "sensor.json", learnt.to_json())
    say(result.summary(), quiet=arguments.quiet)
    if geometry is not None and chosen.is_apart and geometry.accuracy is not None:
        accuracy = geometry.accuracy
        say(
            f"arm          not in these sds: its place is known to {accuracy.place_sd_mm:.2f} mm, lengths to "
            f"{accuracy.scale_sd:.2%}, the same for all readings",
            quiet=arguments.quiet,
        )
    missing = posing.left_out_of(result.last, experiment.trust)
    if experiment.trust < 1:
        say(missing.sentence, quiet=arguments.quiet)
    if missing.leading != posing.CLEAN:
        say(f"what the readings say of the sensor: probewise diagnose {journal} --out DIAGNOSIS", quiet=arguments.quiet)
    if known is not None:
        say(f"error        {report.errors_text(result.last, known)}", quiet=arguments.quiet)
    say(f"written to {out}", quiet=arguments.quiet)
    return 0


def _seen_from(folder: Path, path: Path) -> str:
    """Name a file as seen from a folder, so that both can move together."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # on another drive
        return str(path.absolute())


def _numbers(text: str) -> tuple[float, ...]:
    """Read "A,B,...", each number once, for argparse."""
    try:
        values = tuple(float(cell) for cell in text.split(","))
    except ValueError:
        values = (math.nan,)
    if not all(map(math.isfinite, values)):
        raise argparse.ArgumentTypeError(f"{text!r} is no list of numbers such as 0,45,90")
    return tuple(dict.fromkeys(values))


def _counts(text: str) -> tuple[int, ...]:
    """Read "N,M,...", whole numbers above zero, each once, for argparse."""
    return tuple(dict.fromkeys(positive_int(cell) for cell in text.split(",")))


def _choices(
    arguments: argparse.Namespace, geometry: Geometry | None
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[int, ...]]:
    """Take orientations in radians, heights and repeats that may be chosen, of an arm that can."""
    turns, heights_mm = arguments.orientations, arguments.heights
    asked = {"--orientations": turns, "--heights": heights_mm}
    refused = {}
    if geometry is not None:
        refused = {
            "--orientations": "none with the LEGO arm, no joint of which turns its sensor",
            "--heights": f"none with the LEGO arm, which reads {geometry.read_height_mm:g} mm above the surface",
        }
    elif arguments.both_models:
        refused = {"--heights": "none with --both-models, for the naive model knows no height"}
    for option, allowed in refused.items():
        if asked[option] is not None:
            raise ParameterError(option, ",".join(f"{value:g}" for value in asked[option]), allowed)
    return tuple(math.radians(turn) for turn in turns or (0.0,)), heights_mm or (), arguments.repeats or (1,)


def _field(text: str | None, geometry: Geometry | None) -> Field:
    """Take the field that was asked for, which must be the geometry's where there is one."""
    from probewise.cli._geometry import parse_field
    from probewise.scene import Field

    if geometry is None:
        return parse_field("1048,520" if text is None else text)
    own = Field(*geometry.field_mm)
    if text is not None and parse_field(text) != own:
        raise ParameterError("--field", text, f"{own.width_mm:g},{own.height_mm:g}, the geometry's; or none")
    return own


def _levels(
    arguments: argparse.Namespace, chosen: ArmName, sensor: FittedSensor, *, rng: np.random.Generator
) -> Naive | None:
    """Take the paper's naive levels from the recording that is given; a simulated sensor reads them now."""
    from probewise import experiment as posing
    from probewise.recordings import read_recording

    if arguments.nested_stop is not None and arguments.method != "paper":
        raise ParameterError("--nested-stop", arguments.nested_stop, "none but with --method paper")
    wanted = arguments.method == "paper" and (arguments.model == "naive" or arguments.both_models)
    if arguments.levels is not None:
        if not wanted:
            raise ParameterError("--levels", str(arguments.levels), "none but with --method paper and a naive model")
        return posing.levels_from(read_recording(arguments.levels), sensor)
    if not wanted:
        return None
    if chosen.kind in ("nxt", "file"):
        raise ParameterError(
            "--levels",
            "none",
            "a recording of readings over a black and a white sheet, for the naive model of the paper",
        )
    return posing.levels_in(posing.world_like(sensor), posing.scale_of(sensor.instrumentation), rng=rng)


def _before(journal: Path, *, resume: bool) -> Journal | None:
    from probewise.experiment import read_journal

    if resume and not journal.exists():
        raise FileError(journal, "no such file", "a journal to resume; without --resume a new run begins")
    if not journal.exists():
        return None
    if not resume:
        raise FileError(journal, "a run's journal stands there", "--resume to go on with it, or another --out")
    return read_journal(journal)


def _remove_pictures(out: Path) -> None:
    """Remove what an earlier run has left in `out`, whose journal is gone, lest the pictures of two runs mix."""
    for pattern in ("report.html", "run.gif", "live.html", "frames/[0-9]*.png"):
        for path in out.glob(pattern):
            path.unlink()


VERB = Verb("explore", "Let the robot find a shape, choosing each measurement itself.", add_arguments, run)
