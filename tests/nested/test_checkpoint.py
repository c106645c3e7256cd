"""Runs that are interrupted, killed or failed go on from their file to the very bits of a run that never was."""

import dataclasses
import errno
import itertools
import math
import os
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from nested_sampling import problems
from nested_sampling.problems import Known
from runs import assert_same, quiet

from probewise.errors import DoubtfulResultWarning, FileError, NotConvergedError, NotSavedWarning
from probewise.nested import EvidenceChange, KernelMove, SliceMove, run
from probewise.nested.save import CheckpointFile
from probewise.priors import Product, Uniform

SEED = 20240229
seeded = partial(quiet, seed=SEED)
terraced = partial(seeded, n_live=40)  # of the plateau


class Stop(Exception):
    """Raised by a caller's own code."""


@dataclasses.dataclass
class Counted:
    """A problem that counts what it is asked, and does something else at one of its calls."""

    problem: Known
    at: int | None = None
    act: Callable | None = None
    n_calls: int = 0
    n_hypotheses: int = 0

    @property
    def prior(self):
        return self.problem.prior

    def log_likelihood(self, theta):
        self.n_calls += 1
        self.n_hypotheses += len(theta)
        return self.act(theta) if self.n_calls == self.at else self.problem.log_likelihood(theta)


def interrupt(theta):
    raise KeyboardInterrupt


def half_impossible():
    """A slope over a third of the prior; the rest is impossible, and the lower half of the third a plateau."""

    def function(theta):
        x = theta[:, 0]
        return np.where(x < 1 / 3, np.maximum(20 * (1 / 6 - x), 0.0) - 3 * theta[:, 1], -np.inf)

    return Known(problems.box(2, 0, 1), function, math.nan)


def rarely_possible():
    """One hypothesis in 500 is possible: chains fill up the first live points."""
    return Known(problems.box(2, 0, 1), lambda t: np.where(t[:, 0] < 0.002, -5 * t[:, 1], -np.inf), math.nan)


def slope(steepness=30.0, name="x"):
    return Known(Product({name: Uniform(0.0, 1.0)}), lambda t: -steepness * t[:, 0], math.nan)


sloping = partial(seeded, n_live=30)


def stopper(n_rounds):
    """Return a progress function that raises at the end of the so-manyth round."""
    rounds = itertools.count(1)

    def progress(state):
        if next(rounds) == n_rounds:
            raise Stop

    return progress


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.npz"


@pytest.fixture
def begun(path):
    """The file of a run of the slope that was stopped after three rounds."""
    with pytest.raises(Stop):
        sloping(slope(), progress=stopper(3), checkpoint=path)
    return path


@pytest.mark.parametrize(
    ("make", "options"),
    [
        (problems.plateau, {"n_live": 40, "move": SliceMove()}),
        (half_impossible, {"n_live": 30, "move": KernelMove()}),
        (rarely_possible, {"n_live": 40, "move": SliceMove()}),
    ],
)
def test_a_run_stopped_after_every_round_ends_as_one_never_stopped(make, options, path):
    states = []
    whole = seeded(make(), progress=states.append, **options)
    assert len(states) > 4
    for _ in states:
        with pytest.raises(Stop):
            seeded(make(), progress=stopper(1), checkpoint=path, **options)
    problem = Counted(make())
    assert_same(seeded(problem, checkpoint=path, **options), whole)
    # One hypothesis makes sure that the likelihood is the same; nothing was left to do.
    assert (problem.n_calls, problem.n_hypotheses) == (1, 1)


@pytest.mark.parametrize(("make", "move"), [(problems.plateau, KernelMove()), (half_impossible, SliceMove())])
def test_a_run_interrupted_within_rounds_ends_as_one_never_interrupted(make, move, path):
    """Ctrl-C falls into a likelihood call, each time some calls later; the round begun is done again."""
    whole, n_interrupted = sloping(make(), move=move), 0
    for last_call in itertools.count(3, 3):
        problem = Counted(make(), last_call, interrupt)
        try:
            found = sloping(problem, move=move, checkpoint=path, return_interrupted=True)
        except KeyboardInterrupt:  # before the first round was done
            continue
        if problem.n_calls < last_call:
            break
        n_interrupted += 1
        assert found.stop_reason == "interrupted"
    assert n_interrupted >= 2
    assert_same(found, whole)


@pytest.mark.parametrize("bits", [np.random.PCG64, np.random.MT19937])
def test_every_bit_generator_is_taken_up_again(bits, path):
    def rng():
        new = np.random.Generator(bits(SEED))
        new.integers(1000, size=3, dtype=np.int32)  # half of a 64-bit number waits for the next 32-bit one
        return new

    one, other = rng(), rng()
    whole = run(slope(), rng=one, n_live=30)
    for k in (1, 4):
        with pytest.raises(Stop):
            run(slope(), rng=rng(), n_live=30, progress=stopper(k), checkpoint=path)
    assert_same(run(slope(), rng=other, n_live=30, checkpoint=path), whole)
    assert (one.random(5) == other.random(5)).all()


def test_a_run_at_its_call_limit_goes_on_with_a_higher_one(path):
    for max_calls in (300, 600, 900):
        short = terraced(problems.plateau(), max_calls=max_calls, checkpoint=path)
        assert f"max_calls = {max_calls}" in short.stop_reason
        assert short.n_calls <= max_calls
    assert_same(terraced(problems.plateau(), checkpoint=path), terraced(problems.plateau()))


# ------------------------------------------------------------------ what is no checkpoint of this run


@pytest.mark.parametrize(
    ("problem", "options", "message"),
    [
        (slope(name="y"), {}, r"of a run with names = \['x'\], not \['y'\]"),
        (slope(steepness=30.001), {}, "of a run with another likelihood: its first live point had -"),
        (slope(), {"n_live": 32}, "of a run with n_live = 30, not 32"),
        (slope(), {"move": KernelMove()}, r"of a run with move = SliceMove\(.*, not KernelMove\("),
        (slope(), {"stop": EvidenceChange()}, r"stop = RemainingEvidence\(dlogz=0.05\), not EvidenceChange\("),
    ],
)
def test_the_checkpoint_of_another_run_is_refused(problem, options, message, begun):
    before = begun.read_bytes()
    with pytest.raises(FileError, match=rf"{begun}.*{message}.*delete this one to start anew"):
        sloping(problem, checkpoint=begun, **options)
    assert begun.read_bytes() == before
    assert [*begun.parent.iterdir()] == [begun]
    assert_same(sloping(slope(), checkpoint=begun), sloping(slope()))


def test_a_damaged_checkpoint_is_refused_and_left_alone(begun):
    whole = begun.read_bytes()
    half = len(whole) // 2
    damaged = [b"", b"no checkpoint at all", *(whole[:n] for n in (1, 100, half, len(whole) - 1))]
    for content in (*damaged, *(whole[:n] + bytes(len(whole) - n) for n in (200, half))):
        begun.write_bytes(content)
        problem = Counted(slope())
        with pytest.raises(FileError, match=r"unreadable \(.*delete it to start anew"):
            sloping(problem, checkpoint=begun)
        assert begun.read_bytes() == content
        assert problem.n_calls == 0
    np.savez(begun, other=np.zeros(3))
    with pytest.raises(FileError, match="unreadable"):
        sloping(slope(), checkpoint=begun)


@pytest.mark.parametrize("where", ["file/run.npz", "folder"])
def test_a_place_that_cannot_be_written_to_is_found_out_first(where, tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    problem = Counted(slope())
    with pytest.raises(FileError, match="existing, writable folder"):
        sloping(problem, checkpoint=tmp_path / where)
    assert problem.n_calls == 0


def test_a_disk_that_fills_up_costs_the_checkpoint_only(path, monkeypatch):
    whole, good = sloping(slope()), itertools.count()

    def fsync(handle):
        if next(good) >= 3:
            raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fsync)
        patch.setattr(CheckpointFile, "save_if_due", CheckpointFile.save)  # after every round
        with pytest.warns(NotSavedWarning, match=r"No space left on device.*goes on unsaved"):
            found = sloping(slope(), checkpoint=path)
    assert_same(found, whole)
    assert [*path.parent.iterdir()] == [path]
    assert_same(sloping(slope(), checkpoint=path), whole)  # the third saving stands


# ------------------------------------------------------------------ Ctrl-C, and likelihoods that fail


def test_ctrl_c_raises_by_default_and_gives_what_there_is_if_asked_for(path):
    problem = Counted(problems.plateau())
    whole = terraced(problem)
    late = Counted(problems.plateau(), problem.n_calls - 2, interrupt)
    with pytest.warns(DoubtfulResultWarning, match=r"interrupted; log Z lacks"):
        result = run(late, rng=np.random.default_rng(SEED), n_live=40, max_cost=1.0, return_interrupted=True)
    assert result.stop_reason == "interrupted"
    assert "doubtful: interrupted" in result.summary()
    assert result.n_dead >= 60
    assert result.n_calls <= late.n_hypotheses
    assert np.exp(result.log_weight).sum() == pytest.approx(1.0)
    with pytest.raises(KeyboardInterrupt):
        terraced(dataclasses.replace(late, n_calls=0), checkpoint=path)
    rest = Counted(problems.plateau())
    assert_same(terraced(rest, checkpoint=path), whole)
    assert rest.n_hypotheses < whole.n_calls / 2


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda t: np.where(np.arange(len(t)) == len(t) - 1, np.nan, 0.0), "log likelihood is nan at .*; allowed: a f"),
        (lambda t: np.full(len(t), np.inf), "log likelihood is inf at "),
        (lambda t: np.zeros((len(t), 1)), r"shape \(\d+, 1\); allowed: \(\d+,\).*"),
        (lambda t: ["low"] * len(t), r"something other than numbers \(could not convert string.*"),
        (lambda t: 1 / 0, r"raised ZeroDivisionError: division by zero; .*first of the \d+ .*"),
    ],
)
def test_a_failing_likelihood_is_named_and_the_run_so_far_saved(answer, message, path):
    """It fails at one call and never again, as a mended one does not: at first before any point has died."""
    problem = Counted(problems.plateau())
    whole = terraced(problem)
    for at in (2, problem.n_calls - 2):
        with pytest.raises(NotConvergedError, match=message) as caught:
            terraced(Counted(problems.plateau(), at, answer), checkpoint=path)
        assert "p0 = 0." in str(caught.value)
        assert path.exists()
        assert at > 2 or caught.value.partial is None
    part = caught.value.partial
    assert part.n_dead > 40
    assert part.stop_reason == "the likelihood failed"
    assert part.warnings[-1] == f"the likelihood failed: {caught.value}"
    assert_same(terraced(problems.plateau(), checkpoint=path), whole)
