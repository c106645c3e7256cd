"""`probewise challenge`: measure the diagnosis on simulated recordings with concealed effects."""

from __future__ import annotations

import argparse
import shlex
from functools import partial

from probewise._signals import reporting_what_is_kept
from probewise._writing import Drawings, checked_output_directory
from probewise.cli._common import CommandError, add, add_out, add_seed_and_quiet, finish, parse_count
from probewise.cli._executor import add_executor, executor_and_progress, message_to_resume_campaign


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
    from probewise._progress import progress_shown
    from probewise.proof import pages
    from probewise.proof.challenge import RunCaseInRounds, run_case, run_challenge
    from probewise.proof.system_challenge import run_system_case
    from probewise.proof.tables import score, score_rounds, score_systems

    if arguments.systems and arguments.rounds > 1:
        raise CommandError("--rounds is for the light sensor; a table of --systems takes no further readings")
    out = checked_output_directory(arguments.out, "cases.jsonl")
    out.mkdir(parents=True, exist_ok=True)
    work, scored, of = run_case, score, ""
    if arguments.systems:
        work, scored, of = run_system_case, score_systems, "systems"
    elif arguments.rounds > 1:
        work, scored, of = RunCaseInRounds(arguments.rounds), score_rounds, f"{arguments.rounds} rounds"
    cases = out / "cases.jsonl"
    kept = partial(message_to_resume_campaign, cases, "case", arguments)
    with executor_and_progress(cases, "case", arguments) as (executor, progress):
        results = run_challenge(
            range(arguments.cases),
            seed=arguments.seed,
            work=work,
            of=of,
            path=cases,
            executor=executor,
            progress=progress,
        )
    rows = scored(results)
    options = ["--systems"] if arguments.systems else []
    options += ["--rounds", str(arguments.rounds)] if arguments.rounds > 1 else []
    command = shlex.join(
        ["probewise", "challenge", *options, "--cases", str(arguments.cases), "--seed", str(arguments.seed)]
    )
    drawings = Drawings(out)
    with reporting_what_is_kept(kept, results=True), progress_shown(quiet=arguments.quiet) as progress:
        drawings.write_results(
            lambda stage: stage.write("table.csv", pages.challenge_csv(rows)),
            {},
            lambda _: pages.challenge_html(
                results, rows, command=command, systems=arguments.systems, draw=drawings.draw
            ),
            progress=progress,
        )
    summary = pages.challenge_sentence(rows, len(results))
    return finish(drawings, summary, f"seed {arguments.seed}; written to {out}", quiet=arguments.quiet)
