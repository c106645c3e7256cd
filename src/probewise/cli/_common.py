"""What every verb does around its work: it shows progress, prints its results, says how to go on."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from probewise._words import count_with_noun
from probewise.errors import ProbewiseError, printable, shown

if TYPE_CHECKING:
    from probewise._writing import Drawings
    from probewise.progress import Progress

CLOSED = (ValueError, AttributeError)  # of sys.stdout and sys.stderr that a FILE.py has closed, or set to None


class CommandError(ProbewiseError, ValueError):
    """A command that cannot be carried out as given: an option is missing or does not apply, or nobody answers."""


class OutputError(ProbewiseError, OSError):
    """Report a text that standard output does not take, such as a full disk."""


def write_to_terminal(stream: TextIO, text: str) -> None:
    """Write a text at once, with escapes for control characters, and for those that the stream cannot encode."""
    encoding = stream.encoding or "utf-8"
    stream.write(printable(text, keep="\n\u00a0").encode(encoding, "backslashreplace").decode(encoding))
    stream.flush()


def print_result(text: str) -> None:
    """Write a line of the result to standard output."""
    try:
        write_to_terminal(sys.stdout, text + "\n")
    except BrokenPipeError:
        raise
    except (OSError, *CLOSED) as error:
        line, why = shown(text.partition("\n")[0]), getattr(error, "strerror", None) or "it is closed"
        raise OutputError(f"standard output takes no more ({why}); it was to print {line}") from error


def say(arguments: argparse.Namespace, *lines: str) -> None:
    """Write lines to standard output, unless --quiet is given."""
    for line in lines if not arguments.quiet else ():
        print_result(line)


def finish(arguments: argparse.Namespace, drawings: Drawings, *lines: str) -> int:
    """Print lines, the last after the notes on what was replaced, unless --quiet; return the exit status, 0.

    Raises NotDrawnError if something was not drawn.
    """
    say(arguments, *lines[:-1], *drawings.notes, lines[-1])
    drawings.raise_if_any_failed()
    return 0


@contextlib.contextmanager
def progress_of(arguments: argparse.Namespace, *, beat: bool = True) -> Iterator[Progress]:
    """Yield the progress function of a command, silent with --quiet."""
    from probewise._progress import progress_shown  # takes NumPy to import

    with progress_shown(quiet=arguments.quiet, beat=beat) as progress:
        yield progress


def print_complaint(text: str) -> None:
    """Write a line to standard error, if that can still be written to."""
    with contextlib.suppress(OSError, *CLOSED):
        write_to_terminal(sys.stderr, text + "\n")


def print_warning(text: str) -> None:
    """Write a warning to standard error, even with --quiet."""
    print_complaint(f"warning: {text}")


def error_in_one_line(error: Exception) -> str:
    """Return an error's message on one line; of the system's about a file, its path and what is wrong."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


def message_to_resume(
    path: Path, count: Callable[[], int], noun: str, arguments: argparse.Namespace, *options: str, of: int = 1
) -> str:
    """Return how many of a `noun` (`of` a total) a file holds, if it is there, and the command that resumes."""
    if not path.exists():
        return "nothing was written"
    words = [*arguments.words, *(option for option in options if option not in arguments.words)]
    import shlex  # here, as help needs none
    import subprocess

    command = (subprocess.list2cmdline if os.name == "nt" else shlex.join)(["probewise", *words])
    n = count()
    kept = f"{n} of {of} {noun}s" if of > 1 else count_with_noun(n, noun)
    return f"{path} keeps {kept}; go on with: {command}"


def note_if_replaced(out: Path) -> list[str]:
    """List one line to print after writing a file if it replaces an earlier one; else none."""
    return [f"note: an earlier {out} was replaced"] if out.is_file() else []
