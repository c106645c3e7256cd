"""The folder of an investigation: the plan and the readings of each round, kept as they come.

`settings.json` says what was begun, `1_plan.csv` what the first round was to read, `1.csv` what it has read. A round
that was cut goes on behind its last reading; a plan that has been written decides, also where another machine's
arithmetic would have asked for other readings.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from probewise.arm import Reading, readings_of, recorded
from probewise.errors import FileError
from probewise.progress import Progress, silent
from probewise.recordings import (
    json_of,
    read_plan,
    read_recording,
    read_text,
    write_plan,
    write_recording,
    write_text_atomically,
)
from probewise.recordings.plan import Plan, Recording

__all__ = ["RoundsFolder", "Take"]

Take: TypeAlias = Callable[[int, Plan, str, Sequence[Reading]], Iterator[Reading]]
"""Takes a round's number, its plan, the plan in words and the readings taken already, and yields those that follow."""

_SETTINGS = "settings.json"
_ALLOWED = "the settings of an investigation, a JSON object"
_KEPT_AGAIN_S = 0.5  # an arm takes longer for a reading: none of its readings is lost


class RoundsFolder:
    """The rounds of one investigation, in a folder.

    Parameters
    ----------
    path
        The folder; made with the first round where it is missing.
    settings
        What decides the investigation, as JSON.
    resume
        Whether to go on with what the folder holds.

    Raises
    ------
    FileError
        If the folder holds an investigation and `resume` is not asked for, or one with other settings, or none and
        `resume` is asked for.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any], *, resume: bool) -> None:
        self.path = path
        file, wanted = path / _SETTINGS, dict(settings)
        if resume:
            if not file.exists():
                raise FileError(file, "no such file", "an investigation to resume; without --resume a new one begins")
            _require_same(file, wanted)
        elif file.exists():
            raise FileError(file, "an investigation stands there", "--resume to go on with it, or another --out")
        self._settings = wanted

    def record(self, number: int, plan: Plan, asked: str, *, take: Take, progress: Progress = silent) -> Recording:
        """Carry out a round, or what is left of it, and keep its readings."""
        planned, readings_file = self.path / f"{number}_plan.csv", self.path / f"{number}.csv"
        if not planned.exists():
            self.path.mkdir(parents=True, exist_ok=True)
            if not (self.path / _SETTINGS).exists():
                write_text_atomically(
                    self.path / _SETTINGS, json.dumps(self._settings, indent=1, allow_nan=False) + "\n"
                )
            write_plan(plan, planned)
        plan = read_plan(planned)
        readings = readings_of(read_recording(readings_file)) if readings_file.exists() else []
        kept_s = time.monotonic()
        progress(f"round {number}, readings", len(readings), len(plan))
        for reading in take(number, plan, asked, tuple(readings)):
            readings.append(reading)
            progress(f"round {number}, readings", len(readings), len(plan))
            if time.monotonic() - kept_s > _KEPT_AGAIN_S:
                write_recording(recorded(plan, readings), readings_file)
                kept_s = time.monotonic()
        write_recording(recorded(plan, readings), readings_file)
        return read_recording(readings_file)

    @property
    def n_readings(self) -> int:
        """How many readings it holds."""
        return sum(len(recording) for recording in self._recordings())

    @property
    def ended_s(self) -> float:
        """When the last of them was taken; 0 where there is none."""
        return max((float(recording.plan.time_s.max()) for recording in self._recordings()), default=0.0)

    def _recordings(self) -> Iterator[Recording]:
        return (read_recording(file) for file in self.path.glob("[0-9]*.csv") if file.stem.isdigit())


def _require_same(file: Path, wanted: Mapping[str, Any]) -> None:
    before = json_of(file, read_text(file, _ALLOWED), _ALLOWED)
    if not isinstance(before, dict):
        raise FileError(file, "no JSON object", _ALLOWED)
    for name, value in wanted.items():
        if before.get(name) != value:
            raise FileError(file, f"an investigation with {name} {before.get(name)!r}", f"{value!r}, as asked now")
