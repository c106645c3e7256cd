"""Metropolis-Hastings steps that break replications (paper: about 1000 of them)."""

import numpy as np
import pytest
from nested_sampling import problems

from probewise.errors import ParameterError, ShapeError
from probewise.nested import diversify


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
