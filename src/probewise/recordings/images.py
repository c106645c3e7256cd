"""Images as albedo: 8-bit PNG and .npy; headers are checked before anything is unpacked."""

from __future__ import annotations

import io
import math
import struct
import zlib
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np
from numpy.lib import format as npy

from probewise._arrays import FloatArray
from probewise.errors import FileError, ParameterError, require
from probewise.recordings.io import read_bytes

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # grey, RGB, palette, grey and RGB with alpha
_ALLOWED = "a PNG of 8 bits per channel (grey, RGB, palette, with or without alpha), not interlaced, or .npy"
_LARGEST_PIXELS = 100_000_000
# By version; 3.0 is only for structured arrays.
_NPY_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def is_file_name_without_path(name: str) -> bool:
    """Return whether `name` is a plain file name, without a path, on any system."""
    return name not in ("", ".", "..") and PurePosixPath(name).name == name == PureWindowsPath(name).name


def read_image(path: Path) -> FloatArray:
    """Read an image as albedo 0 to 1, shape (n_rows, n_columns), first row on top.

    Grey values 0 to 255 are linear in albedo; colours are averaged over their channels; transparent pixels have albedo
    0, as outside the image. FileError if it is not such an image, or is damaged.
    """
    content = read_bytes(path, _ALLOWED)
    if path.suffix.lower() == ".npy":
        return _albedo_from_npy(path, content)
    if not content.startswith(_SIGNATURE):
        raise FileError(path, "the file does not begin as a PNG does", _ALLOWED)
    return _albedo_from_png(path, content)


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
    if np.abs(grey - values).max(initial=0.0) > 1e-9:
        raise ParameterError("image file suffix", suffix, "'.npy' for an albedo that is not in steps of 1/255")
    from PIL import Image as Pillow  # imported here: most recordings have no image

    out = io.BytesIO()
    Pillow.fromarray(grey.astype(np.uint8)).save(out, "PNG")
    return out.getvalue()


def _albedo_from_npy(path: Path, content: bytes) -> FloatArray:
    allowed = f"a two-dimensional array of numbers, at most {_LARGEST_PIXELS}"
    file = io.BytesIO(content)
    try:
        shape, by_columns, dtype = _NPY_HEADERS[npy.read_magic(file)](file)
    # numpy parses the header as Python; a malicious one can raise almost any exception.
    except Exception as error:
        raise FileError(path, f"not readable as .npy ({error})", allowed) from error
    size = math.prod(shape)
    if len(shape) != 2 or dtype.kind not in "uif" or min(shape) < 1 or size > _LARGEST_PIXELS:
        raise FileError(path, f"{dtype} of shape {shape}", allowed)
    n_bytes = len(content) - file.tell()
    if n_bytes != size * dtype.itemsize:
        raise FileError(path, f"{n_bytes} bytes of numbers", f"{size * dtype.itemsize} for {dtype} of shape {shape}")
    values = np.frombuffer(content, dtype, offset=file.tell()).reshape(shape, order="F" if by_columns else "C")
    albedo = values.astype(np.float64)
    bad = ~((albedo >= 0) & (albedo <= 255))
    if bad.any():
        row, column = (int(k) for k in np.argwhere(bad)[0])
        raise FileError(path, f"pixel [{row}, {column}] is {albedo[row, column]}", "0 to 255")
    return albedo / 255.0


def _albedo_from_png(path: Path, content: bytes) -> FloatArray:
    from PIL import Image as Pillow  # imported here: most recordings have no image

    if content[12:16] != b"IHDR" or len(content) < 33:
        raise FileError(path, "the PNG has no header", _ALLOWED)
    width, height, depth, colour, _, _, interlace = struct.unpack(">IIBBBBB", content[16:29])
    if depth != 8 or colour not in _CHANNELS or interlace or not 0 < width * height <= _LARGEST_PIXELS:
        found = f"{width} x {height} pixels, {depth} bits, colour type {colour}, interlace {interlace}"
        raise FileError(path, found, f"{_ALLOWED}, at most {_LARGEST_PIXELS} pixels")
    try:
        Pillow.open(io.BytesIO(content), formats=["PNG"]).verify()  # the checksums
        with Pillow.open(io.BytesIO(content), formats=["PNG"]) as picture:
            palette = b"" if picture.palette is None else picture.palette.getdata()[1]  # before it is padded
            if picture.mode == "P" and len(palette) <= 3 * int(np.asarray(picture).max()):
                raise ValueError("the palette is missing or too short for the pixels")
            pixels = np.asarray(picture.convert("RGBA"), dtype=np.float64)
        size = height * (1 + width * _CHANNELS[colour])
        n_bytes = _count_bytes_of_pixels(content, size + 1)
    except Exception as error:  # damaged files make Pillow raise many kinds
        raise FileError(path, f"the PNG is damaged or cut short ({error})", _ALLOWED) from error
    if n_bytes != size:  # Pillow takes missing lines for black
        raise FileError(path, f"{n_bytes} bytes of pixel data", f"{size} bytes for {width} x {height} pixels")
    return np.asarray(pixels[..., :3].mean(axis=-1) / 255.0 * (pixels[..., 3] / 255.0))


def _count_bytes_of_pixels(content: bytes, most: int) -> int:
    """Count the decompressed bytes of a PNG's pixels up to `most`: a small file can expand to gigabytes."""
    packed, at = bytearray(), len(_SIGNATURE)
    while at < len(content):
        begin = at + 8
        end = begin + int.from_bytes(content[at : at + 4], "big")
        if content[at + 4 : begin] == b"IDAT":
            packed += content[begin:end]
        at = end + 4  # behind the checksum
    return len(zlib.decompressobj().decompress(packed, most))
