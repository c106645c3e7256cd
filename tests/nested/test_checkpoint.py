"""Runs that are interrupted, killed or failed go on from their file to the very bits of a run that never was."""

from __future__ import annotations

import dataclasses
import errno
import itertools
import math
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from nested_sampling import problems
from nested_sampling.problems import Known

from probewise.errors import DoubtfulResultWarning, FileError, NotConvergedError, NotSavedWarning
from probewise.nested import (
    Bound,
    Evaluator,
    EvidenceChange,
    KernelMove,
    NestedResult,
    Points,
    RoundSummary,
    SliceMove,
    Tally,
    run,
)
from probewise.nested.save import CheckpointFile
from probewise.priors import Product, Uniform

SEED = 20240229


class Stop(Exception):
    """Raised by a caller's own code."""


@dataclasses.dataclass
class Counted:
    """A problem that counts what it is asked, and does something else at one of its calls."""

    problem: Known
    at: int | None = None
    act: Callable[[np.ndarray], np.ndarray] | None = None
    n_calls: int = 0
    n_hypotheses: int = 0

    @property
    def prior(self) -> object:
        return self.problem.prior

    def log_likelihood(self, theta: np.ndarray) -> np.ndarray:
        self.n_calls += 1
        self.n_hypotheses += len(theta)
        if self.act is not None and self.n_calls == self.at:
            return self.act(theta)
        return self.problem.log_likelihood(theta)


def calls_of(make: Callable[[], Known], **options: object) -> int:
    """Count the calls of a whole run."""
    problem = Counted(make())
    quiet(problem, **options)
    return problem.n_calls


def interrupt(theta: np.ndarray) -> np.ndarray:
    raise KeyboardInterrupt


def half_impossible() -> Known:
    """A slope over a third of the prior; the rest is impossible, and the lower half of the third a plateau."""

    def function(theta: np.ndarray) -> np.ndarray:
        x = theta[:, 0]
        return np.where(x < 1 / 3, np.maximum(20 * (1 / 6 - x), 0.0) - 3 * theta[:, 1], -np.inf)

    return Known(problems.box(2, 0, 1), function, math.nan)


def rarely_possible() -> Known:
    """One hypothesis in 500 is possible: chains fill up the first live points."""
    return Known(problems.box(2, 0, 1), lambda t: np.where(t[:, 0] < 0.002, -5 * t[:, 1], -np.inf), math.nan)


PROBLEMS: dict[str, tuple[Callable[[], Known], dict[str, int]]] = {
    "plateau": (problems.plateau, {"n_live": 40}),
    "half impossible": (half_impossible, {"n_live": 30}),
    "rarely possible": (rarely_possible, {"n_live": 40}),
}
MOVES = {"slices": SliceMove(), "kernels": KernelMove()}


def quiet(problem: object, seed: int = SEED, **options: object) -> NestedResult:
    """Run with the seed and without the warnings, which the result holds too."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)
        options = {"max_cost": 1.0, **options}  # evaluations are counted: those of the search alone
        return run(problem, rng=np.random.default_rng(seed), **options)  # type: ignore[arg-type]


def assert_same(one: NestedResult, other: NestedResult) -> None:
    """Compare every field, bit for bit."""
    for field in dataclasses.fields(NestedResult):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype, field.name
            assert a.tobytes() == b.tobytes(), field.name
        else:
            assert a == b, field.name


def stopper(n_rounds: int) -> Callable[[RoundSummary], None]:
    """Give a progress function that raises at the end of the so-manyth round."""
    rounds = itertools.count(1)

    def progress(state: RoundSummary) -> None:
        if next(rounds) == n_rounds:
            raise Stop

    return progress


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.npz"


@pytest.mark.parametrize(
    ("name", "move"), [("plateau", "slices"), ("half impossible", "kernels"), ("rarely possible", "slices")]
)
def test_a_run_stopped_after_every_round_ends_as_one_never_stopped(name: str, move: str, path: Path) -> None:
    make, options = PROBLEMS[name]
    states: list[RoundSummary] = []
    whole = quiet(make(), move=MOVES[move], progress=states.append, **options)
    assert len(states) > 4
    for _ in states:
        with pytest.raises(Stop):
            quiet(make(), move=MOVES[move], progress=stopper(1), checkpoint=path, **options)
    problem = Counted(make())
    resumed = quiet(problem, move=MOVES[move], checkpoint=path, **options)
    assert_same(resumed, whole)
    assert (resumed.mean() == whole.mean()).all()
    # One hypothesis makes sure that the likelihood is the same; nothing was left to do.
    assert (problem.n_calls, problem.n_hypotheses) == (1, 1)


@pytest.mark.parametrize(("name", "move"), [("plateau", "kernels"), ("half impossible", "slices")])
def test_a_run_interrupted_within_rounds_ends_as_one_never_interrupted(name: str, move: str, path: Path) -> None:
    """Ctrl-C falls into a likelihood call, each time some calls later; the round begun is done again."""
    make, options = PROBLEMS[name]
    whole = quiet(make(), move=MOVES[move], **options)
    n_interrupted = 0
    for last_call in itertools.count(3, 3):
        problem = Counted(make(), last_call, interrupt)
        try:
            found = quiet(problem, move=MOVES[move], checkpoint=path, return_interrupted=True, **options)
        except KeyboardInterrupt:  # before the first round was done
            continue
        if problem.n_calls < last_call:
            break
        n_interrupted += 1
        assert found.stop_reason == "interrupted"
    assert n_interrupted >= 2
    assert_same(found, whole)


@pytest.mark.parametrize("bits", [np.random.PCG64, np.random.MT19937])
def test_every_bit_generator_is_taken_up_again(bits: type[np.random.PCG64], path: Path) -> None:
    def rng() -> np.random.Generator:
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


def test_a_run_at_its_call_limit_goes_on_with_a_higher_one(path: Path) -> None:
    whole = quiet(problems.plateau(), n_live=40)
    for max_calls in (300, 600, 900):
        short = quiet(problems.plateau(), n_live=40, max_calls=max_calls, checkpoint=path)
        assert f"max_calls = {max_calls}" in short.stop_reason
        assert short.n_calls <= max_calls
    assert_same(quiet(problems.plateau(), n_live=40, checkpoint=path), whole)


# ------------------------------------------------------------------ what is no checkpoint of this run


@dataclasses.dataclass(frozen=True)
class OtherMove:
    """A move of somebody else's."""

    move: SliceMove = dataclasses.field(default_factory=SliceMove)
    length: float = 1.0

    def draw(
        self, start: Points, bound: Bound, live: np.ndarray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        return self.move.draw(start, bound, live, evaluate, rng)

    def adapted(self, tally: Tally) -> OtherMove:
        return dataclasses.replace(self, length=self.length / 3)


def slope(steepness: float = 30.0, name: str = "x") -> Known:
    """The problem of the files below, and others like it."""
    return Known(Product({name: Uniform(0.0, 1.0)}), lambda t: -steepness * t[:, 0], math.nan)


@pytest.mark.parametrize(
    ("problem", "options", "message"),
    [
        (slope(name="y"), {}, r"of a run with names = \['x'\], not \['y'\]"),
        (slope(steepness=30.001), {}, "of a run with another likelihood: its first live point had -"),
        (slope(), {"n_live": 32}, "of a run with n_live = 30, not 32"),
        (slope(), {"move": KernelMove()}, r"of a run with move = SliceMove\(.*, not KernelMove\("),
        (
            slope(),
            {"stop": EvidenceChange()},
            r"stop = RemainingEvidence\(dlogz=0.05\), not EvidenceChange\(tolerance=1e-08\)",
        ),
    ],
)
def test_the_checkpoint_of_another_run_is_refused(
    problem: Known, options: dict[str, object], message: str, path: Path
) -> None:
    with pytest.raises(Stop):
        quiet(slope(), n_live=30, progress=stopper(3), checkpoint=path)
    before = path.read_bytes()
    with pytest.raises(FileError, match=message) as caught:
        quiet(problem, **{"n_live": 30, "checkpoint": path, **options})
    assert str(path) in str(caught.value)
    assert "delete this one to start anew" in str(caught.value)
    assert path.read_bytes() == before
    assert [*path.parent.iterdir()] == [path]
    assert_same(quiet(slope(), n_live=30, checkpoint=path), quiet(slope(), n_live=30))


def _damaged(whole: bytes) -> Iterator[tuple[str, bytes]]:
    yield "empty", b""
    yield "text", b"no checkpoint at all"
    for n in (1, 100, len(whole) // 2, len(whole) - 1):
        yield f"cut after {n} bytes", whole[:n]
    for n in (200, len(whole) // 2):
        yield f"zeros from {n}", whole[:n] + bytes(len(whole) - n)


def test_a_damaged_checkpoint_is_refused_and_left_alone(path: Path) -> None:
    with pytest.raises(Stop):
        quiet(slope(), n_live=30, progress=stopper(3), checkpoint=path)
    whole = path.read_bytes()
    for what, content in _damaged(whole):
        path.write_bytes(content)
        problem = Counted(slope())
        with pytest.raises(FileError, match=r"unreadable \(.*delete it to start anew"):
            quiet(problem, n_live=30, checkpoint=path)
        assert path.read_bytes() == content, what
        assert problem.n_calls == 0, what
    np.savez(path, other=np.zeros(3))
    with pytest.raises(FileError, match="unreadable"):
        quiet(slope(), n_live=30, checkpoint=path)
    path.unlink()
    assert_same(quiet(slope(), n_live=30, checkpoint=path), quiet(slope(), n_live=30))


@pytest.mark.parametrize("where", ["file/run.npz", "folder"])
def test_a_place_that_cannot_be_written_to_is_found_out_first(where: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    problem = Counted(slope())
    with pytest.raises(FileError, match="existing, writable folder"):
        quiet(problem, n_live=30, checkpoint=tmp_path / where)
    assert problem.n_calls == 0


def test_a_move_and_a_rule_of_ones_own_are_taken_up_again(path: Path) -> None:
    """What the move has tuned comes back; where a rule's function stands in memory is no other rule."""

    @dataclasses.dataclass(frozen=True)
    class Rule:
        wrapped: Callable[[RoundSummary], str | None]

        def __call__(self, state: RoundSummary) -> str | None:
            return self.wrapped(state)

    def make() -> dict[str, object]:
        return {"move": OtherMove(), "stop": Rule(lambda state: "enough" if state.n_dead > 100 else None), "n_live": 30}

    whole = quiet(slope(), **make())
    with pytest.raises(Stop):
        quiet(slope(), progress=stopper(6), checkpoint=path, **make())
    assert_same(quiet(slope(), checkpoint=path, **make()), whole)
    assert whole.stop_reason == "enough"


def test_a_disk_that_fills_up_costs_the_checkpoint_only(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = quiet(slope(), n_live=30)
    good = itertools.count()

    def fsync(handle: int) -> None:
        if next(good) >= 3:
            raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fsync)
        patch.setattr(CheckpointFile, "save_if_due", CheckpointFile.save)  # after every round
        with pytest.warns(NotSavedWarning, match=r"No space left on device.*goes on unsaved"):
            found = quiet(slope(), n_live=30, checkpoint=path)
    assert_same(found, whole)
    assert [*path.parent.iterdir()] == [path]
    # The third saving stands.
    assert_same(quiet(slope(), n_live=30, checkpoint=path), whole)


# ------------------------------------------------------------------ Ctrl-C


def test_ctrl_c_gives_what_there_is_if_asked_for_and_says_so() -> None:
    problem = Counted(problems.plateau(), calls_of(problems.plateau, n_live=40) - 2, interrupt)
    with pytest.warns(DoubtfulResultWarning, match=r"interrupted; log Z lacks"):
        result = run(problem, rng=np.random.default_rng(SEED), n_live=40, max_cost=1.0, return_interrupted=True)
    assert result.stop_reason == "interrupted"
    assert "doubtful: interrupted" in result.summary()
    assert result.n_dead >= 60
    assert result.n_calls <= problem.n_hypotheses
    assert np.exp(result.log_weight).sum() == pytest.approx(1.0)


def test_ctrl_c_raises_by_default_and_the_run_is_saved(path: Path) -> None:
    late = calls_of(problems.plateau, n_live=40) - 2
    with pytest.raises(KeyboardInterrupt):
        quiet(
            Counted(problems.plateau(), late, interrupt),
            n_live=40,
            checkpoint=path,
        )
    problem = Counted(problems.plateau())
    whole = quiet(problems.plateau(), n_live=40)
    assert_same(quiet(problem, n_live=40, checkpoint=path), whole)
    assert problem.n_hypotheses < whole.n_calls / 2


# ------------------------------------------------------------------ likelihoods that fail


def _with_nan(theta: np.ndarray) -> np.ndarray:
    return np.where(np.arange(len(theta)) == len(theta) - 1, np.nan, 0.0)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (_with_nan, r"log likelihood is nan at p0 = 0\.\d+, p1 = 0\.\d+;.*finite number, or -inf"),
        (lambda t: np.full(len(t), np.inf), r"log likelihood is inf at p0 = 0\.\d+, p1 = 0\.\d+"),
        (lambda t: np.zeros((len(t), 1)), r"shape \(\d+, 1\); allowed: \(\d+,\).*p0 = 0\.\d+, p1 = 0\.\d+"),
        (lambda t: ["low"] * len(t), r"something other than numbers \(could not convert string.*p0 = 0\.\d+"),
        (lambda t: 1 / 0, r"raised ZeroDivisionError: division by zero; .*first of the \d+ .* p0 = 0\.\d+"),
    ],
)
def test_a_failing_likelihood_is_named_and_the_run_so_far_saved(
    answer: Callable[[np.ndarray], np.ndarray], message: str, path: Path
) -> None:
    """It fails at one call and never again, as a mended one does not."""
    problem = Counted(problems.plateau())
    whole = quiet(problem, n_live=40)
    for at, n_least in ((2, None), (problem.n_calls - 2, 40)):
        with pytest.raises(NotConvergedError, match=message) as caught:
            quiet(Counted(problems.plateau(), at, answer), n_live=40, checkpoint=path)
        partial = caught.value.partial
        if n_least is None:
            assert partial is None  # no point had died
        else:
            assert isinstance(partial, NestedResult)
            assert partial.n_dead > n_least
            assert partial.stop_reason == "the likelihood failed"
            assert partial.warnings[-1] == f"the likelihood failed: {caught.value}"
        assert path.exists()
    assert_same(quiet(problems.plateau(), n_live=40, checkpoint=path), whole)
