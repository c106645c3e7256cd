"""`probewise demo`: the paper end to end, on the recordings that ship with the package."""

from __future__ import annotations

import argparse

from probewise._writing import Drawings, checked_output_directory
from probewise.cli._common import add, add_out, add_seed_and_quiet, print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise demo`."""
    add_out(parser)
    add(parser, "--full", "compare one to four Gaussians with 300 live points, as in the paper")
    add_seed_and_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the demo, print its summary, and return the exit status."""
    out = checked_output_directory(arguments.out)
    from probewise._progress import progress_shown
    from probewise.cli._demo import DIAGNOSIS, run_demo

    drawings = (Drawings(out), Drawings(out / DIAGNOSIS))
    with progress_shown(quiet=arguments.quiet) as progress:
        lines = run_demo(*drawings, seed=arguments.seed, full=arguments.full, progress=progress)
    for line in lines:
        print_result(line, quiet=arguments.quiet)
    for each in drawings:
        each.raise_if_any_failed()
    return 0
