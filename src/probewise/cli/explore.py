"""`probewise explore`: the robot chooses its own measurements until it knows the shape."""

from __future__ import annotations

import argparse
import math

from probewise.cli._arm import ARMS, add_geometry
from probewise.cli._common import (
    MOST_BATCH,
    add_count_option,
    add_out_directory,
    add_path,
    add_seed_and_quiet,
    parse_numbers,
    parse_positive_int,
)
from probewise.errors import shown
from probewise.verbs import MAX_READINGS, METHOD, MODEL, SHAPE, SHAPES, UTILITY


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise explore`."""
    add_path(
        parser, "--sensor", "S.json", "sensor model (default in a simulated run: that of the recording that ships)"
    )
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
        choices=SHAPES,
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
        "--orientations",
        type=_parse_finite_numbers,
        metavar="DEG,...",
        help="orientations to choose from, such as 0,45,90",
    )
    more.add_argument(
        "--heights", type=_parse_finite_numbers, metavar="MM,...", help="reading heights to choose from, such as 10,14"
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
    return tuple(dict.fromkeys(parse_positive_int(cell, most=1000) for cell in text.split(",")))
