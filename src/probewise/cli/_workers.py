"""Worker processes, which end with the command, also if it is interrupted."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@contextlib.contextmanager
def worker_pool(n: int) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of `n` processes with one thread of linear algebra each; if the block raises, end the processes.

    Processes are spawned, not forked, for the same behaviour on every system.
    """
    for name in THREAD_VARIABLES:
        os.environ.setdefault(name, "1")
    pool = ProcessPoolExecutor(n, mp_context=multiprocessing.get_context("spawn"), initializer=_initialise_worker)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    pool.shutdown()


def _initialise_worker() -> None:
    import warnings

    from probewise.errors import DoubtfulResultWarning

    signal.signal(signal.SIGINT, signal.SIG_DFL)  # end at once on Ctrl-C; the command reports what was kept
    warnings.simplefilter("ignore", DoubtfulResultWarning)  # the results hold the warnings, and the report shows them
