"""`probewise diagnose`: which physics a sensor model, or a user's simulator, leaves out.

With --each many recordings, of many sensors or days, are diagnosed one by one; one page sorts them.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import tempfile
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probewise import diagnosis as engine
from probewise._signals import reporting_what_is_kept
from probewise._tasks import results_as_tasks_end
from probewise._version import __version__
from probewise._writing import PAGE, Drawings, Output, checked_output_directory, require_ordinary
from probewise.calibration import read_sensor
from probewise.cli._common import CommandError, error_in_one_line, finish, message_to_resume, progress_of
from probewise.cli._executor import open_executor
from probewise.cli._inputs import (
    find_journal_sensor_file,
    is_journal,
    journal_recording_and_shape,
    open_simulator,
    read_joined_table,
    tables_and_descriptions,
)
from probewise.cli._options import parser, refuse_options
from probewise.errors import ParameterError, PipeWarning, ProbewiseError, require
from probewise.progress import Progress
from probewise.recordings import Recording, read_recording
from probewise.recordings.table import csv_text

if TYPE_CHECKING:
    from probewise.calibration import FittedSensor
    from probewise.report.each import DeviceRow
    from probewise.scene import Shape

_INPUTS = "inputs.sha256"  # of the recording, its description, sensor and simulator, and the options


def run(arguments: argparse.Namespace) -> int:
    """Diagnose; write diagnosis.json, both models, the next plan, report and figures; return the exit status."""
    from probewise.report.diagnosis import output_of

    if arguments.each:
        return _diagnose_each(arguments)
    of_simulator = arguments.simulator is not None and arguments.scheduler is None
    if of_simulator:
        refuse_options(arguments, "--simulator, which replaces it", "sensor")
    elif arguments.workers > 1 or arguments.scheduler is not None:
        raise CommandError("--workers and --scheduler are for --each, which diagnoses several recordings one by one")
    drawings = Drawings(checked_output_directory(arguments.out, main="diagnosis.json"))
    source = ", ".join(path.name for path in arguments.recordings)
    rng, nested_rng, _ = engine.generators_of_diagnosis(arguments.seed)
    with contextlib.ExitStack() as stack:
        simulator = stack.enter_context(open_simulator(arguments)) if of_simulator else None
        progress = stack.enter_context(progress_of(arguments))
        weigh_again = partial(engine.weigh_thoroughly, rng=nested_rng, progress=progress)
        options: dict[str, Any] = {"thorough": weigh_again if arguments.thorough else None, "rng": rng}
        if simulator is not None:
            table, said = read_joined_table(simulator, arguments.recordings)
            diagnosis = engine.diagnose_system(
                simulator, table, source=source, notes=said, progress=progress, **options
            )
            notes = (*diagnosis.recording.notes, *engine.notes_on_calls(diagnosis))
            read = [*arguments.recordings, arguments.simulator]
        else:
            recordings, sensor, shape = _read_inputs(arguments, progress=progress)
            joined = engine.join(recordings)
            null = None
            if sensor is not None and shape is not None:
                progress("searching for shapes that fit")
                null = engine.SensorAndShape.of(sensor, shape, joined, rng=rng)
            given = sensor if null is None else None
            diagnosis = engine.diagnose(joined, sensor=given, null=null, progress=progress, **options)
            if null is not None:
                diagnosis = diagnosis.with_shape_in_next_plan(null.shape)
            notes = joined.notes
            read = [*arguments.recordings, *([] if arguments.sensor is None else [arguments.sensor])]
        made = output_of(diagnosis, seed=arguments.seed, source=source)
        drawings.write_results(made, inputs=tables_and_descriptions(read), progress=progress)
    summary = f"{diagnosis.summary()}\nseed {arguments.seed}; written to {drawings.out}"
    return finish(arguments, drawings, *(f"note: {n}" for n in notes), summary)


def _read_inputs(
    arguments: argparse.Namespace, *, progress: Progress
) -> tuple[list[Recording], FittedSensor | None, Shape | None]:
    """Return the recordings, the sensor or None, and the shape that a journal's run looked for (None: no journal).

    Without --sensor, that of the journal's run is read, and `arguments.sensor` is set to its file.
    """
    journals = [path for path in arguments.recordings if is_journal(path)]
    if arguments.sensor is None and journals:
        arguments.sensor = find_journal_sensor_file(journals[0])
    if arguments.sensor is not None and len(journals) > 1:
        raise ParameterError("journals", len(journals), "one at a time: each run has its own unknown shape")
    sensor = None if arguments.sensor is None else read_sensor(arguments.sensor)
    recordings, shape = [], None
    for path in arguments.recordings:
        if sensor is not None and path in journals:
            recording, shape = journal_recording_and_shape(path, sensor)
        else:
            recording = read_recording(path, progress=progress)
        recordings.append(recording)
    return recordings, sensor, shape


# --each


def _diagnose_each(arguments: argparse.Namespace) -> int:
    """Diagnose each recording into a folder of its own; write table.csv and a page of all.

    One that cannot be diagnosed is a row of the table; folders that are complete, of the same files and options, stay.
    """
    from probewise.report import each as report

    files = dict(zip(_device_names(arguments.recordings), arguments.recordings, strict=True))
    out = checked_output_directory(arguments.out, main="counts.svg")
    for name in files:
        require_ordinary([out / name])
        checked_output_directory(out / name, main="diagnosis.json")
    fingerprints = {name: _fingerprint(arguments, file) for name, file in files.items()}

    def row_if_done(name: str) -> DeviceRow | None:
        with contextlib.suppress(OSError, ValueError, LookupError, TypeError):  # a damaged diagnosis is made again
            if (out / name / _INPUTS).read_text() == fingerprints[name]:
                return _row(name, out / name)
        return None

    given = [(name, getattr(arguments, name)) for name in ("sensor", "simulator")]
    options = [word for name, path in given if path is not None for word in (f"--{name}", str(path.absolute()))]
    options += ["--seed", str(arguments.seed), *(["--thorough"] if arguments.thorough else [])]
    words = {name: [str(file.absolute()), *options] for name, file in files.items() if row_if_done(name) is None}
    read = [*arguments.recordings, *(path for _, path in given if path is not None)]
    n_before, refused, notes = len(files) - len(words), dict[str, str](), list[str]()

    def n_done() -> int:
        return sum(row_if_done(name) is not None for name in files)

    kept = partial(message_to_resume, out, n_done, "recording", arguments, of=len(files))
    with (
        reporting_what_is_kept(kept, results=True),
        progress_of(arguments) as progress,
        open_executor(arguments) as executor,
        results_as_tasks_end(_diagnosed, words, executor) as ended,
    ):
        progress("diagnosing", n_before, len(files))
        for done, (name, (message, results)) in enumerate(ended, start=n_before + 1):
            if results:
                results[_INPUTS] = fingerprints[name].encode()
                drawings = Drawings(out / name)
                with drawings.staged("diagnosis.json", inputs=tables_and_descriptions(read), adds=False) as stage:
                    for file, content in results.items():
                        stage.write(file, content)
                notes += drawings.notes
            if message:
                refused[name] = message
            progress("diagnosing", done, len(files), name)
    rows = [row_if_done(name) or report.DeviceRow(name, "refused", says=refused[name]) for name in files]
    drawings = Drawings(out)
    made = Output(
        lambda stage: stage.write("table.csv", csv_text(report.columns_of(rows))),
        {"counts.svg": partial(report.counts_svg, rows)},
        partial(report.page_html, rows, seed=arguments.seed),
        main="counts.svg",
    )
    drawings.write_results(made, inputs=arguments.recordings)
    return finish(arguments, drawings, *notes, report.summary(rows), f"seed {arguments.seed}; written to {out}")


def _device_names(files: Sequence[Path]) -> list[str]:
    """Return a name for each file: its own without the ending, with its folder's in front where two are the same."""
    names = [file.stem for file in files]
    names = [
        f"{file.absolute().parent.name}_{name}" if names.count(name) > 1 else name
        for file, name in zip(files, names, strict=True)
    ]
    twice = next((name for name in names if names.count(name) > 1), None)
    require(twice is None, "recordings", twice, "files of different names, which name their folders")
    taken = next((name for name in names if name in ("table.csv", "counts.svg", PAGE) or name.startswith(".")), None)
    require(taken is None, "recordings", taken, "another name of that file, which names its folder")
    return names


def _fingerprint(arguments: argparse.Namespace, file: Path) -> str:
    digest = hashlib.sha256(f"{__version__} {arguments.seed} {arguments.thorough}".encode())
    for path in (file, file.with_suffix(".json"), arguments.sensor, arguments.simulator):
        digest.update(path.read_bytes() if path is not None and path.is_file() else b"-")
    return digest.hexdigest()


def _diagnosed(words: Sequence[str]) -> tuple[str, dict[str, bytes]]:
    """Diagnose one recording in a temporary folder; return a message, "" if all went well, and the files written."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the page of each recording has them
        warnings.simplefilter("default", PipeWarning)  # who waits for a pipe should know it
        given = ["diagnose", *words, "--out", folder, "--quiet"]
        arguments = parser().parse_args(given)
        arguments.words, message = given, ""
        try:
            run(arguments)
        except (ProbewiseError, OSError) as error:
            message = error_in_one_line(error)
        return message, {
            path.name: path.read_bytes() for path in Path(folder).iterdir() if path.is_file() and path.name[0] != "."
        }


def _row(name: str, folder: Path) -> DeviceRow:
    from probewise.report.each import DeviceRow

    found = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    named = [effect for effect in found["effects"] if effect["name"] in found["combination"]]
    return DeviceRow(
        name,
        found["verdict"],
        " + ".join(found["combination"]) if found["verdict"] not in ("clean", "unknown") else "",
        max((effect["size_lambda"] for effect in named), default=None),
        found["hypotheses"][0]["probability"] if found["hypotheses"] else None,
        found["p_value"],
        found["reason"],
    )
