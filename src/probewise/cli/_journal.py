"""The journal of an `explore` run as a recording over an unknown shape."""

from __future__ import annotations

import glob
import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probewise.errors import FileError

if TYPE_CHECKING:
    from probewise.calibration import FittedSensor
    from probewise.recordings import Instrumentation, Recording
    from probewise.scene import Shape


def is_journal(path: Path) -> bool:
    """Return whether a path is a journal: whether its name ends in .jsonl."""
    return path.suffix == ".jsonl"


def refuse_journal(path: Path) -> None:
    """Raise FileError for a journal where a plan or recording is needed: the shape below its sensor is unknown."""
    if is_journal(path):
        raise FileError(
            path,
            "the journal of a run over a shape that is not known",
            f"a plan or recording, CSV; a journal is for: probewise diagnose {path} --sensor S.json --out DIR",
        )


def journal_recording_and_shape(path: Path, sensor: FittedSensor) -> tuple[Recording, Shape]:
    """Return a journal's readings as a recording by the sensor, and the shape that the run looked for."""
    from dataclasses import replace  # here, as help needs none, and it is slow to import

    from probewise.experiment import read_journal

    journal = read_journal(path)
    if not journal.entries:
        raise FileError(path, "no reading", "a journal with at least one measurement")
    recording = journal.recording(instrumentation=_instrumentation_declared_by_run(path, sensor, journal.settings))
    return replace(recording, notes=(*recording.notes, *journal.notes)), _hypothesised_shape(path, journal.settings)


def find_journal_sensor_file(path: Path) -> Path:
    """Return the sensor.json of a journal's run: where it was, beside the journal, or what results renamed it to."""
    from probewise.calibration import read_sensor
    from probewise.experiment import read_journal, sensor_entry

    settings = read_journal(path).settings
    named, wanted = settings.get("sensor_file"), settings.get("sensor_sha256")
    give = "--sensor S.json, that of the run or a newer one"
    if not isinstance(named, str) or not isinstance(wanted, str):
        raise FileError(path, "it does not name its sensor's file", give)
    places = (path.parent / named, path.parent / Path(named).name)
    standing = [place for place in places if place.exists()]
    for place in places:  # where a result took its place, it has another name: see `staged_output`
        standing += sorted(place.parent.glob(f"{glob.escape(place.stem)}_kept*{place.suffix}"))
    for place in standing:
        if sensor_entry(read_sensor(place))["sensor_sha256"] == wanted:
            return place
    found = "is another by now" if standing else "is not there any more"
    raise FileError(path, f"its sensor {named} (as seen from {path.parent}) {found}", give)


def _instrumentation_declared_by_run(path: Path, sensor: FittedSensor, settings: Mapping[str, Any]) -> Instrumentation:
    """Return the sensor's instrumentation, with the rounding and range that the run declared."""
    try:
        step = settings["options"]["step"]
        low, high = settings["options"]["reading_range"]
        declared = [None if value is None else float(value) for value in (step, low, high)]
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(
            path, f"unusable options: {_missing_key_or_error_text(error)}", "options as explore writes them", row=1
        ) from error
    step, low, high = declared
    if not all(value is None or math.isfinite(value) for value in declared) or (step is not None and step <= 0):
        raise FileError(path, f"unusable options: step {step}, range {low} to {high}", "finite, a step above 0", row=1)
    from dataclasses import replace

    return replace(sensor.instrumentation, step=step, min=low, max=high)


def _hypothesised_shape(path: Path, settings: Mapping[str, Any]) -> Shape:
    """Build the hypothesised shape, or set of them, that the journal's first line names."""
    from probewise.experiment import as_shape
    from probewise.scene import SHAPES, Field

    allowed = f"shapes as explore has them: {', '.join(SHAPES)}"
    try:
        written, size = settings["shape"], settings["field"]
        field = Field(float(size["width_mm"]), float(size["height_mm"]))
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(path, f"unusable settings: {_missing_key_or_error_text(error)}", allowed, row=1) from error
    for n in range(1, len(SHAPES) + 1):
        for names in itertools.permutations(SHAPES, n):
            shape = as_shape(names, field)
            if repr(shape) == written:
                return shape
    raise FileError(path, f"shape {written}", allowed, row=1, column="shape")


def _missing_key_or_error_text(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else str(error)
