"""Images as albedo: 8-bit PNG and .npy; headers are checked before anything is unpacked."""

from __future__ import annotations

import io
import math
import struct
import zlib
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from probewise._arrays import FloatArray
from probewise.errors import FileError, ParameterError
from probewise.recordings.io import read_bytes

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by PNG colour type
_ALLOWED = "a PNG of 8 bits per channel (grey, RGB, palette, with or without alpha), not interlaced, or .npy"
_LARGEST_PIXELS = 100_000_000
# By version; 3.0 is only for structured arrays.
_NPY_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
Bytes8 = NDArray[np.uint8]


def is_file_name_without_path(name: str) -> bool:
    """Return whether `name` is a plain file name, without a path, on any system."""
    return name not in ("", ".", "..") and PurePosixPath(name).name == name == PureWindowsPath(name).name


def read_image(path: Path) -> FloatArray:
    """Read an image as albedo 0 to 1, shape (n_rows, n_columns), first row on top.

    Grey values 0 to 255 are linear in albedo; colours are averaged over their channels; transparent
    pixels have albedo 0, as outside the image.

    Raises FileError if it is not such an image, is damaged, or has values outside 0 to 255.
    """
    content = read_bytes(path, _ALLOWED)
    if path.suffix.lower() == ".npy":
        return _albedo_from_npy(path, content)
    if not content.startswith(_SIGNATURE):
        raise FileError(path, "the file does not begin as a PNG does", _ALLOWED)
    return _albedo_from_png(path, content)


def image_bytes(albedo: FloatArray, suffix: str) -> bytes:
    """Encode albedo (n_rows, n_columns) as the file that `read_image` reads back: '.npy' or '.png'.

    Raises ParameterError if `suffix` is another, an albedo is outside 0 to 1, or `suffix` is '.png' and the albedo is
    not in steps of 1/255.
    """
    bad = ~((albedo >= 0) & (albedo <= 1))
    if bad.any():
        raise ParameterError("albedo of an image", float(albedo[bad][0]), "0 to 1 in every pixel")
    values = albedo * 255.0
    if suffix.lower() == ".npy":
        out = io.BytesIO()
        np.save(out, values, allow_pickle=False)
        return out.getvalue()
    if suffix.lower() != ".png":
        raise ParameterError("image file suffix", suffix, "'.png' or '.npy'")
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
    chunks = _png_chunks(path, content)
    width, height, depth, colour, _, _, interlace = struct.unpack(">IIBBBBB", chunks[b"IHDR"])
    if depth != 8 or colour not in _CHANNELS or interlace or not 0 < width * height <= _LARGEST_PIXELS:
        found = f"{width} x {height} pixels, {depth} bits, colour type {colour}, interlace {interlace}"
        raise FileError(path, found, f"{_ALLOWED}, at most {_LARGEST_PIXELS} pixels")
    n_channels = _CHANNELS[colour]
    expected = height * (1 + width * n_channels)
    try:
        # Never decompress more than the header announces: a small file can expand to gigabytes.
        raw = zlib.decompressobj().decompress(chunks.get(b"IDAT", b""), expected + 1)
    except zlib.error as error:
        raise FileError(path, f"the pixel data are damaged ({error})", _ALLOWED) from error
    if len(raw) != expected:
        raise FileError(path, f"{len(raw)} bytes of pixel data", f"{expected} bytes for {width} x {height} pixels")
    filters = np.frombuffer(raw, dtype=np.uint8).reshape(height, -1)[:, 0]
    if filters.max() > 4:
        k = int(np.argmax(filters > 4))
        raise FileError(path, f"line {k} has filter {filters[k]}", "filters 0 to 4")
    return _albedo_of_pixels(path, _decoded_pixels(chunks[b"IDAT"], width, height, n_channels), colour, chunks)


def _decoded_pixels(packed: bytes, width: int, height: int, n_channels: int) -> Bytes8:
    """Decompress a PNG's pixels and undo its line filters: 8 bits, (height, width, n_channels)."""
    from PIL import Image as Pillow  # imported here: most recordings have no image

    mode = {1: "L", 2: "LA", 3: "RGB", 4: "RGBA"}[n_channels]
    decoded = Pillow.frombytes(mode, (width, height), packed, "zip", mode)
    return np.asarray(decoded).reshape(height, width, n_channels)


def _png_chunks(path: Path, content: bytes) -> dict[bytes, bytes]:
    """Return the data of a PNG's chunks by type, with chunks of one type joined; their checksums are checked."""
    parts: dict[bytes, list[bytes]] = {}
    at = len(_SIGNATURE)
    while at < len(content):
        length = int.from_bytes(content[at : at + 4], "big")
        kind, data = content[at + 4 : at + 8], content[at + 8 : at + 8 + length]
        check = content[at + 8 + length : at + 12 + length]
        if len(check) != 4 or zlib.crc32(data, zlib.crc32(kind)) != int.from_bytes(check, "big"):
            raise FileError(path, f"the PNG is damaged or cut short at byte {at}", _ALLOWED)
        parts.setdefault(kind, []).append(data)
        at += 12 + length
    chunks = {kind: b"".join(data) for kind, data in parts.items()}
    if len(chunks.get(b"IHDR", b"")) != 13:
        raise FileError(path, "the PNG has no header", _ALLOWED)
    return chunks


def _albedo_of_pixels(path: Path, pixels: Bytes8, colour: int, chunks: dict[bytes, bytes]) -> FloatArray:
    """Return albedo, (height, width): the mean over the colours, times opacity."""
    if colour == 3:
        table = np.frombuffer(chunks.get(b"PLTE", b""), dtype=np.uint8)
        if table.size == 0 or table.size % 3 or int(pixels.max()) >= table.size // 3:
            raise FileError(path, "the palette is missing or too short for the pixels", _ALLOWED)
        values = table.reshape(-1, 3).mean(axis=1)
        alpha = np.full(len(values), 255.0)
        given = np.frombuffer(chunks.get(b"tRNS", b""), dtype=np.uint8)[: len(values)]
        alpha[: len(given)] = given
        return np.asarray((values * alpha)[pixels[..., 0]] / 255.0**2, dtype=np.float64)
    if b"tRNS" in chunks:
        raise FileError(path, "one colour is declared transparent", "a PNG without that, or with an alpha channel")
    n_colours = 1 if colour in (0, 4) else 3
    values = pixels[..., :n_colours].mean(axis=-1, dtype=np.float64) / 255.0
    return np.asarray(values * (pixels[..., -1] / 255.0) if colour in (4, 6) else values, dtype=np.float64)
