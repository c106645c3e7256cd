"""Pictures of a run joined with Pillow: an animated GIF with one frame per step."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image

from probewise.errors import require

_COLOURS = 256
_FRAME_S, _LAST_S = 0.8, 3.0


def animated_gif(frames: Sequence[bytes], *, frame_s: float = _FRAME_S, last_s: float = _LAST_S) -> bytes:
    """Join one or more PNGs of one size into an animated GIF that loops for ever."""
    require(frames, "frames", 0, "one picture or more")
    sheets = [Image.open(io.BytesIO(frame)).convert("RGB") for frame in frames]
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
