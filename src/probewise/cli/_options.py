"""Every verb of the command line, with its summary and its options; what several verbs have is described once.

Only what the help needs is imported here: a verb's own module is loaded when it runs.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from probewise.errors import ParameterError, did_you_mean, printable, require, shortened, shown
from probewise.verbs import (
    CALIBRATION,
    DEFAULT_SEED,
    MAX_READINGS,
    METHOD,
    MODEL,
    N_LIVE,
    ORDERS,
    SHAPE,
    SHAPES,
    UTILITY,
)

MOST = 100_000
"""Largest count that an option takes unless it says otherwise: of more readings, runs or live points the time, days at
least, and the memory have no bound."""
MOST_BATCH = 100  # readings chosen at a time, each given those before it
MOST_CIRCLES = 10_000  # as of `probewise.proof.study`, which takes a second to import
MOST_WORKERS = 1024
SHIPPED_RECORDINGS = {
    name: Path(__file__).parents[1] / "data" / f"{name}.csv" for name in ("paper", "concealed")
}  # as `recordings.shipped` has them, which takes NumPy to import
SHIPPED = ("paper", "two_way")
"""Names of the plans that ship."""
ARMS = (
    "simulated; emulator, the LEGO arm in software, or emulator:TRUE.toml, built differently from --geometry; "
    "nxt:PORT such as nxt:/dev/rfcomm0 or nxt:COM5; or FILE.py, an instrument of your own (a "
    "program: run only those that you trust)"
)
"""Names of arms, the same in every verb."""
SCENE = "600,250,80"
"""Default target on the field of an emulated or simulated bench: a circle, in mm."""
SIZES = ("small", "plain", "gross")  # of a concealed effect


class OneLineParser(argparse.ArgumentParser):
    """An argument parser that reports errors in one line, with a suggestion for misspelt options."""

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # no option, but a value: -20,0 and -1e3 as well as -20

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


# Values of options


def parse_path(text: str) -> Path:
    """Parse a path; the empty string, such as an unset shell variable, and NUL are refused."""
    if not text or "\0" in text:
        kind = "a text with a NUL" if text else "an empty text"
        raise argparse.ArgumentTypeError(f"{kind} names no file or directory")
    return Path(os.path.expanduser(text))  # no shell expands --out=~/results


def _recording(text: str) -> Path:
    """Parse the path of a recording, or the name of one that ships, unless a file has that name."""
    path = parse_path(text)
    return SHIPPED_RECORDINGS.get(text, path) if not path.exists() else path


def _whole_number(text: str, *, least: int, most: int, allowed: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if not least <= value <= most:
        raise argparse.ArgumentTypeError(f"{shown(text)} is not a whole number {allowed}")
    return value


def _count_up_to(most: int) -> Callable[[str], int]:
    return partial(_whole_number, least=1, most=most, allowed=f"from 1 to {most:,}")


_count = _count_up_to(MOST)
_seed = partial(_whole_number, least=0, most=2**128 - 1, allowed="of 0 or more, less than 2^128")


def _positive_number(text: str, *, unit: str) -> float:
    numbers = parse_numbers(text)
    if len(numbers) != 1 or not 0 < numbers[0] < math.inf:
        raise argparse.ArgumentTypeError(f"{shown(text)} is not a number of {unit} greater than 0")
    return numbers[0]


def _different_numbers(text: str) -> tuple[float, ...]:
    values = parse_numbers(text)
    if not values or not all(map(math.isfinite, values)):
        raise argparse.ArgumentTypeError(f"{shown(text)} is not a list of numbers such as 0,45,90")
    return tuple(dict.fromkeys(values))


def _different_counts(text: str) -> tuple[int, ...]:
    return tuple(dict.fromkeys(map(_count_up_to(1000), text.split(","))))


def parse_numbers(text: str) -> tuple[float, ...]:
    """Parse "A,B,..."; () if a part is no number."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        return ()


def parse_finite_numbers(option: str, text: str, n: int, allowed: str) -> tuple[float, ...]:
    """Parse "A,B,..." of `n` finite numbers; raise ParameterError, with the option's name, for anything else."""
    numbers = parse_numbers(text)
    require(len(numbers) == n and all(map(math.isfinite, numbers)), option, text, allowed)
    return numbers


def parse_place(name: str, text: str) -> tuple[float, float]:
    """Parse "X,Y" in mm; raise ParameterError, with the option's name, for anything else."""
    x_mm, y_mm = parse_finite_numbers(name, text, 2, "X,Y in mm, such as 524,260")
    return x_mm, y_mm


def refuse_options(arguments: argparse.Namespace, what: str, *names: str) -> None:
    """Raise ParameterError if one of these options is given: there are none with `what`."""
    for name in names:
        value = getattr(arguments, name, None)
        if value is not None and value is not False:
            raise ParameterError(f"--{name.replace('_', '-')}", str(value), f"none with {what}")


# Options that several verbs have

_SIMULATOR = (
    "a simulator of your own; the file says which columns of the table it reads (it is a program: run only those that "
    "you trust)"
)
_ORIGIN = "where on the field the plan's origin lies (default: the field's middle; with FILE.py 0,0"
_GEOMETRY = "the arm as built: lengths, gears, ports, limits (default: the file that ships"
_FILE: dict[str, Any] = {"type": parse_path}
_WORKERS: dict[str, Any] = {"type": _count_up_to(MOST_WORKERS), "default": 1}
_SHARED: dict[str, tuple[str, dict[str, Any]]] = {
    "--out DIR": ("directory for the results, made if missing; earlier ones are replaced", _FILE | {"required": True}),
    "--seed N": (f"seed of all randomness, printed (default {DEFAULT_SEED})", {"type": _seed, "default": DEFAULT_SEED}),
    "--quiet": ("no progress and no summary; errors still show", {}),
    "--nested-stop": (
        "when nested sampling ends with --method paper: at a change of log evidence below 1e-8 (default), or "
        "where the log evidence can rise by 0.05 at most",
        {"choices": ("change", "remaining")},
    ),
    "--simulator FILE.py": (f"in place of the light sensor {_SIMULATOR}", _FILE),
    "--workers N": ("processes for a simulator of one sample at a time (default 1); results are the same", _WORKERS),
    "--arm ARM": (f"where the readings come from: {ARMS} (default simulated)", {"default": "simulated"}),
    "--geometry ARM.toml": (f"{_GEOMETRY})", _FILE),
    "--sensor S.json": ("an earlier calibration, whose posterior becomes the prior", _FILE),
}


def add(to: argparse._ActionsContainer, usage: str, about: str = "", **more: Any) -> None:
    """Add an argument or option by its usage, "NAME METAVAR", and its help, by default those of `_SHARED`.

    Without a metavar and `more` it is a flag.
    """
    about, options = (about, more) if about else _SHARED[usage]
    name, _, metavar = usage.partition(" ")
    if metavar:
        options = {**options, "metavar": metavar}
    elif name.startswith("--") and not options:
        options = {"action": "store_true"}
    to.add_argument(name, help=about, **options)


def _add_executor(to: argparse.ArgumentParser) -> None:
    where = to.add_mutually_exclusive_group()
    add(where, "--workers N", "processes here (default 1)", **_WORKERS)
    add(where, "--scheduler HOST:PORT", "a dask scheduler whose workers do it (extra `cluster`)")


def _add_seed_and_quiet(to: argparse.ArgumentParser) -> None:
    add(to, "--seed N")
    add(to, "--quiet")


# The options of each verb


def _demo(to: argparse.ArgumentParser) -> None:
    add(to, "--out DIR")
    add(to, "--full", "compare one to four Gaussians with 300 live points, as in the paper")
    about = "the hidden circle, radius 50 to 150 mm, entirely on the field (default: drawn from the seed)"
    add(to, "--truth X,Y,R", about)
    _add_seed_and_quiet(to)


def _calibrate(to: argparse.ArgumentParser) -> None:
    add(to, "recording REC.csv", "recording, its JSON beside it; or paper or concealed, which ship", type=_recording)
    add(to, "--out DIR")
    about = f"numbers of Gaussians to compare (default {' '.join(map(str, ORDERS))})"
    add(to, "--orders N", about, type=_count, nargs="+", default=list(ORDERS))
    about = f"live points where a number of Gaussians is searched in full (default {N_LIVE})"
    add(to, "--live N", about, type=_count, default=N_LIVE)
    about = (
        "quick (default): samples from the peaks of the likelihood, and one search of the prior that vouches; full: "
        "nested sampling of the whole prior of every number of Gaussians, its evidence refined by importance sampling; "
        "paper: uniform priors, evidence by nested sampling alone"
    )
    add(to, "--method", about, choices=("quick", "full", "paper"), default=CALIBRATION)
    add(to, "--nested-stop")
    _add_seed_and_quiet(to)


def _predict(to: argparse.ArgumentParser) -> None:
    about = "sensor model, as calibrate and diagnose write it; with --simulator a repaired.json, calibrated.json or "
    add(to, "sensor S.json", f"{about}fitted.json", type=parse_path)
    about = "plan or recording, its JSON beside it; or paper or concealed, which ship; with --simulator any table"
    add(to, "plan PLAN.csv", about, type=_recording)
    add(to, "--out P.csv", "where the prediction goes", type=parse_path, required=True)
    add(to, "--simulator FILE.py")
    _add_seed_and_quiet(to)


def _explore(to: argparse.ArgumentParser) -> None:
    about = "sensor model (default in a simulated run: that of the recording that ships)"
    add(to, "--sensor S.json", about, type=parse_path)
    add(to, "--out DIR")
    add(to, "--model", "the robot's sensor model", choices=("ssf", "naive"), default=MODEL)
    about = (
        "particles (default): posterior samples, reweighted after each reading; paper: nested sampling after each "
        "reading, entropy of 50 diversified samples' predictions, a Student-t or naive likelihood"
    )
    add(to, "--method", about, choices=("particles", "paper"), default=METHOD)
    add(to, "--nested-stop")
    about = "readings over black and white, for the naive model of --method paper (a simulated arm takes its own)"
    add(to, "--levels REC.csv", about, type=parse_path)
    about = f"possible shapes on the field, one or several of %(choices)s (default {SHAPE})"
    add(to, "--shape SHAPE", about, nargs="+", choices=SHAPES, default=[SHAPE])
    about = "the true shape in the simulated world, a circle as X,Y,R in mm (default: drawn from the seed)"
    add(to, "--truth [SHAPE:]V,V,...", about)
    about = (
        "an effect of the simulated world that the sensor model leaves out, such as backlash:8 (mm), saturation:40 or "
        "albedo_gradient:-0.0003,0 (per mm); several are joined by +"
    )
    add(to, "--conceal NAME:V,V", about)
    add(to, "--field W,H", "width and height of the field in mm (default: the geometry's, or 1048,520)")
    add(to, "--arm ARM")
    about = f"{_GEOMETRY}; the simulated arm has its reach, and a sensor that turns with --orientations alone)"
    add(to, "--geometry ARM.toml", about, type=parse_path)
    about = f"largest number of readings (default {MAX_READINGS})"
    add(to, "--max-readings N", about, type=_count, default=MAX_READINGS)
    add(to, "--live", "show the robot's view in a browser while it works (DIR/live.html)")
    add(to, "--both-models", "also show the posterior of the other sensor model from the same readings")
    about = (
        f"what a reading is worth: {UTILITY} (default), information and, near the end, the probability that it ends "
        "the run; information; the paper's entropy; information per-second, about:PARAMETER (about:radius_mm), or on "
        "which-shape of several is there"
    )
    add(to, "--utility NAME", about)
    add(to, "--learn-sensor", "infer the SSF's size and place and both levels too, with the sensor as their prior")
    about = (
        "prior probability that the sensor model leaves nothing out; below 1 what it leaves out is inferred too ("
        "default 0.9; 1 with --model naive, --method paper, --learn-sensor, another --utility, or several shapes)"
    )
    add(to, "--trust P", about, type=float)
    about = "a card on the field: centre and size in mm, albedo from 0 (field) to 1 (shape); may be given again"
    add(to, "--reference X,Y,W,H,ALBEDO", about, action="append", default=[])
    add(to, "--batch N", "choose N readings at a time", type=_count_up_to(MOST_BATCH), default=1)
    more = to.add_argument_group("more than a place", "further choices, for an arm that supports them")
    add(more, "--orientations DEG,...", "orientations to choose from, such as 0,45,90", type=_different_numbers)
    add(more, "--heights MM,...", "reading heights to choose from, such as 10,14", type=_different_numbers)
    add(more, "--repeats N,...", "numbers of repeated readings to choose from, such as 1,2,4", type=_different_counts)
    add(to, "--resume", "resume from the journal in DIR")
    _add_seed_and_quiet(to)


def _study(to: argparse.ArgumentParser) -> None:
    circles = _count_up_to(MOST_CIRCLES)
    add(to, "--out DIR")
    add(to, "--circles N", "circles per row, always the first ones (default 200)", type=circles, default=200)
    add(to, "--quoted N", "circles of the first row (default as --circles)", type=circles)
    about = (
        "conceal an effect in every row, at three sizes; search for the same circles with and without doubt about the "
        "sensor (writes concealed.csv; replaces all other rows)"
    )
    add(to, "--concealed", about)
    add(to, "--seed S", "with --concealed: circles, noise and robot of another seed", type=_seed)
    add(to, "--size", "with --concealed: only this one of the three sizes", choices=SIZES)
    add(to, "--varied", "with --concealed: over each circle a noise, a pace, a rounding and a sensor of its own")
    add(to, "--clean N", "with --concealed: circles of the row without a concealed effect", type=circles)
    about = "both sensor models and methods on the same circles, with --population and --nested-stop of one row"
    add(to, "--beside-paper", about)
    one = to.add_argument_group("one row instead of the table's", "defaults are those of the reference row")
    add(one, "--population NAME", "inside (50 to 150 mm, entirely in the field) or anywhere")
    add(one, "--model NAME", "the robot's sensor model: ssf or naive")
    add(one, "--utility NAME", "acquisition function: finishing, information, entropy, ...")
    add(one, "--noise SD", "sd of the noise, LEGO units (reference: 1)", type=float)
    add(one, "--width F", "assumed width of the SSF over the true one", type=float)
    add(one, "--batch N", "number of readings chosen at a time", type=_count_up_to(MOST_BATCH))
    add(one, "--learn-sensor", "learn the sensor along with the shape", action="store_true", default=None)
    add(one, "--method NAME", "how the robot infers and chooses: particles or paper")
    add(one, "--nested-stop NAME", "when the paper's nested sampling ends: change (of ln Z) or remaining")
    about = "a run that is not done after N readings counts as a miss (default 100)"
    add(to, "--max-readings N", about, type=_count, default=100)
    _add_executor(to)
    add(to, "--quiet")


def _audit(to: argparse.ArgumentParser) -> None:
    about = f"plan or recording, its JSON beside it; or {' or '.join(SHIPPED)}, which ship; with --simulator any table"
    add(to, "plan PLAN.csv", about, type=parse_path)
    add(to, "--sensor S.json", "the calibrated sensor (default: a typical one)", type=parse_path)
    add(to, "--simulator FILE.py")
    add(to, "--workers N")
    about = "directory for audit.json, report.html and, of a light sensor, cure_plan.csv (default: only text)"
    add(to, "--out DIR", about, type=parse_path)
    add(to, "--quiet")


def _diagnose(to: argparse.ArgumentParser) -> None:
    about = (
        "with --simulator any table; else a recording by a light sensor, its JSON beside it, or paper or concealed, "
        "which ship, or an explore run's journal.jsonl; several are diagnosed together"
    )
    add(to, "recordings REC.csv", about, type=_recording, nargs="+")
    about = "an earlier calibration, whose posterior becomes the prior (default with a journal: the one of its run)"
    add(to, "--sensor S.json", about, type=parse_path)
    add(to, "--simulator FILE.py")
    about = (
        "compute the evidence of the leading hypotheses by nested sampling too, which replaces Laplace's approximation "
        "where they differ by more than a nat plus its standard error, unless a run gives a warning"
    )
    add(to, "--thorough", about)
    about = "each recording by itself, into its folder; table.csv and report.html sort them; run again, it resumes"
    add(to, "--each", about)
    _add_executor(to)
    add(to, "--out DIR")
    _add_seed_and_quiet(to)


def _investigate(to: argparse.ArgumentParser) -> None:
    add(to, "--arm ARM")
    about = f"the first plan: a plan or recording, its JSON beside it; or {' or '.join(SHIPPED)}, which ship"
    add(to, "--plan PLAN.csv", about, required=True)
    add(to, "--origin-mm X,Y", f"{_ORIGIN}; none with simulated)")
    add(to, "--geometry ARM.toml")
    add(to, "--out DIR")
    add(to, "--sensor S.json")
    about = "effects concealed in the simulated world: nothing, or backlash:0.5+... (default: one is drawn)"
    add(to, "--truth NAME:V,V", about)
    about = "largest number of readings beyond the first plan (default 400)"
    add(to, "--readings N", about, type=_count, default=400)
    about = "largest number of minutes beyond the first plan (default: no limit)"
    add(to, "--minutes M", about, type=partial(_positive_number, unit="minutes"), default=math.inf)
    add(to, "--rounds N", "largest number of rounds, including the first (default 6)", type=_count, default=6)
    add(to, "--no-hands", "no person turns or exchanges sheets: take only readings over the sheet in place")
    add(to, "--resume", "resume from the rounds in DIR")
    _add_seed_and_quiet(to)


def _fit(to: argparse.ArgumentParser) -> None:
    add(to, "tables DATA.csv", "table of readings; several are fitted together", type=parse_path, nargs="+")
    add(to, "--simulator FILE.py", _SIMULATOR, type=parse_path)
    add(to, "--workers N")
    add(to, "--thorough", "compute the evidence by nested sampling as well")
    add(to, "--out DIR")
    _add_seed_and_quiet(to)


def _challenge(to: argparse.ArgumentParser) -> None:
    add(to, "--out DIR")
    about = "number of recordings, the seed's first; 60 (default) give a case of each kind, 6000 the whole table"
    add(to, "--cases N", about, type=_count, default=60)
    about = "recordings of various systems, each with its simulator's file, instead of a light sensor's"
    add(to, "--systems", about)
    about = "take the readings that the diagnosis advises until it is settled, N rounds at most (1, default: none)"
    add(to, "--rounds N", about, type=_count, default=1)
    _add_executor(to)
    _add_seed_and_quiet(to)


def _sheets(to: argparse.ArgumentParser) -> None:
    about = (
        "paper or two_way, the plans that ship; PLAN.csv, its JSON beside it, or such a JSON alone; field, the "
        "black field; target, a white shape to cut out; marks, the crosses of `arm fit-geometry`; jig, the "
        "arm's links and base at their home angles, for `arm home --here`"
    )
    add(to, "what WHAT", about)
    add(to, "--out SHEETS.pdf", "where the pages go", type=parse_path, required=True)
    add(to, "--paper PAPER", "a4 (default) or letter", type=str.lower, default="a4")
    about = "of field and target: a white shape as --truth of explore takes it, a circle as X,Y,R in mm of the field"
    add(to, "--target [SHAPE:]V,V,...", about)
    add(to, "--geometry ARM.toml")
    add(to, "--quiet")


_BRICK = "the brick, such as nxt:/dev/rfcomm0 or nxt:COM5"
_ALL_ARMS = f"where the readings come from: {ARMS}"
_LEGO_ARMS = (
    "the LEGO arm: nxt:PORT such as nxt:/dev/rfcomm0 or nxt:COM5; or emulator:TRUE.toml, in software, built "
    "differently from --geometry"
)


def _arm(to: argparse.ArgumentParser) -> None:
    tasks = to.add_subparsers(dest="task", metavar="TASK", required=True, parser_class=OneLineParser)

    def task(name: str, summary: str, *, arms: str = _BRICK, moves: bool = True) -> OneLineParser:
        """Add a task's parser, with --geometry and --quiet; if it `moves`, also --arm (help: `arms`) and --dry-run."""
        own = tasks.add_parser(name, help=summary, description=summary)
        if moves:
            add(own, "--arm nxt:PORT" if arms is _BRICK else "--arm ARM", arms)
            add(own, "--dry-run", "only print the moves, from home")
        add(own, "--geometry ARM.toml")
        add(own, "--quiet")
        return own

    check = task("check", "Check a geometry file, and a brick; report and draw the arm's reach.", moves=False)
    add(check, "--arm nxt:PORT", _BRICK)
    add(check, "--out REACH.png", "file of the drawing (default: none)", type=parse_path)
    add(check, "--drawing ARM.png", "file of a drawing with the arm's lengths", type=parse_path)

    jog = task("jog", "Turn a joint by some degrees, or bring the sensor over a place.")
    add(jog, "where WHERE", "base, shoulder or elbow and degrees; or a place X,Y in mm", nargs="+")
    add(jog, "--down", "at a place: lower the sensor to the height of reading")
    add(jog, "--steps", "with --down: in steps, each confirmed with Enter")

    summary = "Fit home angles, links and base to marks that the sensor is brought to; writes the geometry."
    fit = task("fit-geometry", summary, arms=_LEGO_ARMS)
    add(fit, "--out ARM.toml", "where the fitted geometry goes", type=parse_path, required=True)
    about = "where marks are kept (default: beside --out); without --arm they are read from there and only fitted"
    add(fit, "--marks MARKS.csv", about, type=parse_path)
    for usage, default, about in (
        ("--block-mm MM", 32.0, "height of the block on a mark (default 32: three LEGO bricks and a smooth tile)"),
        ("--touch-mm MM", 1.0, "accuracy of a mark, sd of place and height (default 1)"),
    ):
        add(fit, usage, about, type=partial(_positive_number, unit="mm"), default=default)
    add(fit, "--resume", "continue after the marks in MARKS.csv")

    home = task("home", "Bring all joints home, where their counters are 0; joints with a stop find it first.")
    add(home, "--here", "let a person bring the arm home by hand, and set the counters to 0 there")

    summary = "Check from the light over white whether the sensor hangs as high as its counters say."
    heights = task("heights", summary, arms=_LEGO_ARMS)
    add(heights, "places X,Y", "places in mm, two or more (default: the field's middle and the marks)", nargs="*")
    add(heights, "--readings N", "number of readings at each height (default 16)", type=_count, default=16)

    task("read", "Read the sensor where it stands, in LEGO units, and the battery.")

    scan = task("scan", "Read along a line; readings go to standard output as CSV.", arms=_ALL_ARMS)
    add(scan, "start X,Y", "first place of the line, mm")
    add(scan, "end X,Y", "last place of the line, mm")
    add(scan, "--readings N", "number of readings (default 21)", type=_count, default=21)

    summary = "Carry out a plan and write the recording; asks a person to lay sheets and turn the sensor."
    record = task("record", summary, arms=_ALL_ARMS)
    add(record, "plan PLAN.csv", f"plan or recording, its JSON beside it; or {' or '.join(SHIPPED)}, which ship")
    add(record, "--out REC.csv", "where the recording goes", type=parse_path, required=True)
    add(record, "--origin-mm X,Y", f"{_ORIGIN})")
    own = record.add_argument_group("with FILE.py", "properties of the readings, if not in the plan's JSON")
    add(own, "--unit UNIT", "unit of a reading, such as V or counts")
    add(own, "--range LOW,HIGH", "smallest and largest possible reading, such as 0,1023")
    add(own, "--step STEP", "rounding step of the readings, such as 1")
    for each in (scan, record):
        simulated = each.add_argument_group("with simulated and emulator")
        add(simulated, "--sensor S.json", "its sensor (default: that of the shipped recordings)", type=parse_path)
        add(simulated, "--seed N", f"seed of noise (default {DEFAULT_SEED})", type=_seed)
        if each is scan:
            add(simulated, "--scene X,Y,R", "target on the field, as for emulate-nxt")
    add(record, "--resume", "continue after the readings in REC.csv")


def _emulate_nxt(to: argparse.ArgumentParser) -> None:
    about = (
        f"the circle on the field, in mm (default {SCENE}), or ellipse:X,Y,A,B,ANGLE, "
        "polygon:X,Y,X,Y,..., edge:ANGLE,OFFSET, corner:X,Y,DX,DY, uniform:ALBEDO"
    )
    add(to, "--scene X,Y,R", about, default=SCENE)
    about = "the light sensor, as calibrate writes it (default: that of the shipped recordings)"
    add(to, "--sensor S.json", about, type=parse_path)
    add(to, "--geometry ARM.toml")
    about = (
        "a fault and its probability per telegram, 0 to 1: fragment, merge, double, corrupt, half, error, "
        "silence, deaf, unasked, disconnect; drop, per byte; late=RATE,SECONDS; sag=MV, by which the battery falls per "
        "minute; may be given several times"
    )
    add(to, "--fault NAME[=RATE]", about, action="append", default=[])
    about = "minutes without KEEPALIVE until it switches itself off: 0 (never), 2, 5, 10, 30 or 60 (default 10)"
    add(to, "--sleep MIN", about, type=int, default=10)
    add(to, "--link PATH", "a symbolic link to keep on the device, also after a disconnection", type=parse_path)
    add(to, "--log FILE", "write every telegram and fault to a file", type=parse_path)
    _add_seed_and_quiet(to)


VERBS: Mapping[str, tuple[str, Callable[[argparse.ArgumentParser], None]]] = {
    "demo": ("Show sensor and robot: calibrate, find a hidden circle with two models, diagnose.", _demo),
    "diagnose": ("Find which physics a sensor model, or a simulator of your own, leaves out of recordings.", _diagnose),
    "fit": ("Fit a simulator of your own to a table: posterior, evidence, residuals; no diagnosis.", _fit),
    "predict": ("Predict the readings of a plan: mean, sd and log density of each row.", _predict),
    "audit": ("List, before any data, the effects that a plan cannot detect or tell apart.", _audit),
    "calibrate": ("Fit the sensor model of a recording; choose the number of Gaussians.", _calibrate),
    "explore": ("Let the robot find a shape, choosing each measurement itself.", _explore),
    "investigate": (
        "Record, diagnose, take the readings that the diagnosis advises, until it is settled.",
        _investigate,
    ),
    "study": ("Measure how many readings the robot needs, over many circles.", _study),
    "challenge": ("Measure how good a diagnosis is, on recordings with concealed effects.", _challenge),
    "sheets": ("Draw the patterns for a bench at true scale, to print.", _sheets),
    "arm": ("Check, move and read the LEGO arm; record a plan with it or another arm.", _arm),
    "emulate-nxt": ("Emulate a LEGO brick with the arm, behind a serial device.", _emulate_nxt),
}
"""Each verb with its summary and the function that defines its options; `run` is in the module of its name."""


def parser() -> OneLineParser:
    """Build the parser of the whole command line."""
    from probewise import __version__

    top = OneLineParser(
        prog="probewise",
        description="Model a sensor, let it choose its own measurements, find the physics its model leaves out.",
    )
    top.add_argument("--version", action="version", version=f"probewise {__version__}")
    verbs = top.add_subparsers(dest="verb", metavar="VERB", required=True, parser_class=OneLineParser)
    for name, (summary, add_options) in VERBS.items():
        add_options(verbs.add_parser(name, help=summary, description=summary))
    return top
