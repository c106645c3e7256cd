"""An animated GIF of a run: one frame per step."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image

from probewise.errors import ParameterError


def animated_gif(frames: Sequence[bytes], *, frame_s: float = 0.8, last_s: float = 3.0) -> bytes:
    """Join PNGs into an animated GIF that loops for ever; return its bytes.

    Parameters
    ----------
    frames
        One PNG or more (ParameterError for none); smaller ones are set at the upper left of a white sheet.
    frame_s, last_s
        Duration in seconds of each frame but the last, and of the last.
    """
    if not frames:
        raise ParameterError("frames", 0, "one picture or more")
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
    every = Image.fromarray(colours[None])
    return every.quantize(256, method=Image.Quantize.MAXCOVERAGE)
