"""What a command writes: files whole or not at all, results all or none, without losing an input; drawings last.

The results of a command are written into a hidden folder inside `--out`, with a list of their names and digests. When
all are complete, that folder is renamed; only then are they moved. A process killed before that has changed nothing;
after that, the next command with the same `--out` moves the remaining files first. What stands in `--out` as the list
of the same kind of results there has it is an earlier result and is replaced or removed; any other file is a person's.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import itertools
import os
import shutil
import stat
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from io import FileIO
from pathlib import Path
from typing import NamedTuple

from probewise._signals import defer_signals, raise_if_stopped, reporting_what_is_kept
from probewise.errors import FileError, NotDrawnError, ParameterError, message_of, require
from probewise.progress import Progress, silent

PAGE = "report.html"
_HIDDEN = ".probewise-"  # no person's folder has such a name
_STAGED, _COMPLETE = f"{_HIDDEN}writing", f"{_HIDDEN}complete"
_LIST, _BEFORE = f"{_HIDDEN}written", f"{_HIDDEN}before"  # {name: SHA-256} of files, in JSON
_KEPT = "_kept"  # ends the name, without its ending, of a person's file that a result would have replaced
_MOST_FAILED = 3  # drawings that a message names
_MAIN_FILES = {
    "diagnosis.json": "a diagnosis", "fit.json": "a fit", "audit.json": "an audit", "result.json": "a search",
    "answers.json": "a demo", "trials.jsonl": "a study", "concealed.jsonl": "a study", "cases.jsonl": "a challenge",
    "counts.svg": "diagnoses of several recordings",
}  # fmt: skip
_WRITABLE = "a file in an existing, writable folder, on a disk with room"
_PATIENCE_S = 600.0  # timeout for another command that is writing its results
_NO_LOCKS = "flock not supported"  # newer versions of the library warn so, and make a file that a killed process leaves


def is_device_or_pipe(path: Path) -> bool:
    """Return whether something is at `path`, or where a symbolic link leads, that is neither a file nor a folder."""
    return path.exists() and not path.is_file() and not path.is_dir()


def write_bytes_atomically(path: str | os.PathLike[str], content: bytes, *, named: bool = True) -> None:
    """Replace the file at `path` by `content` atomically; its permissions stay.

    The bytes are written to a temporary file in the same folder and synced to disk; then it is renamed. Temporary files
    that killed processes left are removed. If a person has `named` this very file, a symbolic link is followed, and a
    device or a named pipe is written to; one that stands where a further file goes is replaced. FileError if the folder
    does not exist or cannot be written to, `path` is a folder, or the disk is full.
    """
    path = Path(path)
    with _errors_of(path), contextlib.ExitStack() as stack:
        if named and is_device_or_pipe(path):
            _write_all(stack.enter_context(open(path, "wb", buffering=0)), content)
            return
        target = Path(os.path.realpath(path)) if named else path
        for left in target.parent.glob(f".{glob.escape(target.name)}.{'[0-9a-f]' * 8}.part"):
            with contextlib.suppress(OSError), contextlib.ExitStack() as opened:
                if left.is_file():  # a pipe would be waited for
                    _lock(opened.enter_context(open(left, "rb")).fileno())
                left.unlink()
        temporary = target.with_name(f".{target.name}.{os.urandom(4).hex()}.part")
        stack.enter_context(defer_signals())
        with open(temporary, "xb", buffering=0) as file:
            stack.callback(temporary.unlink, missing_ok=True)
            with contextlib.suppress(OSError):  # where files cannot be locked, nobody removes it
                _lock(file.fileno())
            write_and_sync(file, path, content)
        if target.is_file() and not target.is_symlink():
            os.chmod(temporary, stat.S_IMODE(target.stat().st_mode))
        os.replace(temporary, target)


def write_text_atomically(path: str | os.PathLike[str], text: str, *, named: bool = True) -> None:
    """Replace the file at `path` by `text` in UTF-8, as `write_bytes_atomically` does, with line ends unchanged.

    Bytes of a file's name that are no UTF-8, which Python reads as lone surrogates, are written as escapes.
    """
    write_bytes_atomically(path, text.encode("utf-8", "backslashreplace"), named=named)


def write_and_sync(file: FileIO, path: Path, content: bytes) -> None:
    """Write all of `content` to an open, unbuffered file and sync it to disk; FileError, of `path`, if that fails."""
    with _errors_of(path):
        _write_all(file, content)
        os.fsync(file.fileno())


def _write_all(file: FileIO, content: bytes) -> None:
    left_over = memoryview(content)
    while left_over:
        left_over = left_over[file.write(left_over) :]


def _lock(handle: int) -> None:
    """Lock an open file until it is closed; raise OSError if another process has a lock on it, or without locks."""
    if sys.platform != "win32":  # where nobody can remove an open file
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextlib.contextmanager
def _errors_of(path: Path, done: str = "written", allowed: str = _WRITABLE) -> Iterator[None]:
    """Report in words that a path cannot be `done` something to."""
    try:
        yield
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(path, f"cannot be {done} ({getattr(error, 'strerror', None) or error})", allowed) from error


@contextlib.contextmanager
def hold_lock(path: str | os.PathLike[str], *, patience_s: float = 0.0) -> Iterator[None]:
    """Hold an exclusive lock on a file or folder, which ends with the process, by way of a file .NAME.lock beside it.

    The empty lock file stays, since another process may wait for it. `path` need not exist, but its folder must.
    FileError if another process holds the lock for longer than `patience_s`, the lock file is a symbolic link or cannot
    be written, or the file system has no locks.
    """
    from filelock import FileLock, Timeout  # not needed by the help

    path = Path(path)
    file = path.with_name(f".{path.name}.lock")
    if not path.parent.is_dir():  # the library would make it
        raise FileError(path, "cannot be written (no such folder)", _WRITABLE)
    lock = FileLock(file, timeout=patience_s, thread_local=False)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", _NO_LOCKS)
            lock.acquire()
    except (OSError, RuntimeError, UserWarning) as error:
        within_process = isinstance(error, RuntimeError) and not isinstance(error, NotImplementedError)
        if isinstance(error, Timeout) or within_process:
            raise FileError(path, "another process is writing to it", "one process at a time") from error
        found = "is a symbolic link" if file.is_symlink() else getattr(error, "strerror", None) or error
        allowed = "none, or an ordinary file, where files can be locked"
        raise FileError(file, f"cannot be locked ({found})", allowed) from error
    try:
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def hold_lock_as_read(path: Path, read: bytes) -> Iterator[None]:
    """Hold the lock of a file that is to be continued, whose content was `read` before it was parsed, b"" if missing.

    FileError as `hold_lock` raises it, or if another process has written to the file since.
    """
    with hold_lock(path):
        if content_if_there(path) != read:
            raise FileError(path, "another process has written to it", "to resume it once more")
        yield


def content_if_there(path: Path) -> bytes:
    """Return the content of a file; b"" if it is missing."""
    return path.read_bytes() if path.exists() else b""


def checked_output_directory(path: Path, *entries: str, main: str = "", option: str = "--out") -> Path:
    """Check before any work that results can be written there, and return the path, which an `option` has given.

    `entries` are files and folders of it that the run writes as it goes, `main` the file by which its results are
    known. ParameterError if a file is in the way, or results of another verb; FileError if no directory can be made
    there, or an entry is a symbolic link, a device or a pipe.
    """
    for name, results in _MAIN_FILES.items():
        if main not in ("", name) and os.path.exists(path / name):
            allowed = f"another folder: this one holds {results} ({name}), with which these results would mix"
            raise ParameterError(option, str(path), allowed)
    _require_short_name(path)
    with _errors_of(path, allowed="an existing current folder, or a path that begins with /"):
        nearest = next(p for p in (path, *path.absolute().parents) if os.path.lexists(p))
    if not nearest.is_dir():
        what = "is no directory" if nearest.is_symlink() else "is a file"
        here = "this" if nearest == path else nearest
        raise ParameterError(option, str(path), f"a directory, existing or new; {here} {what}")
    require_ordinary(p for entry in entries for p in (path / entry, *path.glob(f"{entry}/*")))
    import tempfile  # here, as help needs none

    try:  # permissions are not enough: /proc and read-only mounts cannot be written to
        os.rmdir(tempfile.mkdtemp(prefix=_HIDDEN, dir=nearest))
    except OSError as error:
        raise FileError(path, f"{nearest} cannot be written to", "a directory you may write to") from error
    return path


def _require_short_name(path: Path) -> None:
    """Raise FileError if a path, or a name in it, is too long: before any work, since it just seems not to exist."""
    for name in (str(path), *path.parts):
        try:
            os.lstat(name)
        except OSError as error:
            if error.errno == errno.ENAMETOOLONG:
                raise FileError(path, "cannot be written (a name is too long)", "shorter names") from error


def checked_output_file(path: Path, *inputs: Path | None, option: str = "--out") -> Path:
    """Check before any work that a file, device or named pipe, given by an `option`, can be written; return the path.

    ParameterError for a directory, an input or a path below a file, FileError if its directory cannot be written to.
    """
    _require_short_name(path)
    require(not path.is_dir(), option, str(path), "a file name; this is a directory")
    for taken in filter(None, inputs):
        same = os.path.realpath(path) == os.path.realpath(taken)
        if same or (path.exists() and taken.exists() and path.samefile(taken)):
            raise ParameterError(option, str(path), f"another file than the input {taken}")
    if path.exists() and not os.access(path, os.W_OK):
        raise FileError(path, "is write-protected", "a file that you may write to, or a new one")
    if not is_device_or_pipe(path):
        checked_output_directory(Path(os.path.realpath(path)).parent, option=option)
    return path


class StagedFiles:
    """Files written into an empty directory, `folder`, and what they replace where they are moved.

    `kept` has the new path of each file that stood in the way; `replaces` is True if earlier results are replaced.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.replaces = folder, False
        self.kept: dict[Path, Path] = {}

    def __truediv__(self, name: str) -> Path:
        return self.folder / name

    def write(self, name: str, content: str | bytes) -> None:
        """Write a file into the directory, or a folder of it: bytes, or a text in UTF-8."""
        content = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
        (self / name).parent.mkdir(exist_ok=True)
        write_bytes_atomically(self / name, content)

    def write_json(self, name: str, document: object) -> None:
        """Write a document as strict JSON."""
        import json  # here, as help needs none

        self.write(name, json.dumps(document, allow_nan=False, indent=1) + "\n")


@contextlib.contextmanager
def staged_output(
    out: Path, main: str = "", *, inputs: Sequence[Path] = (), adds: bool = False
) -> Iterator[StagedFiles]:
    """Yield an empty directory; move its files into `out`, made if missing, only if the block succeeds.

    Earlier results, which the list in `out` of runs with the file `main` names and nobody has changed, are replaced, or
    removed unless this run `adds` to them. Whatever else is in the way gets another name, as do the `inputs` of this
    run, and with it an earlier result of that name with another ending: the description of a table. FileError if `out`
    cannot be made or written to, another process writes there for too long, a directory has the name of a result, or a
    file or symbolic link that of a directory.
    """
    folder = out / _STAGED
    with _errors_of(out, "made", "a directory you may write to"):
        out.mkdir(parents=True, exist_ok=True)
    with hold_lock(out / "results", patience_s=_PATIENCE_S):
        stage, inside = StagedFiles(folder), Path(os.path.realpath(out))
        for path in map(Path, map(os.path.realpath, inputs)):
            if inside in path.parents and path.relative_to(inside).parts[0].startswith(_HIDDEN):
                raise FileError(path, "an input has a name that results need", "another folder for the results")
        stage.kept |= _move_into_place(out)
        _remove(folder)
        folder.mkdir()
        try:
            yield stage
            raise_if_stopped()
            with defer_signals():
                _complete(out, stage, f"{_LIST}-{main}" if main else _LIST, inputs, adds=adds)
                os.rename(folder, out / _COMPLETE)
                stage.kept |= _move_into_place(out)
        except FileError as error:
            if not Path(error.path).is_relative_to(folder):
                raise
            name = out / Path(error.path).relative_to(folder)
            raise FileError(name, error.found, error.allowed, row=error.row, column=error.column) from error
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def _complete(out: Path, stage: StagedFiles, written: str, inputs: Iterable[Path], *, adds: bool) -> None:
    """Add to the results their list, `written`, and what it was before in `out`, but for `inputs`."""
    names, listed, inside = _files_in(stage.folder), _listed(out / written), Path(os.path.realpath(out))
    for name in (*names, written):
        _require_place(out, name)
    read = {os.path.realpath(path) for path in inputs}
    before = {name: digest for name, digest in listed.items() if str(inside / name) not in read}
    after = (before if adds else {}) | {name: _digest(stage.folder, name) for name in names}
    replaced = (name for name, digest in before.items() if after.get(name) != digest)
    stage.replaces = any(_digest(out, name) == before[name] for name in replaced)
    stage.write_json(_BEFORE, before)
    stage.write_json(written, after)


def _move_into_place(out: Path) -> dict[Path, Path]:
    """Move complete results, if there are any, into `out`; return the new path of each file that was in the way.

    A process killed here leaves the rest to the next one. A stranger's folder may hold such results and lists too:
    they can replace files of that folder only.
    """
    complete = out / _COMPLETE
    cure = f"the next results written to {out} put the rest in place first, or remove {complete} to drop it"
    with _errors_of(complete, "moved", f"files in few folders; {cure}"):
        names = [] if complete.is_symlink() else _files_in(complete)
    for name in names:
        _require_place(out, name)
    results = [name for name in names if not name.startswith((_BEFORE, _LIST))]
    written = next((name for name in names if name.startswith(_LIST)), "")  # moved last
    before, after = (_listed(complete / name) if written else {} for name in (_BEFORE, written))
    outdated = before.keys() - after.keys()
    # A table and its description, of the same name but for the ending, stay together.
    stems = {os.path.splitext(name)[0] for name in {*results, *outdated}}
    standing = [n for n in {*before, *results} if os.path.splitext(n)[0] in stems and os.path.lexists(out / n)]
    unchanged = {name for name in standing if _digest(out, name) in (before.get(name), after.get(name))}
    of_person = {os.path.splitext(name)[0] for name in standing if name not in unchanged}
    named = {name for name in standing if os.path.splitext(name)[0] in of_person}
    in_the_way = [out / name for name in reversed(results) if name in named]  # .json before .csv, in case it is killed
    for ending in itertools.chain([_KEPT], (f"{_KEPT}_{k}" for k in itertools.count(2))):
        kept = {path: path.with_stem(path.stem + ending) for path in in_the_way}
        if not any(map(os.path.lexists, kept.values())):
            break
    for name in (unchanged & outdated) - named:
        (out / name).unlink()
    moved = [*results, *[written] * bool(written)]
    for path, new in (kept | {complete / name: out / name for name in moved}).items():
        with _errors_of(new, "replaced", f"a file that no other program holds; {cure}"):
            new.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, new)
    _remove(complete)
    return kept


def _require_place(out: Path, name: str) -> None:
    """Raise FileError if a directory has the name of a result, or anything else that of its directory."""
    path = out / name
    folders = path.parents[: name.count("/")]
    require_ordinary(folders)
    if path.is_dir() and not path.is_symlink():
        raise FileError(path, "a directory of that name is in the way", "another folder, or none there")
    for folder in filter(Path.is_file, folders):
        raise FileError(folder, "a file of that name is in the way", "another folder, or none there")


def _listed(file: Path) -> dict[str, str]:
    """Read a list of files that were written into a folder; it is empty if there is none, or it is damaged."""
    import json  # here, as help needs none

    with contextlib.suppress(OSError, ValueError, AttributeError, RecursionError):
        listed = json.loads(file.read_bytes() if file.is_file() and not file.is_symlink() else b"{}").items()
        return {name: digest for name, digest in listed if digest and isinstance(digest, str)}
    return {}


def _digest(folder: Path, name: str) -> str:
    """Return the SHA-256 of a file in a folder; "" if it is none, is out of the folder or behind a link."""
    import hashlib  # here, as help needs none

    with contextlib.suppress(OSError, ValueError):  # of a name that no file has
        inside = Path(os.path.realpath(folder))
        path = inside / name
        if inside in path.parents and os.path.realpath(path) == str(path) and path.is_file():
            with open(path, "rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
    return ""


def _files_in(folder: Path) -> list[str]:
    """List the files in a directory and its directories, by relative name; symbolic links are not followed."""
    files = (Path(at) / name for at, _, names in os.walk(folder) for name in names)
    return sorted(file.relative_to(folder).as_posix() for file in files)


def require_ordinary(paths: Iterable[Path]) -> None:
    """Raise FileError if one of these is neither a file nor a directory, nor missing."""
    for path in paths:
        if path.is_symlink() or is_device_or_pipe(path):
            link = path.is_symlink()
            found = "is a symbolic link, which may lead out of the folder" if link else "is a device or a pipe"
            raise FileError(path, found, "another folder, or an ordinary file or folder there")


def _remove(path: Path) -> None:
    """Remove a directory with its content, or a file or symbolic link, if it is there."""
    with _errors_of(path, "removed", "none"):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


class Output(NamedTuple):
    """What is written of a run: files by `files`, figures by name of file, and a page of the drawn figures.

    `main` is the file by which results of its kind are known; "": there is none.
    """

    files: Callable[[StagedFiles], None]
    drawers: Mapping[str, Callable[[], bytes]]
    page: Callable[[Mapping[str, bytes]], str]
    main: str = ""


class Drawings:
    """Figures and pages of a run, drawn after its results were written: if one fails, only that one is missing.

    `notes` are lines to print, on files that got another name, and on results that were replaced.
    """

    def __init__(self, out: Path) -> None:
        self.out, self.notes = out, list[str]()
        self._failed: dict[str, str] = {}

    def draw(self, name: str, drawer: Callable[[], bytes]) -> bytes:
        """Return what `drawer` returns; b"" if it raises, which `raise_if_any_failed` tells."""
        try:
            content = drawer()
        except Exception as error:  # whatever it is, the results are more than their pictures
            from matplotlib import pyplot

            pyplot.close("all")  # those that the drawer has opened
            self._failed[name], content = message_of(error), b""
        raise_if_stopped()  # a signal may have damaged the picture
        return content

    @contextlib.contextmanager
    def staged(self, main: str, *, inputs: Sequence[Path] = (), adds: bool = True) -> Iterator[StagedFiles]:
        """Stage files as `staged_output` does; note what got another name."""
        with staged_output(self.out, main, inputs=inputs, adds=adds) as stage:
            yield stage
        self.notes += [f"note: what was {path} is now {now}" for path, now in stage.kept.items()]

    def write_results(
        self, made: Output, *, inputs: Sequence[Path] = (), adds: bool = False, progress: Progress = silent
    ) -> None:
        """Write the files of a run, all or none, then its figures and its page; `adds` is that of `staged_output`.

        NotDrawnError if figures and page cannot be written; those that cannot be drawn are b"" for the page, and told
        by `raise_if_any_failed`.
        """
        progress("writing the results")
        with self.staged(made.main, inputs=inputs, adds=adds) as stage:
            made.files(stage)
        self.notes += ["note: the results of an earlier run there were replaced"] * stage.replaces
        kept = f"the results are in {self.out}, without figures and report"
        drawn: dict[str, bytes] = {}
        every = {**made.drawers, PAGE: lambda: made.page(drawn).encode("utf-8", "backslashreplace")}
        try:
            with reporting_what_is_kept(lambda: kept), self.staged(made.main, inputs=inputs) as stage:
                for name, drawer in every.items():
                    progress("drawing the report", len(drawn), len(every), name)
                    drawn[name] = self.draw(name, drawer)
                    if drawn[name]:
                        stage.write(name, drawn[name])
        except FileError as error:  # such as a full disk
            raise NotDrawnError(f"{error}; {kept}") from error

    def raise_if_any_failed(self) -> None:
        """Raise NotDrawnError, in one line, if something could not be drawn."""
        if self._failed:
            first = ", ".join(f"{name} ({error})" for name, error in list(self._failed.items())[:_MOST_FAILED])
            more = len(self._failed) - _MOST_FAILED
            rest = f" and {more} more" if more > 0 else ""
            raise NotDrawnError(f"could not draw {first}{rest}; everything else is complete in {self.out}")
