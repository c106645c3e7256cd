"""Runs that are interrupted, killed or failed go on from their file to the very bits of a run that never was."""

from __future__ import annotations

import dataclasses
import errno
import itertools
import math
import os
import signal
import subprocess
import sys
import textwrap
import tracemalloc
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from nested_sampling import problems
from nested_sampling.problems import Known

from probewise.errors import DoubtfulResultWarning, FileError, NotConvergedError, NotSavedWarning, ParameterError
from probewise.nested import (
    Bound,
    Evaluator,
    EvidenceChange,
    KernelMove,
    NestedResult,
    Points,
    RemainingEvidence,
    RoundSummary,
    SliceMove,
    Tally,
    run,
)
from probewise.nested.save import BirthRecords, CheckpointFile, LivePoints, RunState, settings_of_run
from probewise.priors import Normal, Product, Uniform

SEED = 20240229
NEVER = 1e9  # seconds between savings: only what an interruption saves is saved


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
    "correlated Gaussian": (lambda: problems.gaussian(3), {"n_live": 30}),
    "SSF": (lambda: problems.ssf(1), {"n_live": 20, "max_calls": 1000}),
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


@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize("name", PROBLEMS)
def test_a_run_stopped_after_every_round_ends_as_one_never_stopped(name: str, move: str, path: Path) -> None:
    make, options = PROBLEMS[name]
    states: list[RoundSummary] = []
    whole = quiet(make(), move=MOVES[move], progress=states.append, **options)
    assert len(states) > 4
    for _ in states:
        with pytest.raises(Stop):
            quiet(make(), move=MOVES[move], progress=stopper(1), checkpoint=path, checkpoint_every_s=NEVER, **options)
    problem = Counted(make())
    resumed = quiet(problem, move=MOVES[move], checkpoint=path, **options)
    assert_same(resumed, whole)
    assert (resumed.mean() == whole.mean()).all()
    # One hypothesis makes sure that the likelihood is the same; nothing was left to do.
    assert (problem.n_calls, problem.n_hypotheses) == (1, 1)


def test_a_run_stopped_once_at_any_round_ends_as_one_never_stopped(tmp_path: Path) -> None:
    states: list[RoundSummary] = []
    whole = quiet(problems.plateau(), n_live=40, progress=states.append)
    for k in range(1, len(states) + 1):
        options = {"n_live": 40, "checkpoint": tmp_path / f"{k}.npz", "checkpoint_every_s": NEVER}
        with pytest.raises(Stop):
            quiet(problems.plateau(), progress=stopper(k), **options)
        seen: list[RoundSummary] = []
        assert_same(quiet(problems.plateau(), progress=seen.append, **options), whole)
        assert seen == states[k:]


@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize("name", ["plateau", "half impossible", pytest.param("SSF", marks=pytest.mark.slow)])
def test_a_run_interrupted_within_rounds_ends_as_one_never_interrupted(name: str, move: str, path: Path) -> None:
    """Ctrl-C falls into a likelihood call, each time some calls later; the round begun is done again."""
    make, options = PROBLEMS[name]
    whole = quiet(make(), move=MOVES[move], **options)
    n_interrupted = 0
    for last_call in itertools.count(3, 3):
        problem = Counted(make(), last_call, interrupt)
        try:
            found = quiet(problem, move=MOVES[move], checkpoint=path, checkpoint_every_s=0, **options)
        except KeyboardInterrupt:  # before the first round was done
            continue
        if problem.n_calls < last_call:
            break
        n_interrupted += 1
        assert found.stop_reason == "interrupted"
    assert n_interrupted >= 2
    assert_same(found, whole)


@pytest.mark.parametrize(
    "bits", [np.random.PCG64, np.random.PCG64DXSM, np.random.MT19937, np.random.Philox, np.random.SFC64]
)
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


def test_a_generator_is_known_by_its_state_however_it_was_made(path: Path) -> None:
    """A jumped or restored generator spawns children of its own: nothing may depend on them."""
    wanted = np.random.PCG64(SEED).jumped(3)

    def rng() -> np.random.Generator:
        bits = np.random.PCG64()
        bits.state = wanted.state
        return np.random.Generator(bits)

    whole = run(problems.plateau(), rng=rng(), n_live=40)
    with pytest.raises(Stop):
        run(problems.plateau(), rng=rng(), n_live=40, progress=stopper(3), checkpoint=path)
    assert_same(run(problems.plateau(), rng=rng(), n_live=40, checkpoint=path), whole)


KILLED = """
import os, signal, sys
from collections.abc import Sequence

import numpy as np

from probewise.nested import run
from probewise.priors import Product, Uniform

class Problem:
    prior = Product({"x": Uniform(0, 1), "y": Uniform(0, 1)})
    n_calls, last = 0, -1

    def log_likelihood(self, theta):
        self.n_calls += 1
        if self.n_calls == self.last:
            os.kill(os.getpid(), signal.SIGKILL)
        return -500 * (theta[:, 0] - 0.3) ** 2 - 5 * theta[:, 1]

def go(path, **options):
    return run(Problem(), rng=np.random.default_rng(7), n_live=50, checkpoint=path, **options)

def die(*arguments):
    os.kill(os.getpid(), signal.SIGKILL)
"""
WAYS = {
    "within a round": "Problem.last = 60; go(sys.argv[1], checkpoint_every_s=0)",
    "within a saving": """
        from probewise.recordings import atomic
        n = 0
        true = os.replace
        def replace(*names):
            global n
            n += 1
            die() if n == 5 else true(*names)
        atomic.os.replace = replace
        go(sys.argv[1], checkpoint_every_s=0)
    """,
    "at some time": """
        import threading
        threading.Timer(float(sys.argv[2]), die).start()
        while True:
            go(sys.argv[1], checkpoint_every_s=0)
            os.unlink(sys.argv[1])
    """,
}


def kill_nine(way: str, path: Path, *arguments: str) -> None:
    """Run in a process of its own, which ends by kill -9."""
    done = subprocess.run(
        [sys.executable, "-c", KILLED + textwrap.dedent(WAYS[way]), str(path), *arguments],
        capture_output=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()


def goes_on(path: Path | None) -> NestedResult:
    """Run the killed program's problem here."""
    program: dict[str, Callable[..., NestedResult]] = {}
    exec(KILLED, program)
    return program["go"](path)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no kill -9")
@pytest.mark.parametrize("way", ["within a round", pytest.param("within a saving", marks=pytest.mark.slow)])
def test_a_killed_run_ends_as_one_never_killed(way: str, path: Path) -> None:
    kill_nine(way, path)
    before = path.read_bytes()
    resumed = goes_on(path)
    assert len(before) < len(path.read_bytes())
    assert_same(resumed, goes_on(None))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no kill -9")
def test_a_run_killed_at_any_time_ends_as_one_never_killed(tmp_path: Path) -> None:
    """The file, where there is one, is whole at every moment of runs that save after every round."""
    whole = goes_on(None)
    for k in range(12):
        path = tmp_path / f"{k}.npz"
        kill_nine("at some time", path, str(0.01 + 0.013 * k))
        assert_same(goes_on(path), whole)


def test_a_finished_run_is_given_again_and_its_file_left_alone(path: Path) -> None:
    whole = quiet(half_impossible(), n_live=30, checkpoint=path)
    before, when = path.read_bytes(), path.stat().st_mtime_ns
    problem, states = Counted(half_impossible()), list[RoundSummary]()
    assert_same(quiet(problem, n_live=30, checkpoint=path, progress=states.append), whole)
    assert (problem.n_hypotheses, states) == (1, [])
    assert (path.read_bytes(), path.stat().st_mtime_ns) == (before, when)


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


def slope(low: float = 0.0, high: float = 1.0, steepness: float = 30.0, name: str = "x", shift: float = 0.0) -> Known:
    """The problem of the files below, and others like it."""
    prior = Product({name: Uniform(low, high)})
    return Known(prior, lambda t: -steepness * (t[:, 0] - shift), math.nan)


def gauss(t: np.ndarray) -> np.ndarray:
    return -30.0 * t[:, 0]


@pytest.mark.parametrize(
    ("problem", "options", "message"),
    [
        (slope(name="y"), {}, r"of a run with names = \['x'\], not \['y'\]"),
        (slope(high=2.0), {}, "of a run with another prior"),
        (Known(Product({"x": Normal(0.5, 0.1)}), gauss, math.nan), {}, "of a run with another prior"),
        (slope(steepness=30.001), {}, "of a run with another likelihood: its first live point had -"),
        (slope(shift=1e-4), {}, r"another likelihood.*the same problem and readings"),
        (slope(), {"seed": 8}, r"of a run with another seed.*made anew from its seed"),
        (slope(), {"n_live": 32}, "of a run with n_live = 30, not 32"),
        (slope(), {"n_replaced": 3}, "of a run with n_replaced = 15, not 3"),
        (slope(), {"move": KernelMove()}, r"of a run with move = SliceMove\(.*, not KernelMove\("),
        (slope(), {"move": SliceMove(hops=1)}, r"of a run with move = SliceMove\(.*, not SliceMove\(.*hops=1"),
        (slope(), {"move": OtherMove()}, r"of a run with move = SliceMove\(.*, not OtherMove\("),
        (
            slope(),
            {"stop": EvidenceChange()},
            r"stop = RemainingEvidence\(dlogz=0.05\), not EvidenceChange\(tolerance=1e-08\)",
        ),
        (slope(), {"stop": RemainingEvidence(0.1)}, r"RemainingEvidence\(dlogz=0.05\), not Rem.*dlogz=0.1"),
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


def test_rounding_that_depends_on_the_batch_is_no_other_likelihood(path: Path) -> None:
    """Matrix products give one row's value in other last digits than the same row's among many."""

    def function(theta: np.ndarray) -> np.ndarray:
        return -30.0 * theta[:, 0] * (1 + 1e-13 * (len(theta) > 1))

    problem = Known(problems.box(1, 0, 1), function, math.nan)
    with pytest.raises(Stop):
        quiet(problem, n_live=30, progress=stopper(3), checkpoint=path)
    assert_same(quiet(problem, n_live=30, checkpoint=path), quiet(problem, n_live=30))


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


@pytest.mark.parametrize("n_places", [40, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_single_wrong_byte_is_refused_or_means_nothing(n_places: int, path: Path) -> None:
    """Either the archive's sums find it, or the run is the same nevertheless."""
    with pytest.raises(Stop):
        quiet(slope(), n_live=20, progress=stopper(2), checkpoint=path)
    whole, result = path.read_bytes(), quiet(slope(), n_live=20)
    rng = np.random.default_rng(1)
    n_refused = 0
    for at in rng.choice(len(whole), n_places, replace=False):
        wrong = bytearray(whole)
        wrong[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(wrong)
        try:
            found = quiet(slope(), n_live=20, checkpoint=path)
        except FileError:
            n_refused += 1
            assert path.read_bytes() == wrong
        else:
            assert_same(found, result)
    assert n_refused > 0.6 * n_places


def test_another_version_of_the_format_is_named(path: Path) -> None:
    with pytest.raises(Stop):
        quiet(slope(), n_live=30, progress=stopper(3), checkpoint=path)
    with np.load(path) as file:
        arrays = dict(file)
    arrays["head"] = np.array(str(arrays["head"]).replace("nested-checkpoint/3", "nested-checkpoint/0"))
    np.savez(path, **arrays)
    with pytest.raises(FileError, match=r"format 'nested-checkpoint/0'; allowed: 'nested-checkpoint/3'"):
        quiet(slope(), n_live=30, checkpoint=path)


@pytest.mark.parametrize("where", ["file/run.npz", "folder"])
def test_a_place_that_cannot_be_written_to_is_found_out_first(where: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    problem = Counted(slope())
    with pytest.raises(FileError, match="existing, writable folder"):
        quiet(problem, n_live=30, checkpoint=tmp_path / where)
    assert problem.n_calls == 0


def test_a_missing_folder_is_made_for_the_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "run.npz"
    whole = quiet(slope(), n_live=30, checkpoint=path)
    assert path.exists()
    assert_same(quiet(slope(), n_live=30, checkpoint=path), whole)


def test_options_of_a_checkpoint_are_checked_first(path: Path) -> None:
    problem = Counted(slope())

    class Wandering:
        draw = SliceMove.draw
        adapted = SliceMove.adapted

    with pytest.raises(ParameterError, match="checkpoint_every_s"):
        quiet(problem, n_live=30, checkpoint=path, checkpoint_every_s=-1.0)
    with pytest.raises(ParameterError, match="dataclass"):
        quiet(problem, n_live=30, checkpoint=path, move=Wandering())
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
        with pytest.warns(NotSavedWarning, match=r"No space left on device.*goes on unsaved"):
            found = quiet(slope(), n_live=30, checkpoint=path, checkpoint_every_s=0)
    assert_same(found, whole)
    assert [*path.parent.iterdir()] == [path]
    # The third saving stands.
    assert_same(quiet(slope(), n_live=30, checkpoint=path), whole)


# ------------------------------------------------------------------ Ctrl-C


def test_ctrl_c_gives_what_there_is_and_says_so() -> None:
    problem = Counted(problems.plateau(), calls_of(problems.plateau, n_live=40) - 2, interrupt)
    with pytest.warns(DoubtfulResultWarning, match=r"interrupted; log Z lacks"):
        result = run(problem, rng=np.random.default_rng(SEED), n_live=40, max_cost=1.0)
    assert result.stop_reason == "interrupted"
    assert "doubtful: interrupted" in result.summary()
    assert result.n_dead >= 60
    assert result.n_calls <= problem.n_hypotheses
    assert np.exp(result.log_weight).sum() == pytest.approx(1.0)


def test_the_result_of_ctrl_c_is_that_of_the_rounds_done() -> None:
    """Two interruptions within one round leave the same points, weights and errors."""
    calls: list[tuple[int, int]] = []
    problem = Counted(problems.plateau())
    quiet(problem, n_live=40, progress=lambda state: calls.append((problem.n_calls, state.n_dead)))
    (first, n_dead), (last, _) = calls[5:7]
    assert last - first >= 2
    ends = [quiet(Counted(problems.plateau(), at, interrupt), n_live=40) for at in (first + 1, last)]
    assert ends[0].n_dead == n_dead + 40
    assert_same(ends[0], dataclasses.replace(ends[1], n_calls=ends[0].n_calls))


@pytest.mark.parametrize("at", [1, 2])
def test_ctrl_c_before_the_first_round_is_done_raises(at: int, path: Path) -> None:
    for options in ({}, {"checkpoint": path}):
        with pytest.raises(KeyboardInterrupt):
            quiet(Counted(problems.plateau(), at, interrupt), n_live=40, **options)
    # Once there are live points, they are kept.
    assert path.exists() == (at == 2)
    assert_same(quiet(problems.plateau(), n_live=40, checkpoint=path), quiet(problems.plateau(), n_live=40))


def test_ctrl_c_raises_where_it_should_and_the_run_is_saved(path: Path) -> None:
    late = calls_of(problems.plateau, n_live=40) - 2
    with pytest.raises(KeyboardInterrupt):
        quiet(
            Counted(problems.plateau(), late, interrupt),
            n_live=40,
            checkpoint=path,
            checkpoint_every_s=NEVER,
            return_interrupted=False,
        )
    problem = Counted(problems.plateau())
    whole = quiet(problems.plateau(), n_live=40)
    assert_same(quiet(problem, n_live=40, checkpoint=path), whole)
    assert problem.n_hypotheses < whole.n_calls / 2


def test_ctrl_c_after_the_last_round_interrupts_nothing(path: Path) -> None:
    """It comes from `progress`, when the rule has already said that the run is done."""
    states: list[RoundSummary] = []
    whole = quiet(problems.plateau(), n_live=40, progress=states.append)

    def progress(state: RoundSummary) -> None:
        if state == states[-1]:
            raise KeyboardInterrupt

    for options in ({}, {"checkpoint": path}):
        assert_same(quiet(problems.plateau(), n_live=40, progress=progress, **options), whole)
    assert_same(quiet(problems.plateau(), n_live=40, checkpoint=path), whole)


# ------------------------------------------------------------------ likelihoods that fail


def _with_nan(theta: np.ndarray) -> np.ndarray:
    return np.where(np.arange(len(theta)) == len(theta) - 1, np.nan, 0.0)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (_with_nan, r"log likelihood is nan at p0 = 0\.\d+, p1 = 0\.\d+;.*finite number, or -inf"),
        (lambda t: np.full(len(t), np.inf), r"log likelihood is inf at p0 = 0\.\d+, p1 = 0\.\d+"),
        (lambda t: np.zeros((len(t), 1)), r"shape \(\d+, 1\); allowed: \(\d+,\).*p0 = 0\.\d+, p1 = 0\.\d+"),
        (lambda t: 0.0, r"shape \(\); allowed: \(\d+,\).*p0 = 0\.\d+"),
        (lambda t: ["low"] * len(t), r"something other than numbers \(could not convert string.*p0 = 0\.\d+"),
        (lambda t: 1 / 0, r"raised ZeroDivisionError: division by zero; .*first of the \d+ .* p0 = 0\.\d+"),
        (lambda t: next(iter(())), r"raised RuntimeError: generator raised StopIteration; .*p0 = 0\.\d+"),
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
            quiet(Counted(problems.plateau(), at, answer), n_live=40, checkpoint=path, checkpoint_every_s=NEVER)
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


def test_a_likelihood_that_raises_for_one_hypothesis_is_told_which() -> None:
    bad: list[float] = []

    def function(theta: np.ndarray) -> np.ndarray:
        worst = theta[theta[:, 0] > 0.95]
        if len(worst):
            bad.append(float(worst[0, 0]))
            raise ArithmeticError("too steep")
        return theta[:, 0]

    with pytest.raises(NotConvergedError, match=r"raised ArithmeticError: too steep; at p0 = 0\.9\d+, p1 =") as caught:
        quiet(Known(problems.box(2, 0, 1), function, math.nan), n_live=200)
    assert f"p0 = {bad[0]:.10g}" in str(caught.value)
    assert isinstance(caught.value.__cause__, ArithmeticError)


def test_a_likelihood_may_hand_out_the_same_array_every_time() -> None:
    store = np.empty(1000)

    def function(theta: np.ndarray) -> np.ndarray:
        out = store[: len(theta)]
        out[:] = -30 * theta[:, 0]
        return out

    shared = quiet(Known(problems.box(1, 0, 1), function, math.nan), n_live=30)
    assert_same(shared, quiet(Known(problems.box(1, 0, 1), lambda t: -30 * t[:, 0], math.nan), n_live=30))


# ------------------------------------------------------------------ what it costs


@pytest.mark.parametrize(("every_s", "share"), [(0, 1.0), (NEVER, 0.0)])
def test_a_run_is_saved_as_often_as_asked(
    every_s: float, share: float, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each state of a run that is saved after every round: even where saving takes longer than a round."""
    n_saved = itertools.count()
    true = CheckpointFile.save

    def save(self: CheckpointFile, now: RunState) -> None:
        next(n_saved)
        true(self, now)

    monkeypatch.setattr(CheckpointFile, "save", save)
    states: list[RoundSummary] = []
    quiet(slope(), n_live=30, checkpoint=path, checkpoint_every_s=every_s, progress=states.append)
    # The first live points, every round, and the end.
    assert next(n_saved) == round(share * (1 + len(states))) + 1


def test_saving_takes_a_tenth_of_the_time_at_most(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever `checkpoint_every_s` above 0 says; by a clock that ticks at every look."""
    settings = settings_of_run(("p0",), 10, 5, SliceMove(), RemainingEvidence(), "{}")
    clock = itertools.count(0.0, 3.0)
    monkeypatch.setattr("probewise.nested.save.time.monotonic", lambda: next(clock))
    keeper = CheckpointFile(path, 1.0, settings, _last_saving=0.0)
    live = LivePoints(_points(10, 1), BirthRecords.of_prior_draws(10), 0.0)
    saved = []
    for k in range(60):
        now = RunState(live, (), SliceMove(), 0.0, 0.0, (), n_calls=k)
        keeper.save_if_due(now)
        saved.append(keeper._state_in_file is now)
    # A saving looks twice and so takes 3 s; ten times that pass at ten looks.
    assert sum(saved) == 6


def _points(n: int, n_params: int) -> Points:
    rng = np.random.default_rng(0)
    u = rng.random((n, n_params))
    return Points(u, u.copy(), np.zeros(n), rng.random(n), rng.random(n))


@pytest.mark.slow
@pytest.mark.parametrize("n_rounds", [24, 120])
def test_memory_beside_the_samples_is_the_same_in_long_runs(n_rounds: int) -> None:
    """What a round takes while it lasts does not grow; what it leaves is its samples.

    A dead point is `u` and `theta`, seven more numbers of its own and its birth, and three counts, of 8 bytes
    each; a round holds them in twelve arrays and three objects, which themselves take some 2 kB.
    """
    n_params, n_live = 4, 40
    per_point, per_round = 8 * (2 * n_params + 10), 12 * 130 + 1200
    held, peak, dead = [], [], []

    def progress(state: RoundSummary) -> None:
        now, most = tracemalloc.get_traced_memory()
        held.append(now)
        peak.append(most - now)
        dead.append(state.n_dead)
        tracemalloc.reset_peak()

    def stop(state: RoundSummary) -> str | None:
        return "enough" if state.n_dead >= n_rounds * n_live // 2 else None

    # No end: the likelihood rises for ever on the way to the middle.
    problem = Known(problems.box(n_params, -1, 1), lambda t: -np.log((t * t).sum(axis=1)), math.nan)
    tracemalloc.start()
    try:
        quiet(problem, n_live=n_live, progress=progress, stop=stop)
    finally:
        tracemalloc.stop()
    early, late = n_rounds // 4, len(dead) - 1
    assert late == n_rounds - 1
    stored = (dead[late] - dead[early]) * per_point + (late - early) * per_round
    assert held[late] - held[early] < stored
    # Working memory of rounds: no more late than early, but for one pointer a round.
    assert max(peak[-early:]) < 1.2 * max(peak[early : 2 * early]) + 16 * late
