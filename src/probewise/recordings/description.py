"""The description of a recording, NAME.json: instrument, patterns and controls."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from probewise.errors import FileError, ParameterError, shortened
from probewise.recordings.images import is_file_name_without_path, read_image
from probewise.recordings.patterns import (
    Disc,
    HalfPlane,
    Image,
    Pattern,
    Polygon,
    Quadrant,
    Ramp,
    Stripes,
    Uniform,
)
from probewise.recordings.plan import Instrumentation
from probewise.recordings.strict_json import parse_json_file_text
from probewise.recordings.table import LARGEST
from probewise.recordings.text import read_text

FORMAT = "recording/1"
_CONTROLS = ("orientation_deg", "height_mm", "led", "speed")


@dataclass(frozen=True)
class Description:
    """A parsed description: instrumentation, patterns by name, and notes on fields that are ignored."""

    instrumentation: Instrumentation
    patterns: Mapping[str, Pattern]
    notes: tuple[str, ...] = ()


def shortest_degrees(angle_rad: float) -> float:
    """Convert to the degrees of fewest digits that convert back to exactly the same radians.

    The package works in radians and its files hold degrees; a plain conversion there and back
    can change an angle by a rounding error.
    """
    plain = math.degrees(angle_rad)
    candidates = [round(plain, digits) for digits in range(16)]
    candidates += [plain, math.nextafter(plain, math.inf), math.nextafter(plain, -math.inf)]
    return next((c for c in candidates if math.radians(c) == angle_rad), plain)


class _CheckedFields:
    """A JSON object whose fields are checked as they are read; a FileError gives the field's path."""

    def __init__(self, path: Path, where: str, content: object) -> None:
        if not isinstance(content, dict):
            raise FileError(path, f"{where} is {_shortened_json(content)}", "an object {...}")
        self.path, self.where, self.content = path, where, content
        self.used: set[str] = set()

    def error_at(self, name: str, value: object, allowed: str) -> FileError:
        return FileError(self.path, f"{self.where}.{name} is {_shortened_json(value)}".lstrip("."), allowed)

    def required_value(self, name: str, allowed: str) -> Any:
        self.used.add(name)
        if name not in self.content:
            raise FileError(self.path, f"{self.where}.{name} is missing".lstrip("."), allowed)
        return self.content[name]

    def has_value(self, name: str) -> bool:
        self.used.add(name)
        return self.content.get(name) is not None

    def number(self, name: str, allowed: str = "a finite number", ok: Callable[[float], bool] | None = None) -> float:
        value = self.required_value(name, allowed)
        if not _is_number(value) or (ok is not None and not ok(float(value))):
            raise self.error_at(name, value, allowed)
        return float(value)

    def positive_number(self, name: str) -> float:
        return self.number(name, "a number greater than 0", lambda v: v > 0)

    def pair_of_numbers(self, name: str) -> tuple[float, float]:
        allowed = "two finite numbers [x, y]"
        value = self.required_value(name, allowed)
        if not _is_pair_of_numbers(value):
            raise self.error_at(name, value, allowed)
        return float(value[0]), float(value[1])

    def text(self, name: str, allowed: str = "a text") -> str:
        value = self.required_value(name, allowed)
        if not isinstance(value, str):
            raise self.error_at(name, value, allowed)
        return value

    def inside_and_outside_albedo(self) -> tuple[float, float]:
        inside = self.number("inside") if "inside" in self.content else 1.0
        outside = self.number("outside") if "outside" in self.content else 0.0
        return inside, outside


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def _is_pair_of_numbers(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(_is_number(v) for v in value)


def _shortened_json(value: object) -> str:
    return shortened(json.dumps(value, ensure_ascii=False, default=str), 60)


def _parse_uniform(f: _CheckedFields) -> Pattern:
    return Uniform(f.number("albedo"))


def _parse_half_plane(f: _CheckedFields) -> Pattern:
    return HalfPlane(math.radians(f.number("normal_deg")), f.number("offset_mm"), *f.inside_and_outside_albedo())


def _parse_quadrant(f: _CheckedFields) -> Pattern:
    direction = f.pair_of_numbers("direction")
    if any(abs(d) != 1 for d in direction):
        raise f.error_at("direction", f.content["direction"], "[1, 1], [1, -1], [-1, 1] or [-1, -1]")
    return Quadrant(
        f.pair_of_numbers("corner_mm"), (int(direction[0]), int(direction[1])), *f.inside_and_outside_albedo()
    )


def _parse_disc(f: _CheckedFields) -> Pattern:
    return Disc(f.pair_of_numbers("center_mm"), f.positive_number("radius_mm"), *f.inside_and_outside_albedo())


def _parse_polygon(f: _CheckedFields) -> Pattern:
    allowed = "a list of at least three corners [x, y]"
    vertices = f.required_value("vertices_mm", allowed)
    if not isinstance(vertices, list) or len(vertices) < 3 or not all(_is_pair_of_numbers(v) for v in vertices):
        raise f.error_at("vertices_mm", vertices, allowed)
    return Polygon(tuple((float(x), float(y)) for x, y in vertices), *f.inside_and_outside_albedo())


def _parse_stripes(f: _CheckedFields) -> Pattern:
    duty = f.number("duty", "a number from 0 to 1", lambda v: 0 <= v <= 1)
    return Stripes(
        math.radians(f.number("normal_deg")),
        f.positive_number("period_mm"),
        duty,
        f.number("phase_mm"),
        *f.inside_and_outside_albedo(),
    )


def _parse_ramp(f: _CheckedFields) -> Pattern:
    return Ramp(math.radians(f.number("normal_deg")), f.number("per_mm"))


def _parse_image(f: _CheckedFields) -> Pattern:
    name = f.text("file", "the name of a PNG or .npy file in the same folder")
    # Security: a recording may only refer to files in its own folder.
    if not is_file_name_without_path(name):
        raise f.error_at("file", name, "the name of a PNG or .npy file in the same folder, without a path")
    picture = f.path.parent / name
    if not picture.is_file():  # the error names the JSON that refers to the picture
        raise f.error_at("file", name, "the name of a PNG or .npy file that lies in the same folder")
    return Image(read_image(picture), f.positive_number("pixel_mm"), f.pair_of_numbers("origin_mm"), name)


_KINDS: dict[str, Callable[[_CheckedFields], Pattern]] = {
    "uniform": _parse_uniform,
    "half_plane": _parse_half_plane,
    "quadrant": _parse_quadrant,
    "disc": _parse_disc,
    "polygon": _parse_polygon,
    "stripes": _parse_stripes,
    "ramp": _parse_ramp,
    "image": _parse_image,
}
_KIND_OF = {
    Uniform: "uniform",
    HalfPlane: "half_plane",
    Quadrant: "quadrant",
    Disc: "disc",
    Polygon: "polygon",
    Stripes: "stripes",
    Ramp: "ramp",
    Image: "image",
}


def read_description(path: Path) -> Description:
    """Read NAME.json, the description beside NAME.csv: instrumentation, patterns, and notes on what is not used.

    Raises FileError if it is missing, does not parse, or a field is missing or invalid.
    """
    text = read_text(path, f"a description ({FORMAT}) beside the CSV, of the same name with the ending .json")
    content = parse_json_file_text(path, text, "strict JSON, each name once")
    top = _CheckedFields(path, "", content)
    if top.text("format", f'"{FORMAT}"') != FORMAT:
        raise top.error_at("format", content["format"], f'"{FORMAT}"')
    patterns: dict[str, Pattern] = {}
    notes: list[str] = []
    listed = top.required_value("patterns", "at least one pattern by name")
    for name, fields_of_it in _CheckedFields(path, "patterns", listed).content.items():
        if name != name.strip() or not name.isprintable():
            raise FileError(
                path, f"patterns has a name {_shortened_json(name)}", "a printable text without blanks around it"
            )
        f = _CheckedFields(path, f"patterns.{name}", fields_of_it)
        kind = f.text("kind", f"one of {', '.join(_KINDS)}")
        if kind not in _KINDS:
            raise f.error_at("kind", kind, f"one of {', '.join(_KINDS)}")
        patterns[name] = _KINDS[kind](f)
        unused = [key for key in fields_of_it if key not in f.used | {"inside", "outside"}]
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
    return Description(instrumentation, patterns, tuple(notes))


def _parse_instrumentation(top: _CheckedFields) -> Instrumentation:
    reading = _CheckedFields(top.path, "reading", top.content.get("reading", {}))
    sensor = _CheckedFields(top.path, "sensor", top.content.get("sensor", {}))
    low = reading.number("min") if reading.has_value("min") else None
    high = reading.number("max") if reading.has_value("max") else None
    if low is not None and high is not None and low >= high:
        raise reading.error_at("max", high, f"greater than reading.min, {low:g}")
    controls = top.content.get("controls", [])
    if not isinstance(controls, list) or not all(isinstance(name, str) for name in controls):
        raise top.error_at("controls", controls, "a list of texts")
    return Instrumentation(
        unit=reading.text("unit") if reading.has_value("unit") else "",
        min=low,
        max=high,
        step=reading.positive_number("step") if reading.has_value("step") else None,
        sensor=sensor.text("name") if sensor.has_value("name") else "",
        height_mm=sensor.positive_number("height_mm") if sensor.has_value("height_mm") else None,
        controls=tuple(controls),
        description=top.text("description") if top.has_value("description") else "",
    )


def description_text(instrumentation: Instrumentation, patterns: Mapping[str, Pattern]) -> str:
    """Return the text of NAME.json, with numbers in full precision.

    Raises ParameterError for a pattern that is of none of the format's kinds.
    """
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
    if type(pattern) not in _KIND_OF:
        raise ParameterError("pattern", type(pattern).__name__, f"one of {', '.join(_KINDS)}")
    out: dict[str, object] = {"kind": _KIND_OF[type(pattern)]}
    for field in fields(pattern):
        value = getattr(pattern, field.name)
        if isinstance(value, np.ndarray):
            continue  # an image's pixels are in their own file
        if field.name.endswith("_rad"):
            out[field.name.removesuffix("_rad") + "_deg"] = shortest_degrees(value)
        elif field.name not in ("inside", "outside") or value != field.default:
            out[field.name] = value
    return out
