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
ELBOWS = ("absolute", "relative")
_HEADER = re.compile(r"\s*\[\s*([\w.]+)\s*\]")
_ENTRY = re.compile(r"(\s*(\w+)\s*=\s*)([-+\w.]+)(.*)")
LARGEST = 1e6
T = TypeVar("T")


def shipped_geometry_path() -> Path:
    """Return the path of the shipped file: a LEGO arm over the paper's field, with plausible, not measured, values."""
    return Path(str(resources.files("probewise"))) / "data" / "lego_arm.toml"


def read_geometry(path: str | Path) -> Geometry:
    """Read an arm's geometry from a TOML file of format "arm/1".

    Raises FileError if the file is missing or not TOML, an entry is missing or not allowed, or a name is unknown; the
    message gives file, entry, content and what is allowed.
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
    if top.take_entry("format") != FORMAT:
        raise top.error_at("format", f'"{FORMAT}"')
    field, base, links, sensor = (top.table(name) for name in ("field", "base", "links", "sensor"))
    joints = top.table("joints")
    elbow = links.take_entry("elbow")
    if elbow not in ELBOWS:
        raise links.error_at("elbow", " or ".join(f'"{name}"' for name in ELBOWS))
    port = sensor.take_entry("port")
    if port not in (1, 2, 3, 4) or isinstance(port, bool | float):
        raise sensor.error_at("port", "1, 2, 3 or 4")
    whole = sensor.take_entry("whole_percent")
    if not isinstance(whole, bool):
        raise sensor.error_at("whole_percent", "true or false")
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
    """Return the text of a geometry file with the fitted values and their accuracy replaced.

    Limits and stops of the joints, which shift with their home angles, are replaced too. The table [accuracy] is added
    if missing; no other entry is.

    `text`: text of the file before the fit; its comments are kept; `geometry`: the fitted geometry. Raises
    ParameterError if a number is not on a line of its own below the header of its table, as in an inline table: it
    would stay.
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

    def error_at(self, name: str, allowed: str) -> FileError:
        return FileError(self.path, f"{self.where}{name} is {shown(self.content[name])}", allowed)

    def take_entry(self, name: str) -> Any:
        if name not in self.content:
            raise FileError(self.path, f"{self.where}{name} is missing", "every entry of the shipped lego_arm.toml")
        self._left.discard(name)
        return self.content[name]

    def table(self, name: str) -> _TomlTable:
        content = self.take_entry(name)
        if not isinstance(content, dict):
            raise self.error_at(name, f"a table [{self.where}{name}]")
        return _TomlTable(self.path, f"{self.where}{name}.", content)

    def number(self, name: str) -> float:
        value = self.take_entry(name)
        if not _is_number(value):
            raise self.error_at(name, f"a number of magnitude up to {LARGEST:g}")
        return float(value)

    def rows_of_numbers(self, name: str) -> tuple[tuple[float, ...], ...]:
        rows = self.take_entry(name)
        if not isinstance(rows, list) or not all(isinstance(row, list) for row in rows):
            raise self.error_at(name, "rows of numbers, [[...], [...], ...]")
        if not all(_is_number(number) for row in rows for number in row):
            raise self.error_at(name, f"rows of numbers of magnitude up to {LARGEST:g}")
        return tuple(tuple(map(float, row)) for row in rows)

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
    port = table.take_entry("port")
    if port not in ("A", "B", "C"):
        raise table.error_at("port", '"A", "B" or "C"')
    ratio = table.number("gear_ratio")
    angles = [math.radians(table.number(f"{name}_deg")) for name in ("home", "low", "high", "play")]
    stop = math.radians(table.number("stop_deg")) if "stop_deg" in table.content else None
    return _built(table, Joint, "ABC".index(port), ratio, *angles, stop)


def _parse_accuracy(table: _TomlTable) -> Accuracy:
    marks = table.take_entry("marks")
    if not isinstance(marks, int) or isinstance(marks, bool):
        raise table.error_at("marks", "a whole number, 1 or more")
    sds = [table.number(name) for name in ("place_sd_mm", "height_sd_mm", "scale_sd")]
    if "covariance" not in table.content:
        again = "what `arm fit-geometry` writes: fit the marks again (--marks MARKS.csv), or leave [accuracy] out"
        raise FileError(table.path, "accuracy.covariance is missing", again)
    return _built(table, Accuracy, marks, *sds, table.rows_of_numbers("covariance"))
