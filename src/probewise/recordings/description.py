"""The description of a recording, NAME.json: instrument, patterns and controls."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import numpy as np

from probewise.errors import FileError, ParameterError, require, shortened
from probewise.recordings.images import is_file_name_without_path, read_image
from probewise.recordings.io import parse_json_file_text, read_text
from probewise.recordings.patterns import PATTERNS, Image, Pattern
from probewise.recordings.plan import Instrumentation
from probewise.recordings.table import LARGEST

FORMAT = "recording/1"
_CONTROLS = ("orientation_deg", "height_mm", "led", "speed")


def shortest_degrees(angle_rad: float) -> float:
    """Convert to the degrees of fewest digits that convert back to exactly the same radians, for files."""
    plain = math.degrees(angle_rad)
    candidates = [round(plain, digits) for digits in range(16)]
    candidates += [plain, math.nextafter(plain, math.inf), math.nextafter(plain, -math.inf)]
    return next((c for c in candidates if math.radians(c) == angle_rad), plain)


class _Object:
    """A JSON object of the file, `where` it stands; a FileError names the place of what is wrong in it."""

    def __init__(self, path: Path, where: str, content: object) -> None:
        if not isinstance(content, dict):
            raise FileError(path, f"{where} is {_shortened_json(content)}", "an object {...}")
        self.path, self.where, self.content = path, where, content

    def error(self, name: str, allowed: str) -> FileError:
        found = f"is {_shortened_json(self.content[name])}" if name in self.content else "is missing"
        return FileError(self.path, f"{self.where}.{name} {found}".lstrip("."), allowed)

    def value(self, name: str, allowed: str, fits: Callable[[Any], bool]) -> Any:
        if name not in self.content or not fits(self.content[name]):
            raise self.error(name, allowed)
        return self.content[name]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def _is_pair(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(_is_number(v) for v in value)


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _shortened_json(value: object) -> str:
    return shortened(json.dumps(value, ensure_ascii=False, default=str), 60)


_KINDS: dict[str, type[Pattern]] = {re.sub("(?<=.)(?=[A-Z])", "_", kind.__name__).lower(): kind for kind in PATTERNS}
_KIND_OF = {pattern: kind for kind, pattern in _KINDS.items()}
_A_PICTURE = "the name of a PNG or .npy file in the same folder, without a path"
# What a field of a pattern may hold in the file, by the field's type.
_FIELDS: dict[object, tuple[str, Callable[[Any], bool]]] = {
    "float": ("a finite number", _is_number),
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


def _parse_pattern(found: _Object, kind: type[Pattern]) -> Pattern:
    values: dict[str, Any] = {}
    for field in fields(kind):
        name = _name_in_file(field.name)
        if field.type not in _FIELDS or (name not in found.content and field.default is not MISSING):
            continue  # an image's pixels, which are in their own file; what has a default
        value = found.value(name, *_FIELDS[field.type])
        values[field.name] = math.radians(value) if name != field.name else value
    if kind is Image:
        picture = found.path.parent / values["file"]
        if not picture.is_file():  # the error names the JSON that refers to the picture
            raise found.error("file", "the name of a PNG or .npy file that lies in the same folder")
        values["albedo"] = read_image(picture)
    try:
        return kind(**values)
    except ParameterError as error:
        raise found.error(error.name, error.allowed) from error


def read_description(path: Path) -> tuple[Instrumentation, dict[str, Pattern], tuple[str, ...]]:
    """Read NAME.json beside NAME.csv: instrumentation, patterns, notes; FileError for a field missing or invalid."""
    text = read_text(path, f"a description ({FORMAT}) beside the CSV, of the same name with the ending .json")
    top = _Object(path, "", parse_json_file_text(path, text, "strict JSON, each name once"))
    top.value("format", f'"{FORMAT}"', lambda v: v == FORMAT)
    patterns: dict[str, Pattern] = {}
    notes: list[str] = []
    listed = top.value("patterns", "at least one pattern by name", lambda v: True)
    for name, content in _Object(path, "patterns", listed).content.items():
        if name != name.strip() or not name.isprintable():
            raise FileError(
                path, f"patterns has a name {_shortened_json(name)}", "a printable text without blanks around it"
            )
        found = _Object(path, f"patterns.{name}", content)
        kind = found.value("kind", f"one of {', '.join(_KINDS)}", lambda v: isinstance(v, str) and v in _KINDS)
        patterns[name] = _parse_pattern(found, _KINDS[kind])
        known = (_name_in_file(field.name) for field in fields(_KINDS[kind]) if field.type in _FIELDS)
        used = {"kind", "inside", "outside", *known}
        unused = [key for key in content if key not in used]
        if unused:
            notes.append(f"pattern {name}: {', '.join(unused)} not used, no field of kind {kind}")
    if not patterns:
        raise FileError(path, "patterns is empty", "at least one pattern by name")
    instrumentation = _parse_instrumentation(top)
    notes += [
        f"controls: {name} is not used, none of {', '.join(_CONTROLS)}"
        for name in instrumentation.controls
        if name not in _CONTROLS
    ]
    return instrumentation, patterns, tuple(notes)


def _parse_instrumentation(top: _Object) -> Instrumentation:
    reading, sensor = (_Object(top.path, name, top.content.get(name, {})) for name in ("reading", "sensor"))
    number, text = ("a finite number", _is_number), ("a text", _is_text)
    texts = ("a list of texts", lambda v: isinstance(v, list) and all(map(_is_text, v)))
    places: dict[str, tuple[_Object, str, str, Callable[[Any], bool]]] = {
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
    for field in fields(pattern):
        value = getattr(pattern, field.name)
        if isinstance(value, np.ndarray):
            continue  # an image's pixels are in their own file
        if field.name.endswith("_rad"):
            out[_name_in_file(field.name)] = shortest_degrees(value)
        elif field.name not in ("inside", "outside") or value != field.default:
            out[field.name] = value
    return out
