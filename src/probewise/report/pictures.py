"""Pictures of a run joined with Pillow: two runs side by side, and an animated GIF with one frame per step."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import zip_longest

import numpy as np
from PIL import Image

from probewise.errors import require

_COLOURS = 256
_FRAME_S, _LAST_S = 0.8, 3.0


def join_side_by_side(left: Sequence[bytes], right: Sequence[bytes]) -> list[bytes]:
    """Join the PNGs of two runs, one or more each, step by step; the shorter run keeps its last picture.

    Return PNGs with a small palette, as many as the longer run has; b"" for a step without a picture (b"") of either.
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
    few.save(out, "PNG")
    return out.getvalue()


def animated_gif(frames: Sequence[bytes], *, frame_s: float = _FRAME_S, last_s: float = _LAST_S) -> bytes:
    """Join one or more PNGs into an animated GIF that loops for ever; smaller ones lie at the upper left."""
    require(frames, "frames", 0, "one picture or more")
    pictures = [Image.open(io.BytesIO(frame)).convert("RGB") for frame in frames]
    size = (max(p.width for p in pictures), max(p.height for p in pictures))
    sheets = []
    for picture in pictures:
        sheet = Image.new("RGB", size, "white")
        sheet.paste(picture, (0, 0))
        sheets.append(sheet)
    palette = _common_palette(sheets)
    sheets = [sheet.quantize(palette=palette, dither=Image.Dither.NONE) for sheet in sheets]
    durations = [round(1000 * frame_s)] * (len(sheets) - 1) + [round(1000 * last_s)]
    out = io.BytesIO()
    sheets[0].save(out, "GIF", save_all=True, append_images=sheets[1:], duration=durations, loop=0)
    return out.getvalue()


def _common_palette(sheets: Sequence[Image.Image]) -> Image.Image:
    """Return a palette image of 256 colours that all frames share; with one palette each, a colour would change.

    The palette covers the range of colours, whatever their frequency, so that small squares keep their rare colours.
    """
    weights = np.array([1 << 16, 1 << 8, 1], dtype=np.uint32)
    codes = np.unique(np.concatenate([np.unique(np.asarray(sheet) @ weights) for sheet in sheets]))
    colours = np.stack([codes >> 16, codes >> 8 & 255, codes & 255], axis=-1).astype(np.uint8)
    return Image.fromarray(colours[None]).quantize(_COLOURS, method=Image.Quantize.MAXCOVERAGE)
