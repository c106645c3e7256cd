"""PNG and .npy pictures, and damaged ones."""

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


@pytest.mark.parametrize(
    "values", [np.zeros(3), np.array([[256.0]]), np.array([[np.nan]]), np.array([["a"]]), np.zeros((0, 2)), b"", b"abc"]
)
def test_an_array_that_is_no_picture_is_refused(tmp_path, values):
    if isinstance(values, bytes):
        (tmp_path / "a.npy").write_bytes(values)
    else:
        np.save(tmp_path / "a.npy", values)
    with pytest.raises(FileError, match="a\\.npy: "):
        read_image(tmp_path / "a.npy")
