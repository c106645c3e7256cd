"""`probewise diagnose --each`: many recordings, of many sensors or days, one by one; one page that sorts them."""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import tempfile
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from probewise._progress import progress_shown
from probewise._signals import reporting_what_is_kept
from probewise._tasks import results_as_tasks_end
from probewise._version import __version__
from probewise._writing import Drawings, StagedFiles, checked_output_directory, staged_output
from probewise.cli._common import error_in_one_line, finish, message_to_resume
from probewise.cli._executor import open_executor
from probewise.errors import ProbewiseError, require
from probewise.recordings.table import csv_text
from probewise.report import each as report

if TYPE_CHECKING:
    from probewise.report.each import DeviceRow

_INPUTS = "inputs.sha256"  # of the recording, its description, sensor and simulator, and the options
Outcome = tuple[str, dict[str, bytes]]
Verb = Callable[[argparse.Namespace], int]


def diagnose_each(arguments: argparse.Namespace, diagnose: Verb) -> int:
    """Diagnose each recording, by the verb `diagnose`, into a folder of its own; write table.csv and a page of all.

    One that cannot be diagnosed is a row of the table; folders that are complete, of the same files and options, stay.
    """
    out = checked_output_directory(arguments.out)
    folders = {name: out / name for name in _device_names(arguments.recordings)}
    files = dict(zip(folders, arguments.recordings, strict=True))
    fingerprints = {name: _fingerprint(arguments, file) for name, file in files.items()}
    left = {name: file for name, file in files.items() if not _is_done(folders[name], fingerprints[name])}
    given = ((name, getattr(arguments, name)) for name in ("sensor", "simulator"))
    options = [word for name, path in given if path is not None for word in (f"--{name}", str(path.absolute()))]
    options += ["--seed", str(arguments.seed), *(["--thorough"] if arguments.thorough else [])]
    refused: dict[str, str] = {}
    words = {name: [str(file.absolute()), *options] for name, file in left.items()}

    def kept() -> str:
        n = sum(_is_done(folders[name], fingerprints[name]) for name in files)
        return message_to_resume(out, n, "recording", arguments, of=len(files))

    with (
        reporting_what_is_kept(kept),
        progress_shown(quiet=arguments.quiet) as progress,
        open_executor(arguments) as executor,
        results_as_tasks_end(partial(_diagnosed, diagnose), words, executor) as ended,
    ):
        progress("diagnosing", len(files) - len(left), len(files))
        for done, (name, (message, results)) in enumerate(ended, start=1):
            if results:
                results[_INPUTS] = fingerprints[name].encode()
                with staged_output(folders[name], outdated=("*.svg", "next*.csv", "next*.json")) as stage:
                    for file, content in results.items():
                        stage.write(file, content)
            if message:
                refused[name] = message
            progress("diagnosing", len(files) - len(left) + done, len(files), name)
    rows = [
        _row(name, folders[name])
        if _is_done(folders[name], fingerprints[name])
        else report.DeviceRow(name, "refused", says=refused[name])
        for name in files
    ]
    drawings = Drawings(out)

    def write_table(stage: StagedFiles) -> None:
        stage.write("table.csv", csv_text(report.columns_of(rows)))

    drawings.write_results(
        write_table,
        {"counts.svg": partial(report.counts_svg, rows)},
        partial(report.page_html, rows, seed=arguments.seed),
        inputs=arguments.recordings,
    )
    return finish(drawings, report.summary(rows), f"seed {arguments.seed}; written to {out}", quiet=arguments.quiet)


def _device_names(files: Sequence[Path]) -> list[str]:
    """Return a name for each file: its own without the ending, with its folder's in front where two are the same."""
    names = [file.stem for file in files]
    names = [
        f"{file.absolute().parent.name}_{name}" if names.count(name) > 1 else name
        for file, name in zip(files, names, strict=True)
    ]
    twice = next((name for name in names if names.count(name) > 1), None)
    require(twice is None, "recordings", twice, "files of different names, which name their folders")
    return names


def _fingerprint(arguments: argparse.Namespace, file: Path) -> str:
    read = (file, file.with_suffix(".json"), arguments.sensor, arguments.simulator)
    digest = hashlib.sha256(f"{__version__} {arguments.seed} {arguments.thorough}".encode())
    for path in read:
        digest.update(path.read_bytes() if path is not None and path.is_file() else b"-")
    return digest.hexdigest()


def _is_done(folder: Path, fingerprint: str) -> bool:
    with contextlib.suppress(OSError):
        return (folder / _INPUTS).read_text() == fingerprint
    return False


def _diagnosed(diagnose: Verb, words: Sequence[str]) -> Outcome:
    """Diagnose one recording in a temporary folder; return a message, "" if all went well, and the files written."""
    from probewise.cli import parser

    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the page of each recording has them
        given = ["diagnose", *words, "--out", folder, "--quiet"]
        arguments = parser(given).parse_args(given)
        arguments.words, message = given, ""
        try:
            diagnose(arguments)
        except (ProbewiseError, OSError) as error:
            message = error_in_one_line(error)
        return message, {
            path.name: path.read_bytes() for path in Path(folder).iterdir() if path.is_file() and path.name[0] != "."
        }


def _row(name: str, folder: Path) -> DeviceRow:
    found = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    named = [effect for effect in found["effects"] if effect["name"] in found["combination"]]
    return report.DeviceRow(
        name,
        found["verdict"],
        " + ".join(found["combination"]) if found["verdict"] not in ("clean", "unknown") else "",
        max((effect["size_lambda"] for effect in named), default=None),
        found["hypotheses"][0]["probability"] if found["hypotheses"] else None,
        found["p_value"],
        found["reason"],
    )
