"""The file format of an arm's geometry: TOML, written by hand, with every number checked."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from probewise._kinds import checked_path
from probewise.arm.geometry import FITTED, JOINTS, Accuracy, Geometry, Joint
from probewise.errors import FileError, ParameterError, shown
from probewise.recordings.io import read_text

FORMAT = "arm/1"
_HEADER = re.compile(r"\s*\[\s*([\w.]+)\s*\]")
_ENTRY = re.compile(r"(\s*(\w+)\s*=\s*)([-+\w.]+)(.*)")
LARGEST = 1e6
T = TypeVar("T")


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
    top = _TomlTable(path, "", content)
    top.value("format", f'"{FORMAT}"', lambda v: v == FORMAT)
    field, base, links, sensor = (top.table(name) for name in ("field", "base", "links", "sensor"))
    joints = top.table("joints")
    elbow = links.value("elbow", '"absolute" or "relative"', lambda v: v in ("absolute", "relative"))
    port = sensor.value("port", "1, 2, 3 or 4", lambda v: v in (1, 2, 3, 4) and not isinstance(v, bool | float))
    whole = sensor.value("whole_percent", "true or false", lambda v: isinstance(v, bool))
    tables = {name: joints.table(name) for name in JOINTS}
    known = top.table("accuracy") if "accuracy" in content else None
    parts: dict[str, Any] = {name: _parse_joint(table) for name, table in tables.items()}
    accuracy = None if known is None else _parse_accuracy(known)
    geometry = _built(
        top,
        lambda: Geometry(
            field_mm=(field.number("width_mm"), field.number("height_mm")),
            axis_mm=(base.number("x_mm"), base.number("y_mm")),
            shoulder_mm=(base.number("shoulder_forward_mm"), base.number("shoulder_height_mm")),
            links_mm=(links.number("upper_mm"), links.number("lower_mm")),
            elbow_is_relative=elbow == "relative",
            sensor_port=port - 1,
            sensor_mm=(sensor.number("forward_mm"), sensor.number("drop_mm")),
            mounting_rad=math.radians(sensor.number("mounting_deg")),
            read_height_mm=sensor.number("read_height_mm"),
            travel_height_mm=sensor.number("travel_height_mm"),
            lowest_mm=sensor.number("lowest_mm"),
            **parts,
            whole_percent=whole,
            accuracy=accuracy,
            light_per_mm=sensor.number("light_per_mm") if "light_per_mm" in sensor.content else None,
        ),
    )
    for table in (top, field, base, links, sensor, joints, *tables.values(), *([] if known is None else [known])):
        table.require_all_taken()
    return geometry


def text_with_fitted_values(text: str, geometry: Geometry) -> str:
    """Return the text of a geometry file, its comments kept, with the fitted values and their accuracy replaced.

    Limits and stops of the joints, which shift with their home angles, are replaced too; the table [accuracy] is added
    if missing. Raises ParameterError if a number is not on a line of its own below the header of its table, as in an
    inline table: it would stay.
    """
    numbers: dict[tuple[str, str], float] = {
        ("base", "x_mm"): geometry.axis_mm[0],
        ("base", "y_mm"): geometry.axis_mm[1],
        ("base", "shoulder_forward_mm"): geometry.shoulder_mm[0],
        ("base", "shoulder_height_mm"): geometry.shoulder_mm[1],
        ("links", "upper_mm"): geometry.links_mm[0],
        ("links", "lower_mm"): geometry.links_mm[1],
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


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


class _TomlTable:
    """One table of the file; `require_all_taken` raises FileError if an entry, being unknown, was never taken."""

    def __init__(self, path: Path, where: str, content: dict[str, Any]) -> None:
        self.path, self.where, self.content = path, where, content
        self._left = set(content)

    def value(self, name: str, allowed: str, fits: Callable[[Any], bool]) -> Any:
        if name not in self.content:
            raise FileError(self.path, f"{self.where}{name} is missing", "every entry of the shipped lego_arm.toml")
        self._left.discard(name)
        if not fits(self.content[name]):
            raise FileError(self.path, f"{self.where}{name} is {shown(self.content[name])}", allowed)
        return self.content[name]

    def table(self, name: str) -> _TomlTable:
        content = self.value(name, f"a table [{self.where}{name}]", lambda v: isinstance(v, dict))
        return _TomlTable(self.path, f"{self.where}{name}.", content)

    def number(self, name: str) -> float:
        return float(self.value(name, f"a number of magnitude up to {LARGEST:g}", _is_number))

    def require_all_taken(self) -> None:
        if self._left:
            name = min(self._left)
            known = ", ".join(sorted(set(self.content) - self._left))
            raise FileError(self.path, f"{self.where}{name} is not known", f"the entries {known}")


def _built(table: _TomlTable, kind: Callable[..., T], *values: Any) -> T:
    """Return a value made of a table's entries; a ParameterError becomes a FileError that names the entry."""
    try:
        return kind(*values)
    except ParameterError as error:
        raise FileError(table.path, f"{table.where}{error.name} is {shown(error.value)}", error.allowed) from error


def _parse_joint(table: _TomlTable) -> Joint:
    port = table.value("port", '"A", "B" or "C"', lambda v: v in ("A", "B", "C"))
    ratio = table.number("gear_ratio")
    angles = [math.radians(table.number(f"{name}_deg")) for name in ("home", "low", "high", "play")]
    stop = math.radians(table.number("stop_deg")) if "stop_deg" in table.content else None
    return _built(table, Joint, "ABC".index(port), ratio, *angles, stop)


def _parse_accuracy(table: _TomlTable) -> Accuracy:
    whole = "a whole number, 1 or more"
    marks = table.value("marks", whole, lambda v: isinstance(v, int) and not isinstance(v, bool))
    sds = [table.number(name) for name in ("place_sd_mm", "height_sd_mm", "scale_sd")]
    if "covariance" not in table.content:
        again = "what `arm fit-geometry` writes: fit the marks again (--marks MARKS.csv), or leave [accuracy] out"
        raise FileError(table.path, "accuracy.covariance is missing", again)
    allowed, of_numbers = "rows of numbers, [[...], [...], ...]", f"rows of numbers of magnitude up to {LARGEST:g}"
    table.value("covariance", allowed, lambda v: isinstance(v, list) and all(isinstance(row, list) for row in v))
    rows = table.value("covariance", of_numbers, lambda v: all(_is_number(number) for row in v for number in row))
    return _built(table, Accuracy, marks, *sds, tuple(tuple(map(float, row)) for row in rows))
