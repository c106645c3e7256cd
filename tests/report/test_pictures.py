"""Pictures of a run: a GIF with every frame in order, and two runs side by side."""

import io

import numpy as np
from PIL import Image

from probewise.report.pictures import animated_gif, join_side_by_side


def png(colour, size):
    out = io.BytesIO()
    Image.new("RGB", size, colour).save(out, "PNG")
    return out.getvalue()


def test_frames_follow_each_other_and_smaller_ones_are_set_on_white():
    moving = Image.open(io.BytesIO(animated_gif([png("red", (8, 6)), png("blue", (4, 6))], frame_s=0.5, last_s=2.0)))
    assert moving.n_frames == 2
    assert moving.size == (8, 6)
    assert moving.info["loop"] == 0
    assert moving.info["duration"] == 500
    assert tuple(np.asarray(moving.convert("RGB"))[3, 6]) == (255, 0, 0)
    moving.seek(1)
    assert moving.info["duration"] == 2000
    second = np.asarray(moving.convert("RGB"))
    assert tuple(second[3, 1]) == (0, 0, 255)
    assert tuple(second[3, 6]) == (255, 255, 255)


def test_the_run_that_ended_first_stays_at_its_last_picture():
    slides = join_side_by_side([png((s, s, s), (20, 10)) for s in (0, 100)], [png((200, 200, 200), (30, 10))])
    opened = [Image.open(io.BytesIO(slide)).convert("RGB") for slide in slides]
    assert [image.size for image in opened] == [(50, 10)] * 2
    assert [(image.getpixel((0, 0))[0], image.getpixel((49, 9))[0]) for image in opened] == [(0, 200), (100, 200)]


def test_a_colour_that_few_pixels_have_survives_in_a_slide():
    """The next place is a green square of some fifty pixels in a map of all copper tones."""
    tones = np.linspace([42, 26, 18], [255, 217, 168], 400 * 300).round().astype(np.uint8).reshape(300, 400, 3)
    tones[100:107, 50:57] = (0, 224, 138)
    out = io.BytesIO()
    Image.fromarray(tones).save(out, "PNG")
    (slide,) = join_side_by_side([out.getvalue()], [png("black", (5, 10))])
    shown = Image.open(io.BytesIO(slide)).convert("RGB").getpixel((53, 103))
    np.testing.assert_allclose(shown, (0, 224, 138), atol=16)
