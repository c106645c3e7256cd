"""Hold a run between two rounds, and save it so that a kill loses nothing that was saved."""

from __future__ import annotations

import io
import json
import re
import tempfile
import time
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import FileError, NotSavedWarning, ParameterError
from probewise.nested.evaluate import Evaluator, Points
from probewise.nested.moves import Move
from probewise.nested.stop import StopRule
from probewise.recordings.atomic import write_bytes_atomically

__all__ = ["Dead", "Keeper", "Live", "Origin", "Run", "settings_of"]

_FORMAT = "nested-checkpoint/3"
_ROUNDING = 1e-6
_POINTS = ("u", "theta", "log_density", "log_likelihood", "label")


@dataclass(frozen=True, eq=False)
class Origin:
    """Say of points where each came from, all (n,).

    `log_birth`, `birth_label`: the level that it was drawn above. `ident`: its number in order of birth; `parent`:
    that of the point at which its chain began, -1 for none.
    """

    log_birth: FloatArray
    birth_label: FloatArray
    ident: IntArray
    parent: IntArray

    @classmethod
    def of_prior(cls, n: int) -> Origin:
        """Say so of draws from the prior, numbered."""
        return cls(np.full(n, -np.inf), np.ones(n), np.arange(n), np.full(n, -1))

    def take(self, rows: IntArray) -> Origin:
        """Select."""
        return Origin(*(getattr(self, f.name)[rows] for f in fields(self)))

    @classmethod
    def join(cls, *parts: Origin) -> Origin:
        """Put one behind the other."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))


@dataclass(frozen=True, eq=False)
class Live:
    """Hold the live points and the log volume they fill."""

    points: Points
    origin: Origin
    log_volume: float


@dataclass(frozen=True, eq=False)
class Dead:
    """Hold the points that one round removed, worst first, and how their successors came in.

    `n_at_death`: points alive when each died, itself included. `rank`, `n_ranked`: how many of
    the `n_ranked` points alive at a successor's insertion were worse than it.
    """

    points: Points
    origin: Origin
    n_at_death: IntArray
    rank: IntArray
    n_ranked: IntArray


@dataclass(frozen=True, eq=False)
class Run:
    """Hold everything that the rest of a run depends on.

    `log_start`, `log_start_error`: log of the prior's possible share. `best`: greatest log likelihood of the live
    points; `log_z_over_best`: log of the evidence of the dead points, less that. `n_stuck`: chains that could
    not leave their start; `last_cost`: evaluations of the last round; `ended`: why it is over.
    """

    live: Live
    dead: tuple[Dead, ...]
    moving: Move
    log_start: float
    log_start_error: float
    notes: tuple[str, ...]
    best: float = -np.inf
    log_z_over_best: float = -np.inf
    n_stuck: int = 0
    last_cost: int = 0
    n_calls: int = 0
    ended: str | None = None
    rng_state: Mapping[str, Any] = field(default_factory=dict)


def settings_of(
    names: tuple[str, ...], n_live: int, n_replaced: int, move: Move, stop: StopRule, seed_state: str
) -> dict[str, object]:
    """Describe what a resumed run must share with the one that was interrupted.

    Raises
    ------
    ParameterError
        If the move is none that a checkpoint can hold.
    """
    _numbers(move)
    return {
        "names": list(names),
        "n_live": n_live,
        "n_replaced": n_replaced,
        "move": _told(move),
        "stop": _told(stop),
        "seed_state": seed_state,
    }


def _told(value: object) -> str:
    if not is_dataclass(value):
        return str(getattr(value, "__qualname__", type(value).__qualname__))
    # Where a function stands in memory differs from one process to the next.
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))


@dataclass
class Keeper:
    """Save a run to `path`, whole or not at all, and take it up again."""

    path: Path
    every_s: float
    settings: dict[str, object]
    _last: float = field(default_factory=time.monotonic)
    _took: float = 0.0
    _held: Run | None = None

    def __post_init__(self) -> None:
        if not self.every_s >= 0:
            raise ParameterError("checkpoint_every_s", self.every_s, "0 or more")
        if self.path.is_dir():
            raise FileError(self.path, "a folder", "a file in an existing, writable folder")
        try:
            # Found out now rather than when there is something to lose.
            tempfile.TemporaryFile(dir=self.path.parent).close()
        except OSError as error:
            raise FileError(
                self.path, f"cannot be written ({error.strerror})", "a file in an existing, writable folder"
            ) from error

    def save_if_due(self, now: Run) -> None:
        """Save if the last time is long ago, and long compared with what saving takes; always if `every_s` is 0."""
        if self.every_s == 0 or time.monotonic() - self._last >= max(self.every_s, 10.0 * self._took):
            self.save(now)

    def save(self, now: Run) -> None:
        """Write the file, unless it holds this run already; warn where that fails: the run itself is sound."""
        if now is self._held:
            return
        begun = time.monotonic()
        try:
            write_bytes_atomically(self.path, self._bytes(now))
            self._held = now
        except FileError as error:
            warnings.warn(f"{error}; the run goes on unsaved", NotSavedWarning, stacklevel=2)
        finally:
            self._last = time.monotonic()
            self._took = self._last - begun

    def _bytes(self, now: Run) -> bytes:
        head = {
            "format": _FORMAT,
            "settings": self.settings,
            "moving": _numbers(now.moving),
            "log_volume": now.live.log_volume,
            "sizes": [len(d.points) for d in now.dead],
            "rng_state": now.rng_state,
            **{name: getattr(now, name) for name in _PLAIN},
        }
        arrays = {f"live_{name}": getattr(now.live.points, name) for name in _POINTS}
        arrays |= {f"live_{name}": getattr(now.live.origin, name) for name in _ORIGIN}
        if now.dead:
            dead = Points.join(*(d.points for d in now.dead))
            arrays |= {f"dead_{name}": getattr(dead, name) for name in _POINTS}
            origin = Origin.join(*(d.origin for d in now.dead))
            arrays |= {f"dead_{name}": getattr(origin, name) for name in _ORIGIN}
            arrays |= {f"dead_{name}": np.concatenate([getattr(d, name) for d in now.dead]) for name in _RECORD}
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, head=np.array(json.dumps(head, default=_plain)), **arrays)
        return buffer.getvalue()

    def resume(self, evaluate: Evaluator, move: Move, rng: np.random.Generator) -> Run | None:
        """Read the file and put the generator where it was; None where there is no file.

        Raises
        ------
        FileError
            If the file is damaged or of another run.
        """
        if not self.path.exists():
            return None
        try:
            with open(self.path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
                # An array read short of its end would go unchecked.
                damaged = file.zip.testzip()
                if damaged is not None:
                    raise zipfile.BadZipFile(f"{damaged} is damaged")
                head = json.loads(str(file["head"]))
                found, settings = head["format"], head["settings"]
                # Only then, since another version or move may have stored other things.
                same = found == _FORMAT and settings == self.settings
                now = (
                    _run_from(head, {name: file[name] for name in file.files if name != "head"}, move) if same else None
                )
        except Exception as error:  # a damaged archive can raise whatever its parts do
            raise FileError(
                self.path, f"unreadable ({error})", "a checkpoint of this run; delete it to start anew"
            ) from error
        if found != _FORMAT:
            raise FileError(self.path, f"format {found!r}", f"{_FORMAT!r}; delete the file to start anew")
        if now is None:
            raise self._of_another(settings)
        self._require_same_problem(now, evaluate)
        evaluate.n_calls = now.n_calls
        rng.bit_generator.state = now.rng_state
        self._last, self._held = time.monotonic(), now
        return now

    def _of_another(self, settings: dict[str, object]) -> FileError:
        """Say in what the file's settings differ from this run's."""
        name = next(n for n in (*self.settings, *settings) if settings.get(n) != self.settings.get(n))
        if name == "seed_state":
            return FileError(
                self.path,
                "of a run with another seed: its generator began in another state",
                "rng as it was when that run began, made anew from its seed; "
                "give another file, or delete this one to start anew",
            )
        return FileError(
            self.path,
            f"of a run with {name} = {_short(settings.get(name))}, not {_short(self.settings.get(name))}",
            "the same problem, settings and seed; give another file, or delete this one to start anew",
        )

    def _require_same_problem(self, now: Run, evaluate: Evaluator) -> None:
        points, way_out = now.live.points, "give another file, or delete this one to start anew"
        theta, log_density = evaluate.space.leave(points.u)
        scale = np.abs(points.theta).max(axis=0)
        if not (_near(theta, points.theta, scale) and _near(log_density, points.log_density, 1.0)):
            raise FileError(
                self.path,
                "of a run with another prior: it leads from its live points' coordinates to other parameters",
                f"the same problem; {way_out}",
            )
        then = points.log_likelihood[:1]
        again = evaluate.log_likelihood(points.theta[:1])
        if not _near(again, then, 1.0 + np.abs(then)):
            raise FileError(
                self.path,
                f"of a run with another likelihood: its first live point had {then[0]:.10g}, now {again[0]:.10g}",
                f"the same problem and readings; {way_out}",
            )


_PLAIN = (
    "log_start",
    "log_start_error",
    "notes",
    "best",
    "log_z_over_best",
    "n_stuck",
    "last_cost",
    "n_calls",
    "ended",
)
_ORIGIN = ("log_birth", "birth_label", "ident", "parent")
_RECORD = ("n_at_death", "rank", "n_ranked")


def _run_from(head: dict[str, object], arrays: dict[str, np.ndarray], move: Move) -> Run:
    ends = np.cumsum(np.asarray(head["sizes"], dtype=np.int64))
    dead = []
    for end, size in zip(ends, np.diff(ends, prepend=0), strict=True):
        rows = slice(int(end - size), int(end))
        points = Points(*(arrays[f"dead_{name}"][rows] for name in _POINTS))
        origin = Origin(*(arrays[f"dead_{name}"][rows] for name in _ORIGIN))
        dead.append(Dead(points, origin, *(arrays[f"dead_{name}"][rows] for name in _RECORD)))
    live = Live(
        Points(*(arrays[f"live_{name}"] for name in _POINTS)),
        Origin(*(arrays[f"live_{name}"] for name in _ORIGIN)),
        float(str(head["log_volume"])),
    )
    plain = {name: head[name] for name in _PLAIN}
    plain["notes"] = tuple(plain["notes"])  # type: ignore[arg-type]
    moving = _with_numbers(move, head["moving"])
    return Run(live, tuple(dead), moving, rng_state=_state(head["rng_state"]), **plain)  # type: ignore[arg-type]


def _near(a: FloatArray, b: FloatArray, scale: FloatArray | float) -> bool:
    """Compare but for rounding: the last digits of a row depend on how many rows are computed with it."""
    with np.errstate(invalid="ignore"):  # inf - inf
        return a.shape == b.shape and bool(((a == b) | (np.abs(a - b) <= _ROUNDING * scale)).all())


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 200 else f"{text[:200]}..."


def _numbers(move: Move) -> dict[str, float]:
    """Give what a move has tuned: its numbers."""
    if not is_dataclass(move):
        raise ParameterError("move", move, "a dataclass, whose numbers a checkpoint can keep")
    return {f.name: v for f in fields(move) if isinstance(v := getattr(move, f.name), int | float)}


def _with_numbers(move: Move, numbers: object) -> Move:
    if not is_dataclass(move) or not isinstance(numbers, dict):
        raise ValueError("the move cannot be restored")
    restored: Move = replace(move, **numbers)
    return restored


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


def _state(value: object) -> dict[str, Any]:
    """Turn lists of a generator's state back into arrays."""
    if not isinstance(value, dict):
        raise ValueError("no state of a random generator")

    def back(item: object) -> object:
        if isinstance(item, dict):
            return {k: back(v) for k, v in item.items()}
        return np.asarray(item, dtype=np.uint64) if isinstance(item, list) else item

    return {k: back(v) for k, v in value.items()}
