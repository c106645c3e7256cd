"""The journal of a run: one JSON line per measurement, on disk before the next one is taken.

Format "journal/1". The first line holds the settings: field, shape, model, likelihood, digest of the sensor, seed,
options. Every further line is a measurement: index, pose, time, reading and covariates, then the posterior after it
(mean and sd of each parameter, bits gained), the next pose, and a digest of all that the file holds before it.

A line reaches the disk in two parts. The reading is written and synchronised as soon as it is taken; the posterior
summary (key "belief") follows after inference. So a process that is killed at any time loses no reading: a last line
without its summary is read as a reading alone, and a last line without a whole reading is dropped with a note.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np

from probewise._kinds import checked_path
from probewise._writing import hold_lock, write_and_sync, write_text_atomically
from probewise.arm.carry_out import recording_of
from probewise.arm.instrument import Pose, Reading
from probewise.effects import Effect, NoiseEffect
from probewise.errors import FileError, ParameterError, shown
from probewise.recordings.io import LARGEST, is_number_of_file, parse_json_file_text, read_bytes
from probewise.recordings.patterns import Pattern
from probewise.recordings.plan import Instrumentation, Recording
from probewise.recordings.table import LARGEST_PLACE_MM

FORMAT = "journal/1"
_SUMMARY_KEY = ', "belief": '
_DIGEST_KEY = ', "digest": '
# Settings in which a resumed run may differ: files may have moved, and an arm may have another name.
_FREE = frozenset({"format", "version", "spawn_key", "arm", "sensor_file"})
# Settings that are compared only if the journal has them.
_OPTIONAL = frozenset({"geometry_sha256"})
_EFFECT, _WITH_EFFECTS = b"<effect>", "effects-"
_DIGESTED = {
    "sensor": "another sensor model, or other cards",
    "sensor_sha256": "another sensor",
    "likelihood_sha256": "another likelihood",
    "fitted_arm": "another geometry of the arm",
    "geometry_sha256": "another geometry of the arm",
}  # in words, since their values are digests
_OF_SENSOR = frozenset({"sensor", "likelihood", "likelihood_sha256", "options.noise_sd"})  # what follows from its file


@dataclass(frozen=True)
class PosteriorSummary:
    """Posterior summary after a measurement: mean and sd by parameter, bits gained, the next pose."""

    mean: Mapping[str, float]
    sd: Mapping[str, float]
    bits: float
    next_pose: Pose


@dataclass(frozen=True)
class Entry:
    """One measurement of a journal, its index from 1; `summary` is None if the run was killed before inference."""

    index: int
    reading: Reading
    summary: PosteriorSummary | None


@dataclass(frozen=True, eq=False)
class Journal:
    """Content of a journal file: settings, measurements, notes on dropped lines.

    `n_bytes` is the length of the valid part, up to the last whole line or the reading of a truncated one; `n_torn` is
    the length of the rest, which is removed on resuming.
    """

    path: str
    settings: Mapping[str, Any]
    entries: tuple[Entry, ...]
    notes: tuple[str, ...]
    n_bytes: int
    n_torn: int = 0

    @property
    def readings(self) -> tuple[Reading, ...]:
        """The readings in order of time."""
        return tuple(entry.reading for entry in self.entries)

    def recording(
        self, *, patterns: Mapping[str, Pattern] | None = None, instrumentation: Instrumentation | None = None
    ) -> Recording:
        """Convert the readings to a recording over the pattern "field"; see `recording_of`."""
        return recording_of(self.readings, patterns=patterns, instrumentation=instrumentation, source=self.path)


def read_journal(path: str | Path) -> Journal:
    """Read a journal, even if its writer was killed at any time.

    FileError if the file is missing, is not a journal of this version, is damaged before its last line, or a line has
    another digest than that of the file up to there; lines of earlier versions, which have none, are taken as they are.
    """
    raw = read_bytes(checked_path("path", path), "a journal written by this package")
    *lines, tail = raw.split(b"\n")
    if not lines:
        raise FileError(path, "no whole first line", f'a journal, whose first line says "format": "{FORMAT}"', row=1)
    settings = _parse_line(path, lines[0], 1)
    if settings.get("format") != FORMAT:
        found, allowed = f"format {shown(settings.get('format'))}", f'"{FORMAT}", the version this package writes'
        raise FileError(path, found, allowed, row=1)
    entries: list[Entry] = []
    digest = hashlib.sha256(lines[0])
    for row, line in enumerate(lines[1:], start=2):
        parsed = _parse_line(path, line, row)
        entry = _parse_entry(path, parsed, row)
        if entry.index != row - 1:
            allowed = f"{row - 1}: one line per measurement, in order"
            raise FileError(path, f"index {shown(entry.index)}", allowed, row=row)
        text, key, end = line.rpartition(_DIGEST_KEY.encode())
        digest.update(b"\n" + text)
        if parsed.get("digest", digest.hexdigest()) != digest.hexdigest():
            allowed = "the journal as written; or one that ends before the first changed line, to go on there"
            raise FileError(path, "this line or one before it was changed, or is of another run", allowed, row=row)
        digest.update(key + end)
        entries.append(entry)
    notes: list[str] = []
    n_torn = 0
    if tail:
        head = _line_without_summary(tail)
        saved = _parse_entry_without_summary(path, head, len(entries) + 1)
        if saved is None:
            head = b""
            notes.append(f"the last line of {path} was torn while it was written and is dropped")
        else:
            entries.append(saved)
            notes.append(f"the last line of {path} was torn after its reading; the reading is kept")
        n_torn = len(tail) - len(head)
    return Journal(str(path), settings, tuple(entries), tuple(notes), len(raw) - n_torn, n_torn)


def _parse_line(path: str | Path, line: bytes, row: int) -> dict[str, Any]:
    value = parse_json_file_text(path, line, "one JSON object a line", row=row)
    if not isinstance(value, dict):
        raise FileError(path, f"a JSON {type(value).__name__}", "one JSON object a line", row=row)
    return value


def _line_without_summary(tail: bytes) -> bytes:
    """Return the start of an incomplete line, up to its reading, without the written part of the posterior summary."""
    mark = _SUMMARY_KEY.encode()
    head, found, _ = tail.partition(b"}" + mark)  # the brace closes the covariates, one of which may have this name
    head += b"}" if found else b""
    torn = next((k for k in range(len(mark) - 1, 0, -1) if head.endswith(mark[:k])), 0)
    return head[: len(head) - torn]


def _parse_entry_without_summary(path: str | Path, head: bytes, index: int) -> Entry | None:
    """Parse the first part of a line, up to its reading; None if the reading itself is incomplete."""
    # The covariates come last and are an object: only a complete first part becomes valid with one more brace.
    try:
        entry = _parse_entry(path, _parse_line(path, head + b"}", index + 1), index + 1)
    except FileError:
        return None
    return entry if entry.index == index else None


def _parse_entry(path: str | Path, line: Mapping[str, Any], row: int) -> Entry:
    """Parse a measurement from a line's JSON object; a FileError names the row and the entry."""
    column = "index"
    try:
        index = line["index"]
        column = "pose"
        pose = _parse_pose(line["pose"])
        column = "time_s"
        time_s = _parse_number(line["time_s"])
        column = "reading"
        value = _nan_if_null(line["reading"], math.inf)  # whose range its sensor has
        column = "covariates"
        covariates = {str(name): _nan_if_null(number) for name, number in line["covariates"].items()}
        column = "belief"
        summary = _parse_summary(line["belief"]) if "belief" in line else None
    except KeyError as error:
        raise FileError(path, f"{error} is missing", "a line as explore writes it", row=row, column=column) from error
    except (TypeError, ValueError, AttributeError) as error:
        raise FileError(path, f"unusable: {error}", "a line as explore writes it", row=row, column=column) from error
    return Entry(index, Reading(value, pose, time_s, covariates), summary)


def _parse_summary(line: Mapping[str, Any]) -> PosteriorSummary:
    mean, sd = ({name: _parse_number(value) for name, value in line[key].items()} for key in ("mean", "sd"))
    return PosteriorSummary(mean, sd, _parse_number(line["bits"]), _parse_pose(line["next"]))


def _null_if_nan(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _nan_if_null(value: float | None, largest: float = LARGEST) -> float:
    return math.nan if value is None else _parse_number(value, largest)


def _parse_number(value: Any, largest: float = LARGEST) -> float:
    """Return a JSON number of moderate magnitude as a float; raise TypeError for anything else, such as a text."""
    if not is_number_of_file(value, largest):
        raise TypeError(f"{shown(value)} is no number of magnitude up to {largest:g}")
    return float(value)


def _parse_pose(line: Mapping[str, Any]) -> Pose:
    height_mm, place = line.get("height_mm"), (line["x_mm"], line["y_mm"], line["orientation_rad"])
    x_mm, y_mm, turn_rad = (_parse_number(value, LARGEST_PLACE_MM) for value in place)
    return Pose(x_mm, y_mm, turn_rad, None if height_mm is None else _parse_number(height_mm, LARGEST_PLACE_MM))


def _pose_as_json(pose: Pose) -> dict[str, float]:
    return {name: value for name, value in dataclasses.asdict(pose).items() if value is not None}


def require_same_settings(journal: Journal, settings: Mapping[str, Any]) -> None:
    """Raise FileError with every setting in which a journal differs from the run that would resume it.

    Version, arm, spawn key and the name of the sensor's file may differ. The arm's geometry, and the digest of a model
    with effects, are compared only if the journal has them; without the latter the digest of the sensor's file counts.
    """
    there, here = _flattened_settings(journal.settings), _flattened_settings(json.loads(json.dumps(settings)))
    compared = {*there, *here} - _FREE - {name for name in _OPTIONAL if name not in there}
    with_effects = {name for name, value in here.items() if str(value).startswith(_WITH_EFFECTS)}
    compared -= {name for name in with_effects if not str(there.get(name)).startswith(_WITH_EFFECTS)}
    different = sorted(name for name in compared if there.get(name) != here.get(name))
    if "sensor_sha256" in different:
        different = [name for name in different if name not in _OF_SENSOR]
    if different:
        plain = (f"{name} {shown(there.get(name))} there, {shown(here.get(name))} here" for name in different)
        words = (_DIGESTED.get(name, text) for name, text in zip(different, plain, strict=True))
        raise FileError(
            journal.path,
            f"a run with other settings: {'; '.join(dict.fromkeys(words))}",
            "resume with the settings it was begun with, or begin a new journal under another name",
            row=1,
        )


def _flattened_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Flatten settings of two levels, to names such as "options.repeats", so that a message shows only differences."""
    out: dict[str, Any] = {}
    for name, value in settings.items():
        inner = value.items() if isinstance(value, dict) else ()
        out |= {f"{name}.{key}": item for key, item in inner} or {name: value}
    return out


@dataclass(eq=False)
class JournalWriter:
    """Writer that appends to a journal; every call returns when the text is on disk.

    `begin` and `resume` are context managers, in which no other process can write to the journal.
    """

    path: Path
    _file: FileIO = field(repr=False)
    _digest: hashlib._Hash = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._digest = hashlib.sha256(self.path.read_bytes())

    @classmethod
    @contextlib.contextmanager
    def begin(cls, path: str | Path, settings: Mapping[str, Any]) -> Iterator[JournalWriter]:
        """Begin a new journal with these settings; missing directories are created.

        FileError if the file exists already, cannot be written, or another process writes to it.
        """
        path = Path(path)
        _require_new_file(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FileError(path.parent, f"cannot be made ({error.strerror})", "a folder you may write to") from error
        with hold_lock(path):
            _require_new_file(path)
            write_text_atomically(path, json.dumps({"format": FORMAT, **settings}, allow_nan=False) + "\n")
            with open(path, "ab", buffering=0) as file:
                yield cls(path, file)

    @classmethod
    @contextlib.contextmanager
    def resume(cls, journal: Journal) -> Iterator[JournalWriter]:
        """Continue after the last whole line of a journal, or the reading of a truncated one, and remove the rest.

        After such a reading, `write_summary` completes the line. FileError if the file cannot be written, or another
        process writes to it or has changed it since it was read.
        """
        with hold_lock(journal.path):
            try:
                file = FileIO(journal.path, "r+b")
            except OSError as error:
                found = f"cannot be written ({error.strerror})"
                raise FileError(journal.path, found, "a file you may write to") from error
            with file:
                if file.seek(0, os.SEEK_END) != journal.n_bytes + journal.n_torn:
                    raise FileError(journal.path, "another process has written to it", "to resume it once more")
                file.truncate(journal.n_bytes)
                file.seek(0, os.SEEK_END)
                yield cls(Path(journal.path), file)

    def write_reading(self, index: int, reading: Reading) -> None:
        """Write a reading, the first part of its line."""
        line = {
            "index": index,
            "pose": _pose_as_json(reading.pose),
            "time_s": reading.time_s,
            "reading": _null_if_nan(reading.value),
            "covariates": {name: _null_if_nan(value) for name, value in reading.covariates.items()},
        }
        self._append(json.dumps(line, allow_nan=False)[:-1])

    def write_summary(self, summary: PosteriorSummary) -> None:
        """Write the summary after the last reading written: the rest of its line."""
        line = {
            "mean": dict(summary.mean),
            "sd": dict(summary.sd),
            "bits": summary.bits,
            "next": _pose_as_json(summary.next_pose),
        }
        text, digest = _SUMMARY_KEY + json.dumps(line, allow_nan=False), self._digest.copy()
        digest.update(text.encode())
        self._append(f'{text}{_DIGEST_KEY}"{digest.hexdigest()}"}}\n')

    def _append(self, text: str) -> None:
        write_and_sync(self._file, self.path, text.encode())
        self._digest.update(text.encode())


def _require_new_file(path: Path) -> None:
    if path.exists():
        raise FileError(path, "a file of this name exists", "a new file; or resume the journal that is there")


def value_digest(value: object) -> str:
    """Digest a value built of dataclasses, arrays, mappings, sequences, numbers and texts (sha256, hex).

    Two values have the same digest when their types, their fields and every bit of their numbers are the same, in
    whatever process; a list counts as a tuple. An effect counts by its name, its origin and the scans and patterns to
    which it is restricted, however it is written; "effects-" precedes the digest of a value that holds one.
    ParameterError if the value holds anything else, such as a function, which has no reproducible digest.
    """
    parts = list(_digested(value))
    digest = hashlib.sha256(b"".join(parts)).hexdigest()
    return f"{_WITH_EFFECTS}{digest}" if _EFFECT in parts else digest


def _digested(value: object) -> Iterator[bytes]:
    """Yield types, names of fields and bits of a value, to be digested."""
    if isinstance(value, Effect):
        yield _EFFECT
        yield from _digested((value.name, None if isinstance(value, NoiseEffect) else value.binding.where))
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield f"<{type(value).__qualname__}>".encode()
        for item in dataclasses.fields(value):
            yield item.name.encode()
            yield from _digested(getattr(value, item.name))
    elif isinstance(value, np.ndarray):
        yield f"[{value.dtype.str}{value.shape}]".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, Enum):
        yield f"<{value}>".encode()
    elif value is None or isinstance(value, (bool, int, float, str, np.generic)):
        plain = value.item() if isinstance(value, np.generic) else value
        yield f"{type(plain).__name__}:{plain!r};".encode()
    elif isinstance(value, Mapping):
        yield f"{{{len(value)}".encode()
        for key in sorted(value, key=str):
            yield from _digested(key)
            yield from _digested(value[key])
    elif isinstance(value, Sequence):
        yield f"({len(value)}".encode()
        for item in value:
            yield from _digested(item)
    else:
        raise ParameterError(
            "fingerprint of", value, "frozen dataclasses of arrays, numbers and texts, so that a journal can name them"
        )
