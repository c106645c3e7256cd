"""The second route to the evidence: it agrees with a right run, and speaks up against a wrong one."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from nested_sampling import problems
from runs import quiet

from probewise.nested import NestedResult, SliceMove
from probewise.nested.check import check_and_repeat
from probewise.nested.problem import Evaluator
from probewise.nested.sampler import run_once

checked = partial(quiet, n_live=100, max_cost=5.0)


def misled(max_cost, seed=5):
    """A sound run, and what the check makes of it if its evidence is shifted by eight errors."""
    known, rng = problems.problem("Gaussian 4-D"), np.random.default_rng(seed)
    sound = checked(known, max_cost=1.0)
    wrong = dataclasses.replace(sound, log_z=sound.log_z + 8 * sound.log_z_error)
    limits = {"max_cost": max_cost, "max_calls": None, "least_live": 10}
    return sound, check_and_repeat(wrong, Evaluator(known), SliceMove(), run_once, **limits, rng=rng)


def test_a_wrong_evidence_is_doubted_where_nothing_is_left_to_spend():
    sound, result = misled(1.6)
    assert result.log_z == pytest.approx(sound.log_z + 8 * sound.log_z_error)
    assert result.check.distance > 2.5
    assert "errors apart" in result.warnings[-1]
    assert result.n_calls <= 1.6 * sound.n_calls


def test_the_check_keeps_to_max_calls():
    known = problems.problem("Gaussian 4-D")
    alone = checked(known, max_cost=1.0)
    result = checked(known, max_calls=int(1.2 * alone.n_calls))
    assert result.n_calls <= 1.2 * alone.n_calls
    assert result.check is None
    assert "did not end within max_cost and max_calls" in result.warnings[-1]


def test_a_checked_run_is_repeated_by_its_seed_and_saved_whole(tmp_path):
    # Of the second the search is done, and the check comes again.
    first, again = (checked(problems.plateau(), checkpoint=tmp_path / "run.npz") for _ in range(2))
    assert first.check == again.check
    first.save(tmp_path / "result.npz")
    assert NestedResult.load(tmp_path / "result.npz").check == first.check
