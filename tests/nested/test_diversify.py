"""Metropolis-Hastings steps that break replications (paper: about 1000 of them)."""

import numpy as np
import pytest
from nested_sampling import problems

from probewise.errors import ParameterError, ShapeError
from probewise.nested import diversify


def test_exact_draws_stay_exact_draws_and_forget_where_they_began():
    problem = problems.gaussian(2, correlation=0.9)
    rng = np.random.default_rng(12)
    start = rng.multivariate_normal([0, 0], [[1, 0.9], [0.9, 1]], size=2000)
    end = diversify(start, problem, rng=rng, n_steps=150)
    assert np.cov(end, rowvar=False) == pytest.approx(np.array([[1, 0.9], [0.9, 1]]), abs=0.12)
    assert abs(np.corrcoef(start[:, 0], end[:, 0])[0, 1]) < 0.1
    # Of independent samples the mean square difference is twice the variance.
    assert ((end - start) ** 2).mean() / 2 == pytest.approx(1.0, abs=0.15)


def test_samples_pass_between_modes():
    problem = problems.mixture_of_far_peaks(2)
    rng = np.random.default_rng(13)
    start = np.concatenate([rng.normal(0.3, 0.02, (150, 2)), rng.normal(0.7, 0.02, (50, 2))])
    end = diversify(start, problem, rng=rng, n_steps=500)
    assert (end[:, 0] > 0.5).mean() == pytest.approx(0.75, abs=0.14)


def test_an_impossible_sample_or_a_wrong_shape_is_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(ParameterError, match=r"theta\[1\]"):
        diversify(np.array([[0.5, 0.5], [1.5, 0.5]]), problems.plateau(), rng=rng)
    with pytest.raises(ShapeError, match=r"\(n_samples, 2\)"):
        diversify(np.zeros((3, 4)), problems.plateau(), rng=rng)
    with pytest.raises(ParameterError, match="n_steps"):
        diversify(np.full((3, 2), 0.5), problems.plateau(), rng=rng, n_steps=-1)
