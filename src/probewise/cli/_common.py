"""What every verb shares: options, what it says, the directory it writes."""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from probewise.errors import FileError, ParameterError

__all__ = [
    "DEFAULT_SEED",
    "OneLineParser",
    "Verb",
    "add_common",
    "add_out_directory",
    "add_quiet",
    "check_live",
    "check_out_directory",
    "check_out_file",
    "positive_int",
    "say",
    "staged",
]

DEFAULT_SEED = 2013  # the year of the paper; printed with every run


@dataclass(frozen=True)
class Verb:
    """One subcommand: `add_arguments` fills its parser, `run` does it and returns the exit status."""

    name: str
    summary: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


class OneLineParser(argparse.ArgumentParser):
    """Report a wrong command line in one line, as every other bad input is."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def add_common(parser: argparse.ArgumentParser) -> None:
    """Add the options that every verb with randomness or progress has."""
    parser.add_argument(
        "--seed",
        type=_seed,
        default=DEFAULT_SEED,
        metavar="N",
        help=f"seed of all randomness, printed with the result (default {DEFAULT_SEED})",
    )
    add_quiet(parser)


def add_quiet(parser: argparse.ArgumentParser) -> None:
    """Add --quiet."""
    parser.add_argument("--quiet", action="store_true", help="no progress and no summary; errors still show")


def add_out_directory(parser: argparse.ArgumentParser) -> None:
    """Add --out DIR."""
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="directory for the results; made if missing, files of the same name are replaced",
    )


def positive_int(text: str) -> int:
    """Read an integer above zero, for argparse."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number above 0")
    return value


def _seed(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = -1
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number from 0 on")
    return value


def say(text: str, *, quiet: bool = False) -> None:
    """Write a line of result to standard output."""
    if not quiet:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()


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


def check_live(n_live: int, n_params: int) -> int:
    """Refuse, before any work, too few live points for so many parameters."""
    from probewise.nested import least_live  # here: most commands do without

    least = least_live(n_params)
    if n_live < least:
        raise ParameterError("--live", n_live, f"{least} or more for {n_params} parameters")
    return n_live


@contextlib.contextmanager
def staged(out: Path) -> Iterator[Path]:
    """Yield an empty directory; move its files into `out` only when the block ends well.

    Nobody ever sees half a result: each file is put in place by one atomic rename within
    one file system, and an error or an interrupt leaves `out` as it was.
    """
    out.mkdir(parents=True, exist_ok=True)
    stage = Path(tempfile.mkdtemp(prefix=".writing-", dir=out))
    try:
        yield stage
        for file in sorted(p for p in stage.rglob("*") if p.is_file()):
            target = out / file.relative_to(stage)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, target)
    finally:
        shutil.rmtree(stage, ignore_errors=True)
