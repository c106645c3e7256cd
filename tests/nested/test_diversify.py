"""Metropolis-Hastings steps that break replications (paper: about 1000 of them)."""

import numpy as np
import pytest
from nested_sampling import problems

from probewise.errors import ParameterError, ShapeError
from probewise.nested import diversify


def test_replicated_samples_become_independent():
    """Fifty copies of two points become fifty draws of a correlated Gaussian, forty clouds pooled for the test."""
    problem = problems.gaussian(3, correlation=0.8)
    rng = np.random.default_rng(11)
    clouds = []
    for _ in range(8):
        copies = np.repeat(np.array([[0.5, 0.2, 0.4], [-0.3, -0.1, 0.0]]), 25, axis=0)
        theta = diversify(copies, problem, rng=rng, n_steps=600)
        assert len(np.unique(theta, axis=0)) == 50
        clouds.append(theta)
    everything = np.concatenate(clouds)
    assert everything.mean(axis=0) == pytest.approx(np.zeros(3), abs=0.25)
    assert np.cov(everything, rowvar=False) == pytest.approx(0.8 + 0.2 * np.eye(3), abs=0.35)
    # No copy remembers which point it came from.
    first = np.concatenate([c[:25] for c in clouds])
    second = np.concatenate([c[25:] for c in clouds])
    assert first.mean(axis=0) == pytest.approx(second.mean(axis=0), abs=0.45)


def test_samples_pass_between_modes():
    problem = problems.mixture_of_far_peaks(2)
    rng = np.random.default_rng(13)
    start = np.concatenate([rng.normal(0.3, 0.02, (150, 2)), rng.normal(0.7, 0.02, (50, 2))])
    end = diversify(start, problem, rng=rng, n_steps=500)
    assert (end[:, 0] > 0.5).mean() == pytest.approx(0.75, abs=0.14)


def test_the_likelihood_is_never_asked_outside_the_prior():
    def function(theta):
        assert ((theta >= 0) & (theta <= 1)).all()
        return np.zeros(len(theta))

    rng = np.random.default_rng(14)
    end = diversify(rng.random((30, 2)), problems.Known(problems.box(2, 0, 1), function, 0.0), rng=rng)
    assert ((end >= 0) & (end <= 1)).all()


def test_an_impossible_sample_or_a_wrong_shape_is_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(ParameterError, match=r"theta\[1\]"):
        diversify(np.array([[0.5, 0.5], [1.5, 0.5]]), problems.plateau(), rng=rng)
    with pytest.raises(ShapeError, match=r"\(n_samples, 2\)"):
        diversify(np.zeros((3, 4)), problems.plateau(), rng=rng)
    with pytest.raises(ParameterError, match="n_steps"):
        diversify(np.full((3, 2), 0.5), problems.plateau(), rng=rng, n_steps=-1)
