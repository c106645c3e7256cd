"""What verbs read: plans and geometries, of a file or shipped; journals; simulators of users and their tables."""

from __future__ import annotations

import argparse
import contextlib
import glob
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from probewise import recordings
from probewise.arm import Geometry, read_geometry, shipped_geometry_path
from probewise.cli._executor import worker_pool
from probewise.cli._options import SHIPPED
from probewise.errors import FileError, ParameterError
from probewise.progress import Progress, silent
from probewise.recordings.io import parse_strict_json

if TYPE_CHECKING:
    from probewise.calibration import FittedSensor
    from probewise.scene import Shape
    from probewise.systems import RunTable, Simulator


def read_or_shipped_geometry(arguments: argparse.Namespace) -> Geometry:
    """Read the geometry of --geometry, or the shipped one."""
    return read_geometry(arguments.geometry or shipped_geometry_path())


def read_or_shipped_plan(text: str, *, progress: Progress = silent) -> recordings.Plan:
    """Read the plan of a file, or take the one of that name that ships, unless a file has the name."""
    if text in SHIPPED and not Path(text).exists():
        return recordings.paper_plan() if text == "paper" else recordings.two_way_plan()
    return recordings.read_plan(text, progress=progress)


def tables_and_descriptions(tables: Sequence[Path]) -> list[Path]:
    """Return each file of a table followed by its description, the JSON beside it, and the pictures that this names."""
    files = []
    for table in (table for table in tables if table.name):  # not "." and "/"
        files += [table, table.with_suffix(".json")]
        with contextlib.suppress(OSError, ValueError, AttributeError, TypeError, KeyError):  # whoever reads it says it
            patterns = parse_strict_json(files[-1].read_bytes() if files[-1].is_file() else b"")["patterns"].values()
            files += [table.parent / pattern["file"] for pattern in patterns if "file" in pattern]
    return files


# A user's simulator and its tables


@contextlib.contextmanager
def open_simulator(arguments: argparse.Namespace) -> Iterator[Simulator]:
    """Read the simulator of --simulator; with --workers, the calls of its `simulate` are spread over processes."""
    from probewise.systems import read_simulator
    from probewise.systems.calls import SpreadCalls

    path, n_workers = arguments.simulator, arguments.workers
    simulator = read_simulator(path)
    if n_workers == 1 or simulator.simulate is None or simulator.vectorized:
        yield simulator
        return
    with worker_pool(n_workers) as pool:
        yield replace(simulator, simulate=SpreadCalls(simulator.simulate, path, pool, n_workers))


def read_joined_table(simulator: Simulator, paths: Sequence[Path]) -> tuple[RunTable, tuple[str, ...]]:
    """Read tables of one system, all with the reading or none; return them joined, and notes on their columns."""
    from probewise.systems import as_recording, concatenate_tables, read_table_for

    tables = []
    for path in paths:
        if is_journal(path):
            raise FileError(path, "a journal", "a CSV table; the journal of an explore run goes with --sensor")
        tables.append(read_table_for(simulator, path))
    with_reading = [path for path, table in zip(paths, tables, strict=True) if simulator.reading in table.columns]
    for path, table in zip(paths, tables, strict=True):
        if with_reading and path not in with_reading:
            header = ", ".join(repr(name) for name in table.columns)
            allowed = f"the reading, as in {with_reading[0].name}; the header has {header}"
            raise FileError(path, f"no column {simulator.reading!r}", allowed)
        if len(paths) > 1:  # after they are joined, a row would be one of no file
            try:
                as_recording(simulator, table)
                table.require_rising_time()
                table.require_moderate_numbers()
            except ParameterError as error:
                raise FileError(path, f"{error.name} is {error.value}", error.allowed) from error
    return concatenate_tables(tables, [path.name for path in paths])


# The journal of an `explore` run as a recording over an unknown shape


def is_journal(path: Path) -> bool:
    """Return whether a path is a journal: whether its name ends in .jsonl."""
    return path.suffix == ".jsonl"


def refuse_journal(path: Path) -> None:
    """Raise FileError for a journal where a plan or recording is needed: the shape below its sensor is unknown."""
    if is_journal(path):
        allowed = f"a plan or recording, CSV; a journal is for: probewise diagnose {path} --sensor S.json --out DIR"
        raise FileError(path, "the journal of a run over a shape that is not known", allowed)


def journal_recording_and_shape(path: Path, sensor: FittedSensor) -> tuple[recordings.Recording, Shape]:
    """Return a journal's readings as a recording by the sensor, and the shape that the run looked for."""
    from probewise.experiment import as_shape, read_journal
    from probewise.scene import SHAPES, Field

    journal = read_journal(path)
    if not journal.entries:
        raise FileError(path, "no reading", "a journal with at least one measurement")
    with _key_errors_of(path, "options", "options as explore writes them"):
        options = journal.settings["options"]
        low, high = options["reading_range"]
        instrumentation = replace(sensor.instrumentation, step=options["step"], min=low, max=high)
    recording = journal.recording(instrumentation=instrumentation)
    allowed = f"shapes as explore has them: {', '.join(SHAPES)}"
    with _key_errors_of(path, "settings", allowed):
        written, size = journal.settings["shape"], journal.settings["field"]
        field = Field(float(size["width_mm"]), float(size["height_mm"]))
    orders = (names for n in range(1, len(SHAPES) + 1) for names in itertools.permutations(SHAPES, n))
    shape = next((shape for names in orders if repr(shape := as_shape(names, field)) == written), None)
    if shape is None:
        raise FileError(path, f"shape {written}", allowed, row=1, column="shape")
    return replace(recording, notes=(*recording.notes, *journal.notes)), shape


@contextlib.contextmanager
def _key_errors_of(path: Path, what: str, allowed: str) -> Iterator[None]:
    """Raise FileError where `what` in the first line of a journal lacks a key or has another value."""
    try:
        yield
    except (KeyError, TypeError, ValueError) as error:
        said = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise FileError(path, f"unusable {what}: {said}", allowed, row=1) from error


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
