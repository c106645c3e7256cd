"""The second route to the evidence: it agrees with a right run, and speaks up against a wrong one."""

from __future__ import annotations

import dataclasses
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
from nested_sampling import hard, problems

from probewise.errors import DoubtfulResultWarning
from probewise.nested import NestedResult, SliceMove, run
from probewise.nested.check import check_and_repeat
from probewise.nested.problem import Evaluator
from probewise.nested.sampler import run_once


def rng() -> np.random.Generator:
    return np.random.default_rng(20261123)


def quiet(problem: object, **options: object) -> NestedResult:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)
        return run(problem, **{"rng": rng(), "n_live": 100, **options})  # type: ignore[arg-type]


@pytest.mark.slow
def test_right_runs_are_confirmed_for_a_fraction_of_their_cost() -> None:
    """Two of thirty cost more than half of the run, since they were asked again: the median of eleven does not."""
    known = problems.problem("Gaussian 4-D")
    cost, z, n_same, n_doubted = [], [], 0, 0
    for seed in range(11):
        alone = quiet(known, rng=np.random.default_rng(seed), max_cost=1.0)
        result = quiet(known, rng=np.random.default_rng(seed))
        assert alone.check is None
        assert result.check is not None
        z.append((result.check.log_z - known.log_z) / result.check.log_z_error)
        assert f"check        log Z {result.check.log_z:.2f}" in result.summary()
        cost.append(result.n_calls / alone.n_calls - 1)
        n_same += np.array_equal(result.theta, alone.theta) and result.log_z == alone.log_z
        n_doubted += bool(result.warnings)
    assert abs(np.mean(z)) < 3.9 * 1.3 / math.sqrt(11)  # with 40 live points errors have long tails: sd 1.3 of thirty
    assert np.median(cost) < 0.5
    assert n_same > 7
    assert n_doubted < 4


def misled(max_cost: float, seed: int = 5) -> tuple[NestedResult, NestedResult]:
    """A sound run whose evidence was shifted by eight errors, and what the check makes of it."""
    known = problems.problem("Gaussian 4-D")
    sound = quiet(known, max_cost=1.0)
    wrong = dataclasses.replace(sound, log_z=sound.log_z + 8 * sound.log_z_error)
    result = check_and_repeat(
        wrong,
        Evaluator(known),
        SliceMove(),
        run_once,
        max_cost=max_cost,
        max_calls=None,
        least_live=10,
        rng=np.random.default_rng(seed),
    )
    return sound, result


def test_a_wrong_evidence_is_doubted_where_nothing_is_left_to_spend() -> None:
    sound, result = misled(1.6)
    assert result.log_z == pytest.approx(sound.log_z + 8 * sound.log_z_error)
    assert result.check is not None
    assert result.check.distance > 2.5
    assert "errors apart" in result.warnings[-1]
    assert result.n_calls <= 1.6 * sound.n_calls


@pytest.mark.slow
def test_a_wrong_evidence_is_cured_by_longer_chains() -> None:
    """The longer run itself may be doubted: of twenty by one or two. Three of six have a probability below 1 %."""
    n_cured = 0
    for seed in range(6):
        sound, result = misled(5.0, seed)
        assert result.n_calls <= 5 * sound.n_calls
        if not result.warnings:
            assert abs(result.log_z - sound.log_z) < 5 * sound.log_z_error
            n_cured += 1
    assert n_cured > 3


@pytest.mark.slow
@pytest.mark.parametrize("max_cost", [2.0, 5.0])
def test_many_scales_with_chains_too_short_are_never_wrong_without_a_word(max_cost: float) -> None:
    """In twelve dimensions log Z of the search alone is off by many errors, or its memory is beyond what they model.

    With a limit of 2 the second estimate does not end.
    """
    known, move = hard.many_dimensions(12), SliceMove(steps_per_param=0.3, fewest_steps=3)
    n_off = n_forgetful = 0
    for part in rng().spawn(8):
        result = quiet(known, rng=part, n_live=40, move=move, max_cost=max_cost)
        off = abs(result.log_z - known.log_z) > 3 * result.log_z_error
        n_off += off
        n_forgetful += result.memory > 10
        assert result.warnings or not off
        second = result.check
        settled = second is not None and second.log_z_error < result.log_z_error and abs(second.distance) <= 2.5
        doubtful = any("is itself doubtful" in note for note in result.warnings)
        said = any("memory is" in note for note in result.warnings)
        missed = any("lost or never met" in note for note in result.warnings)
        assert said == (result.memory > 10 and (doubtful or missed or not settled))
    assert n_off
    assert n_forgetful


def test_the_check_keeps_to_max_calls() -> None:
    known = problems.problem("Gaussian 4-D")
    alone = quiet(known, max_cost=1.0)
    result = quiet(known, max_calls=int(1.2 * alone.n_calls))
    assert result.n_calls <= 1.2 * alone.n_calls
    assert result.check is None
    assert "did not end within max_cost and max_calls" in result.warnings[-1]


def test_a_checked_run_is_repeated_by_its_seed_and_saved_whole(tmp_path: Path) -> None:
    first = quiet(problems.plateau(), checkpoint=tmp_path / "run.npz")
    again = quiet(problems.plateau(), checkpoint=tmp_path / "run.npz")  # the search is done, the check comes again
    assert first.check == again.check
    first.save(tmp_path / "result.npz")
    assert NestedResult.load(tmp_path / "result.npz").check == first.check
