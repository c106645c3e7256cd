"""Output files: checked before any work, written all or none, without losing any input.

The files of a command are written into a hidden folder inside `--out`. When all are complete, a file `commit.json`
there lists them; only then are they moved. A process killed before that has changed nothing; after that, the next
command with the same `--out` finds the list and moves the remaining files first.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from probewise._signals import defer_signals
from probewise.cli._stopping import raise_if_stopped, reporting_what_is_kept
from probewise.errors import FileError, ParameterError, ProbewiseError, message_of
from probewise.progress import Progress, silent

_FOLDER, _COMMIT = ".writing", "commit.json"
PAGE = "report.html"
_MOST_FAILED = 3  # drawings that a message names
_PATIENCE_S = 600.0  # timeout for another command that is writing its results


class StagedFiles:
    """Files written into an empty directory, and the input files that were renamed to make way for them.

    `staged_output` makes the directory and moves the files.

    Attributes
    ----------
    folder
        The directory.
    kept
        New path, by old path, of each input file that a result would have replaced.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.kept: dict[Path, Path] = {}

    def __truediv__(self, name: str) -> Path:
        return self.folder / name

    def write(self, name: str, content: str | bytes) -> None:
        """Write a file into the directory: bytes, or a text in UTF-8."""
        from probewise.recordings import write_bytes_atomically  # imported here, since the help does not need it

        write_bytes_atomically(self / name, content.encode() if isinstance(content, str) else content)

    def write_json(self, name: str, document: object) -> None:
        """Write a document as strict JSON."""
        self.write(name, json.dumps(document, allow_nan=False, indent=1) + "\n")

    @property
    def notes_on_renamed_inputs(self) -> list[str]:
        """A sentence for each input file that was renamed."""
        return [f"what was {path} is now {now}" for path, now in self.kept.items()]


class NotDrawnError(ProbewiseError):
    """Report figures or pages that could not be drawn, beside results that are complete."""


class Drawings:
    """Figures and pages of a run, drawn after its results were written: if one fails, only that one is missing."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self._failed: dict[str, str] = {}

    def draw(self, name: str, drawer: Callable[[], bytes]) -> bytes:
        """Return what `drawer` returns; b"" if it raises, which `raise_if_any_failed` tells."""
        from probewise.report.plots.canvas import close_opened_figures  # imported here, since the help does not need it

        try:
            content = drawer()
        except Exception as error:  # whatever it is, the results are more than their pictures
            close_opened_figures()
            self._failed[name], content = message_of(error), b""
        raise_if_stopped()  # a signal may have damaged the picture
        return content

    def write_report(
        self,
        drawers: Mapping[str, Callable[[], bytes]],
        page: Callable[[Mapping[str, bytes]], str],
        *,
        inputs: Sequence[Path] = (),
        progress: Progress = silent,
    ) -> None:
        """Draw figures and the page report.html into the directory of results, which are complete there.

        Parameters
        ----------
        drawers
            Functions that draw the figures, by file name.
        page
            Function that builds the HTML from the figures by name; b"" stands for one that could not be drawn.
        inputs
            Input files of this run, which nothing replaces.
        progress
            Told which drawing is being made.
        """
        kept = f"the results are in {self.out}, without figures and report"
        drawn: dict[str, bytes] = {}
        every = {**drawers, PAGE: lambda: page(drawn).encode()}
        with reporting_what_is_kept(lambda: kept, results=True), staged_output(self.out, inputs=inputs) as stage:
            for name, drawer in every.items():
                progress("drawing the report", len(drawn), len(every), name)
                drawn[name] = self.draw(name, drawer)
                if drawn[name]:
                    stage.write(name, drawn[name])

    def raise_if_any_failed(self) -> None:
        """Raise NotDrawnError, in one line, if something could not be drawn."""
        if self._failed:
            first = ", ".join(f"{name} ({error})" for name, error in list(self._failed.items())[:_MOST_FAILED])
            more = len(self._failed) - _MOST_FAILED
            rest = f" and {more} more" if more > 0 else ""
            raise NotDrawnError(f"could not draw {first}{rest}; everything else is complete in {self.out}")


def checked_output_directory(path: Path) -> Path:
    """Check before any work that results can be written there, and return the path.

    Raises ParameterError if a file is in the way, FileError if no directory can be made there.
    """
    if path.exists() and not path.is_dir():
        raise ParameterError("--out", str(path), "a directory, existing or new; this is a file")
    parent = next(p for p in (path, *path.absolute().parents) if p.exists())
    if not parent.is_dir():
        raise ParameterError("--out", str(path), f"a directory; {parent} is a file")
    try:  # permissions are not enough: /proc and read-only mounts cannot be written to
        os.rmdir(tempfile.mkdtemp(prefix=".probewise-", dir=parent))
    except OSError as error:
        raise FileError(path, f"{parent} cannot be written to", "a directory you may write to") from error
    return path


def checked_output_file(path: Path, *inputs: Path) -> Path:
    """Check before any work that a file can be written there, and return the path.

    Raises ParameterError if it is a directory, an input or below a file, FileError if its directory cannot be written
    to.
    """
    if path.is_dir():
        raise ParameterError("--out", str(path), "a file name; this is a directory")
    for taken in inputs:
        if path.exists() and taken.exists() and path.samefile(taken):
            raise ParameterError("--out", str(path), f"another file than the input {taken}")
    checked_output_directory(path.parent)
    return path


def tables_and_descriptions(tables: Sequence[Path]) -> list[Path]:
    """Return each file of a table followed by its description, the JSON beside it."""
    named = [table for table in tables if table.name]  # not "." and "/"
    return [path for table in named for path in (table, table.with_suffix(".json"))]


def holds_readings(table: Path, column: str) -> bool:
    """Return whether a table has readings in this column, or cannot be read, so that it must not be replaced."""
    from probewise.recordings.table import read_table  # imported here, since the help does not need it

    try:
        rows = read_table(table, wanted=(column,))
    except FileError:
        return table.is_file()
    return column in rows.columns and any(rows.cells(column))


@contextlib.contextmanager
def staged_output(out: Path, *, inputs: Sequence[Path] = (), outdated: Sequence[str] = ()) -> Iterator[StagedFiles]:
    """Yield an empty directory; move its files into `out` only if the block succeeds.

    An error or a signal before that leaves `out` as it was.

    Parameters
    ----------
    out
        Where the results go; made if missing.
    inputs
        Input files of this run: one that a result would replace is renamed.
    outdated
        Patterns of an earlier run's files in `out`, which are removed unless this run writes them.

    Raises
    ------
    FileError
        If `out` cannot be made or written to, another process writes there for too long, or a directory has the name of
        a result.
    """
    from probewise.recordings import hold_lock, write_text_atomically  # imported here, since the help does not need it

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(out, f"cannot be made ({error.strerror})", "a directory you may write to") from error
    folder = out / _FOLDER
    with hold_lock(out / "results", patience_s=_PATIENCE_S):
        try:
            _finish_interrupted_commit(out)
            folder.mkdir()
            stage = StagedFiles(folder)
            yield stage
            raise_if_stopped()
            with defer_signals():
                commit = _planned_commit(out, folder, inputs, outdated)
                stage.kept = {out / name: out / kept for name, kept in commit.aside.items()}
                write_text_atomically(folder / _COMMIT, json.dumps(asdict(commit)))
                _finish_interrupted_commit(out)
        except FileError as error:
            if not Path(error.path).is_relative_to(folder):
                raise
            name = out / Path(error.path).relative_to(folder)
            raise FileError(name, error.found, error.allowed, row=error.row, column=error.column) from error
        finally:
            if not (folder / _COMMIT).exists():
                shutil.rmtree(folder, ignore_errors=True)


@dataclass(frozen=True)
class _Commit:
    """Changes to make in `out`, by relative names: rename `aside` (old to new), move `names` in, delete `remove`."""

    names: Sequence[str]
    aside: Mapping[str, str]
    remove: Sequence[str]


def _planned_commit(out: Path, folder: Path, inputs: Sequence[Path], outdated: Sequence[str]) -> _Commit:
    """Return the changes that move the files of `folder` into `out`, spare the inputs and remove outdated files.

    Raises FileError if a directory has the name of a file.
    """
    names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    for name in names:
        if (out / name).is_dir():
            raise FileError(out / name, "a directory of that name is in the way", "another --out, or none there")
    own = {path.resolve() for path in inputs}
    aside = _new_names_of_kept(out, [name for name in names if (out / name).resolve() in own])
    old = itertools.chain.from_iterable(out.glob(pattern) for pattern in outdated)
    gone = [path.relative_to(out).as_posix() for path in old if path.resolve() not in own]
    return _Commit(names, aside, [name for name in gone if name not in names])


def _finish_interrupted_commit(out: Path) -> None:
    """Complete the changes of an interrupted commit in `out`; discard incomplete results.

    Every step is idempotent, so that it does not matter where the earlier process was killed.
    """
    folder = out / _FOLDER
    if not folder.exists():
        return
    if (folder / _COMMIT).exists():
        try:
            _apply_commit(out, folder, _Commit(**json.loads((folder / _COMMIT).read_text(encoding="utf-8"))))
        except OSError as error:
            raise FileError(
                error.filename2 or error.filename,
                f"cannot be replaced ({error.strerror})",
                f"a file that no other program holds; the next command with --out {out} puts the rest in place",
            ) from error
        (folder / _COMMIT).unlink()
    shutil.rmtree(folder)


def _apply_commit(out: Path, folder: Path, commit: _Commit) -> None:
    """Make the changes of a commit; those already made are skipped."""
    for name in commit.names:
        new, target = folder / name, out / name
        if not new.exists():
            continue
        if name in commit.aside and target.exists() and not (out / commit.aside[name]).exists():
            os.replace(target, out / commit.aside[name])
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(new, target)
    for name in commit.remove:
        (out / name).unlink(missing_ok=True)


def _new_names_of_kept(out: Path, names: Sequence[str]) -> dict[str, str]:
    """Return each file's new name by its old one: the first free of NAME_kept, NAME_kept_2, ... before the suffix.

    Files of one stem get the same ending.
    """
    aside: dict[str, str] = {}
    for stem in dict.fromkeys(Path(name).with_suffix("") for name in names):
        group = [Path(name) for name in names if Path(name).with_suffix("") == stem]
        endings = itertools.chain(["_kept"], (f"_kept_{k}" for k in itertools.count(2)))
        ending = next(e for e in endings if not any((out / _with_stem_ending(path, e)).exists() for path in group))
        aside |= {path.as_posix(): _with_stem_ending(path, ending).as_posix() for path in group}
    return aside


def _with_stem_ending(path: Path, ending: str) -> Path:
    return path.with_name(f"{path.stem}{ending}{path.suffix}")
