"""Files of recordings, plans and predictions: NAME.csv with the rows, NAME.json with instrument and patterns."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, data_frame, read_only_floats, require_finite
from probewise._display import ShowsItself
from probewise._kinds import checked_path
from probewise._writing import is_device_or_pipe, write_bytes_atomically, write_text_atomically
from probewise.errors import FileError, ParameterError, ShapeError, require, shown
from probewise.progress import Progress, silent
from probewise.recordings.cells import MISSING, count_numbers
from probewise.recordings.columns import (
    A_SESSION,
    SESSION,
    a_command,
    is_commanded,
    led_cell,
    notes_on_codes,
    notes_on_names,
    pattern_codes,
    scan_codes_and_names,
    sessions_of_scans,
)
from probewise.recordings.io import (
    LARGEST,
    FileObject,
    image_bytes,
    is_file_name_without_path,
    is_number_of_file,
    parse_json_file_text,
    read_image,
    read_text,
    shortened_json,
)
from probewise.recordings.patterns import PATTERNS, Image, Pattern
from probewise.recordings.plan import Instrumentation, Plan, Recording, range_in_words, require_plan, require_recording
from probewise.recordings.table import LARGEST_PLACE_MM, CSVTable, cell_in_words, csv_text, number_text, read_table

FORMAT = "recording/1"
_A_NAME = "a printable text without blanks around it"
_CONTROLS = ("orientation_deg", "height_mm", "led", "speed")


def shortest_degrees(angle_rad: float) -> float:
    """Convert to the degrees of fewest digits that convert back to exactly the same radians, for files."""
    plain = math.degrees(angle_rad)
    candidates = [round(plain, digits) for digits in range(16)]
    candidates += [plain, math.nextafter(plain, math.inf), math.nextafter(plain, -math.inf)]
    return next((c for c in candidates if math.radians(c) == angle_rad), plain)


def _is_pair(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(is_number_of_file, value))


_KINDS: dict[str, type[Pattern]] = {re.sub("(?<=.)(?=[A-Z])", "_", kind.__name__).lower(): kind for kind in PATTERNS}
_KIND_OF = {pattern: kind for kind, pattern in _KINDS.items()}
_A_PICTURE = "the name of a PNG or .npy file in the same folder, without a path"
# What a field of a pattern may hold in the file, by the field's type.
_FIELDS: dict[object, tuple[str, Callable[[Any], bool]]] = {
    "float": ("a finite number", is_number_of_file),
    "tuple[float, float]": ("two finite numbers [x, y]", _is_pair),
    "tuple[int, int]": ("[1, 1], [1, -1], [-1, 1] or [-1, -1]", lambda v: _is_pair(v) and all(abs(d) == 1 for d in v)),
    "tuple[tuple[float, float], ...]": (
        "a list of at least three corners [x, y]",
        lambda v: isinstance(v, list) and len(v) >= 3 and all(map(_is_pair, v)),
    ),
    # Security: a recording may only refer to files in its own folder.
    "str": (_A_PICTURE, lambda v: isinstance(v, str) and is_file_name_without_path(v)),
}


def _name_in_file(field: str) -> str:
    return field.removesuffix("_rad") + "_deg" if field.endswith("_rad") else field


def _parse_pattern(found: FileObject) -> tuple[Pattern, list[str]]:
    """Return a pattern, and notes on entries that its kind does not have."""
    name = found.value("kind", f"one of {', '.join(_KINDS)}", lambda v: isinstance(v, str) and v in _KINDS)
    kind: Any = _KINDS[name]
    values = dict[str, Any]()
    for one in fields(kind):
        entry = _name_in_file(one.name)
        if one.type not in _FIELDS or (entry not in found.content and one.default is not dataclasses.MISSING):
            continue  # an image's pixels, which are in their own file; what has a default
        value = found.value(entry, *_FIELDS[one.type])
        values[one.name] = math.radians(value) if entry != one.name else value
    if kind is Image:
        picture = found.path.parent / values["file"]
        if not picture.is_file():  # the error names the JSON that refers to the picture
            raise found.error("file", "the name of a PNG or .npy file that lies in the same folder")
        values["albedo"] = read_image(picture)
    unused = ", ".join(found.unknown)
    return found.build(kind, **values), [f"{unused} not used, no field of kind {name}"] * bool(unused)


def read_description(path: Path) -> tuple[Instrumentation, dict[str, Pattern], tuple[str, ...]]:
    """Read NAME.json beside NAME.csv: instrumentation, patterns, notes; FileError for a field missing or invalid."""
    text = read_text(path, f"a description ({FORMAT}) beside the CSV, of the same name with the ending .json")
    top = FileObject(path, "", parse_json_file_text(path, text, "strict JSON, each name once"))
    top.value("format", f'"{FORMAT}"', lambda v: v == FORMAT)
    patterns, notes, listed = dict[str, Pattern](), list[str](), top.object("patterns", "at least one pattern by name")
    for name in listed.content:
        if name != name.strip() or not name.isprintable():
            raise FileError(path, f"patterns has a name {shortened_json(name)}", _A_NAME)
        patterns[name], said = _parse_pattern(listed.object(name))
        notes += [f"pattern {name}: {each}" for each in said]
    if not patterns:
        raise FileError(path, "patterns is empty", "at least one pattern by name")
    instrumentation = _parse_instrumentation(top)
    unused = (name for name in instrumentation.controls if name not in _CONTROLS)
    notes += [f"controls: {name} is not used, none of {', '.join(_CONTROLS)}" for name in unused]
    return instrumentation, patterns, tuple(notes)


def _parse_instrumentation(top: FileObject) -> Instrumentation:
    reading, sensor = (FileObject(top.path, name, top.content.get(name, {})) for name in ("reading", "sensor"))
    number, text = _FIELDS["float"], ("a text", lambda v: isinstance(v, str))
    texts = ("a list of texts", lambda v: isinstance(v, list) and all(isinstance(each, str) for each in v))
    places: dict[str, tuple[FileObject, str, str, Callable[[Any], bool]]] = {
        "unit": (reading, "unit", *text),
        **{name: (reading, name, *number) for name in ("min", "max", "step")},
        "sensor": (sensor, "name", *text),
        "height_mm": (sensor, "height_mm", *number),
        "description": (top, "description", *text),
        "controls": (top, "controls", *texts),
    }
    values = {
        field: where.value(name, allowed, fits)
        for field, (where, name, allowed, fits) in places.items()
        if name in where.content and (field == "controls" or where.content[name] is not None)
    }
    try:
        return Instrumentation(**{"unit": "", **values})
    except ParameterError as error:
        where, name, *_ = places[error.name]
        raise where.error(name, error.allowed) from error


def description_text(instrumentation: Instrumentation, patterns: Mapping[str, Pattern]) -> str:
    """Return the text of NAME.json, with numbers in full precision; ParameterError for a pattern of no known kind."""
    inst = instrumentation
    reading = {"unit": inst.unit, "min": inst.min, "max": inst.max, "step": inst.step}
    sensor = {"name": inst.sensor, "height_mm": inst.height_mm}
    content: dict[str, object] = {
        "format": FORMAT,
        "reading": {key: value for key, value in reading.items() if value is not None},
        "sensor": {key: value for key, value in sensor.items() if value is not None},
        "patterns": {name: _pattern_fields(pattern) for name, pattern in patterns.items()},
    }
    if inst.controls:
        content["controls"] = list(inst.controls)
    if inst.description:
        content["description"] = inst.description
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _pattern_fields(pattern: Pattern) -> dict[str, object]:
    require(type(pattern) in _KIND_OF, "pattern", type(pattern).__name__, f"one of {', '.join(_KINDS)}")
    out: dict[str, object] = {"kind": _KIND_OF[type(pattern)]}
    for one in fields(pattern):
        value = getattr(pattern, one.name)
        if isinstance(value, np.ndarray):
            continue  # an image's pixels are in their own file
        if one.name.endswith("_rad"):
            out[_name_in_file(one.name)] = shortest_degrees(value)
        elif one.name not in ("inside", "outside") or value != one.default:
            out[one.name] = value
    return out


_KNOWN = ("reading", "x_mm", "y_mm", "orientation_deg", "scan", "pattern", "time_s")
_OF_A_LIGHT_SENSOR = (
    "a header row with it, in a recording by a light sensor; a table of anything else needs --simulator FILE.py"
)
_FULL_TURN_DEG = 360.0
_WHOLE_DEG = 0.05  # of radians of three decimals
_IN_METRES_MM = 0.5  # of a sensor whose readings change within millimetres
_FAR_AWAY = 100.0  # a place this many times the 5 to 95 % range of all places away looks mistyped
PathLike = str | os.PathLike[str]


def read_recording(path: PathLike, *, progress: Progress = silent) -> Recording:
    """Read a recording: NAME.csv, and NAME.json beside it; `progress` is called as rows are read.

    Missing readings become NaN, readings outside the declared range keep their value; both are counted in the notes and
    are not `usable`. Raises FileError, with row, column, what was found and what is allowed, if either file cannot be
    used.
    """
    plan, readings, notes = _read_with_json(path, progress)
    if readings is None:
        found = "no such column: this is a plan"
        raise FileError(path, found, "a recording, with a column of readings", row=1, column="reading")
    recording = Recording(plan, readings, str(path))
    if not recording.usable.any():
        inst = plan.instrumentation
        nothing = np.isnan(readings).all()
        found = "there is no reading at all" if nothing else "no reading is within the declared range"
        raise FileError(path, found, f"at least one number in {range_in_words(inst.min, inst.max)}", column="reading")
    return replace(recording, notes=(*notes, *recording.notes_on_unusable_readings()))


def read_plan(path: PathLike, *, progress: Progress = silent) -> Plan:
    """Read a plan, or the plan of a recording; raises as `read_recording`."""
    return _read_with_json(path, progress)[0]


def read_plan_and_readings(path: PathLike, *, progress: Progress = silent) -> tuple[Plan, FloatArray | None]:
    """Read a plan or a recording: return the plan, and the readings (n_points,) or None; raises as `read_recording`."""
    return _read_with_json(path, progress)[:2]


def write_recording(recording: Recording, path: PathLike) -> None:
    """Write NAME.csv, NAME.json and the images of its patterns, each file atomically, in full precision.

    ParameterError if the format cannot hold it (an unknown pattern, a name with line ends); FileError if files cannot
    be written.
    """
    require_recording(recording)
    largest = math.inf if len(recording.plan.instrumentation.declared_ends) == 2 else LARGEST
    readings = _number_cells("readings", recording.readings, largest)
    _write_with_json(recording.plan, checked_path("path", path), plan_columns(recording.plan) | {"reading": readings})


def write_plan(plan: Plan, path: PathLike) -> None:
    """Write a plan as NAME.csv, NAME.json and the images of its patterns; raises as `write_recording`."""
    require_plan(plan)
    _write_with_json(plan, checked_path("path", path), plan_columns(plan))


def plan_columns(plan: Plan) -> dict[str, Sequence[str]]:
    """Format the rows of a plan as cells by column of its CSV file, in full precision; ParameterError if it cannot."""
    for name in (*plan.scan_names, *plan.pattern_names, *plan.covariates):
        require(name == name.strip() and name.isprintable(), "name", name, _A_NAME)
    for name in plan.covariates:
        require(name not in (*_KNOWN, SESSION, ""), "covariate", name, "a name that is no column of the format")
    if (falls := np.flatnonzero(np.diff(plan.scan) < 0)).size:
        raise ParameterError("scan", int(plan.scan[falls[0] + 1]), "scans in the order they were taken")
    names: dict[int, str] = {}
    for k in np.unique(plan.scan).tolist():  # one like the scan's before gains a word, as a file would join the two
        again = bool(names) and plan.scan_names[k] == names[max(names)]
        names[k] = plan.scan_names[k] + " (again)" * again
    turns, which = np.unique(plan.orientation_rad, return_inverse=True)  # few: each conversion is a search
    degrees = [number_text(shortest_degrees(angle)) for angle in turns.tolist()]
    columns: dict[str, Sequence[str]] = {
        "scan": [names[k] for k in plan.scan],
        "pattern": [plan.pattern_names[k] for k in plan.pattern],
        "x_mm": _number_cells("x_mm", plan.x_mm, LARGEST_PLACE_MM),
        "y_mm": _number_cells("y_mm", plan.y_mm, LARGEST_PLACE_MM),
        "orientation_deg": [degrees[k] for k in which.reshape(-1).tolist()],
        "time_s": _number_cells("time_s", plan.time_s),
    }
    if len({plan.sessions[k] for k in names} if plan.sessions else ()) > 1:
        columns[SESSION] = [str(plan.sessions[k]) for k in plan.scan]
    return columns | {name: _number_cells(name, values) for name, values in plan.covariates.items()}


def _number_cells(name: str, values: FloatArray, largest: float = LARGEST) -> list[str]:
    bad = np.isinf(values) | (np.abs(values) > largest)
    if bad.any():
        raise ParameterError(name, float(values[bad][0]), f"finite numbers of magnitude up to {largest:g}")
    return [number_text(value) for value in values.tolist()]


def _write_with_json(plan: Plan, path: Path, columns: dict[str, Sequence[str]]) -> None:
    require(path.suffix.lower() != ".json", "path", str(path), "the name of the CSV; the JSON goes beside it")
    if unknown := sorted({name for name, _ in plan.rows_by_pattern()} - set(plan.patterns)):
        raise ParameterError("pattern", unknown[0], "a pattern that plan.patterns describes")
    text = description_text(plan.instrumentation, plan.patterns)
    pictures = pictures_to_write(plan.patterns, path.parent)
    # The CSV comes last: if it exists, everything it needs exists too.
    if not is_device_or_pipe(path):  # nothing lies beside one
        for picture, content in pictures.items():
            write_bytes_atomically(picture, content, named=False)
        write_text_atomically(path.with_suffix(".json"), text, named=False)
    write_text_atomically(path, csv_text(columns))


def pictures_to_write(patterns: Mapping[str, Pattern], folder: Path) -> dict[Path, bytes]:
    """Return by path the pictures of patterns, but for those that are in the folder as they are.

    ParameterError if a file's name is no plain one, or two images that differ share it.
    """
    images: dict[str, Image] = {}
    for name, pattern in patterns.items():
        if isinstance(pattern, Image):
            file, is_plain = f"file of patterns[{name!r}]", is_file_name_without_path(pattern.file)
            require(is_plain, file, pattern.file, "the name of a PNG or .npy file, without a path")
            same = np.array_equal(images.setdefault(pattern.file, pattern).albedo, pattern.albedo, equal_nan=True)
            require(same, file, pattern.file, "another file than that of an image which differs")
    content = {}
    for file, image in images.items():
        picture = folder / file
        with contextlib.suppress(FileError):  # something else is there
            there = read_image(picture)
            if not picture.is_symlink() and there.shape == image.albedo.shape and np.allclose(there, image.albedo):
                continue
        content[picture] = image_bytes(image.albedo, picture.suffix)
    return content


def _read_with_json(path: object, progress: Progress) -> tuple[Plan, FloatArray | None, list[str]]:
    """Read a table and its description: the plan, the readings or None, and notes."""
    # A table in memory is the usual mistake.
    path = checked_path("path", path, "the name of a CSV file; a table in memory: Recording.from_table(...)")
    if path.suffix.lower() == ".json":
        raise FileError(path, "this is a description", "the name of the CSV beside it")
    known = ("x_mm", "y_mm", "reading")
    table = read_table(path, wanted=known, names=("scan", "pattern"), time="time_s", progress=progress)
    table.require_columns("x_mm", "y_mm", allowed=_OF_A_LIGHT_SENSOR)
    if not len(table):
        raise FileError(path, "there is no reading at all, only a header", "one row per reading")
    instrumentation, patterns, ignored = read_description(path.with_suffix(".json"))
    notes = [*table.notes, *ignored]
    time_s = table.column_of_numbers("time_s") if "time_s" in table.columns else np.arange(len(table), dtype=np.float64)
    back = np.flatnonzero(np.diff(time_s) < 0)
    if back.size:
        notes.append(f"time_s runs backwards at row {table.rows[int(back[0]) + 1]}")
    if "orientation_rad" in table.columns:
        raise FileError(path, "it is in radians", "orientation_deg, in degrees", row=1, column="orientation_rad")
    turned = "orientation_deg" in table.columns
    orientation_deg = table.column_of_numbers("orientation_deg") if turned else np.zeros(len(table))
    if (beyond := np.flatnonzero(np.abs(orientation_deg) > _FULL_TURN_DEG)).size:
        k = int(beyond[0])
        notes.append(f"row {table.rows[k]}: orientation_deg is {orientation_deg[k]:g}, beyond a full turn: mistyped?")
    in_degrees = np.degrees(orientation_deg[orientation_deg != 0])
    off = np.maximum(np.abs(in_degrees - np.rint(in_degrees)), np.abs(in_degrees) - _FULL_TURN_DEG)
    if off.size and off.max() < _WHOLE_DEG:
        notes.append(f"orientation_deg holds {np.radians(in_degrees[0]):.4g}, in radians {in_degrees[0]:.0f} degrees")
    covariates = _covariate_columns(table, instrumentation.controls, notes)
    try:
        scan, scan_names = scan_codes_and_names(table.columns.get("scan"), len(table))
        sessions = sessions_of_scans(covariates.pop(SESSION, np.zeros(len(table))), scan)
        pattern = pattern_codes(table.columns.get("pattern"), patterns, len(table))
    except ParameterError as error:
        raise _error_in_table(table, error, list(patterns)) from error
    plan = Plan(
        x_mm=table.column_of_numbers("x_mm", largest=LARGEST_PLACE_MM),
        y_mm=table.column_of_numbers("y_mm", largest=LARGEST_PLACE_MM),
        orientation_rad=np.radians(orientation_deg),
        time_s=time_s,
        scan=scan,
        scan_names=scan_names,
        pattern=pattern,
        pattern_names=tuple(patterns),
        patterns=patterns,
        covariates=covariates,
        instrumentation=instrumentation,
        sessions=sessions,
    )
    notes += [*_notes_on_far_place(table, "x_mm", plan.x_mm), *_notes_on_far_place(table, "y_mm", plan.y_mm)]
    if 0 < (span_mm := max(np.ptp(plan.x_mm), np.ptp(plan.y_mm))) < _IN_METRES_MM:
        notes.append(f"all places lie within {span_mm:.2g} mm: are x_mm and y_mm in metres?")
    notes += notes_on_codes({"x_mm": plan.x_mm, "y_mm": plan.y_mm, **covariates})
    notes += notes_on_names("scan", table.columns.get("scan", ()), "scans")
    if "reading" not in table.columns:
        return plan, None, notes
    # With a declared range a huge number is only unusable; without one it would spoil every sum.
    largest = None if len(plan.instrumentation.declared_ends) == 2 else LARGEST
    return plan, table.column_of_numbers("reading", missing=True, largest=largest), notes


def _notes_on_far_place(table: CSVTable, name: str, places_mm: FloatArray) -> list[str]:
    """List one note if the coordinate farthest from the median looks mistyped, far from all others; else none."""
    low, middle, high = np.quantile(places_mm, [0.05, 0.5, 0.95])
    k = int(np.argmax(np.abs(places_mm - middle)))
    if abs(places_mm[k] - middle) <= _FAR_AWAY * max(high - low, 1.0):
        return []
    return [
        f"row {table.rows[k]}: {name} is {places_mm[k]:g}, nine in ten of the others {low:g} to {high:g}: mistyped?"
    ]


def _error_in_table(table: CSVTable, error: ParameterError, described: Sequence[str]) -> FileError:
    """Return the error of a reading's scan, session or pattern, called scan[3], with its row in the file."""
    column, _, index = error.name.removesuffix("]").partition("[")
    found, allowed = cell_in_words(error.value), error.allowed
    if column == "pattern":
        json_name = table.path.with_suffix(".json").name
        allowed = f"one of {', '.join(map(repr, described))}, as {json_name} describes them"
        found = found if index else f"no such column, and {json_name} has {len(described)} patterns"
    row = table.rows[int(index)] if index else table.header_row
    return FileError(table.path, found, allowed, row=row, column=column)


def _covariate_columns(table: CSVTable, controls: Sequence[str], notes: list[str]) -> dict[str, FloatArray]:
    """Return the numeric columns that are not the format's own but for `session`, by name; add `notes` on the rest.

    A column is numeric if most of its cells hold numbers. FileError if a commanded one, or a `session` that differs
    between rows, is not.
    """
    out: dict[str, FloatArray] = {}
    if "led" in table.columns:
        table = replace(table, columns={**table.columns, "led": list(map(led_cell, table.columns["led"]))})
    for name in table.columns:
        if name in _KNOWN:
            continue
        filled = [cell for cell in table.columns[name] if cell not in MISSING]
        if not name.isprintable():
            raise FileError(table.path, shown(name), f"{_A_NAME} for each column", row=1)
        elif not filled:
            notes.append(f"column {name} is empty, ignored")
        elif is_commanded(name, controls):
            out[name] = table.column_of_numbers(name, missing=True, allowed=a_command(name))
        elif name == SESSION and len(set(filled)) > 1:
            out[name] = table.column_of_numbers(name, missing=True, allowed=A_SESSION)
        elif 2 * count_numbers(filled) <= len(filled):
            notes.append(f"column {name} is text, ignored")
        else:
            out[name] = table.column_of_numbers(name, missing=True)
    return out


def fingerprint(recording: Recording) -> str:
    """Return the SHA-256, in hexadecimal, of a recording's content, written in a fixed order.

    That is its rows, readings, scans, sessions, covariates, patterns and instrument; not the free-text description,
    file names, column order or line ends.
    """
    plan = recording.plan
    columns = plan_columns(plan) | {"reading": [number_text(value) for value in recording.readings]}
    patterns = {
        name: replace(pattern, file="") if isinstance(pattern, Image) else pattern
        for name, pattern in sorted(plan.patterns.items())
    }
    digest = hashlib.sha256(csv_text(dict(sorted(columns.items()))).encode())
    digest.update(description_text(replace(plan.instrumentation, description=""), patterns).encode())
    for pattern in patterns.values():
        if isinstance(pattern, Image):
            digest.update(f"{pattern.albedo.shape}".encode() + pattern.albedo.astype("<f8").tobytes())
    return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class Prediction(ShowsItself):
    """Predictive mean and sd of each row's reading; all arrays have shape (n_points,).

    `sd` includes noise and parameter uncertainty. `log_density` is the natural log of the marginal predictive density
    of that row's reading, per unit of the reading; NaN where it is missing or out of range, and everywhere for a plan.
    `readings` are the scored readings, NaN where there is none.
    """

    plan: Plan
    mean: FloatArray
    sd: FloatArray
    log_density: FloatArray
    readings: FloatArray = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        if not np.size(self.readings):
            object.__setattr__(self, "readings", np.full(len(self.plan), np.nan))
        for name in ("readings", "mean", "sd", "log_density"):
            values = read_only_floats(getattr(self, name))
            if values.shape != (len(self.plan),):
                raise ShapeError(f"{name} has shape {values.shape}; allowed: ({len(self.plan)},), one per row")
            object.__setattr__(self, name, values)
        require_finite("mean", self.mean)
        require_finite("sd", self.sd)
        is_fine = not np.isinf(self.log_density).any()
        require(is_fine, "log_density", math.inf, "finite numbers, or NaN without a reading")
        require((self.sd > 0).all(), "sd", float(self.sd.min(initial=math.inf)), "greater than 0")

    def __len__(self) -> int:
        return len(self.plan)

    def to_frame(self) -> Any:
        """Return a pandas DataFrame: the plan's columns, `mean`, `sd` and `log_density`; a row per reading."""
        predicted = {name: getattr(self, name) for name in ("mean", "sd", "log_density")}
        return data_frame({**self.plan.columns, **predicted})

    def summary(self) -> str:
        """Summarise: number of predictions; for recorded readings, chi-square and log density per reading."""
        return prediction_summary(self.readings, self.mean, self.sd, self.log_density)


def prediction_summary(readings: FloatArray, mean: FloatArray, sd: FloatArray, log_density: FloatArray) -> str:
    """Summarise predictions in a line or two, as `Prediction.summary` does; all arguments have shape (n_points,)."""
    lines = [f"{len(mean)} readings predicted"]
    scored = np.isfinite(log_density) & np.isfinite(readings)
    if scored.any():
        n_left = int(len(mean) - scored.sum())
        left_out = f" ({n_left} missing or out of range, left out)" if n_left else ""
        z = (readings[scored] - mean[scored]) / sd[scored]
        lines.append(
            f"of {int(scored.sum())} recorded{left_out}: chi-square per reading {float(np.mean(z**2)):.3f}, "
            f"log density per reading {float(log_density[scored].mean()):.3f}"
        )
    return "\n".join(lines)


def write_prediction(prediction: Prediction, path: str | os.PathLike[str]) -> None:
    """Write a CSV file of the plan's rows in order, with `mean`, `sd` and `log_density`, in full precision."""
    columns = plan_columns(prediction.plan)
    for name in ("mean", "sd", "log_density"):
        columns[name] = [number_text(value) for value in getattr(prediction, name)]
    write_text_atomically(path, csv_text(columns))


def read_prediction_columns(path: str | os.PathLike[str]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return `mean`, `sd` and `log_density` from a file of predictions, (n_points,) each; an empty density becomes NaN.

    Raises FileError if the file is missing, a cell is not a valid number, or an sd is not above 0.
    """
    table = read_table(checked_path("path", path), wanted=("mean", "sd", "log_density"))
    table.require_columns("mean", "sd", "log_density")
    mean, sd = table.column_of_numbers("mean"), table.column_of_numbers("sd")
    if np.any(sd <= 0):
        k = int(np.argmax(sd <= 0))
        raise FileError(path, f"{sd[k]:g}", "greater than 0", row=table.rows[k], column="sd")
    return mean, sd, table.column_of_numbers("log_density", missing=True)
