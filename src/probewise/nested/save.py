"""The state of a run between two rounds, and its checkpoint file, which survives a kill."""

from __future__ import annotations

import contextlib
import re
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise._writing import write_bytes_atomically
from probewise.errors import FileError, NotSavedWarning, ParameterError, warn
from probewise.nested.moves import Move
from probewise.nested.problem import Evaluator, Points
from probewise.nested.result import archive_bytes, read_archive

_FORMAT = "nested-checkpoint/4"
_ROUNDING = 1e-6
_EVERY_S = 10.0  # least seconds between two writes: a killed run loses no more
_WAY_OUT = "give another file, or delete this one to start anew"
_WRITABLE = "a file in an existing, writable folder"


@dataclass(frozen=True, eq=False)
class LivePoints(Points):
    """Points with the record of their births, (n,) each.

    `log_birth`, `birth_label`: log likelihood and label of the bound above which each was drawn. `ident`: its number in
    order of birth; `parent`: `ident` of the point at which its chain began, -1 for a draw from the prior.
    """

    log_birth: FloatArray
    birth_label: FloatArray
    ident: IntArray
    parent: IntArray

    def without_births(self) -> Points:
        """Return the points alone, as moves take them."""
        return Points(self.u, self.theta, self.log_density, self.log_likelihood, self.label)

    @classmethod
    def drawn_from_prior(cls, points: Points) -> Self:
        """Return draws from the prior, numbered from 0."""
        n = len(points)
        births = {"log_birth": np.full(n, -np.inf), "birth_label": np.ones(n), "parent": np.full(n, -1)}
        return cls(**vars(points), **births, ident=np.arange(n))


@dataclass(frozen=True, eq=False)
class RunState:
    """The state of the sampler after a round: everything that the rest of the run depends on."""

    live: LivePoints
    dead: tuple[LivePoints, ...]  # the points that died, worst first, in parts
    moving: Move  # as tuned so far
    log_start: float  # log of the share of the prior with nonzero likelihood
    log_start_error: float
    log_volume: float  # log of the share that the live points fill
    best: float = -np.inf  # greatest log likelihood of the live points
    log_z_over_best: float = -np.inf  # log evidence of the dead points, minus `best`
    n_stuck: int = 0  # chains that never left their start, so far
    last_cost: int = 0  # evaluations of the last round
    n_calls: int = 0
    ended: str | None = None  # the stop reason, None while the run goes on
    rng_state: Mapping[str, Any] = field(default_factory=dict)


def settings_of_run(
    names: tuple[str, ...], n_live: int, n_replaced: int, move: Move, stop: object, seed_state: str
) -> dict[str, object]:
    """Return the settings that a resumed run must share with the interrupted one, by name.

    ParameterError if the move is not a dataclass, which a checkpoint requires.
    """
    _numeric_fields_of_move(move)
    texts = {"move": _value_as_text(move), "stop": _value_as_text(stop)}
    counts = {"names": list(names), "n_live": n_live, "n_replaced": n_replaced}
    return {**counts, **texts, "seed_state": seed_state}


def _value_as_text(value: object) -> str:
    if not is_dataclass(value):
        return str(getattr(value, "__qualname__", type(value).__qualname__))
    # A function's memory address differs between processes.
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))


@dataclass
class CheckpointFile:
    """The checkpoint file of a run: the run's state is written to `path` atomically, and read to resume the run."""

    path: Path
    settings: dict[str, object]  # see `settings_of_run`
    _last_saving: float = field(default_factory=time.monotonic)
    _saving_time_s: float = 0.0
    _state_in_file: RunState | None = None

    def __post_init__(self) -> None:
        with contextlib.suppress(OSError):  # the next lines report a folder that cannot be created
            self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.is_dir():
            raise FileError(self.path, "a folder", _WRITABLE)
        try:
            # Fail now, before anything is computed.
            tempfile.TemporaryFile(dir=self.path.parent).close()
        except OSError as error:
            raise FileError(self.path, f"cannot be written ({error.strerror})", _WRITABLE) from error

    def save_if_due(self, now: RunState) -> None:
        """Save once ten seconds and ten times the duration of the last saving have passed."""
        if time.monotonic() - self._last_saving >= max(_EVERY_S, 10.0 * self._saving_time_s):
            self.save(now)

    def save(self, now: RunState) -> None:
        """Write the file unless it holds this state already; a failure only issues NotSavedWarning."""
        if now is self._state_in_file:
            return
        begun = time.monotonic()
        head = {name: value for name, value in vars(now).items() if name not in ("live", "dead", "moving")}
        head |= {"format": _FORMAT, "settings": self.settings, "moving": _numeric_fields_of_move(now.moving)}
        parts = {"live": now.live, **({"dead": LivePoints.join(*now.dead)} if now.dead else {})}
        arrays = {f"{which}_{name}": array for which, part in parts.items() for name, array in vars(part).items()}
        try:
            write_bytes_atomically(self.path, archive_bytes(head, arrays))
            self._state_in_file = now
        except FileError as error:
            warn(f"{error}; the run goes on unsaved", NotSavedWarning)
        finally:
            self._last_saving = time.monotonic()
            self._saving_time_s = self._last_saving - begun

    def resume(self, evaluate: Evaluator, move: Move, rng: np.random.Generator) -> RunState | None:
        """Read the state of the run and set `rng` and the count of `evaluate` to it; None where there is no file.

        `move`, the one given on resuming, gets the tuned numbers of the file. FileError if the file is damaged, or of a
        run with other settings, prior or likelihood.
        """
        if not self.path.exists():
            return None
        cure = "delete the file to start anew"
        head, arrays = read_archive(self.path, _FORMAT, "a checkpoint of this run; delete it to start anew", cure=cure)
        settings = head.pop("settings")
        # The first setting in which the file differs from this run.
        if differs := [n for n in (*self.settings, *settings) if settings.get(n) != self.settings.get(n)]:
            texts = [str(each.get(differs[0])) for each in (settings, self.settings)]
            there, here = (text if len(text) <= 200 else f"{text[:200]}..." for text in texts)
            why, allowed = f"{differs[0]} = {there}, not {here}", "the same problem, settings and seed"
            if differs[0] == "seed_state":
                why = "another seed: its generator began in another state"
                allowed = "rng as it was when that run began, made anew from its seed"
            raise FileError(self.path, f"of a run with {why}", f"{allowed}; {_WAY_OUT}")
        assert is_dataclass(move)  # as settings_of_run requires
        moving = replace(move, **head.pop("moving"))

        live, *dead = (
            LivePoints(*(arrays[f"{which}_{f.name}"] for f in fields(LivePoints)))
            for which in ("live", "dead")
            if f"{which}_u" in arrays
        )
        now = RunState(live, tuple(dead), moving, **head)
        self._require_same_problem(now, evaluate)
        evaluate.n_calls = now.n_calls
        rng.bit_generator.state = now.rng_state
        self._last_saving, self._state_in_file = time.monotonic(), now
        return now

    def _require_same_problem(self, now: RunState, evaluate: Evaluator) -> None:
        theta, log_density = evaluate.space.leave(now.live.u)
        scale = np.abs(now.live.theta).max(axis=0)
        if not (_nearly_equal(theta, now.live.theta, scale) and _nearly_equal(log_density, now.live.log_density, 1.0)):
            why = "another prior: it leads from its live points' coordinates to other parameters"
            raise FileError(self.path, f"of a run with {why}", f"the same problem; {_WAY_OUT}")
        then = now.live.log_likelihood[:1]
        again = evaluate.log_likelihood(now.live.theta[:1])
        if not _nearly_equal(again, then, 1.0 + np.abs(then)):
            why = f"another likelihood: its first live point had {then[0]:.10g}, now {again[0]:.10g}"
            raise FileError(self.path, f"of a run with {why}", f"the same problem and readings; {_WAY_OUT}")


def _nearly_equal(a: FloatArray, b: FloatArray, scale: FloatArray | float) -> bool:
    """Return whether two arrays agree to 1e-6 of `scale`: a row's last digits depend on the size of its batch."""
    with np.errstate(invalid="ignore"):  # inf - inf
        return a.shape == b.shape and bool(((a == b) | (np.abs(a - b) <= _ROUNDING * scale)).all())


def _numeric_fields_of_move(move: Move) -> dict[str, float]:
    """Return the numeric fields of a move by name: they hold its tuned values; ParameterError if it is no dataclass."""
    if not is_dataclass(move):
        raise ParameterError("move", move, "a dataclass, whose numbers a checkpoint can keep")
    return {f.name: v for f in fields(move) if isinstance(v := getattr(move, f.name), int | float)}
