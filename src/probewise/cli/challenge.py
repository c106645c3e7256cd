"""`probewise challenge`: what a diagnosis is worth, on concealed recordings of another simulator."""

from __future__ import annotations

import argparse
import shlex
from functools import partial

from probewise.cli._common import Verb, add_common, add_out_directory, positive_int, say
from probewise.cli._executor import add_executor, campaign_keeps, executor_of
from probewise.cli._output import check_out_directory, staged
from probewise.cli._stopping import saying_what_is_kept

__all__ = ["VERB"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Fill the verb's parser."""
    add_out_directory(parser)
    parser.add_argument(
        "--cases",
        type=positive_int,
        default=60,
        metavar="N",
        help="recordings, always the first of the seed's; 60 are one of each kind, 6000 the whole table (default 60)",
    )
    parser.add_argument(
        "--systems",
        action="store_true",
        help="recordings of twelve kinds of system, each with its owner's file, instead of a light sensor's",
    )
    add_executor(parser)
    add_common(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run what is left of the challenge and write its table."""
    from probewise._progress import progress_shown
    from probewise.challenge import run_case, run_challenge, score
    from probewise.challenge.systems import run_system_case, score_systems
    from probewise.recordings import write_text_atomically
    from probewise.report import challenge as report

    out = check_out_directory(arguments.out)
    out.mkdir(parents=True, exist_ok=True)
    cases = out / "cases.jsonl"
    kept = partial(campaign_keeps, cases, "case", arguments)
    with (
        saying_what_is_kept(kept),
        progress_shown(quiet=arguments.quiet) as progress,
        executor_of(arguments) as executor,
    ):
        results = run_challenge(
            arguments.cases,
            seed=arguments.seed,
            work=run_system_case if arguments.systems else run_case,
            of="systems" if arguments.systems else "",
            path=cases,
            executor=executor,
            progress=progress,
        )
    rows = score_systems(results) if arguments.systems else score(results)
    of = ["--systems"] if arguments.systems else []
    command = shlex.join(
        ["probewise", "challenge", *of, "--cases", str(arguments.cases), "--seed", str(arguments.seed)]
    )
    drawing = progress_shown(quiet=arguments.quiet)
    with saying_what_is_kept(kept, results=True), drawing as progress, staged(out) as stage:
        progress("drawing the report")
        write_text_atomically(stage / "table.csv", report.table_csv(rows))
        write_text_atomically(
            stage / "report.html", report.write_page(results, command=command, systems=arguments.systems)
        )
    say(report.answer(rows, len(results)), quiet=arguments.quiet)
    say(f"seed {arguments.seed}; written to {out}", quiet=arguments.quiet)
    return 0


VERB = Verb("challenge", "Measure what a diagnosis is worth, on concealed recordings.", add_arguments, run)
