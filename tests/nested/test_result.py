"""Results: what they compute from weighted samples, and their file."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from probewise.errors import FileError, ParameterError, ShapeError
from probewise.nested import NestedResult, run

problems = sys.modules["nested_problems"]


@pytest.fixture(scope="module")
def result() -> NestedResult:
    return run(problems.gaussian(2, 0.5), rng=np.random.default_rng(3), n_live=100)


def test_a_saved_result_comes_back_whole(result: NestedResult, tmp_path: Path) -> None:
    doubtful = dataclasses.replace(result, warnings=("a doubt",))
    doubtful.save(tmp_path / "run.npz")
    back = NestedResult.load(tmp_path / "run.npz")
    for field in dataclasses.fields(NestedResult):
        assert np.array_equal(getattr(back, field.name), getattr(doubtful, field.name)), field.name
    assert [p.name for p in tmp_path.iterdir()] == ["run.npz"]


def test_a_damaged_file_is_refused(result: NestedResult, tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    result.save(path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(FileError, match=r"run\.npz"):
        NestedResult.load(path)
    np.savez(
        path,
        head=np.array('{"format": "nested-result/9"}'),
        **dict.fromkeys(("theta", "log_likelihood", "log_weight", "log_birth", "insertion_rank"), np.zeros(1)),
    )
    with pytest.raises(FileError, match="nested-result/9"):
        NestedResult.load(path)


def test_equally_weighted_samples_follow_the_weights(result: NestedResult) -> None:
    weight = np.zeros(result.n_dead)
    weight[[3, 5]] = 0.25, 0.75
    with np.errstate(divide="ignore"):
        known = dataclasses.replace(result, log_weight=np.log(weight))
    drawn = known.samples(400, rng=np.random.default_rng(0))
    assert (drawn == result.theta[5]).all(axis=1).sum() == pytest.approx(300, abs=1)
    assert (drawn == result.theta[3]).all(axis=1).sum() == pytest.approx(100, abs=1)
    assert known.mean() == pytest.approx(0.25 * result.theta[3] + 0.75 * result.theta[5])


def test_quantiles_of_equal_weights_are_the_plain_ones(result: NestedResult) -> None:
    n = result.n_dead
    plain = dataclasses.replace(result, log_weight=np.full(n, -np.log(n)))
    assert plain.quantiles([0.2, 0.5]) == pytest.approx(np.quantile(result.theta, [0.2, 0.5], axis=0, method="hazen"))
    assert plain.sd() == pytest.approx(result.theta.std(axis=0))
    with pytest.raises(ParameterError, match="q"):
        plain.quantiles([1.2])
    with pytest.raises(ParameterError, match="mass"):
        plain.interval(1.0)
    with pytest.raises(ParameterError, match="n is 0"):
        plain.samples(0, rng=np.random.default_rng(0))
    with pytest.raises(ShapeError, match="rows"):
        plain.mean(lambda t: t[:3])


def test_the_summary_names_what_matters(result: NestedResult) -> None:
    text = result.summary()
    assert f"{result.log_z:.2f} ± {result.log_z_error:.2f}" in text
    assert "p0" in text
    assert str(result.n_calls) in text


def test_a_result_cannot_be_changed(result: NestedResult) -> None:
    with pytest.raises(ValueError, match="read-only"):
        result.theta[0, 0] = 1.0
    assert result.best() == pytest.approx(result.theta[np.argmax(result.log_likelihood)])
