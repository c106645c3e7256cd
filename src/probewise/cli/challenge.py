"""`probewise challenge`: measure the diagnosis on simulated recordings with concealed effects."""

from __future__ import annotations

import argparse
import shlex
from functools import partial

from probewise._writing import checked_output_directory
from probewise.cli._common import CommandError, add, add_out, add_seed_and_quiet, parse_count
from probewise.cli._executor import add_executor, run_and_report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise challenge`."""
    add_out(parser)
    about = (
        "number of recordings, always the first of the seed; 60 give one case of each kind, 6000 the whole table "
        "(default 60)"
    )
    add(parser, "--cases N", about, type=parse_count, default=60)
    about = "recordings of twelve kinds of system, each with its simulator's file, instead of a light sensor's"
    add(parser, "--systems", about)
    about = (
        "take the readings that the diagnosis advises until it is settled, N rounds at most (default 1: no further "
        "readings)"
    )
    add(parser, "--rounds N", about, type=parse_count, default=1)
    add_executor(parser)
    add_seed_and_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the remaining cases of the challenge; write its table and report; return the exit status."""
    from probewise.proof import pages, tables
    from probewise.proof.challenge import challenge, run_case, run_system_case

    if arguments.systems and arguments.rounds > 1:
        raise CommandError("--rounds is for the light sensor; a table of --systems takes no further readings")
    checked_output_directory(arguments.out, "cases.jsonl")
    work, score, of, options = partial(run_case, rounds=arguments.rounds), tables.score, "", list[str]()
    if arguments.systems:
        work, score, of, options = partial(run_system_case), tables.score_systems, "systems", ["--systems"]
    elif arguments.rounds > 1:
        score, of, options = tables.score_rounds, f"{arguments.rounds} rounds", ["--rounds", str(arguments.rounds)]
    words = ["probewise", "challenge", *options, "--cases", str(arguments.cases), "--seed", str(arguments.seed)]
    command = shlex.join(words)
    return run_and_report(
        challenge(range(arguments.cases), seed=arguments.seed, work=work, of=of),
        lambda found: pages.challenge_page([*found.values()], score, command=command, systems=arguments.systems),
        arguments,
        "cases.jsonl",
        said=f"seed {arguments.seed}; ",
    )
