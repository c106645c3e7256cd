"""A user's own instrument: adapts any object with `measure(pose)` to the Instrument interface."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from numbers import Real
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import BoolArray, FloatArray
from probewise._kinds import checked_finite_number, require_callable, require_flag, require_like
from probewise._signals import defer_signals
from probewise.arm.instrument import Clock, Instrument, Pose, Reading
from probewise.arm.lego import LegoArm
from probewise.arm.simulated import SimulatedArm, Speed
from probewise.errors import FileError, LinkError, ParameterError, ShapeError, message_of, require, warn
from probewise.recordings.columns import KNOWN, SESSION
from probewise.recordings.io import LARGEST, in_this_directory, run_python_file
from probewise.recordings.table import LARGEST_PLACE_MM

_A_READING = 'a finite number, or a dict such as {"value": 41.5, "time_s": 12.0, "temperature_c": 21.3}'
_OF_THE_POSE = ("x_mm", "y_mm", "orientation_rad")
_RETURNED, _OR_NAN = " of what measure returned", "a finite number, or nan where it is missing"


class Measures(Protocol):
    """The minimal interface of a user's own instrument; see `as_instrument` for optional methods."""

    def measure(self, pose: Pose, /) -> Any:
        """Move to a pose and read; return a number, a dict with "value" and further numbers, or a Reading."""


class OwnInstrument:
    """An Instrument that wraps a user's own object.

    `connect` returns the object; called once, when the instrument is entered. With a `source`, the path of the file
    that the object comes from, its errors become a `LinkError` of one line, with the line number in the file; without,
    they pass through. `start_s` is the time at the start, for resuming an earlier run, `clock` for readings without a
    time. `mounted_rad` is the angle to which a person was last asked to turn the sensor, see `carry_out`; NaN: not
    known.
    """

    def __init__(
        self, connect: Callable[[], object], *, source: str = "", start_s: float = 0.0, clock: Clock = time
    ) -> None:
        require_callable("connect", connect, "a function without arguments that returns an object with measure(pose)")
        self._connect, self.source, self._start_s, self._clock = connect, source, start_s, clock
        self._own: Any = None
        self._entered: Any = None  # what is left or closed at the end
        self.mounted_rad, self.reach = 0.0, self  # it says itself which places it reaches
        self._zero_s = clock.monotonic() - start_s
        self._speed = Speed()

    @classmethod
    def from_file(cls, path: str | Path, *, start_s: float = 0.0) -> Self:
        """Load a user's file; its function `connect()`, which returns the instrument, is called on entering.

        Raises FileError if the file cannot be read or run, or has no function `connect`.
        """
        names = run_python_file(path, "a Python file with a function connect() that returns the instrument")
        connect = names.get("connect")
        if not callable(connect):
            found = "connect is missing" if connect is None else f"connect is a {type(connect).__name__}"
            raise FileError(path, found, "def connect(): ..., which returns an object with measure(pose)")
        return cls(connect, source=str(path), start_s=start_s)

    def __enter__(self) -> Self:
        """Connect; an object without `measure` is closed and refused."""
        with self._errors_located("connect"):
            own = self._connect() if self._own is None else self._own
            manager = own
            if hasattr(own, "__enter__") and hasattr(own, "__exit__"):
                entered = own.__enter__()
                own = entered if hasattr(entered, "measure") else own
        self._own, self._entered = own, manager
        try:
            with self._errors_located(""):
                require_measures("what connect() returned", own)
        except BaseException as error:
            self.__exit__(type(error), error, error.__traceback__)
            raise
        self._zero_s = self._clock.monotonic() - self._start_s
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Exit or close the connected object, once; if an exception is pending, errors here become warnings."""
        own = self._own if self._entered is None else self._entered
        self._own = self._entered = None
        try:
            with defer_signals(), self._errors_located("close"):
                leave, close = getattr(own, "__exit__", None), getattr(own, "close", None)
                if hasattr(own, "__enter__") and callable(leave):
                    leave(kind, error, trace)
                elif callable(close):
                    close()
        except Exception as failure:
            if error is None:
                raise
            warn(f"the instrument may not be at rest: {message_of(failure, kind=False)}", RuntimeWarning)

    @property
    def turns(self) -> bool:
        """Whether the object turns its sensor to `pose.orientation_rad`: its attribute `turns`, by default False."""
        return self._flag("turns")

    @property
    def lifts(self) -> bool:
        """Whether the object reads at a given `pose.height_mm`: its attribute `lifts`, by default False."""
        return self._flag("lifts")

    @property
    def read_height_mm(self) -> float | None:
        """Height above the surface at which the object reads: its attribute `read_height_mm`; None: not known."""
        with self._errors_located("read_height_mm"):
            height_mm = getattr(self._own, "read_height_mm", None)
            return None if height_mm is None else checked_finite_number("read_height_mm of the instrument", height_mm)

    def _flag(self, name: str) -> bool:
        with self._errors_located(name):
            require_flag(f"{name} of the instrument", value := getattr(self._own, name, False))
            return bool(value)

    def sentence(self) -> str:
        """Describe the allowed places in words."""
        return f"places that reachable of {self.source or 'the instrument'} allows"

    def reachable(self, places_mm: FloatArray) -> BoolArray:
        """Return which places, shape (n_places, 2), are reachable, by default all: shape (n_places,)."""
        own = getattr(self._own, "reachable", None)
        if own is None:
            return np.ones(len(places_mm), dtype=np.bool_)
        with self._errors_located("reachable"):
            return _array_per_place("reachable", own(places_mm), len(places_mm), "biu", "True or False").astype(
                np.bool_
            )

    contains = reachable
    """Its name in `ReachablePlaces`."""

    def orientation_rad(self, places_mm: FloatArray) -> FloatArray:
        """Return the sensor's own orientation at places, (n_places, 2), by default 0: shape (n_places,)."""
        own = getattr(self._own, "orientation_rad", 0.0)
        with self._errors_located("orientation_rad"):
            angles = own(places_mm) if callable(own) else own
            allowed = "a finite number of radians"
            turns = _array_per_place("orientation_rad", angles, len(places_mm), "biuf", allowed).astype(np.float64)
            require(np.isfinite(turns).all(), "what orientation_rad returned", angles, allowed)
            return np.asarray(turns)

    def travel_s(self, start: Pose, places_mm: FloatArray) -> FloatArray:
        """Return the seconds to move from `start` to each place and read, (n_places,); default: 100 mm/s plus 1.2 s."""
        own = getattr(self._own, "travel_s", None)
        if own is None:
            away = np.hypot(places_mm[:, 0] - start.x_mm, places_mm[:, 1] - start.y_mm)
            return np.asarray(away / self._speed.move_mm_s + self._speed.read_s)
        with self._errors_located("travel_s"):
            allowed = "seconds, finite, 0 or more; nan out of reach"
            found = _array_per_place("travel_s", own(start, places_mm), len(places_mm), "biuf", allowed)
            seconds: FloatArray = found.astype(np.float64)
            wrong = ~((seconds >= 0) & (seconds < math.inf))
            if wrong.any() and (wrong[self.reachable(places_mm)].any() or (seconds[wrong] < math.inf).any()):
                raise ParameterError("what travel_s returned", float(seconds[wrong][0]), allowed)
            return seconds

    def measure(self, pose: Pose) -> Reading:
        """Measure and return a Reading: the object's own, or one built from its number or dict.

        Where the dict does not say otherwise, its time is the clock's and its pose the commanded one. Raises
        ParameterError if the result is not a valid reading; with a `source`, a LinkError instead, and of the object's
        own errors.
        """
        with self._errors_located("measure"):
            return self._as_reading(self._own.measure(pose), pose)

    def _as_reading(self, found: object, pose: Pose) -> Reading:
        if isinstance(found, Reading):
            require(not math.isinf(found.value), f"value{_RETURNED}", found.value, _OR_NAN)
            own = {"time_s": found.time_s} | {name: getattr(found.pose, name) for name in _OF_THE_POSE}
            reading, known = found, found.covariates
        else:
            allowed = f'a dict with "value", or a number: {_A_READING}'
            require(not isinstance(found, Mapping) or "value" in found, "what measure returned", found, allowed)
            told = found if isinstance(found, Mapping) else {}
            value = _number(f"value{_RETURNED}" if told else "what measure returned", told.get("value", found))
            own = {"time_s": self._clock.monotonic() - self._zero_s}
            own |= {name: getattr(pose, name) for name in _OF_THE_POSE}
            known = {name: number for name, number in told.items() if name not in (*own, "value")}
            own = {name: _number_or_nan(name, told.get(name, usual)) for name, usual in own.items()}
            there = dataclasses.replace(pose, **{name: own[name] for name in _OF_THE_POSE})
            reading = Reading(value, there, own["time_s"])
        for name, number in own.items():
            largest = LARGEST_PLACE_MM if name.endswith("_mm") else LARGEST
            allowed = f"a finite number of magnitude up to {largest:g}"
            require(abs(number) <= largest, f"{name}{_RETURNED}", number, allowed)
        return dataclasses.replace(
            reading, covariates={n: _checked_covariate(n, number) for n, number in known.items()}
        )

    @contextlib.contextmanager
    def _errors_located(self, what: str) -> Iterator[None]:
        """Turn errors of the object's method `what` into a LinkError of one line with the line number in its file.

        What the file prints goes to standard error. Without a `source`, do nothing.
        """
        aside = contextlib.redirect_stdout(sys.stderr) if self.source else contextlib.nullcontext()
        try:
            with aside, in_this_directory():
                yield
        except BaseException as error:
            if not self.source or isinstance(error, KeyboardInterrupt):
                raise
            frames = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == self.source]
            where = f"{self.source}, line {frames[-1]}" if frames else self.source
            returned = isinstance(error, ParameterError | ShapeError) and not frames  # a wrong value
            said = str(error) if returned else f"{what} raises {message_of(error)}"
            raise LinkError(f"{where}: {said}") from error


def as_instrument(
    own: Instrument | Measures, *, start_s: float = 0.0, name: str = "instrument"
) -> OwnInstrument | LegoArm | SimulatedArm:
    """Adapt any object with `measure(pose)` to an Instrument; instruments of this package are returned unchanged.

    Its `measure(pose)` moves to `pose.x_mm`, `pose.y_mm`, orientation `pose.orientation_rad` and, if not None, height
    `pose.height_mm`, and returns a number, a Reading, or a dict with "value" and optionally the true pose `x_mm`,
    `y_mm`, `orientation_rad`, the time `time_s`, and any other numbers, which become covariates. For a missing reading
    return Reading(math.nan, pose, time_s); a number or "value" has to be finite. Optional methods:
    `reachable(places_mm)`, True or False for each place (n_places, 2); `travel_s(start, places_mm)`, seconds from a
    pose to each place; `orientation_rad(places_mm)`, the sensor's own orientation at each place; a single value applies
    to all places. Attributes `turns = True` and `lifts = True` declare that the sensor is turned to the pose's
    orientation and reads at the pose's height; `read_height_mm` is the height at which it reads otherwise, if that is
    known, so that `explore` can compare it with the calibration's. `__exit__`, or else `close()`, is always called at
    the end.

    `start_s` is the time at the start, for resuming an earlier run, without effect on instruments of this package;
    `name` is for messages. Raises ParameterError if `own` has no method `measure`.
    """
    if isinstance(own, OwnInstrument | LegoArm | SimulatedArm):
        return own
    require_measures(name, own)
    made = OwnInstrument(lambda: own, start_s=start_s)
    made._own = own  # it may have been entered already, so its methods work before `with` too
    return made


def require_measures(name: str, own: object) -> None:
    """Raise ParameterError unless `own` has a method `measure`."""
    allowed = "an Instrument such as SimulatedArm(light) or LegoArm, of probewise.arm, or an object with measure(pose)"
    require_like(name, own, ("measure",), allowed)
    require_callable(f"measure of {name}", getattr(own, "measure", None), "a method measure(pose)")


def _number(name: str, found: object, allowed: str = _A_READING, *, may_be_nan: bool = False) -> float:
    """Return a number, also one of NumPy, as a float; ParameterError unless it is finite, or NaN where that may be."""
    number = found
    if isinstance(found, np.generic | np.ndarray) and np.ndim(found) == 0:
        number = math.nan if np.ma.is_masked(found) else found.item()
    wrong = not isinstance(number, Real) or math.isinf(number)
    if wrong or not (may_be_nan or (math.isfinite(number) and not isinstance(number, bool))):  # type: ignore[arg-type]
        raise ParameterError(name, found, allowed)
    return float(number)  # type: ignore[arg-type]


def _number_or_nan(name: str, found: object) -> float:
    number = _number(f"{name}{_RETURNED}", found, _OR_NAN, may_be_nan=True)
    require(not abs(number) > LARGEST, f"{name}{_RETURNED}", number, f"magnitudes up to {LARGEST:g}")
    return number


def _checked_covariate(name: object, number: object) -> float:
    """Return a covariate of a reading as a float, NaN if missing; ParameterError for a name that is not allowed."""
    if name in (*KNOWN, SESSION):
        allowed = (
            "a name that is no column of a recording; time and place are time_s, x_mm, y_mm, orientation_rad of a "
            "dict, or time_s and pose of a Reading"
        )
        raise ParameterError("a name in what measure returned", name, allowed)
    if not isinstance(name, str) or not name.isprintable() or name != name.strip() or not name:
        raise ParameterError("a name in what measure returned", name, "a printable text without blanks around it")
    return _number_or_nan(name, number)


def _array_per_place(name: str, found: object, n_places: int, kinds: str, allowed: str) -> NDArray[Any]:
    """Return one value per place, or one for all repeated, as an array (n_places,) of one of NumPy's `kinds`."""
    array = np.asarray(found)
    if array.ndim == 0:
        array = np.full(n_places, array)
    if array.shape != (n_places,):
        raise ShapeError(f"{name} returned shape {array.shape}; allowed: ({n_places},), {allowed} for each place")
    if array.dtype.kind not in kinds:
        raise ParameterError(f"what {name} returned", found, f"{allowed}, for each place or one for all")
    return array
