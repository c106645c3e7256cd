"""Executors of a campaign (many tasks whose results are kept in a file): this process, workers, or a cluster."""

from __future__ import annotations

import argparse
import contextlib
import logging
from collections.abc import Iterator
from concurrent.futures import Executor
from functools import partial
from pathlib import Path

from probewise._signals import reporting_what_is_kept
from probewise.cli._common import message_to_resume, parse_positive_int
from probewise.errors import LinkError
from probewise.progress import Progress


def add_executor(parser: argparse.ArgumentParser) -> None:
    """Add --workers and --scheduler."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--workers",
        type=partial(parse_positive_int, most=1024),
        default=1,
        metavar="N",
        help="processes here (default 1)",
    )
    where.add_argument(
        "--scheduler", metavar="HOST:PORT", help="a dask scheduler whose workers do it (extra `cluster`)"
    )


@contextlib.contextmanager
def open_executor(arguments: argparse.Namespace) -> Iterator[Executor | None]:
    """Yield the executor that --workers or --scheduler asks for; None for this process."""
    if arguments.scheduler is not None:
        with _cluster_executor(arguments.scheduler) as executor:
            yield executor
    elif arguments.workers > 1:
        from probewise.cli._workers import worker_pool

        with worker_pool(arguments.workers) as pool:
            yield pool
    else:
        yield None


@contextlib.contextmanager
def executor_and_progress(
    path: Path, noun: str, arguments: argparse.Namespace
) -> Iterator[tuple[Executor | None, Progress]]:
    """Yield a campaign's executor, None for this process, and its progress function.

    If the block is interrupted, the message says what the campaign's file, `path`, holds.
    """
    from probewise._progress import progress_shown

    with (
        reporting_what_is_kept(lambda: message_to_resume_campaign(path, noun, arguments)),
        progress_shown(quiet=arguments.quiet) as progress,
        open_executor(arguments) as executor,
    ):
        yield executor, progress


def message_to_resume_campaign(path: Path, noun: str, arguments: argparse.Namespace) -> str:
    """Return a message: how many finished tasks a campaign's file holds, and the command that resumes it."""
    from probewise.proof.campaign import read_campaign

    return (
        message_to_resume(path, len(read_campaign(path).results), noun, arguments)
        if path.exists()
        else "nothing was written"
    )


@contextlib.contextmanager
def _cluster_executor(address: str) -> Iterator[Executor]:
    try:
        from distributed import Client
    except ImportError as error:
        raise LinkError(
            "--scheduler needs the package distributed, which is not installed; "
            "install it with: pip install distributed; --workers N does without"
        ) from error
    # A lost scheduler is reported in one line: its library's log would add a page.
    for name in ("distributed", "distributed.client", "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=10)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise LinkError(f"no scheduler answers at {address}; start one with `dask scheduler`") from error
    with client:
        yield client.get_executor(pure=False)  # type: ignore[no-untyped-call]
