"""`probewise explore`: the robot chooses its own measurements until it knows the shape."""

from __future__ import annotations

import argparse
import math

from probewise.cli._arm import add_arm, add_geometry
from probewise.cli._common import (
    MOST_BATCH,
    add,
    add_nested_stop,
    add_out,
    add_seed_and_quiet,
    count_up_to,
    parse_count,
    parse_numbers,
    parse_path,
)
from probewise.errors import shown
from probewise.verbs import MAX_READINGS, METHOD, MODEL, SHAPE, SHAPES, UTILITY


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise explore`."""
    about = "sensor model (default in a simulated run: that of the recording that ships)"
    add(parser, "--sensor S.json", about, type=parse_path)
    add_out(parser)
    add(parser, "--model", "the robot's sensor model", choices=("ssf", "naive"), default=MODEL)
    add(
        parser,
        "--method",
        "method of inference and choice: posterior samples reweighted after each reading (particles, default), or "
        "the paper's: a new nested sampling run after each reading, 50 diversified samples, entropy of their "
        "predictions, a Student-t or naive likelihood",
        choices=("particles", "paper"),
        default=METHOD,
    )
    add_nested_stop(parser)
    about = (
        "recording with readings over black and over white, from which the naive model of --method paper takes "
        "its levels and sds (a simulated arm reads both before it starts)"
    )
    add(parser, "--levels REC.csv", about, type=parse_path)
    about = f"possible shapes on the field, one or several of %(choices)s (default {SHAPE})"
    add(parser, "--shape SHAPE", about, nargs="+", choices=SHAPES, default=[SHAPE])
    about = "the true shape in the simulated world, a circle as X,Y,R in mm (default: drawn from the seed)"
    add(parser, "--truth [SHAPE:]V,V,...", about)
    add(parser, "--field W,H", "width and height of the field in mm (default: the geometry's, or 1048,520)")
    add_arm(parser)
    default = "the file that ships; the simulated arm has its reach, and a sensor that turns with --orientations alone"
    add_geometry(parser, default)
    about = f"largest number of readings (default {MAX_READINGS})"
    add(parser, "--max-readings N", about, type=parse_count, default=MAX_READINGS)
    add(parser, "--live", "show the robot's view in a browser while it works (DIR/live.html)")
    add(parser, "--both-models", "also show the posterior of the other sensor model from the same readings")
    add(
        parser,
        "--utility NAME",
        f"acquisition function: {UTILITY} (default), information and, near the end, the probability that the "
        f"reading ends the run; information alone; the paper's entropy; information per-second of arm time, "
        f"information about:PARAMETER such as about:radius_mm, or on which-shape of several is present",
    )
    about = "infer the SSF's size and place and both levels together with the shape, with sensor.json as prior"
    add(parser, "--learn-sensor", about)
    about = (
        "prior probability that the sensor model leaves nothing out; below 1 the robot also infers which effects "
        "it leaves out (default 0.9; 1 with --model naive, --method paper, --learn-sensor, any --utility but "
        "finishing, or several shapes)"
    )
    add(parser, "--trust P", about, type=float)
    about = (
        "a card that lies on the field, its centre and size in mm, its albedo from 0 (as the field) to 1 (as the "
        "shape); may be given again"
    )
    add(parser, "--reference X,Y,W,H,ALBEDO", about, action="append", default=[])
    add(parser, "--batch N", "choose N readings at a time", type=count_up_to(MOST_BATCH), default=1)
    more = parser.add_argument_group("more than a place", "further choices, for an arm that supports them")
    add(more, "--orientations DEG,...", "orientations to choose from, such as 0,45,90", type=_parse_finite_numbers)
    add(more, "--heights MM,...", "reading heights to choose from, such as 10,14", type=_parse_finite_numbers)
    add(more, "--repeats N,...", "numbers of repeated readings to choose from, such as 1,2,4", type=_parse_counts)
    add(parser, "--resume", "resume from the journal in DIR")
    add_seed_and_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Let the robot search; return the exit status."""
    from probewise.cli._explore import explore

    return explore(arguments)


def _parse_finite_numbers(text: str) -> tuple[float, ...]:
    """Parse "A,B,..." to finite numbers, each once, for argparse."""
    values = parse_numbers(text)
    if not values or not all(map(math.isfinite, values)):
        raise argparse.ArgumentTypeError(f"{shown(text)} is not a list of numbers such as 0,45,90")
    return tuple(dict.fromkeys(values))


def _parse_counts(text: str) -> tuple[int, ...]:
    """Parse "N,M,...", integers above zero, each once, for argparse."""
    return tuple(dict.fromkeys(map(count_up_to(1000), text.split(","))))
