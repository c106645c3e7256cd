"""Pictures of a run: a GIF with every frame in order."""

import io

import numpy as np
from PIL import Image

from probewise.report.exploration import animated_gif


def png(colour, size):
    out = io.BytesIO()
    Image.new("RGB", size, colour).save(out, "PNG")
    return out.getvalue()


def test_frames_follow_each_other():
    moving = Image.open(io.BytesIO(animated_gif([png("red", (8, 6)), png("blue", (8, 6))], frame_s=0.5, last_s=2.0)))
    assert moving.n_frames == 2
    assert moving.size == (8, 6)
    assert moving.info["loop"] == 0
    assert moving.info["duration"] == 500
    assert tuple(np.asarray(moving.convert("RGB"))[3, 6]) == (255, 0, 0)
    moving.seek(1)
    assert moving.info["duration"] == 2000
    assert tuple(np.asarray(moving.convert("RGB"))[3, 1]) == (0, 0, 255)
