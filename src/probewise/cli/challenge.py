"""`probewise challenge`: measure the diagnosis on simulated recordings with concealed effects."""

import argparse
import shlex
from functools import partial

from probewise._writing import checked_output_directory
from probewise.cli._common import CommandError
from probewise.cli._executor import run_and_report
from probewise.proof import pages, tables
from probewise.proof.challenge import challenge, run_case, run_system_case


def run(arguments: argparse.Namespace) -> int:
    """Run the remaining cases of the challenge; write its table and report; return the exit status."""
    if arguments.systems and arguments.rounds > 1:
        raise CommandError("--rounds is for the light sensor; a table of --systems takes no further readings")
    checked_output_directory(arguments.out, "cases.jsonl", main="cases.jsonl")
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
