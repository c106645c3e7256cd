"""Executors of many tasks whose results are kept: this process, worker processes, which end with it, or a cluster."""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import shutil
import signal
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from contextlib import AbstractContextManager
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from probewise._signals import reporting_what_is_kept
from probewise._writing import Drawings, Output
from probewise.cli._common import finish, message_to_resume, progress_of
from probewise.errors import DoubtfulResultWarning, LinkError, NotConvergedError

if TYPE_CHECKING:
    from probewise.proof.campaign import Campaign, Result
    from probewise.proof.pages import CampaignPage

K = TypeVar("K")
_END_S = 2.0  # longest wait for the end of a worker process
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def open_executor(arguments: argparse.Namespace) -> AbstractContextManager[Executor | None]:
    """Open the executor that --workers or --scheduler asks for; None for this process."""
    if arguments.scheduler is not None:
        return _cluster_executor(arguments.scheduler)
    return worker_pool(arguments.workers) if arguments.workers > 1 else contextlib.nullcontext()


def run_and_report(
    campaign: Campaign[K],
    page_of: Callable[[dict[K, Result]], CampaignPage],
    arguments: argparse.Namespace,
    file: str,
    table: str = "table.csv",
    said: str = "",
) -> int:
    """Run what a campaign's `file` in --out lacks; write table and report; the last line printed begins with `said`."""
    from probewise.proof.campaign import read_campaign

    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)

    noun, n_done = campaign.noun.removesuffix("s"), lambda: len(read_campaign(out / file).results)
    kept = partial(message_to_resume, out / file, n_done, noun, arguments)
    with reporting_what_is_kept(kept), progress_of(arguments) as progress, open_executor(arguments) as executor:
        results = campaign.run(path=out / file, executor=executor, progress=progress)
    drawings = Drawings(out)
    with reporting_what_is_kept(kept, results=True), progress_of(arguments) as progress:
        page = page_of(results)
        made = Output(lambda stage: stage.write(table, page.table), {}, lambda _: page.html(drawings.draw))
        drawings.write_results(made, progress=progress)
    return finish(arguments, drawings, page.sentence, f"{said}written to {out}")


@contextlib.contextmanager
def _cluster_executor(address: str) -> Iterator[Executor]:
    import logging

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


@contextlib.contextmanager
def worker_pool(n: int) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of `n` processes with one thread of linear algebra each; if the block raises, end the processes.

    They are spawned, not forked, for the same behaviour on every system. Their temporary files lie in one folder, which
    ends with the pool, also if they or this process are killed. NotConvergedError if one dies.
    """
    for name in THREAD_VARIABLES:
        os.environ.setdefault(name, "1")
    if hasattr(signal, "SIGHUP") and threading.current_thread() is threading.main_thread():
        # The process that tracks shared resources outlives a closed terminal, without complaints.
        before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
        resource_tracker.ensure_running()
        signal.signal(signal.SIGHUP, before)
    with tempfile.TemporaryDirectory(prefix="probewise-", ignore_cleanup_errors=True) as folder:
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(n, mp_context=context, initializer=_initialise_worker, initargs=(folder,))
        try:
            yield pool
        except BaseException as error:
            pool.shutdown(wait=False, cancel_futures=True)
            children = multiprocessing.active_children()
            for child in children:
                child.terminate()
            for child in children:
                child.join(_END_S)
            if isinstance(error, BrokenExecutor):
                why = f"a worker process has died, by a signal or for want of memory ({error})"
                raise NotConvergedError(why) from error
            raise
        pool.shutdown()


def _initialise_worker(folder: str) -> None:
    tempfile.tempdir = folder
    threading.Thread(target=_end_with_parent, args=(folder,), daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # end at once on Ctrl-C; the command reports what was kept
    warnings.simplefilter("ignore", DoubtfulResultWarning)  # the results hold the warnings, and the report shows them


def _end_with_parent(folder: str) -> None:
    """End this process once its parent is gone, though killed: a pool's processes would wait for tasks for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)
