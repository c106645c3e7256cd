"""`probewise study`: how many readings the robot needs, over many circles and configurations."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterable
from functools import partial
from typing import TYPE_CHECKING, Any

from probewise._writing import checked_output_directory
from probewise.cli._common import MOST_BATCH, add, add_out, add_quiet, count_up_to, parse_count, parse_seed
from probewise.cli._executor import add_executor, run_and_report
from probewise.errors import ParameterError, require

if TYPE_CHECKING:
    from probewise.proof.study import SearchConfiguration

_FACTORS = ("population", "model", "utility", "noise", "width", "batch", "learn_sensor", "method", "nested_stop")
MOST_CIRCLES = 10_000  # as of `probewise.proof.study`, which takes a second to import
_OF_CONCEALED = ("clean", "seed", "size", "varied")
_SIZES = ("small", "plain", "gross")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise study`."""
    circles = count_up_to(MOST_CIRCLES)
    add_out(parser)
    add(parser, "--circles N", "circles per row, always the first ones (default 200)", type=circles, default=200)
    add(parser, "--quoted N", "circles of the first row (default as --circles)", type=circles)
    add(
        parser,
        "--concealed",
        "conceal an effect from the robot in every row, at three sizes, and search for the same circles with and "
        "without doubt about the sensor (writes report.html and concealed.csv; replaces all other rows)",
    )
    add(parser, "--seed S", "with --concealed: circles, noise and robot of another seed", type=parse_seed)
    add(parser, "--size", "with --concealed: only this one of the three sizes", choices=_SIZES)
    add(parser, "--varied", "with --concealed: over each circle a noise, a pace, a rounding and a sensor of its own")
    add(parser, "--clean N", "with --concealed: circles of the row without a concealed effect", type=circles)
    add(
        parser,
        "--beside-paper",
        "for each sensor model, our method and the paper's (explore --method paper) on the same circles; of the "
        "options of one row, only --population and --nested-stop apply",
    )
    one = parser.add_argument_group("one row instead of the table's", "defaults are those of the reference row")
    add(one, "--population NAME", "inside (50 to 150 mm, entirely in the field) or anywhere")
    add(one, "--model NAME", "the robot's sensor model: ssf or naive")
    add(one, "--utility NAME", "acquisition function: finishing, information, entropy, ...")
    add(one, "--noise SD", "sd of the noise, LEGO units (reference: 1)", type=float)
    add(one, "--width F", "assumed width of the SSF over the true one", type=float)
    add(one, "--batch N", "number of readings chosen at a time", type=count_up_to(MOST_BATCH))
    add(one, "--learn-sensor", "learn the sensor along with the shape", action="store_true", default=None)
    add(one, "--method NAME", "how the robot infers and chooses: particles or paper")
    add(one, "--nested-stop NAME", "when the paper's nested sampling ends: change (of ln Z) or remaining")
    about = "a run that is not done after N readings counts as a miss (default 100)"
    add(parser, "--max-readings N", about, type=parse_count, default=100)
    add_executor(parser)
    add_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the study's remaining tasks; write its table and report; return the exit status."""
    from probewise.proof import pages
    from probewise.proof.concealed_study import concealed_study
    from probewise.proof.study import study

    checked_output_directory(arguments.out, "trials.jsonl", "concealed.jsonl")
    command = _command_line(arguments)
    if arguments.concealed:
        _require_none(arguments, (*_FACTORS, "quoted", "beside_paper"), "--concealed")
        hiding = concealed_study(
            arguments.circles,
            max_readings=arguments.max_readings,
            sizes=(0, 1, 2) if arguments.size is None else (_SIZES.index(arguments.size),),
            n_clean=arguments.clean,
            varied=arguments.varied,
            **({} if arguments.seed is None else {"seed": arguments.seed}),
        )
        page_of = partial(pages.concealed_page, command=command)
        return run_and_report(hiding, page_of, arguments, "concealed.jsonl", "concealed.csv")
    for name, value in _given(arguments, _OF_CONCEALED).items():
        raise ParameterError(f"--{name}", value, "only with --concealed")
    rows = _configuration_rows(arguments)
    numbers = dict.fromkeys(rows, arguments.circles)
    numbers[rows[0]] = arguments.quoted or arguments.circles
    require(max(numbers.values()) >= 2, "--circles", arguments.circles, "2 or more: one circle gives no standard error")
    plain = study(numbers, max_readings=arguments.max_readings)
    return run_and_report(plain, partial(pages.study_page, command=command), arguments, "trials.jsonl")


def _given(arguments: argparse.Namespace, names: Iterable[str]) -> dict[str, Any]:
    """Return the options among `names` that were given, with their values."""
    values = {name: getattr(arguments, name) for name in names}
    return {name: value for name, value in values.items() if value is not None and value is not False}


def _require_none(arguments: argparse.Namespace, names: Iterable[str], beside: str) -> None:
    for name in _given(arguments, names):
        raise ParameterError(f"--{name.replace('_', '-')}", "given", f"none with {beside}, which has its own rows")


def _configuration_rows(arguments: argparse.Namespace) -> tuple[SearchConfiguration, ...]:
    from probewise.proof.study import SearchConfiguration, paper_comparison_rows, standard_rows

    given = _given(arguments, _FACTORS)
    if arguments.beside_paper:
        others = [name for name in given if name not in ("population", "nested_stop")]
        _require_none(arguments, others, "--beside-paper")
        return paper_comparison_rows(**given)
    if not given:
        return standard_rows()
    if given.get("method") == "paper":
        given.setdefault("utility", "entropy")
    if "noise" in given:
        given["noise_sd"] = given.pop("noise")
    return (SearchConfiguration(**given),)


def _command_line(arguments: argparse.Namespace) -> str:
    words = ["probewise", "study", *(["--concealed"] if arguments.concealed else [])]
    names = _OF_CONCEALED if arguments.concealed else ("quoted", "beside_paper", *_FACTORS)
    for name, value in _given(arguments, ("circles", *names, "max_readings")).items():
        words += [f"--{name.replace('_', '-')}"] + ([] if value is True else [str(value)])
    return shlex.join(words)
