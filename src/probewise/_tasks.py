"""Independent tasks on any executor, their results as they come."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, as_completed
from typing import TypeVar

from probewise.errors import LinkError, NotConvergedError

T = TypeVar("T")
R = TypeVar("R")


@contextlib.contextmanager
def results_as_tasks_end(
    work: Callable[[T], R], tasks: Mapping[str, T], executor: Executor | None
) -> Iterator[Iterator[tuple[str, R]]]:
    """Yield an iterator over (key, result), in the order in which tasks end; at exit, cancel tasks not begun."""
    if executor is None:
        yield ((key, work(task)) for key, task in tasks.items())
        return
    futures: dict[Future[R], str] = {executor.submit(work, task): key for key, task in tasks.items()}
    try:
        yield ((futures[future], _result_of_future(future)) for future in as_completed(futures))
    finally:
        for future in futures:
            future.cancel()


def _result_of_future(future: Future[R]) -> R:
    """Return a task's result; raise NotConvergedError if its worker died, LinkError if its executor dropped it."""
    try:
        return future.result()
    except CancelledError as error:
        raise LinkError("the executor dropped its tasks: the connection to its scheduler was lost") from error
    except BrokenExecutor as error:
        raise NotConvergedError(
            f"a worker died ({error}); finished results are kept, and the same command continues from there"
        ) from error
