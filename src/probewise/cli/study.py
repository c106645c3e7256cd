"""`probewise study`: how many readings the robot needs, over many circles and configurations."""

from __future__ import annotations

import argparse
import shlex
from functools import partial
from typing import TYPE_CHECKING

from probewise._signals import reporting_what_is_kept
from probewise._writing import Drawings, checked_output_directory
from probewise.cli._common import MOST_BATCH, add, add_out, add_quiet, count_up_to, finish, parse_count, parse_seed
from probewise.cli._executor import add_executor, executor_and_progress, message_to_resume_campaign
from probewise.errors import ParameterError

if TYPE_CHECKING:
    from pathlib import Path

    from probewise.proof.configurations import SearchConfiguration

_FACTORS = ("population", "model", "utility", "noise", "width", "batch", "learn_sensor", "method", "nested_stop")
MOST_CIRCLES = 10_000  # as of `probewise.proof.study`, which takes a second to import
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
    from probewise._progress import progress_shown
    from probewise.proof import pages
    from probewise.proof.study import run_study

    out = checked_output_directory(arguments.out, "trials.jsonl", "concealed.jsonl")
    if arguments.concealed:
        return _run_concealed(arguments, out)
    for name in ("seed", "size", "clean", "varied"):
        if getattr(arguments, name) not in (None, False):
            raise ParameterError(f"--{name}", getattr(arguments, name), "only with --concealed")
    rows = _configuration_rows(arguments)
    numbers = dict.fromkeys(rows, arguments.circles)
    numbers[rows[0]] = arguments.quoted or arguments.circles
    if max(numbers.values()) < 2:
        raise ParameterError("--circles", arguments.circles, "2 or more: one circle gives no standard error")
    out.mkdir(parents=True, exist_ok=True)
    trials = out / "trials.jsonl"
    kept = partial(message_to_resume_campaign, trials, "run", arguments)
    with executor_and_progress(trials, "run", arguments) as (executor, progress):
        study = run_study(
            numbers, path=trials, max_readings=arguments.max_readings, executor=executor, progress=progress
        )
    drawings = Drawings(out)
    with reporting_what_is_kept(kept, results=True), progress_shown(quiet=arguments.quiet) as progress:
        drawings.write_results(
            lambda stage: stage.write("table.csv", pages.study_csv(study)),
            {},
            lambda _: pages.study_html(study, command=_command_line(arguments), draw=drawings.draw),
            progress=progress,
        )
    return finish(drawings, pages.study_sentence(study), f"written to {out}", quiet=arguments.quiet)


def _run_concealed(arguments: argparse.Namespace, out: Path) -> int:
    """Run the remaining tasks of the study of concealed effects; write its table and report; return the exit status."""
    from probewise.proof import pages
    from probewise.proof.concealed_study import concealed_csv_rows, concealed_forms, concealed_rows, run_concealed
    from probewise.recordings.table import csv_text_of_rows

    others = [f"--{name.replace('_', '-')}" for name in (*_FACTORS, "quoted") if getattr(arguments, name) is not None]
    others += ["--beside-paper"] if arguments.beside_paper else []
    if others:
        raise ParameterError(others[0], "given", "none with --concealed, which has its own rows")
    out.mkdir(parents=True, exist_ok=True)
    trials = out / "concealed.jsonl"
    with executor_and_progress(trials, "run", arguments) as (executor, progress):
        found = run_concealed(
            arguments.circles,
            path=trials,
            max_readings=arguments.max_readings,
            sizes=(0, 1, 2) if arguments.size is None else (_SIZES.index(arguments.size),),
            n_clean=arguments.clean,
            varied=arguments.varied,
            **({} if arguments.seed is None else {"seed": arguments.seed}),
            executor=executor,
            progress=progress,
        )
    table = concealed_csv_rows(found)
    rows, drawings = concealed_rows(found), Drawings(out)
    command = _concealed_command_line(arguments)
    drawings.write_results(
        lambda stage: stage.write("concealed.csv", csv_text_of_rows(table[0], (row.values() for row in table))),
        {},
        lambda _: pages.concealed_html(rows, concealed_forms(found), command=command, draw=drawings.draw),
    )
    return finish(drawings, pages.concealed_sentence(rows), f"written to {out}", quiet=arguments.quiet)


def _configuration_rows(arguments: argparse.Namespace) -> tuple[SearchConfiguration, ...]:
    from probewise.proof.configurations import SearchConfiguration, paper_comparison_rows, standard_rows

    given = {name: getattr(arguments, name) for name in _FACTORS if getattr(arguments, name) is not None}
    if arguments.beside_paper:
        others = [f"--{name.replace('_', '-')}" for name in given if name not in ("population", "nested_stop")]
        if others:
            raise ParameterError(others[0], "given", "none with --beside-paper, which has its own rows")
        return paper_comparison_rows(**given)
    if not given:
        return standard_rows()
    if given.get("method") == "paper":
        given.setdefault("utility", "entropy")
    if "noise" in given:
        given["noise_sd"] = given.pop("noise")
    return (SearchConfiguration(**given),)


def _command_line(arguments: argparse.Namespace) -> str:
    words = ["probewise", "study", "--circles", str(arguments.circles)]
    words += [] if arguments.quoted is None else ["--quoted", str(arguments.quoted)]
    words += ["--beside-paper"] if arguments.beside_paper else []
    for name in _FACTORS:
        value = getattr(arguments, name)
        if value is not None:
            words += [f"--{name.replace('_', '-')}"] + ([] if value is True else [str(value)])
    return shlex.join([*words, "--max-readings", str(arguments.max_readings)])


def _concealed_command_line(arguments: argparse.Namespace) -> str:
    words = ["probewise", "study", "--concealed", "--circles", str(arguments.circles)]
    for name in ("clean", "seed", "size"):
        value = getattr(arguments, name)
        words += [] if value is None else [f"--{name}", str(value)]
    words += ["--varied"] if arguments.varied else []
    return shlex.join([*words, "--max-readings", str(arguments.max_readings)])
