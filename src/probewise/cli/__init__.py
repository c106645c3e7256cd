"""The command line `probewise`: the options of all verbs are in `_options`, what a verb does in the file of its name.

The steps of the paper as commands: `calibrate` (section 2.7, the SSF from a recording), `explore`
(sections 2.2-2.3, the robot finds a shape), `audit` (what a plan can detect), `diagnose` (what the model leaves out),
`predict` (eq. of the sensor model with its uncertainty) and `demo`, which does all of them at once. Beyond the paper:
`investigate` takes the readings that a diagnosis advises, `fit` fits a user's simulator, `study` and `challenge`
measure how good the robot and the diagnosis are; `sheets` draws patterns to print, `arm` moves and reads the LEGO arm,
`emulate-nxt` emulates it.

Exit status 0: done; 1: a computation that could not finish, an instrument that does not answer, a figure or page that
could not be drawn (the results are complete); 2: unusable input, reported in one line, nothing written, or a standard
output that takes no more; 128 + N: stopped by signal N (130: Ctrl-C).
"""

from __future__ import annotations

import importlib
import os
import sys
import warnings
from collections.abc import Sequence

from probewise._signals import Stopped, stoppable
from probewise.cli._common import CLOSED, OutputError, error_in_one_line, print_complaint, print_warning
from probewise.cli._options import VERBS, parser
from probewise.errors import LinkError, NotConvergedError, NotDrawnError, ProbewiseError

__all__ = ["VERBS", "main", "parser"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb of the command line, by default on the process's arguments, and return the exit status."""
    words = sys.argv[1:] if argv is None else list(argv)
    # The null device in place of streams that the shell closed (>&-): the next file would take their number.
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115
    try:
        arguments = parser().parse_args(words)
    except SystemExit as stop:  # argparse exits this way after --help, --version and errors
        return stop.code if isinstance(stop.code, int) else 2
    arguments.words = words
    verb: str = arguments.verb
    os.environ["MPLBACKEND"] = "Agg"  # figures go to files: no window and no display
    with warnings.catch_warnings():
        warnings.showwarning = _write_warning
        try:
            with stoppable():
                return int(importlib.import_module(f"probewise.cli.{verb.replace('-', '_')}").run(arguments))
        except Stopped as stop:
            status, said = stop.status, f"stopped; {str(stop) or 'nothing was written'}"
        except OutputError as error:
            out = getattr(arguments, "out", None)
            kept = "" if out is None or not out.exists() else f"; what was written is kept: {out}"
            status, said = 2, f"{error}{kept}"
        except (NotConvergedError, LinkError, NotDrawnError) as error:
            status, said = 1, str(error)
        except BrokenPipeError:  # the reader of a pipe has closed it; written files are complete
            status, said = 1, ""
        except (ProbewiseError, OSError) as error:
            status, said = 2, error_in_one_line(error)
        if said:
            print_complaint(f"probewise {verb}: {said}")
        _discard_unwritable_output()
        return status


def _discard_unwritable_output() -> None:
    """Send output that can no longer be written to the null device, so that the interpreter's flush at exit works."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except CLOSED:
            pass
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _write_warning(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    if issubclass(category, RuntimeWarning) and " encountered in " in str(message):
        return  # NumPy's, of arithmetic: whether a result can be used is checked, and said in our words
    print_warning(" ".join(str(message).split()))
