"""The file format of an arm's geometry: TOML, written by hand, with every number checked."""

from __future__ import annotations

import math
import re
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

from probewise._kinds import checked_path
from probewise.arm.geometry import FITTED, JOINTS, Accuracy, Geometry, Joint
from probewise.errors import FileError, ParameterError
from probewise.recordings.io import FileObject, is_number_of_file, read_text

FORMAT = "arm/1"
_HEADER = re.compile(r"\s*\[\s*([\w.]+)\s*\]")
_ENTRY = re.compile(r"(\s*(\w+)\s*=\s*)([-+\w.]+)(.*)")
_LARGEST = 1e6  # magnitude of a number
# Where the lengths of a geometry stand, table and entry.
_PAIRS = {
    "field_mm": (("field", "width_mm"), ("field", "height_mm")),
    "axis_mm": (("base", "x_mm"), ("base", "y_mm")),
    "shoulder_mm": (("base", "shoulder_forward_mm"), ("base", "shoulder_height_mm")),
    "links_mm": (("links", "upper_mm"), ("links", "lower_mm")),
    "sensor_mm": (("sensor", "forward_mm"), ("sensor", "drop_mm")),
}


def shipped_geometry_path() -> Path:
    """Return the path of the shipped file: a LEGO arm over the paper's field, with plausible, not measured, values."""
    return Path(str(resources.files("probewise"))) / "data" / "lego_arm.toml"


def read_geometry(path: str | Path) -> Geometry:
    """Read an arm's geometry from a TOML file of format "arm/1".

    FileError, with entry, content and what is allowed, if the file is missing or not TOML, an entry is missing or not
    allowed, or a name is unknown.
    """
    path = checked_path("path", path)
    text = read_text(path, "an arm's geometry, TOML in UTF-8")
    try:
        content = tomllib.loads(text)
    except RecursionError as error:
        raise FileError(path, "tables or lists nested too deep", "an arm's geometry, TOML") from error
    except ValueError as error:  # not TOML, or a number of thousands of digits
        raise FileError(path, f"not TOML ({error})", "an arm's geometry, TOML") from error
    top = FileObject(path, "", content, largest=_LARGEST)
    top.value("format", f'"{FORMAT}"', lambda v: v == FORMAT)
    tables = {name: top.object(name) for name in ("field", "base", "links", "sensor", "joints")}
    joints = {name: tables["joints"].object(name) for name in JOINTS}
    links, sensor, known = tables["links"], tables["sensor"], top.object("accuracy") if "accuracy" in content else None
    elbow = links.value("elbow", '"absolute" or "relative"', lambda v: v in ("absolute", "relative"))
    port = sensor.value("port", "1, 2, 3 or 4", lambda v: v in (1, 2, 3, 4) and not isinstance(v, bool | float))
    parts: dict[str, Any] = {
        name: tuple(tables[table].number(entry) for table, entry in places) for name, places in _PAIRS.items()
    }
    parts |= {name: sensor.number(name) for name in ("read_height_mm", "travel_height_mm", "lowest_mm")}
    parts["whole_percent"] = sensor.value("whole_percent", "true or false", lambda v: isinstance(v, bool))
    parts["mounting_rad"] = math.radians(sensor.number("mounting_deg"))
    parts["light_per_mm"] = sensor.number("light_per_mm") if "light_per_mm" in sensor.content else None
    parts |= {name: _parse_joint(table) for name, table in joints.items()}
    parts["accuracy"] = None if known is None else _parse_accuracy(known)
    geometry = top.build(Geometry, elbow_is_relative=elbow == "relative", sensor_port=port - 1, **parts)
    for table in (top, *tables.values(), *joints.values(), *([] if known is None else [known])):
        table.require_none_unknown()
    return geometry


def _parse_joint(table: FileObject) -> Joint:
    port = table.value("port", '"A", "B" or "C"', lambda v: v in ("A", "B", "C"))
    ratio = table.number("gear_ratio")
    angles = [math.radians(table.number(f"{name}_deg")) for name in ("home", "low", "high", "play")]
    stop = math.radians(table.number("stop_deg")) if "stop_deg" in table.content else None
    return table.build(Joint, "ABC".index(port), ratio, *angles, stop)


def _is_row(value: object) -> bool:
    return isinstance(value, list) and all(is_number_of_file(number, _LARGEST) for number in value)


def _parse_accuracy(table: FileObject) -> Accuracy:
    marks = table.value("marks", "a whole number, 1 or more", lambda v: type(v) is int)
    sds = [table.number(name) for name in ("place_sd_mm", "height_sd_mm", "scale_sd")]
    allowed = "rows of numbers as `arm fit-geometry` writes them: fit the marks again, or leave [accuracy] out"
    rows = table.value("covariance", allowed, lambda v: isinstance(v, list) and all(map(_is_row, v)))
    return table.build(Accuracy, marks, *sds, tuple(tuple(map(float, row)) for row in rows))


def text_with_fitted_values(text: str, geometry: Geometry) -> str:
    """Return the text of a geometry file, its comments kept, with the fitted values and their accuracy replaced.

    Limits and stops of the joints, which shift with their home angles, are replaced too; the table [accuracy] is added
    if missing. Raises ParameterError if a number is not on a line of its own below the header of its table, as in an
    inline table: it would stay.
    """
    numbers: dict[tuple[str, str], float] = {
        place: length
        for pair in ("axis_mm", "shoulder_mm", "links_mm")
        for place, length in zip(_PAIRS[pair], getattr(geometry, pair), strict=True)
    }
    for name, joint in zip(JOINTS, geometry.joints, strict=True):
        angles = {"home": joint.home_rad, "low": joint.low_rad, "high": joint.high_rad, "stop": joint.stop_rad}
        numbers |= {
            (f"joints.{name}", f"{key}_deg"): math.degrees(angle) for key, angle in angles.items() if angle is not None
        }
    lines, table, left = [], "", dict.fromkeys(numbers)
    for line in text.splitlines():
        if header := _HEADER.match(line):
            table = header[1]
        entry = _ENTRY.match(line)
        if table == "accuracy":
            continue
        if entry and (table, entry[2]) in numbers:
            line = f"{entry[1]}{numbers[table, entry[2]]:.4f}{entry[4]}"
            left.pop((table, entry[2]), None)
        lines.append(line)
    if left:
        table, key = next(iter(left))
        allowed = f'"{key} = NUMBER" on a line of its own below [{table}], so that the fitted number can replace it'
        raise ParameterError(f"{table}.{key}", "written in another way", allowed)
    known = geometry.accuracy
    if known is not None:
        lines += [
            *([""] if lines and lines[-1] else []),
            "[accuracy]                # written by `probewise arm fit-geometry`, from marks on the field",
            f"marks = {known.marks}",
            f"place_sd_mm = {known.place_sd_mm:.4f}",
            f"height_sd_mm = {known.height_sd_mm:.4f}",
            f"scale_sd = {known.scale_sd:.6f}",
            f"# of the errors of {', '.join(FITTED)}: radians and mm",
            "covariance = [",
            *(f"  [{', '.join(f'{number:.9e}' for number in row)}]," for row in known.covariance),
            "]",
        ]
    return "\n".join(lines) + "\n"
