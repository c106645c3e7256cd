"""Independent proposals from kernels: the density they are drawn from, the distribution they leave."""

import numpy as np
import pytest
from scipy.stats import kstest

from probewise.errors import ParameterError
from probewise.nested.moves import KernelMove
from probewise.nested.problem import Bound, Evaluator
from probewise.priors import Product, Uniform


class Crescent:
    """A likelihood whose levels are crescents: bent, with empty corners."""

    prior = Product({"a": Uniform(0.0, 1.0), "b": Uniform(0.0, 1.0)})

    def log_likelihood(self, theta):
        radius = np.hypot(theta[:, 0] - 0.5, theta[:, 1] - 0.1)
        return -(((radius - 0.5) / 0.05) ** 2)


@pytest.mark.parametrize("move", [KernelMove(), KernelMove(patience=1.0)], ids=["kernels", "chains after kernels"])
def test_the_move_leaves_the_uniform_distribution_above_a_bound(move):
    """Radius and angle of points above a level of the crescent, against a rejection sample; KS at 1e-6.

    The chains that take over begin where the kernels ended, which is no live point.
    """
    problem, rng = Crescent(), np.random.default_rng(4)
    evaluate, bound = Evaluator(problem), Bound(-1.0, 0.0)
    exact = evaluate(rng.random((60_000, 2)), rng)
    exact = exact.take_rows(bound.mask_above(exact.log_likelihood, exact.label))
    live = exact.take_rows(slice(0, 200))
    ends = []
    for _ in range(15):
        start = live.take_rows(rng.permutation(200)[:100])
        new, tally = move.draw(start, bound, live.u, evaluate, rng)
        move = move.adapted(tally)
        assert bound.mask_above(new.log_likelihood, new.label).all()
        ends.append(new.u)
    found = np.concatenate(ends)
    for of in (lambda u: np.hypot(u[:, 0] - 0.5, u[:, 1] - 0.1), lambda u: np.arctan2(u[:, 1] - 0.1, u[:, 0] - 0.5)):
        assert kstest(of(found), of(exact.u)).pvalue > 1e-6


def test_where_kernels_are_wasteful_chains_take_over():
    """A thin shell in eight parameters: the proposals hardly ever land on it."""

    class Shell:
        prior = Product({f"p{k}": Uniform(-1.0, 1.0) for k in range(8)})

        def log_likelihood(self, theta):
            return -(((np.sqrt((theta**2).sum(axis=1)) - 0.7) / 1e-4) ** 2)

    rng, evaluate = np.random.default_rng(7), Evaluator(Shell())
    direction = rng.standard_normal((100, 8))
    u = 0.5 + 0.35 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    live = evaluate(u, rng)
    bound = Bound(-1.0, 0.5)
    new, tally = KernelMove().draw(live.take_rows(slice(0, 50)), bound, live.u, evaluate, rng)
    assert bound.mask_above(new.log_likelihood, new.label).all()
    assert tally.n_evaluated > 50 * 16
    assert (new.u != live.u[:50]).any(axis=1).mean() > 0.9


@pytest.mark.parametrize("change", [{"moves": 0.0}, {"n_proposals": 0}, {"patience": 0.5}])
def test_an_option_out_of_range_is_refused(change):
    with pytest.raises(ParameterError, match=next(iter(change))):
        KernelMove(**change)
