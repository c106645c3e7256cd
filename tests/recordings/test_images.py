"""PNG and .npy pictures, and damaged ones."""

import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image as Pillow

from probewise.errors import FileError
from probewise.recordings.io import image_bytes, read_image

RNG = np.random.default_rng(8)
SMOOTH = np.clip(np.add.outer(np.arange(40) * 3, np.arange(33) * 2) + RNG.integers(0, 9, (40, 33)), 0, 255)


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width, height, lines, *, depth=8, colour=0, more=b""):
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + more + chunk(b"IDAT", zlib.compress(lines)) + chunk(b"IEND", b"")


@pytest.mark.parametrize(("mode", "channels"), [("L", 1), ("RGB", 3), ("LA", 2), ("RGBA", 4)])
def test_an_albedo_is_the_mean_of_the_colours_times_the_opacity(tmp_path, mode, channels):
    values = RNG.integers(0, 256, (6, 5, channels), dtype=np.uint8)
    Pillow.fromarray(values.squeeze(), mode).save(tmp_path / "a.png")
    grey = values[..., : 3 if channels > 2 else 1].mean(axis=-1) / 255
    alpha = values[..., -1] / 255 if channels in (2, 4) else 1.0
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), grey * alpha, atol=1e-14)


def test_a_grey_picture_is_written_as_it_is_read_also_with_a_palette(tmp_path):
    (tmp_path / "a.png").write_bytes(image_bytes(SMOOTH / 255, ".png"))
    np.testing.assert_array_equal(np.asarray(Pillow.open(tmp_path / "a.png")), SMOOTH)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), SMOOTH / 255)
    Pillow.open(tmp_path / "a.png").convert("P").save(tmp_path / "p.png")
    np.testing.assert_allclose(read_image(tmp_path / "p.png"), SMOOTH / 255, atol=1e-14)


def test_transparent_palette_entries_reflect_nothing(tmp_path):
    more = chunk(b"PLTE", bytes([255, 255, 255, 51, 51, 51])) + chunk(b"tRNS", bytes([0]))
    (tmp_path / "a.png").write_bytes(png(2, 1, bytes([0, 0, 1]), colour=3, more=more))
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), [[0.0, 0.2]])
    (tmp_path / "a.png").write_bytes(png(2, 1, bytes([0, 51, 102]), more=chunk(b"tRNS", bytes([0, 51]))))
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), [[0.0, 0.4]])


GOOD = png(2, 1, bytes([0, 10, 20]))
DAMAGED = {
    "not a png": b"GIF89a",
    "cut short": GOOD[:40],
    "a bit flipped": GOOD[:45] + bytes([GOOD[45] ^ 1]) + GOOD[46:],
    "16 bits": png(2, 1, bytes(9), depth=16),
    "enormous": png(2**31 - 1, 2**31 - 1, b""),
}


@pytest.mark.parametrize("what", DAMAGED)
def test_a_picture_that_cannot_be_used_is_named(tmp_path, what):
    (tmp_path / "a.png").write_bytes(DAMAGED[what])
    with pytest.raises(FileError, match=r"a\.png: no such picture"):
        read_image(tmp_path / "a.png")


def npy(header, content=b"", version=b"\x01\x00"):
    size = struct.pack("<H" if version == b"\x01\x00" else "<I", len(header))
    return b"\x93NUMPY" + version + size + header.encode() + content


def described(shape, kind="|u1"):
    return f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n"


def saved(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


ARRAYS = {
    "one row": saved(np.zeros(3)),
    "beyond white": saved(np.array([[256.0]])),
    "NaN": saved(np.array([[np.nan]])),
    "texts": saved(np.array([["a"]])),
    "no pixel": saved(np.zeros((0, 2))),
    "nothing": b"",
    "a picture of 100,000 x 100,000": npy(described("(100000, 100000)")),
    "a negative shape": npy(described("(-1, -4)"), bytes(4)),
    "two thousand brackets": npy("(" * 2000 + ")" * 2000),
    "Python objects": npy(described("(2, 2)", "|O"), bytes(32)),
    "cut short": npy(described("(4, 4)"), bytes(15)),
    "another file's first bytes": b"\x89PNG\r\n\x1a\n" + bytes(100),
    "a header that is cut short": b"\x93NUMPY\x01\x00\xff\xff{",
    "a header of a gigabyte": b"\x93NUMPY\x02\x00\xff\xff\xff\x3f{",
}


@pytest.mark.parametrize("what", ARRAYS)
def test_an_array_that_is_no_picture_is_refused_by_its_header(tmp_path, what):
    (tmp_path / "a.npy").write_bytes(ARRAYS[what])
    with pytest.raises(FileError, match=r"a\.npy: no such picture"):
        read_image(tmp_path / "a.npy")
