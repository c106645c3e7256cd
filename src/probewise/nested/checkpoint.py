"""Hold a run between two rounds, and save it so that a kill loses nothing that was saved."""

from __future__ import annotations

import io
import json
import time
import zipfile
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import FileError, ParameterError
from probewise.nested.evaluate import Evaluator, Points
from probewise.nested.moves import Move
from probewise.nested.stop import StopRule
from probewise.recordings.atomic import write_bytes_atomically

__all__ = ["Dead", "Keeper", "Live", "Run", "settings_of"]

_FORMAT = "nested-checkpoint/1"
_POINTS = ("u", "theta", "log_density", "log_likelihood", "label")


@dataclass(frozen=True, eq=False)
class Live:
    """Hold the live points, the level and label each was born above, both (n_live,), and the log volume they fill."""

    points: Points
    log_birth: FloatArray
    birth_label: FloatArray
    log_volume: float


@dataclass(frozen=True, eq=False)
class Dead:
    """Hold the points that one round removed, worst first, and how their successors came in.

    `n_at_death`: points alive when each died, itself included. `rank`, `n_ranked`: how many of
    the `n_ranked` points alive at a successor's insertion were worse than it.
    """

    points: Points
    log_birth: FloatArray
    birth_label: FloatArray
    n_at_death: IntArray
    rank: IntArray
    n_ranked: IntArray


@dataclass(frozen=True, eq=False)
class Run:
    """Hold everything that the rest of a run depends on.

    `log_start`, `log_start_error`: log of the prior's possible share. `n_stuck`: chains that could
    not leave their start; `last_cost`: evaluations of the last round; `ended`: why it is over.
    """

    live: Live
    dead: tuple[Dead, ...]
    moving: Move
    log_start: float
    log_start_error: float
    notes: tuple[str, ...]
    log_z: float = -np.inf
    n_stuck: int = 0
    last_cost: int = 0
    n_calls: int = 0
    ended: str | None = None
    rng_state: object = field(default=None)


def settings_of(
    names: tuple[str, ...], n_live: int, n_replaced: int, move: Move, stop: StopRule, seed_state: str
) -> dict[str, object]:
    """Describe what a resumed run must share with the one that was interrupted."""
    return {
        "names": list(names),
        "n_live": n_live,
        "n_replaced": n_replaced,
        "move": _told(move),
        "stop": _told(stop),
        "seed_state": seed_state,
    }


def _told(value: object) -> str:
    return repr(value) if is_dataclass(value) else str(getattr(value, "__qualname__", type(value).__qualname__))


@dataclass
class Keeper:
    """Save a run to `path`, whole or not at all, and take it up again."""

    path: Path
    every_s: float
    settings: dict[str, object]
    _last: float = field(default_factory=time.monotonic)
    _took: float = 0.0

    def __post_init__(self) -> None:
        if not self.every_s >= 0:
            raise ParameterError("checkpoint_every_s", self.every_s, "0 or more")

    def save_if_due(self, now: Run) -> None:
        """Save if the last time is long ago, and long compared with what saving takes."""
        if time.monotonic() - self._last >= max(self.every_s, 10.0 * self._took):
            self.save(now)

    def save(self, now: Run) -> None:
        """Write the file."""
        begun = time.monotonic()
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
        arrays |= {"live_log_birth": now.live.log_birth, "live_birth_label": now.live.birth_label}
        if now.dead:
            dead = Points.join(*(d.points for d in now.dead))
            arrays |= {f"dead_{name}": getattr(dead, name) for name in _POINTS}
            arrays |= {f"dead_{name}": np.concatenate([getattr(d, name) for d in now.dead]) for name in _RECORD}
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, head=np.array(json.dumps(head, default=_plain)), **arrays)
        write_bytes_atomically(self.path, buffer.getvalue())
        self._last = time.monotonic()
        self._took = self._last - begun

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
                head = json.loads(str(file["head"]))
                if head.get("format") != _FORMAT:
                    raise ValueError(f"format {head.get('format')!r}, not {_FORMAT!r}")
                arrays = {name: file[name] for name in file.files if name != "head"}
            now = _run_from(head, arrays, move)
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise FileError(
                self.path, f"unreadable ({error})", "a checkpoint of this run; delete it to start anew"
            ) from error
        for name, mine in self.settings.items():
            if head["settings"].get(name) != mine:
                raise FileError(
                    self.path,
                    f"of a run with {name} = {str(head['settings'].get(name))[:80]}, not {str(mine)[:80]}",
                    "the same problem, settings and seed; give another file, or delete this one to start anew",
                )
        first = now.live.points.take(slice(0, 1))
        if evaluate.log_likelihood(first.theta)[0] != first.log_likelihood[0]:
            raise FileError(
                self.path,
                "of a run with another likelihood: its first live point now has another value",
                "the same problem and readings; give another file, or delete this one to start anew",
            )
        evaluate.n_calls = now.n_calls
        rng.bit_generator.state = _state(now.rng_state)
        self._last = time.monotonic()
        return now


_PLAIN = ("log_start", "log_start_error", "notes", "log_z", "n_stuck", "last_cost", "n_calls", "ended")
_RECORD = ("log_birth", "birth_label", "n_at_death", "rank", "n_ranked")


def _run_from(head: dict[str, object], arrays: dict[str, np.ndarray], move: Move) -> Run:
    ends = np.cumsum(np.asarray(head["sizes"], dtype=np.int64))
    dead = []
    for end, size in zip(ends, np.diff(ends, prepend=0), strict=True):
        rows = slice(int(end - size), int(end))
        points = Points(*(arrays[f"dead_{name}"][rows] for name in _POINTS))
        dead.append(Dead(points, *(arrays[f"dead_{name}"][rows] for name in _RECORD)))
    live = Live(
        Points(*(arrays[f"live_{name}"] for name in _POINTS)),
        arrays["live_log_birth"],
        arrays["live_birth_label"],
        float(str(head["log_volume"])),
    )
    plain = {name: head[name] for name in _PLAIN}
    plain["notes"] = tuple(plain["notes"])  # type: ignore[arg-type]
    moving = _with_numbers(move, head["moving"])
    return Run(live, tuple(dead), moving, rng_state=head["rng_state"], **plain)  # type: ignore[arg-type]


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


def _state(value: object) -> dict[str, object]:
    """Turn lists of a generator's state back into arrays."""
    if not isinstance(value, dict):
        raise ValueError("no state of a random generator")

    def back(item: object) -> object:
        if isinstance(item, dict):
            return {k: back(v) for k, v in item.items()}
        return np.asarray(item, dtype=np.uint64) if isinstance(item, list) else item

    return {k: back(v) for k, v in value.items()}
