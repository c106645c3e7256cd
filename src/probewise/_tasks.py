"""Independent tasks on any executor, their results as they come."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, CancelledError, Executor, as_completed
from typing import TypeVar

from probewise.errors import LinkError, NotConvergedError

T = TypeVar("T")
R = TypeVar("R")


@contextlib.contextmanager
def results_as_tasks_end(
    work: Callable[[T], R], tasks: Mapping[str, T], executor: Executor | None
) -> Iterator[Iterator[tuple[str, R]]]:
    """Yield an iterator over (key, result), in the order in which tasks end; at exit, cancel tasks not begun.

    It raises NotConvergedError if a worker died, LinkError if the executor dropped its tasks.
    """
    if executor is None:
        yield ((key, work(task)) for key, task in tasks.items())
        return
    futures = {executor.submit(work, task): key for key, task in tasks.items()}

    def results() -> Iterator[tuple[str, R]]:
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except CancelledError as error:
            raise LinkError("the executor dropped its tasks: the connection to its scheduler was lost") from error
        except BrokenExecutor as error:
            said = f"a worker died ({error}); finished results are kept, and the same command continues from there"
            raise NotConvergedError(said) from error

    try:
        yield results()
    finally:
        for future in futures:
            future.cancel()
