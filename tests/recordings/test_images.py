"""PNG and .npy pictures against an encoder that is not ours, and damaged ones."""

import io
import struct
import zlib

import numpy as np
import pytest

from probewise.errors import FileError
from probewise.recordings.images import image_bytes, read_image

RNG = np.random.default_rng(8)
SMOOTH = np.clip(np.add.outer(np.arange(40) * 3, np.arange(33) * 2) + RNG.integers(0, 9, (40, 33)), 0, 255)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width, height, lines: bytes, *, depth=8, colour=0, interlace=0, more=b"") -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, interlace))
    return b"\x89PNG\r\n\x1a\n" + header + more + chunk(b"IDAT", zlib.compress(lines)) + chunk(b"IEND", b"")


def paeth(a, b, c):
    guess = a + b - c
    return min((a, b, c), key=lambda v: abs(guess - v))


def filtered(values: np.ndarray, kind: int) -> bytes:
    """Encode by the text of the PNG specification, byte by byte."""
    height, width, channels = values.shape
    flat = values.reshape(height, -1).astype(int)
    out = bytearray()
    for r in range(height):
        out.append(kind)
        for k in range(width * channels):
            a = flat[r, k - channels] if k >= channels else 0
            b = flat[r - 1, k] if r else 0
            c = flat[r - 1, k - channels] if r and k >= channels else 0
            out.append((flat[r, k] - (0, a, b, (a + b) // 2, paeth(a, b, c))[kind]) % 256)
    return bytes(out)


@pytest.mark.parametrize("kind", range(5))
@pytest.mark.parametrize(("colour", "channels"), [(0, 1), (2, 3), (4, 2), (6, 4)])
def test_every_filter_and_colour_type_is_undone(tmp_path, kind, colour, channels):
    values = RNG.integers(0, 256, (6, 5, channels), dtype=np.uint8)
    (tmp_path / "a.png").write_bytes(png(5, 6, filtered(values, kind), colour=colour))
    grey = values[..., : 3 if channels > 2 else 1].mean(axis=-1) / 255
    alpha = values[..., -1] / 255 if channels in (2, 4) else 1.0
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), grey * alpha, atol=1e-14)


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA", "P"])
def test_pictures_by_another_program_are_read(tmp_path, mode):
    pillow = pytest.importorskip("PIL.Image")
    pillow.fromarray(SMOOTH.astype(np.uint8)).convert(mode).save(tmp_path / "a.png")
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), SMOOTH / 255, atol=1e-14)


def test_a_grey_picture_is_written_and_another_program_reads_it(tmp_path):
    pillow = pytest.importorskip("PIL.Image")
    content = image_bytes(SMOOTH / 255, ".png")
    np.testing.assert_array_equal(np.asarray(pillow.open(io.BytesIO(content))), SMOOTH)
    (tmp_path / "a.png").write_bytes(content)
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), SMOOTH / 255)


def test_transparent_palette_entries_reflect_nothing(tmp_path):
    more = chunk(b"PLTE", bytes([255, 255, 255, 51, 51, 51])) + chunk(b"tRNS", bytes([0]))
    (tmp_path / "a.png").write_bytes(png(2, 1, bytes([0, 0, 1]), colour=3, more=more))
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), [[0.0, 0.2]])


GOOD = png(2, 1, bytes([0, 10, 20]))
DAMAGED = {
    "not a png": (b"GIF89a", "does not begin as a PNG"),
    "cut short": (GOOD[:40], "damaged or cut short"),
    "a bit flipped": (GOOD[:45] + bytes([GOOD[45] ^ 1]) + GOOD[46:], "damaged"),
    "16 bits": (png(2, 1, bytes(9), depth=16), "16 bits"),
    "interlaced": (png(2, 1, bytes([0, 1, 2]), interlace=1), "interlace 1"),
    "too few pixels": (png(2, 2, bytes([0, 1, 2])), "6 bytes for 2 x 2"),
    "too many pixels": (png(2, 1, bytes(50)), "3 bytes for 2 x 1"),
    "enormous": (png(2**31 - 1, 2**31 - 1, b""), "at most"),
    "no pixels": (png(0, 1, b""), "0 x 1"),
    "unknown filter": (png(2, 1, bytes([9, 1, 2])), "filter 9"),
    "not zlib": (GOOD[:33] + chunk(b"IDAT", b"abc") + chunk(b"IEND", b""), "pixel data are damaged"),
    "no header": (GOOD[:8] + chunk(b"IEND", b""), "no header"),
    "no palette": (png(2, 1, bytes([0, 1, 2]), colour=3), "palette"),
    "colour key": (png(2, 1, bytes([0, 1, 2]), more=chunk(b"tRNS", bytes(2))), "transparent"),
}


@pytest.mark.parametrize("what", DAMAGED)
def test_a_picture_that_cannot_be_used_is_named(tmp_path, what):
    content, fragment = DAMAGED[what]
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(FileError, match=fragment):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize(
    "values", [np.zeros(3), np.array([[256.0]]), np.array([[np.nan]]), np.array([["a"]]), np.zeros((0, 2))]
)
def test_an_array_that_is_no_picture_is_refused(tmp_path, values):
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(FileError):
        read_image(tmp_path / "a.npy")


@pytest.mark.parametrize("content", [b"", b"abc", b"\x93NUMPY\x01\x00"])
def test_a_damaged_array_file_is_refused(tmp_path, content):
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(FileError, match="npy"):
        read_image(tmp_path / "a.npy")
