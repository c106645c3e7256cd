"""Files as bytes and as text, strict JSON, a person's Python file, what ships with the package, and images as albedo.

Of images, 8-bit PNG and .npy, the headers are checked before anything is unpacked.
"""

from __future__ import annotations

import codecs
import contextlib
import functools
import io
import json
import math
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from importlib import resources
from pathlib import Path, PurePosixPath, PureWindowsPath
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from probewise._arrays import FloatArray
from probewise._kinds import checked_path
from probewise.errors import FileError, ParameterError, PipeWarning, message_of, require, shortened, shown, warn

T = TypeVar("T")


def read_bytes(path: Path, what: str) -> bytes:
    """Read a whole file; `what`, for messages, is what it should be. A pipe gives a PipeWarning.

    Raises FileError if it is missing, cannot be read or is a device.
    """
    try:
        device = path.is_char_device() or path.is_block_device()  # /dev/zero never ends
        if path.is_fifo():
            warn(f"{path} is a pipe: reading it waits for its writer to end", PipeWarning)
        content = b"" if device else path.read_bytes()
    except FileNotFoundError as error:
        raise FileError(path, "there is no such file", what) from error
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be read ({error})", what) from error
    if device:
        raise FileError(path, "this is a device", what)
    return content


_AS_UTF_8 = "UTF-8 text (save the file again with that encoding; from a spreadsheet program as CSV UTF-8)"


def read_text(path: Path, what: str) -> str:
    """Read a whole file of UTF-8, or of UTF-16 with its byte-order mark, without that mark; `what` as in `read_bytes`.

    Raises FileError if it is missing, cannot be read or is no such text.
    """
    content = read_bytes(path, what)
    if content.startswith(b"PK\x03\x04"):  # a workbook is a zip archive
        raise FileError(
            path, "it is a workbook of a spreadsheet program or a zip archive", "a table saved as CSV UTF-8"
        )
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if wide else "utf-8-sig")
        if (zero := text.find("\0")) < 0:
            return text
        found = "a character is NUL, as in UTF-16 without its mark or in a file that is no text"
        raise FileError(path, found, _AS_UTF_8, row=text.count("\n", 0, zero) + 1)
    except UnicodeDecodeError as error:
        row = content.count(b"\n", 0, error.start) + 1
        found = f"byte 0x{content[error.start]:02x} at offset {error.start} is not {'UTF-16' if wide else 'UTF-8'}"
        raise FileError(path, found, _AS_UTF_8, row=row) from error


_MOST_DIGITS = 400  # more digits than any finite float has before the point


def parse_json_file_text(
    path: str | os.PathLike[str], text: str | bytes, allowed: str, *, row: int | None = None
) -> Any:
    """Parse strict JSON from a file, or its line `row`; FileError says where it is wrong and what is `allowed`."""
    try:
        return parse_strict_json(text)
    except json.JSONDecodeError as error:
        found = f"does not parse as JSON: {error.msg} at character {error.colno}"
        raise FileError(path, found, allowed, row=error.lineno if row is None else row) from error
    except ValueError as error:
        raise FileError(path, f"does not parse as JSON: {error}", allowed, row=row) from error


def parse_strict_json(text: str | bytes) -> Any:
    """Parse a JSON text, or UTF-8 bytes; a byte-order mark is skipped.

    Raises json.JSONDecodeError if it does not parse; ValueError if it is nested too deep, bytes are not UTF-8, a lone
    surrogate is escaped, a number is NaN, infinite or beyond the floats, or an object repeats a name.
    """
    text = text.decode("utf-8-sig") if isinstance(text, bytes) else text.removeprefix("\ufeff")
    try:
        value = json.loads(
            text,
            object_pairs_hook=_dict_of_unique_names,
            parse_constant=_refuse_constant,
            parse_int=_parse_whole_number,
            parse_float=_parse_finite_number,
        )
        if "\\u" in text:  # an escaped lone surrogate could not be written to a file
            json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        raise ValueError("half of an escaped character, a surrogate, stands alone") from error
    except RecursionError as error:
        raise ValueError("lists or objects nested too deep") from error
    return value


LARGEST = 1e15
"""Largest magnitude of a number in a file: beyond, squares and differences lose all precision."""


class FileObject:
    """A JSON object or a table of TOML, `where` it stands in its file; a FileError names the place of what is wrong.

    Its numbers are of magnitude up to `largest`.
    """

    def __init__(self, path: Path, where: str, content: object, *, largest: float = LARGEST) -> None:
        if not isinstance(content, dict):
            allowed = f"a table [{where}]" if path.suffix == ".toml" else "an object {...}"
            raise FileError(path, f"{where or 'the whole'} is {shortened_json(content)}", allowed)
        self.path, self.where, self.largest = path, where, largest
        self.content: dict[str, Any] = content
        self._taken = set[str]()

    def error(self, name: str, allowed: str) -> FileError:
        """Return the error of an entry that is missing or not allowed."""
        found = f"is {shortened_json(self.content[name])}" if name in self.content else "is missing"
        return FileError(self.path, f"{self.where}.{name} {found}".lstrip("."), allowed)

    def value(self, name: str, allowed: str, fits: Callable[[Any], bool]) -> Any:
        """Return an entry that `fits`; FileError if it is missing or does not."""
        self._taken.add(name)
        if name not in self.content or not fits(self.content[name]):
            raise self.error(name, allowed)
        return self.content[name]

    def number(self, name: str) -> float:
        """Return an entry that is a number."""
        allowed = f"a finite number of magnitude up to {self.largest:g}"
        return float(self.value(name, allowed, lambda value: is_number_of_file(value, self.largest)))

    def object(self, name: str, allowed: str = "a table of that name") -> FileObject:
        """Return an entry that is an object."""
        content = self.value(name, allowed, lambda value: True)
        return FileObject(self.path, f"{self.where}.{name}".lstrip("."), content, largest=self.largest)

    def build(self, kind: Callable[..., T], *values: Any, **named: Any) -> T:
        """Return `kind` of values from the object; its ParameterError becomes a FileError that names the entry."""
        try:
            return kind(*values, **named)
        except ParameterError as error:
            found = f"{self.where}.{error.name} is {shown(error.value)}".lstrip(".")
            raise FileError(self.path, found, error.allowed) from error

    @property
    def unknown(self) -> list[str]:
        """The names of the entries that were not asked for."""
        return [name for name in self.content if name not in self._taken]

    def require_none_unknown(self) -> None:
        """Raise FileError if an entry, being unknown, was never asked for."""
        for name in self.unknown:
            found = f"{self.where}.{name} is not known".lstrip(".")
            raise FileError(self.path, found, f"the entries {', '.join(sorted(self._taken))}")


def is_number_of_file(value: object, largest: float = LARGEST) -> bool:
    """Return whether a parsed value is a number of magnitude up to `largest`."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= largest


def shortened_json(value: object) -> str:
    """Return a parsed value as it stands in a file, cut where it is long."""
    return shortened(json.dumps(value, ensure_ascii=False, default=str), 60)


def _dict_of_unique_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out = dict(pairs)
    if len(out) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the name {shown(next(n for n in names if names.count(n) > 1))} comes twice")
    return out


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")


def _parse_whole_number(digits: str) -> int:
    # Python refuses to convert texts of thousands of digits.
    if len(digits) > _MOST_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits, beyond every float")
    _parse_finite_number(digits)
    return int(digits)


def _parse_finite_number(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(f"the number {shown(digits)} is beyond every float")
    return value


def run_python_file(path: str | os.PathLike[str], what: str) -> Mapping[str, Any]:
    """Run a user's file as `import` would, its folder first on the search path, and return the names that it defines.

    Raises FileError, with the line, if it cannot be read or run; `what` says what the file should be.
    """
    path = checked_path("path", path, what)
    return run_python_text(read_text(path, what), path)


def run_python_text(text: str, path: Path) -> Mapping[str, Any]:
    """Run the text of a user's file and return the names that it defines, as `run_python_file` does."""
    try:
        code = compile(text, str(path), "exec")
    except Exception as error:
        found = f"is no Python: {message_of(error, kind=False)}"
        if isinstance(error, MemoryError | RecursionError):  # of the parser
            found = f"has an expression that is too long or too deeply nested for Python ({type(error).__name__})"
        raise FileError(path, found, "a file that Python can run", row=getattr(error, "lineno", None)) from error
    module = ModuleType(f"probewise_file_{path.stem}")  # a prefix, so that serial.py cannot hide the package serial
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses look their module up
    folder = str(path.absolute().parent)
    added = folder not in sys.path
    if added:
        sys.path.insert(0, folder)
    try:
        with np.errstate(), warnings.catch_warnings(), in_this_directory():  # what the file sets is its own affair
            exec(code, module.__dict__)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        found = f"stops with {message_of(error)}"
        raise FileError(path, found, "a file that Python can run", row=lines[-1] if lines else None) from error
    finally:
        if added:  # now last: what lies beside the file is not taken for a library that is imported later
            sys.path[:] = [*(each for each in sys.path if each != folder), folder]
    return module.__dict__


@contextlib.contextmanager
def in_this_directory() -> Iterator[None]:
    """Return to the working directory, from which relative names count, if code of a user leaves it in the block."""
    before = "."
    with contextlib.suppress(OSError):  # it was removed
        before = os.getcwd()
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.chdir(before)


class EndedByFile(Exception):
    """What a function of a user's file raised that is no Exception, such as SystemExit; the text names it."""


class FunctionOfFile:
    """A function of a user's file: whatever it raises, but for Ctrl-C, is an Exception; unpickled, the file runs again.

    `name` is what it is called in `text`, which `path` had when it was read.
    """

    def __init__(self, function: Callable[..., Any], name: str, text: str, path: Path) -> None:
        functools.update_wrapper(self, function)
        self._function, self._where = function, (name, text, path)

    def __call__(self, *args: Any, **named: Any) -> Any:
        """Call the function."""
        try:
            return self._function(*args, **named)
        except (Exception, KeyboardInterrupt):
            raise
        except BaseException as error:
            raise EndedByFile(message_of(error)).with_traceback(error.__traceback__) from error

    def __reduce__(self) -> tuple[Callable[..., FunctionOfFile], tuple[str, str, Path]]:
        return _function_of_file, self._where


def _function_of_file(name: str, text: str, path: Path) -> FunctionOfFile:
    return FunctionOfFile(_run_once(text, path)[name], name, text, path)


_run_once = functools.lru_cache(maxsize=4)(run_python_text)  # for all functions of a file


SHIPPED = ("paper", "concealed")


def shipped(name: str) -> Path:
    """Return the path of a recording shipped with the package, with its JSON beside it.

    Both are simulated (world/shipped.py). `paper`: readings of the paper's plan, 404 over the black-and-white boundary
    and four over the quadrants. `concealed`: 961 readings of scans out and back, with one effect that the sensor model
    leaves out, drawn from a seed. ParameterError for another name.
    """
    require(name in SHIPPED, "name", name, " or ".join(repr(known) for known in SHIPPED))
    return Path(str(resources.files("probewise"))) / "data" / f"{name}.csv"


_ALLOWED = "a PNG of 8 bits per channel, or an .npy of two axes with numbers 0 to 255; at most 1e8 pixels"
_LARGEST_PIXELS = 100_000_000


def is_file_name_without_path(name: str) -> bool:
    """Return whether `name` is a plain file name, without a path, on any system."""
    return name not in ("", ".", "..") and PurePosixPath(name).name == name == PureWindowsPath(name).name


def read_image(path: Path) -> FloatArray:
    """Read an image as albedo 0 to 1, shape (n_rows, n_columns), first row on top.

    Grey values 0 to 255 are linear in albedo; colours are averaged over their channels; transparent pixels have albedo
    0, as outside the image. FileError if it is not such an image, or is damaged.
    """
    content = read_bytes(path, _ALLOWED)
    try:
        if path.suffix.lower() == ".npy":
            values = np.load(io.BytesIO(content), allow_pickle=False)
            is_picture = isinstance(values, np.ndarray) and values.ndim == 2 and values.dtype.kind in "uif"
            if not is_picture or not 0 < values.size <= _LARGEST_PIXELS or not ((values >= 0) & (values <= 255)).all():
                raise ValueError(shown(values))
            return np.asarray(values, dtype=np.float64) / 255.0
        from PIL import Image as Pillow  # imported here: most recordings have no image

        with Pillow.open(io.BytesIO(content), formats=["PNG"]) as picture:
            size, is_known = picture.width * picture.height, picture.mode in ("1", "L", "LA", "P", "RGB", "RGBA")
            if not is_known or size > _LARGEST_PIXELS:
                raise ValueError(f"{picture.width} x {picture.height} pixels of the mode {picture.mode}")
            pixels = np.asarray(picture.convert("RGBA"), dtype=np.float64)
        return np.asarray(pixels[..., :3].mean(axis=-1) / 255.0 * (pixels[..., 3] / 255.0))
    except Exception as error:  # damaged files make Pillow and NumPy raise many kinds
        raise FileError(path, f"no such picture ({message_of(error, kind=False)})", _ALLOWED) from error


def image_bytes(albedo: FloatArray, suffix: str) -> bytes:
    """Encode albedo (n_rows, n_columns) as the file that `read_image` reads back: '.npy' or '.png'.

    ParameterError for another suffix, an albedo outside 0 to 1, or, of a '.png', one not in steps of 1/255.
    """
    bad = ~((albedo >= 0) & (albedo <= 1))
    if bad.any():
        raise ParameterError("albedo of an image", float(albedo[bad][0]), "0 to 1 in every pixel")
    values = albedo * 255.0
    if suffix.lower() == ".npy":
        out = io.BytesIO()
        np.save(out, values, allow_pickle=False)
        return out.getvalue()
    require(suffix.lower() == ".png", "image file suffix", suffix, "'.png' or '.npy'")
    grey = np.rint(values)
    in_steps = np.abs(grey - values).max(initial=0.0) <= 1e-9
    require(in_steps, "image file suffix", suffix, "'.npy' for an albedo that is not in steps of 1/255")
    from PIL import Image as Pillow  # imported here: most recordings have no image

    out = io.BytesIO()
    Pillow.fromarray(grey.astype(np.uint8)).save(out, "PNG")
    return out.getvalue()
