"""Pictures of two runs side by side, one per step, compressed to fit in one page."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import zip_longest

from PIL import Image

_COLOURS = 256


def join_side_by_side(left: Sequence[bytes], right: Sequence[bytes]) -> list[bytes]:
    """Join the pictures of two runs step by step; the shorter run keeps its last picture.

    Parameters
    ----------
    left, right
        One or more PNGs each.

    Returns
    -------
    PNGs with a small palette, as many as the longer run has; b"" for a step without a picture (b"") of either.
    """
    pairs = zip_longest(left, right)
    return [_paste_side_by_side(a if a is not None else left[-1], b if b is not None else right[-1]) for a, b in pairs]


def _paste_side_by_side(left: bytes, right: bytes) -> bytes:
    if not (left and right):
        return b""
    pictures = [Image.open(io.BytesIO(picture)).convert("RGB") for picture in (left, right)]
    sheet = Image.new("RGB", (sum(p.width for p in pictures), max(p.height for p in pictures)), "white")
    sheet.paste(pictures[0], (0, 0))
    sheet.paste(pictures[1], (pictures[0].width, 0))
    out = io.BytesIO()
    # An octree keeps rare colours: the median cut turned the green place of the next reading blue.
    few = sheet.quantize(_COLOURS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    few.save(out, "PNG", optimize=True)
    return out.getvalue()
