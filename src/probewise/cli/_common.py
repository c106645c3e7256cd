"""Options and messages that all verbs share."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import math
import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

from probewise.errors import (
    FileError,
    ParameterError,
    ProbewiseError,
    did_you_mean,
    printable,
    require,
    shortened,
    shown,
)

if TYPE_CHECKING:
    from probewise._writing import Drawings

DEFAULT_SEED = 2013  # year of the paper; printed with every run
MOST = 100_000
"""Largest count that an option takes unless it says otherwise: of more readings, runs or live points the time, days at
least, and the memory have no bound."""
SHIPPED_RECORDINGS = {
    name: Path(__file__).parents[1] / "data" / f"{name}.csv" for name in ("paper", "concealed")
}  # as `recordings.shipped` has them, which takes NumPy to import
CLOSED = (ValueError, AttributeError)  # of sys.stdout and sys.stderr that a FILE.py has closed, or set to None
MOST_BATCH = 100  # readings chosen at a time, each given those before it


class CommandError(ProbewiseError, ValueError):
    """A command that cannot be carried out as given: an option is missing or does not apply, or nobody answers."""


class OutputError(ProbewiseError, OSError):
    """Report a text that standard output does not take, such as a full disk."""


class OneLineParser(argparse.ArgumentParser):
    """An argument parser that reports errors in one line, with a suggestion for misspelt options."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {printable(shortened(message))} (see {self.prog} --help)\n")

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        words = sys.argv[1:] if args is None else list(args)
        if self._subparsers is None:  # otherwise words may be options of a verb
            options = self._option_string_actions
            for word in itertools.takewhile(lambda word: word != "--", words):
                name, _, value = word.partition("=")
                if name.startswith("--") and not any(option.startswith(name) for option in options):
                    self.error(f"no option {name}{did_you_mean(name, options)}")
                if value == "--":  # argparse, until Python 3.13, would make an empty list of it
                    self.error(f"argument {name}: -- is not a value")
        parsed, surplus = super().parse_known_args(words, namespace)
        if surplus and self._subparsers is None:
            self.error(f"unrecognized arguments: {' '.join(surplus)}")
        return parsed, surplus

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            choices = [str(choice) for choice in action.choices]
            raise argparse.ArgumentError(
                action, f"{value!r} is not one of {', '.join(choices)}{did_you_mean(value, choices)}"
            )


def add(to: argparse._ActionsContainer, usage: str, about: str, **more: Any) -> None:
    """Add an argument or option by its usage, "NAME METAVAR", and its help; without metavar and `more` it is a flag."""
    name, _, metavar = usage.partition(" ")
    if metavar:
        more["metavar"] = metavar
    elif name.startswith("--") and not more:
        more["action"] = "store_true"
    to.add_argument(name, help=about, **more)


def add_out(parser: argparse.ArgumentParser) -> None:
    """Add --out DIR."""
    about = "directory for the results; made if missing, files of the same names are replaced"
    add(parser, "--out DIR", about, type=parse_path, required=True)


def add_seed_and_quiet(parser: argparse.ArgumentParser) -> None:
    about = f"seed of all randomness, printed with the result (default {DEFAULT_SEED})"
    add(parser, "--seed N", about, type=parse_seed, default=DEFAULT_SEED)
    add_quiet(parser)


def add_quiet(parser: argparse.ArgumentParser) -> None:
    add(parser, "--quiet", "no progress and no summary; errors still show")


def add_nested_stop(parser: argparse.ArgumentParser) -> None:
    about = (
        "when nested sampling ends with --method paper: at a change of log evidence below 1e-8 (default), or "
        "where the log evidence can rise by 0.05 at most"
    )
    add(parser, "--nested-stop", about, choices=("change", "remaining"))


def refuse_options(arguments: argparse.Namespace, what: str, *names: str) -> None:
    """Raise ParameterError if one of these options is given: there are none with `what`."""
    for name in names:
        if (value := getattr(arguments, name, None)) is not None:
            raise ParameterError(f"--{name.replace('_', '-')}", str(value), f"none with {what}")


def refuse_nested_stop(arguments: argparse.Namespace) -> None:
    """Raise ParameterError if --nested-stop is given without --method paper."""
    if arguments.nested_stop is not None and arguments.method != "paper":
        raise ParameterError("--nested-stop", arguments.nested_stop, "only with --method paper")


def parse_path(text: str) -> Path:
    """Parse a path, for argparse; the empty string, such as an unset shell variable, and NUL are refused."""
    if not text or "\0" in text:
        kind = "a text with a NUL" if text else "an empty text"
        raise argparse.ArgumentTypeError(f"{kind} names no file or directory")
    return Path(text)


def parse_recording(text: str) -> Path:
    """Parse the path of a recording, or the name of one that ships, unless a file has that name."""
    path = parse_path(text)
    return SHIPPED_RECORDINGS.get(text, path) if not path.exists() else path


def _parse_whole_number(text: str, *, least: int, most: int, allowed: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if not least <= value <= most:
        raise argparse.ArgumentTypeError(f"{shown(text)} is not a whole number {allowed}")
    return value


def count_up_to(most: int) -> Callable[[str], int]:
    """Return a parser of integers from 1 to `most`, for argparse."""
    return partial(_parse_whole_number, least=1, most=most, allowed=f"from 1 to {most:,}")


parse_count = count_up_to(MOST)
parse_seed = partial(_parse_whole_number, least=0, most=2**128 - 1, allowed="of 0 or more, less than 2^128")


def positive_number_parser(unit: str) -> Callable[[str], float]:
    """Return a parser of finite numbers above 0, for argparse; its message names the unit."""

    def parse(text: str) -> float:
        numbers = parse_numbers(text)
        if len(numbers) != 1 or not 0 < numbers[0] < math.inf:
            raise argparse.ArgumentTypeError(f"{shown(text)} is not a number of {unit} greater than 0")
        return numbers[0]

    return parse


def parse_finite_numbers(option: str, text: str, n: int, allowed: str) -> tuple[float, ...]:
    """Parse "A,B,..." of `n` finite numbers; raise ParameterError, with the option's name, for anything else."""
    numbers = parse_numbers(text)
    require(len(numbers) == n and all(map(math.isfinite, numbers)), option, text, allowed)
    return numbers


def parse_numbers(text: str) -> tuple[float, ...]:
    """Parse "A,B,..."; () if a part is no number."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        return ()


def write_to_terminal(stream: TextIO, text: str) -> None:
    """Write a text at once, with escapes for control characters, and for those that the stream cannot encode."""
    encoding = stream.encoding or "utf-8"
    stream.write(printable(text, keep="\n\u00a0").encode(encoding, "backslashreplace").decode(encoding))
    stream.flush()


def print_result(text: str, *, quiet: bool = False) -> None:
    """Write a line of the result to standard output, unless `quiet`."""
    if quiet:
        return
    try:
        write_to_terminal(sys.stdout, text + "\n")
    except BrokenPipeError:
        raise
    except (OSError, *CLOSED) as error:
        line, why = shown(text.partition("\n")[0]), getattr(error, "strerror", None) or "it is closed"
        raise OutputError(f"standard output takes no more ({why}); it was to print {line}") from error


def print_complaint(text: str) -> None:
    """Write a line to standard error, if that can still be written to."""
    with contextlib.suppress(OSError, *CLOSED):
        write_to_terminal(sys.stderr, text + "\n")


def error_in_one_line(error: Exception) -> str:
    """Return an error's message on one line; of the system's about a file, its path and what is wrong."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


def print_warning(text: str) -> None:
    """Write a warning to standard error, even with --quiet."""
    print_complaint(f"warning: {text}")


def message_to_resume(path: Path, n: int, noun: str, arguments: argparse.Namespace, *options: str, of: int = 1) -> str:
    """Return how many of a `noun` (`of` a total) a file holds, and the command, with `options`, that resumes."""
    import shlex
    import subprocess

    words = [*arguments.words, *(option for option in options if option not in arguments.words)]
    command = (subprocess.list2cmdline if os.name == "nt" else shlex.join)(["probewise", *words])
    count = f"{n} of {of} {noun}s" if of > 1 else f"{n} {noun}{'' if n == 1 else 's'}"
    return f"{path} keeps {count}; go on with: {command}"


def finish(drawings: Drawings, *lines: str, quiet: bool) -> int:
    """Print lines unless `quiet`; return the exit status, 0. Raises NotDrawnError if something was not drawn."""
    for line in lines:
        print_result(line, quiet=quiet)
    drawings.raise_if_any_failed()
    return 0


def note_if_replaced(out: Path) -> list[str]:
    """List one line to print after writing a file if it replaces an earlier one; else none."""
    return [f"note: an earlier {out} was replaced"] if out.is_file() else []


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
    return column in rows.columns and any(rows.columns[column])
