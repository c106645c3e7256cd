"""Runs of nested sampling in tests: without their warnings, and compared bit for bit."""

import dataclasses
import warnings

import numpy as np

from probewise.errors import DoubtfulResultWarning
from probewise.nested import run

N_ERRORS = 3.9  # a right sampler is further off than this many of its own errors less than once in 10,000 runs


def quiet(*problem, seed=20261123, **options):
    """Run with a seed and without warnings, which the result holds too, and by default without the check."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)
        return run(*problem, **{"rng": np.random.default_rng(seed), "max_cost": 1.0, **options})


def assert_same(one, other):
    """Compare every field, bit for bit."""
    for field in dataclasses.fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, np.ndarray):
            assert (a.dtype, a.tobytes()) == (b.dtype, b.tobytes()), field.name
        else:
            assert a == b, field.name
