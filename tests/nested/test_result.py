"""Results: what they compute from weighted samples, and their file."""

import dataclasses
import json

import numpy as np
import pytest
from nested_sampling import problems

from probewise.errors import FileError, ParameterError, ShapeError
from probewise.nested import NestedResult, run


@pytest.fixture(scope="module")
def result():
    return run(problems.gaussian(2, 0.5), rng=np.random.default_rng(3), n_live=100)


def test_a_saved_result_comes_back_whole(result, tmp_path):
    doubtful = dataclasses.replace(result, warnings=("a doubt",))
    doubtful.save(tmp_path / "run.npz")
    back = NestedResult.load(tmp_path / "run.npz")
    for field in dataclasses.fields(NestedResult):
        stored, kept = getattr(back, field.name), getattr(doubtful, field.name)
        assert np.array_equal(stored, kept), field.name
        assert type(stored) is type(kept), field.name
    assert [p.name for p in tmp_path.iterdir()] == ["run.npz"]


def test_a_file_with_a_wrong_byte_is_refused_or_read_as_it_was(result, tmp_path):
    path = tmp_path / "run.npz"
    result.save(path)
    whole = path.read_bytes()
    refused = 0
    for at in range(0, len(whole), len(whole) // 150):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        try:
            back = NestedResult.load(path)
        except FileError:
            refused += 1
        else:
            np.testing.assert_array_equal(back.theta, result.theta)
    assert refused > 100


def test_a_file_of_another_format_says_so_even_where_its_arrays_have_other_names(result, tmp_path):
    path = tmp_path / "run.npz"
    np.savez(path, head=np.array('{"format": "nested-result/1"}'), theta=np.zeros(1))
    with pytest.raises(FileError, match=r"nested-result/1.*make the file anew"):
        NestedResult.load(path)
    result.save(path)
    with np.load(path) as file:
        parts = {name: file[name] for name in file.files}
    head = json.loads(str(parts.pop("head")))
    del head["log_z"]
    np.savez(path, head=np.array(json.dumps({**head, "mood": 1})), **parts)
    with pytest.raises(FileError, match="log_z, mood missing or unknown"):
        NestedResult.load(path)
    head["log_z"] = result.log_z
    np.savez(path, head=np.array(json.dumps({**head, "agreement": None})), **parts)  # as merged runs had
    assert NestedResult.load(path).log_z == result.log_z
    for name, wrong in {"theta": np.zeros(0), "log_weight": np.array(np.nan), "parent": np.array("a")}.items():
        np.savez(path, head=np.array(json.dumps(head)), **{**parts, name: wrong})
        with pytest.raises(FileError, match=r"run\.npz: unusable: "):
            NestedResult.load(path)


def test_equally_weighted_samples_follow_the_weights(result):
    weight = np.zeros(result.n_dead)
    weight[[3, 5]] = 0.25, 0.75
    with np.errstate(divide="ignore"):
        known = dataclasses.replace(result, log_weight=np.log(weight))
    drawn = known.samples(400, rng=np.random.default_rng(0))
    assert (drawn == result.theta[5]).all(axis=1).sum() == pytest.approx(300, abs=1)
    assert (drawn == result.theta[3]).all(axis=1).sum() == pytest.approx(100, abs=1)
    assert known.mean() == pytest.approx(0.25 * result.theta[3] + 0.75 * result.theta[5])


def test_quantiles_of_equal_weights_are_the_plain_ones(result):
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
    with pytest.raises(ShapeError, match=r"shape \(\)"):
        plain.mean(lambda t: t.sum())
