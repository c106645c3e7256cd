"""`probewise study`: how many readings the robot needs, over many circles and configurations."""

import argparse
import shlex
from collections.abc import Iterable
from functools import partial
from typing import Any

from probewise._writing import checked_output_directory
from probewise.cli._executor import run_and_report
from probewise.cli._options import SIZES, refuse_options
from probewise.errors import require
from probewise.proof import pages
from probewise.proof.concealed_study import concealed_study
from probewise.proof.study import SearchConfiguration, paper_comparison_rows, standard_rows, study

_FACTORS = ("population", "model", "utility", "noise", "width", "batch", "learn_sensor", "method", "nested_stop")
_OF_CONCEALED = ("clean", "seed", "size", "varied")


def run(arguments: argparse.Namespace) -> int:
    """Run the study's remaining tasks; write its table and report; return the exit status."""
    file = "concealed.jsonl" if arguments.concealed else "trials.jsonl"
    checked_output_directory(arguments.out, file, main=file)
    words = ["probewise", "study", *(["--concealed"] if arguments.concealed else [])]
    names = _OF_CONCEALED if arguments.concealed else ("quoted", "beside_paper", *_FACTORS)
    for name, value in _given(arguments, ("circles", *names, "max_readings")).items():
        words += [f"--{name.replace('_', '-')}"] + ([] if value is True else [str(value)])
    command = shlex.join(words)
    if arguments.concealed:
        refuse_options(arguments, "--concealed, which has its own rows", *_FACTORS, "quoted", "beside_paper")
        hiding = concealed_study(
            arguments.circles,
            max_readings=arguments.max_readings,
            sizes=(0, 1, 2) if arguments.size is None else (SIZES.index(arguments.size),),
            n_clean=arguments.clean,
            varied=arguments.varied,
            **({} if arguments.seed is None else {"seed": arguments.seed}),
        )
        page_of = partial(pages.concealed_page, command=command)
        return run_and_report(hiding, page_of, arguments, file, "concealed.csv")
    refuse_options(arguments, "a study without --concealed", *_OF_CONCEALED)
    rows = _configuration_rows(arguments)
    numbers = dict.fromkeys(rows, arguments.circles)
    numbers[rows[0]] = arguments.quoted or arguments.circles
    require(max(numbers.values()) >= 2, "--circles", arguments.circles, "2 or more: one circle gives no standard error")
    plain = study(numbers, max_readings=arguments.max_readings)
    return run_and_report(plain, partial(pages.study_page, command=command), arguments, file)


def _given(arguments: argparse.Namespace, names: Iterable[str]) -> dict[str, Any]:
    values = {name: getattr(arguments, name) for name in names}
    return {name: value for name, value in values.items() if value is not None and value is not False}


def _configuration_rows(arguments: argparse.Namespace) -> tuple[SearchConfiguration, ...]:
    given = _given(arguments, _FACTORS)
    if arguments.beside_paper:
        others = [name for name in given if name not in ("population", "nested_stop")]
        refuse_options(arguments, "--beside-paper, which has its own rows", *others)
        return paper_comparison_rows(**given)
    if not given:
        return standard_rows()
    if given.get("method") == "paper":
        given.setdefault("utility", "entropy")
    if "noise" in given:
        given["noise_sd"] = given.pop("noise")
    return (SearchConfiguration(**given),)
