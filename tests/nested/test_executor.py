"""Likelihoods evaluated elsewhere: by threads and processes, in order, whole, and stopped with the run."""

from __future__ import annotations

import dataclasses
import importlib
import multiprocessing
import sys
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from nested_sampling import problems

from probewise.errors import NotConvergedError
from probewise.nested import Evaluator, KernelMove, NestedResult, SliceMove, run
from probewise.priors import Product, Uniform

# A module of its own, since a process is sent the names of functions and not the functions.
MODULE = '''
"""Problems that workers can be sent."""

import os
import signal
from dataclasses import dataclass

import numpy as np

from probewise.priors import Product, Uniform


@dataclass(frozen=True)
class Slope:
    """Steep along x; from `edge` on something else happens."""

    edge: float = 2.0
    what: str = "nothing"

    @property
    def prior(self):
        return Product({"x": Uniform(0, 1), "y": Uniform(0, 1)})

    def log_likelihood(self, theta):
        over = theta[:, 0] > self.edge
        if over.any():
            if self.what == "die":
                os.kill(os.getpid(), signal.SIGKILL)
        return 30 * theta[:, 0] - 5 * theta[:, 1]
'''


@pytest.fixture(scope="module")
def slopes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ModuleType]:
    folder = tmp_path_factory.mktemp("modules")
    (folder / "slopes_for_workers.py").write_text(MODULE)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield importlib.import_module("slopes_for_workers")
    del sys.modules["slopes_for_workers"]


@pytest.fixture(scope="module")
def processes(slopes: ModuleType) -> Iterator[Executor]:
    """Two processes, begun anew, so that they know what they are sent and no more."""
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool


@pytest.fixture(scope="module")
def threads() -> Iterator[Executor]:
    with ThreadPoolExecutor(3) as pool:
        yield pool


@pytest.fixture(params=["threads", "processes"])
def executor(request: pytest.FixtureRequest) -> Executor:
    pool: Executor = request.getfixturevalue(request.param)
    return pool


def rng() -> np.random.Generator:
    return np.random.default_rng(20240229)


def assert_same(one: NestedResult, other: NestedResult) -> None:
    """Compare every field, bit for bit."""
    for field in dataclasses.fields(NestedResult):
        a, b = getattr(one, field.name), getattr(other, field.name)
        same = a.tobytes() == b.tobytes() if isinstance(a, np.ndarray) else a == b
        assert same, field.name


class AtOnce(Executor):
    """The least that an executor is: it does at once what it is given."""

    def __init__(self) -> None:
        self.sizes: list[int] = []

    def submit(self, fn, /, *args, **kwargs):  # type: ignore[no-untyped-def]
        future: Future[object] = Future()
        self.sizes.append(len(args[0]))
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@pytest.mark.parametrize("move", [SliceMove(), KernelMove()])
def test_the_result_does_not_depend_on_the_executor(
    move: SliceMove | KernelMove, executor: Executor, slopes: ModuleType
) -> None:
    alone = run(slopes.Slope(), rng=rng(), n_live=50, move=move)
    for n_workers in (None, 5):
        together = run(slopes.Slope(), rng=rng(), n_live=50, move=move, executor=executor, n_workers=n_workers)
        assert_same(together, alone)


def test_any_executor_will_do_and_gets_even_parts() -> None:
    pool = AtOnce()
    together = run(problems.plateau(), rng=rng(), n_live=50, executor=pool, n_workers=4)
    assert_same(together, run(problems.plateau(), rng=rng(), n_live=50))
    assert pool.sizes[:4] == [13, 13, 12, 12]
    # A single hypothesis is not worth sending.
    assert sum(pool.sizes) <= together.n_calls


def test_the_check_too_evaluates_its_batches_in_the_executor() -> None:
    """The search for missed hills is a part of the run: a likelihood may work in the workers alone."""
    inside, here = [False], list[int]()

    class Within(AtOnce):
        def submit(self, fn, /, *args, **kwargs):  # type: ignore[no-untyped-def]
            inside[0] = True
            future = super().submit(fn, *args, **kwargs)
            inside[0] = False
            return future

    def function(theta: np.ndarray) -> np.ndarray:
        if not inside[0]:
            here.append(len(theta))
        return np.asarray(-0.5 * np.sum(((theta - 0.3) / 0.05) ** 2, axis=1))

    problem = problems.Known(problems.box(2, 0, 1), function, 0.0)
    result = run(problem, rng=rng(), n_live=50, executor=Within(), n_workers=4)
    assert result.check is not None
    assert set(here) <= {1}  # a single hypothesis is not worth sending


def test_the_part_that_failed_is_the_one_that_is_told() -> None:
    def function(theta: np.ndarray) -> np.ndarray:
        if (theta[:, 0] == 7.0).any():
            raise ArithmeticError
        return theta[:, 0]

    problem = problems.Known(Product({"x": Uniform(0, 10)}), function, 0.0)
    for n_parts in (1, 3, 10):
        evaluate = Evaluator(problem, executor=AtOnce(), n_parts=n_parts)
        with pytest.raises(NotConvergedError, match=r"at x = 7$"):
            evaluate.log_likelihood(np.arange(10.0)[:, None])
        assert evaluate.n_calls == 0


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no kill -9")
def test_a_worker_that_dies_does_not_take_the_run_along(slopes: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    with (
        ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool,
        pytest.raises(NotConvergedError, match=r"raised BrokenProcessPool: .*first of the \d+ .*: x = 0\.") as caught,
    ):
        run(slopes.Slope(0.9995, "die"), rng=rng(), n_live=50, executor=pool, n_workers=2, checkpoint=path)
    assert isinstance(caught.value.__cause__, BrokenProcessPool)
    assert isinstance(caught.value.partial, NestedResult)
    assert_same(run(slopes.Slope(), rng=rng(), n_live=50, checkpoint=path), run(slopes.Slope(), rng=rng(), n_live=50))


def test_a_problem_that_cannot_be_sent_is_told_how_to(processes: Executor) -> None:
    problem = problems.Known(problems.box(2, 0, 1), lambda t: t[:, 0], 0.0)
    with pytest.raises(NotConvergedError, match=r"cannot be sent to the executor's workers .*without lambdas; or take"):
        run(problem, rng=rng(), n_live=50, executor=processes, n_workers=2)
