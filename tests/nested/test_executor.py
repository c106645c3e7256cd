"""Likelihoods evaluated elsewhere: by threads and processes, in order, whole, and stopped with the run."""

import importlib
import multiprocessing
import sys
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial

import numpy as np
import pytest
from nested_sampling import problems
from runs import assert_same, quiet

from probewise.errors import NotConvergedError
from probewise.nested import Evaluator, NestedResult
from probewise.priors import Product, Uniform

checked = partial(quiet, n_live=50, max_cost=5.0)

# A module of its own, since a process is sent the names of functions and not the functions.
MODULE = '''
import os
import signal
from dataclasses import dataclass

from probewise.priors import Product, Uniform


@dataclass(frozen=True)
class Slope:
    """Steep along x; from `edge` on the process dies."""

    edge: float = 2.0

    @property
    def prior(self):
        return Product({"x": Uniform(0, 1), "y": Uniform(0, 1)})

    def log_likelihood(self, theta):
        if (theta[:, 0] > self.edge).any():
            os.kill(os.getpid(), signal.SIGKILL)
        return 30 * theta[:, 0] - 5 * theta[:, 1]
'''


@pytest.fixture(scope="module")
def slopes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("modules")
    (folder / "slopes_for_workers.py").write_text(MODULE)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield importlib.import_module("slopes_for_workers")
    del sys.modules["slopes_for_workers"]


@pytest.fixture(scope="module")
def processes(slopes):
    """Two processes, begun anew, so that they know what they are sent and no more."""
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool


class AtOnce(Executor):
    """The least that an executor is: it does at once what it is given."""

    def __init__(self):
        self.sizes, self.inside = [], False

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        self.sizes.append(len(args[0]))
        self.inside = True
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        self.inside = False
        return future


def test_any_executor_will_do_and_gets_even_parts_of_the_check_too():
    """The search for missed peaks is a part of the run: a likelihood may work in the workers alone."""
    pool, here = AtOnce(), []

    def function(theta):
        if not pool.inside:
            here.append(len(theta))
        return -0.5 * np.sum(((theta - 0.3) / 0.05) ** 2, axis=1)

    problem = problems.Known(problems.box(2, 0, 1), function, 0.0)
    result = checked(problem, executor=pool, n_workers=4)
    assert result.check is not None
    assert set(here) <= {1}  # a single hypothesis is not worth sending
    assert pool.sizes[:4] == [13, 13, 12, 12]
    assert sum(pool.sizes) + len(here) == result.n_calls


def test_the_part_that_failed_is_the_one_that_is_told():
    def function(theta):
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
def test_a_worker_that_dies_does_not_take_the_run_along(slopes, tmp_path):
    path = tmp_path / "run.npz"
    with (
        ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool,
        pytest.raises(NotConvergedError, match=r"raised BrokenProcessPool: .*first of the \d+ .*: x = 0\.") as caught,
    ):
        checked(slopes.Slope(0.9995), executor=pool, n_workers=2, checkpoint=path)
    assert isinstance(caught.value.__cause__, BrokenProcessPool)
    assert isinstance(caught.value.partial, NestedResult)
    assert_same(checked(slopes.Slope(), checkpoint=path), checked(slopes.Slope()))


def test_a_problem_that_cannot_be_sent_is_told_how_to(processes):
    problem = problems.Known(problems.box(2, 0, 1), lambda t: t[:, 0], 0.0)
    with pytest.raises(NotConvergedError, match=r"cannot be sent to the executor's workers .*without lambdas; or take"):
        checked(problem, executor=processes, n_workers=2)
