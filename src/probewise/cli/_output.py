"""Output files: checked before any work, written all or none, without losing any input.

The files of a command are written into a hidden folder inside `--out`. When all are complete, that folder is renamed;
only then are they moved. A process killed before that has changed nothing; after that, the next command with the same
`--out` moves the remaining files first.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from probewise._signals import defer_signals
from probewise.cli._common import print_result
from probewise.cli._stopping import raise_if_stopped, reporting_what_is_kept
from probewise.errors import FileError, ParameterError, ProbewiseError, message_of
from probewise.progress import Progress, silent

_STAGED, _COMPLETE = ".writing", ".complete"
_OUTDATED = ".outdated"  # ends the name of an empty file: the file of that name without it is to be removed
PAGE = "report.html"
_MOST_FAILED = 3  # drawings that a message names
_PATIENCE_S = 600.0  # timeout for another command that is writing its results


class StagedFiles:
    """Files written into an empty directory, `folder`; `kept` has the new path of each input file that they replace."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.kept: dict[Path, Path] = {}

    def __truediv__(self, name: str) -> Path:
        return self.folder / name

    def write(self, name: str, content: str | bytes) -> None:
        """Write a file into the directory: bytes, or a text in UTF-8."""
        from probewise.recordings import write_bytes_atomically, write_text_atomically  # not needed by the help

        if isinstance(content, str):
            write_text_atomically(self / name, content)
        else:
            write_bytes_atomically(self / name, content)

    def write_json(self, name: str, document: object) -> None:
        """Write a document as strict JSON."""
        self.write(name, json.dumps(document, allow_nan=False, indent=1) + "\n")

    @property
    def notes_on_renamed_inputs(self) -> list[str]:
        """A sentence for each input file that a result has replaced."""
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
        """Draw figures, by name, and the page report.html into the directory of results, which are complete there.

        `page` builds the HTML from the figures by name; b"" stands for one that could not be drawn.
        """
        kept = f"the results are in {self.out}, without figures and report"
        drawn: dict[str, bytes] = {}
        every = {**drawers, PAGE: lambda: page(drawn).encode("utf-8", "backslashreplace")}
        with reporting_what_is_kept(lambda: kept, results=True), staged_output(self.out, inputs=inputs) as stage:
            for name, drawer in every.items():
                progress("drawing the report", len(drawn), len(every), name)
                drawn[name] = self.draw(name, drawer)
                if drawn[name]:
                    stage.write(name, drawn[name])

    def write_results(
        self,
        files: Callable[[StagedFiles], None],
        drawers: Mapping[str, Callable[[], bytes]],
        page: Callable[[Mapping[str, bytes]], str],
        *,
        inputs: Sequence[Path] = (),
        outdated: Sequence[str] = (),
        progress: Progress = silent,
    ) -> list[str]:
        """Write the files of a run, all or none, by a function of the `StagedFiles`; then figures and page.

        Files of an earlier run, of the patterns `outdated`, are removed. Return lines on inputs that got another name.
        """
        with staged_output(self.out, inputs=inputs, outdated=(*outdated, *drawers, PAGE)) as stage:
            files(stage)
        self.write_report(drawers, page, inputs=inputs, progress=progress)
        return [f"note: {note}" for note in stage.notes_on_renamed_inputs]

    def finish(self, *lines: str, quiet: bool) -> int:
        """Print lines unless `quiet`; return the exit status, 0. Raises NotDrawnError if something was not drawn."""
        for line in lines:
            print_result(line, quiet=quiet)
        self.raise_if_any_failed()
        return 0

    def raise_if_any_failed(self) -> None:
        """Raise NotDrawnError, in one line, if something could not be drawn."""
        if self._failed:
            first = ", ".join(f"{name} ({error})" for name, error in list(self._failed.items())[:_MOST_FAILED])
            more = len(self._failed) - _MOST_FAILED
            rest = f" and {more} more" if more > 0 else ""
            raise NotDrawnError(f"could not draw {first}{rest}; everything else is complete in {self.out}")


def checked_output_directory(path: Path, *entries: str) -> Path:
    """Check before any work that results can be written there, and return the path.

    `entries` are files and folders of it that the run writes as it goes. Raises ParameterError if a file is in the way,
    FileError if no directory can be made there, or one of the entries is a symbolic link, a device or a pipe.
    """
    if path.exists() and not path.is_dir():
        raise ParameterError("--out", str(path), "a directory, existing or new; this is a file")
    parent = next(p for p in (path, *path.absolute().parents) if p.exists())
    if not parent.is_dir():
        raise ParameterError("--out", str(path), f"a directory; {parent} is a file")
    _require_ordinary(p for entry in entries for p in (path / entry, *path.glob(f"{entry}/*")))
    try:  # permissions are not enough: /proc and read-only mounts cannot be written to
        os.rmdir(tempfile.mkdtemp(prefix=".probewise-", dir=parent))
    except OSError as error:
        raise FileError(path, f"{parent} cannot be written to", "a directory you may write to") from error
    return path


def checked_output_file(path: Path, *inputs: Path) -> Path:
    """Check before any work that a file, device or named pipe can be written there, and return the path.

    Raises ParameterError if it is a directory, an input or below a file, FileError if its directory cannot be written
    to.
    """
    from probewise.recordings.atomic import is_device_or_pipe  # imported here, since the help does not need it

    if path.is_dir():
        raise ParameterError("--out", str(path), "a file name; this is a directory")
    for taken in inputs:
        if path.exists() and taken.exists() and path.samefile(taken):
            raise ParameterError("--out", str(path), f"another file than the input {taken}")
    if not is_device_or_pipe(path):
        checked_output_directory(Path(os.path.realpath(path)).parent)
    return path


def tables_and_descriptions(tables: Sequence[Path]) -> list[Path]:
    """Return each file of a table followed by its description, the JSON beside it."""
    named = [table for table in tables if table.name]  # not "." and "/"
    return [path for table in named for path in (table, table.with_suffix(".json"))]


def inputs_and_filled_in_plan(inputs: Sequence[Path], plan: Path, column: str = "reading") -> list[Path]:
    """List files that results must not replace: inputs, and an earlier advised plan with readings in a column."""
    return tables_and_descriptions([*inputs, *([plan] if holds_readings(plan, column) else [])])


def holds_readings(table: Path, column: str) -> bool:
    """Return whether a table has readings in this column, or cannot be read, so that it must not be replaced."""
    from probewise.recordings.table import read_table  # imported here, since the help does not need it

    if not table.is_file():  # a named pipe would be waited for
        return False
    try:
        rows = read_table(table, wanted=(column,))
    except FileError:
        return True
    return column in rows.columns and any(rows.cells(column))


@contextlib.contextmanager
def staged_output(out: Path, *, inputs: Sequence[Path] = (), outdated: Sequence[str] = ()) -> Iterator[StagedFiles]:
    """Yield an empty directory; move its files into `out`, made if missing, only if the block succeeds.

    One of the `inputs` of this run that a result would replace is copied to another name. Files of an earlier run, of
    the patterns `outdated`, are removed unless this run writes them.

    Raises FileError if `out` cannot be made or written to, another process writes there for too long, a directory has
    the name of a result, or a symbolic link that of a directory of results.
    """
    from probewise.recordings import hold_lock  # imported here, since the help does not need it

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(out, f"cannot be made ({error.strerror})", "a directory you may write to") from error
    folder = out / _STAGED
    with hold_lock(out / "results", patience_s=_PATIENCE_S):
        _move_into_place(out)
        _remove(folder)
        folder.mkdir()
        stage = StagedFiles(folder)
        try:
            yield stage
            raise_if_stopped()
            with defer_signals():
                stage.kept = _complete(out, stage, inputs, outdated)
                os.rename(folder, out / _COMPLETE)
                _move_into_place(out)
        except FileError as error:
            if not Path(error.path).is_relative_to(folder):
                raise
            name = out / Path(error.path).relative_to(folder)
            raise FileError(name, error.found, error.allowed, row=error.row, column=error.column) from error
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def _complete(out: Path, stage: StagedFiles, inputs: Sequence[Path], outdated: Sequence[str]) -> dict[Path, Path]:
    """Add to the results copies of the inputs that they replace, which are returned, and marks of outdated files.

    Raises FileError if a directory has the name of a file, or a symbolic link that of a directory.
    """
    names = _files_in(stage.folder)
    for name in names:
        _require_ordinary((out / name).parents[: name.count("/")])
        if (out / name).is_dir():
            raise FileError(out / name, "a directory of that name is in the way", "another --out, or none there")
    own = {os.path.realpath(path) for path in inputs}  # which, unlike resolve, follows no circle of links
    kept = _new_names_of_kept(out, [name for name in names if os.path.realpath(out / name) in own])
    for name, new in kept.items():
        stage.write(new, (out / name).read_bytes())
        shutil.copystat(out / name, stage / new)
    for path in itertools.chain.from_iterable(out.glob(pattern) for pattern in outdated):
        if os.path.realpath(path) not in own and path.name not in names and not path.is_dir():
            (stage / (path.name + _OUTDATED)).touch()
    return {out / name: out / new for name, new in kept.items()}


def _move_into_place(out: Path) -> None:
    """Move complete results, if there are any, into `out`; a process killed here leaves the rest to the next one.

    A stranger's folder may hold such results too: they can replace files of that folder only.
    """
    complete = out / _COMPLETE
    try:
        for name in [] if complete.is_symlink() else _files_in(complete):
            _require_ordinary((out / name).parents[: name.count("/")])
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            if name.endswith(_OUTDATED):
                (out / name.removesuffix(_OUTDATED)).unlink(missing_ok=True)
            else:
                os.replace(complete / name, out / name)
    except (OSError, RecursionError) as error:
        raise FileError(
            getattr(error, "filename2", None) or getattr(error, "filename", None) or complete,
            f"cannot be replaced ({getattr(error, 'strerror', None) or error})",
            f"a file that no other program holds; the next command with --out {out} puts the rest in place, or remove "
            f"{complete} to drop it",
        ) from error
    _remove(complete)


def _files_in(folder: Path) -> list[str]:
    """List the files in a directory and its directories, by relative name; symbolic links are not followed."""
    files = (Path(at) / name for at, _, names in os.walk(folder) for name in names)
    return sorted(file.relative_to(folder).as_posix() for file in files)


def _require_ordinary(paths: Iterable[Path]) -> None:
    """Raise FileError if one of these is neither a file nor a directory, nor missing."""
    for path in paths:
        link = path.is_symlink()
        if link or (path.exists() and not path.is_file() and not path.is_dir()):
            found = "is a symbolic link, which may lead out of the folder" if link else "is a device or a pipe"
            raise FileError(path, found, "another --out, or an ordinary file or folder there")


def _remove(path: Path) -> None:
    """Remove a directory with its content, or a file or symbolic link, if it is there."""
    try:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    except (OSError, RecursionError) as error:
        raise FileError(path, f"cannot be removed ({getattr(error, 'strerror', None) or error})", "none") from error


def _new_names_of_kept(out: Path, names: Sequence[str]) -> dict[str, str]:
    """Return each file's new name by its old one: the first free of NAME_kept, NAME_kept_2, ... before the suffix.

    Files of one stem get the same ending.
    """
    aside: dict[str, str] = {}
    for stem in dict.fromkeys(name.removesuffix(Path(name).suffix) for name in names):
        suffixes = [name.removeprefix(stem) for name in names if name.removesuffix(Path(name).suffix) == stem]
        endings = itertools.chain(["_kept"], (f"_kept_{k}" for k in itertools.count(2)))
        ending = next(e for e in endings if not any((out / (stem + e + suffix)).exists() for suffix in suffixes))
        aside |= {stem + suffix: stem + ending + suffix for suffix in suffixes}
    return aside
