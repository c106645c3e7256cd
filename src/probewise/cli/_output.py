"""Where results go: checked before any work, written whole or not at all, no input lost."""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from probewise.errors import FileError, ParameterError

__all__ = ["Stage", "check_out_directory", "check_out_file", "staged"]


class Stage:
    """An empty directory to write results into, and what was set aside for them.

    Attributes
    ----------
    folder
        The directory.
    kept
        Where each file went that a result would have replaced, and that this run had read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.kept: dict[Path, Path] = {}

    def __truediv__(self, name: str) -> Path:
        return self.folder / name

    @property
    def notes(self) -> list[str]:
        """What was set aside, in words."""
        return [f"what was {path} is now {now}" for path, now in self.kept.items()]


def check_out_directory(path: Path) -> Path:
    """Refuse, before any work, a place where no directory can be made."""
    if path.exists() and not path.is_dir():
        raise ParameterError("--out", str(path), "a directory, existing or new; this is a file")
    parent = next(p for p in (path, *path.absolute().parents) if p.exists())
    if not parent.is_dir():
        raise ParameterError("--out", str(path), f"a directory; {parent} is a file")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise FileError(path, f"{parent} cannot be written to", "a directory you may write to")
    return path


def check_out_file(path: Path, *inputs: Path) -> Path:
    """Refuse, before any work, a place where no file can be written, and one that would overwrite an input."""
    if path.is_dir():
        raise ParameterError("--out", str(path), "a file name; this is a directory")
    for taken in inputs:
        if path.exists() and taken.exists() and path.samefile(taken):
            raise ParameterError("--out", str(path), f"another file than the input {taken}")
    check_out_directory(path.parent)
    return path


@contextlib.contextmanager
def staged(out: Path, *, inputs: Sequence[Path] = (), outdated: Sequence[str] = ()) -> Iterator[Stage]:
    """Yield an empty directory; move its files into `out` only when the block ends well.

    Nobody ever sees half a result: each file is put in place by one atomic rename within
    one file system, and an error or an interrupt leaves `out` as it was.

    Parameters
    ----------
    out
        Where the results go; made if missing.
    inputs
        Files that this run had read: one that a result would replace is set aside under a name of its own.
    outdated
        Patterns of files that an earlier run may have left in `out`: what this run did not write anew is removed.

    Raises
    ------
    FileError
        If `out` cannot be made or written to, or a directory stands where a file has to go.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        stage = Stage(Path(tempfile.mkdtemp(prefix=".writing-", dir=out)))
    except OSError as error:
        raise FileError(out, f"cannot be written to ({error.strerror})", "a directory you may write to") from error
    try:
        yield stage
        written = sorted(p.relative_to(stage.folder) for p in stage.folder.rglob("*") if p.is_file())
        for name in written:
            if (out / name).is_dir():
                raise FileError(out / name, "a directory of that name is in the way", "another --out, or none there")
        own = {path.resolve() for path in inputs}
        _set_aside([out / name for name in written if (out / name).resolve() in own], stage)
        for name in written:
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(stage.folder / name, out / name)
        for path in itertools.chain.from_iterable(out.glob(pattern) for pattern in outdated):
            if path.relative_to(out) not in written and path.resolve() not in own and path not in stage.kept.values():
                path.unlink()
    finally:
        shutil.rmtree(stage.folder, ignore_errors=True)


def _set_aside(paths: Sequence[Path], stage: Stage) -> None:
    """Rename files to the first free NAME_kept, NAME_kept_2 ...; files of one name keep one name."""
    for stem in dict.fromkeys(path.with_suffix("") for path in paths):
        group = [path for path in paths if path.with_suffix("") == stem]
        endings = itertools.chain(["_kept"], (f"_kept_{k}" for k in itertools.count(2)))
        ending = next(e for e in endings if not any(_renamed(path, e).exists() for path in group))
        for path in group:
            os.replace(path, _renamed(path, ending))
            stage.kept[path] = _renamed(path, ending)


def _renamed(path: Path, ending: str) -> Path:
    return path.with_name(f"{path.stem}{ending}{path.suffix}")
