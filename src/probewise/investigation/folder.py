"""The folder of an investigation: the plan and the readings of each round, written as they arrive.

`settings.json` holds the settings, `1_plan.csv` the plan of the first round, `1.csv` its readings. An interrupted round
resumes after its last reading. A plan that has been written is used as it is, even if other readings would be advised
now.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from probewise.arm import Reading, readings_of_recording, recording_of_readings
from probewise.errors import FileError
from probewise.progress import Progress, silent
from probewise.recordings import (
    parse_json_file_text,
    read_plan,
    read_recording,
    read_text,
    write_plan,
    write_recording,
    write_text_atomically,
)
from probewise.recordings.plan import Plan, Recording

Take: TypeAlias = Callable[[int, Plan, str, Sequence[Reading]], Iterator[Reading]]
"""Function of a round's number, its plan, the plan in words and the readings so far; yields the further readings."""

_SETTINGS = "settings.json"
_ALLOWED = "the settings of an investigation, a JSON object"
_KEPT_AGAIN_S = 0.5  # an arm takes longer per reading, so that none of its readings is lost


class RoundsFolder:
    """The folder of one investigation, in which the plan and the readings of its rounds are kept.

    Parameters
    ----------
    path
        The folder; created with the first round if missing.
    settings
        Settings that determine the investigation, as JSON takes them.
    resume
        Whether to resume the investigation in the folder.

    Raises
    ------
    FileError
        If the folder holds an investigation and `resume` is False, or holds none, or one with other settings, and
        `resume` is True.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any], *, resume: bool) -> None:
        self.path = path
        file, wanted = path / _SETTINGS, dict(settings)
        if resume:
            if not file.exists():
                raise FileError(file, "no such file", "an investigation to resume; omit --resume to begin a new one")
            _require_same_settings(file, wanted)
        elif file.exists():
            raise FileError(file, "an investigation is in this folder", "--resume to continue it, or another --out")
        self._settings = wanted

    def record_round(
        self, number: int, plan: Plan, asked: str, *, take: Take, progress: Progress = silent
    ) -> Recording:
        """Take the readings of a round, or those still missing, write them to the folder, and return all of them.

        A plan of the round that is in the folder already is used in place of `plan`; `asked` is the plan in words.
        """
        planned, readings_file = self.path / f"{number}_plan.csv", self.path / f"{number}.csv"
        if not planned.exists():
            self.path.mkdir(parents=True, exist_ok=True)
            if not (self.path / _SETTINGS).exists():
                write_text_atomically(
                    self.path / _SETTINGS, json.dumps(self._settings, indent=1, allow_nan=False) + "\n"
                )
            write_plan(plan, planned)
        plan = read_plan(planned)
        readings = readings_of_recording(read_recording(readings_file)) if readings_file.exists() else []
        kept_s = time.monotonic()
        progress(f"round {number}, readings", len(readings), len(plan))
        try:
            for reading in take(number, plan, asked, tuple(readings)):
                readings.append(reading)
                progress(f"round {number}, readings", len(readings), len(plan))
                if time.monotonic() - kept_s > _KEPT_AGAIN_S:
                    write_recording(recording_of_readings(plan, readings), readings_file)
                    kept_s = time.monotonic()
        finally:  # an error or an interruption loses none of them
            if readings:
                write_recording(recording_of_readings(plan, readings), readings_file)
        return read_recording(readings_file)

    @property
    def n_readings(self) -> int:
        """Number of readings in the folder, of all rounds."""
        return sum(len(recording) for recording in self._recordings_of_rounds())

    @property
    def last_time_s(self) -> float:
        """Time of the last reading in seconds; 0 if there is none."""
        return max((float(recording.plan.time_s.max()) for recording in self._recordings_of_rounds()), default=0.0)

    def _recordings_of_rounds(self) -> Iterator[Recording]:
        return (read_recording(file) for file in self.path.glob("[0-9]*.csv") if file.stem.isdigit())


def _require_same_settings(file: Path, wanted: Mapping[str, Any]) -> None:
    before = parse_json_file_text(file, read_text(file, _ALLOWED), _ALLOWED)
    if not isinstance(before, dict):
        raise FileError(file, "no JSON object", _ALLOWED)
    for name, value in wanted.items():
        if before.get(name) != value:
            raise FileError(file, f"an investigation with {name} {before.get(name)!r}", f"{value!r}, as asked now")
