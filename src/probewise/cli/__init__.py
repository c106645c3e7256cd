"""The command line `probewise`: one file per verb.

The steps of the paper as commands: `calibrate` (section 2.5, the SSF from a recording), `explore`
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
from collections.abc import Mapping, Sequence
from types import ModuleType

from probewise._signals import Stopped, stoppable
from probewise._writing import NotDrawnError
from probewise.cli._common import CLOSED, OneLineParser, OutputError, error_in_one_line, print_complaint, print_warning
from probewise.errors import LinkError, NotConvergedError, ProbewiseError

__all__ = ["VERBS", "main", "parser"]

VERBS: Mapping[str, str] = {
    "demo": "Run everything: calibrate, find a hidden circle with two models, diagnose.",
    "calibrate": "Fit the sensor model of a recording; choose the number of Gaussians.",
    "predict": "Predict the readings of a plan: mean, sd and log density of each row.",
    "explore": "Let the robot find a shape, choosing each measurement itself.",
    "study": "Measure how many readings the robot needs, over many circles.",
    "audit": "List, before any data, the effects that a plan cannot detect or tell apart.",
    "diagnose": "Find which physics a sensor model, or a simulator of your own, leaves out of recordings.",
    "investigate": "Record, diagnose, take the readings that the diagnosis advises, until it is settled.",
    "fit": "Fit a simulator of your own to a table: posterior, evidence, residuals; no diagnosis.",
    "challenge": "Measure how good a diagnosis is, on recordings with concealed effects.",
    "sheets": "Draw the patterns for a bench at true scale, to print.",
    "arm": "Check, move and read the LEGO arm; record a plan with it or another arm.",
    "emulate-nxt": "Emulate a LEGO brick with the arm, behind a serial device.",
}
"""Each verb with its summary; `add_arguments` and `run` are in the module of its name."""


def parser(words: Sequence[str] | None = None) -> OneLineParser:
    """Build the parser of the whole command line; given `words`, only verbs among them get their options.

    Other verbs need not be imported then.
    """
    from probewise import __version__

    top = OneLineParser(
        prog="probewise",
        description="Model a sensor, let it choose its own measurements, find the physics its model leaves out.",
    )
    top.add_argument("--version", action="version", version=f"probewise {__version__}")
    verbs = top.add_subparsers(dest="verb", metavar="VERB", required=True, parser_class=OneLineParser)
    for name, summary in VERBS.items():
        added = verbs.add_parser(name, help=summary, description=summary)
        if words is None or name in words:
            _module_of(name).add_arguments(added)
    return top


def _module_of(verb: str) -> ModuleType:
    return importlib.import_module(f"probewise.cli.{verb.replace('-', '_')}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb of the command line, by default on the process's arguments, and return the exit status."""
    words = sys.argv[1:] if argv is None else list(argv)
    _replace_closed_streams()
    try:
        arguments = parser(words).parse_args(words)
    except SystemExit as stop:  # argparse exits this way after --help, --version and errors
        return stop.code if isinstance(stop.code, int) else 2
    arguments.words = words
    verb: str = arguments.verb
    os.environ["MPLBACKEND"] = "Agg"  # figures go to files: no window and no display
    with warnings.catch_warnings():
        warnings.showwarning = _write_warning
        try:
            with stoppable():
                return int(_module_of(verb).run(arguments))
        except Stopped as stop:
            _write_complaint(verb, f"stopped; {str(stop) or 'nothing was written'}")
            _discard_unwritable_output()
            return stop.status
        except OutputError as error:
            out = getattr(arguments, "out", None)
            kept = "" if out is None or not out.exists() else f"; what was written is kept: {out}"
            _write_complaint(verb, f"{error}{kept}")
            _discard_unwritable_output()
            return 2
        except (NotConvergedError, LinkError, NotDrawnError) as error:
            _write_complaint(verb, str(error))
            return 1
        except BrokenPipeError:  # the reader of a pipe has closed it; written files are complete
            _discard_unwritable_output()
            return 1
        except (ProbewiseError, OSError) as error:
            _write_complaint(verb, error_in_one_line(error))
            _discard_unwritable_output()
            return 2


def _write_complaint(verb: str, text: str) -> None:
    print_complaint(f"probewise {verb}: {text}")


def _replace_closed_streams() -> None:
    """Open the null device in place of streams that the shell closed (>&-): the next file would take their number."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115


def _discard_unwritable_output() -> None:
    """Send output that can no longer be written to the null device, so that the interpreter's flush at exit works."""
    try:
        sys.stdout.flush()
    except CLOSED:
        return
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _write_warning(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    if issubclass(category, RuntimeWarning) and " encountered in " in str(message):
        return  # NumPy's, of arithmetic: whether a result can be used is checked, and said in our words
    print_warning(" ".join(str(message).split()))
