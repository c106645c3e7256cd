"""What is written is what is read back: recordings, plans that come ready, pictures, damaged ones too; and locks."""

import csv
import io
import math
import os
import signal
import struct
import subprocess
import sys
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image as Pillow

from probewise.errors import FileError, ParameterError
from probewise.recordings import (
    Disc,
    HalfPlane,
    Image,
    Instrumentation,
    Plan,
    Polygon,
    Prediction,
    Quadrant,
    Ramp,
    Recording,
    Stripes,
    Uniform,
    fingerprint,
    hold_lock,
    paper_plan,
    read_plan,
    read_plan_and_readings,
    read_prediction_columns,
    read_recording,
    shipped,
    two_way_plan,
    write_bytes_atomically,
    write_plan,
    write_prediction,
    write_recording,
)
from probewise.recordings.files import shortest_degrees
from probewise.recordings.io import image_bytes, read_image
from probewise.recordings.plans import with_jittered_times
from probewise.recordings.table import csv_text, read_table

numbers = st.floats(-1e6, 1e6)
lengths = st.floats(1e-6, 1e6)
angles_rad = st.floats(-720, 720).map(math.radians)
names = st.text(st.characters(categories=("L", "N", "P", "S")), max_size=12)
levels = {"inside": numbers, "outside": numbers}
pairs = st.tuples(numbers, numbers)
patterns = st.one_of(
    st.builds(Uniform, numbers),
    st.builds(HalfPlane, angles_rad, numbers, **levels),
    st.builds(Quadrant, pairs, st.tuples(st.sampled_from((-1, 1)), st.sampled_from((-1, 1))), **levels),
    st.builds(Disc, pairs, lengths, **levels),
    st.builds(Polygon, st.lists(pairs, min_size=3, max_size=6).map(tuple), **levels),
    st.builds(Stripes, angles_rad, lengths, st.floats(0, 1), numbers, **levels),
    st.builds(Ramp, angles_rad, numbers),
)
instruments = st.builds(
    Instrumentation,
    unit=names,
    min=st.none() | st.floats(-100, 0),
    max=st.none() | st.floats(1, 100),
    step=st.none() | lengths,
    sensor=names,
    height_mm=st.none() | lengths,
    controls=st.lists(names, max_size=2).map(tuple),
    description=names,
)


@st.composite
def plans(draw):
    n = draw(st.integers(1, 8))
    columns = [draw(st.lists(numbers, min_size=n, max_size=n)) for _ in range(4)]
    steps = draw(st.lists(st.sampled_from((0, 1)), min_size=n, max_size=n))
    scan = np.cumsum([0, *steps[1:]])
    known = draw(st.dictionaries(names, patterns, min_size=1, max_size=3))
    sessions = tuple(draw(st.integers(0, 3)) for _ in range(scan[-1] + 1))
    return Plan(
        x_mm=columns[0],
        y_mm=columns[1],
        orientation_rad=draw(st.lists(angles_rad, min_size=n, max_size=n)),
        time_s=np.sort(columns[2]),
        scan=scan,
        scan_names=tuple(draw(names) + f"#{k}" for k in range(scan[-1] + 1)),
        pattern=draw(st.lists(st.integers(0, len(known) - 1), min_size=n, max_size=n)),
        pattern_names=tuple(known),
        patterns=known,
        covariates={"battery_mv": columns[3]} if draw(st.booleans()) else {},
        instrumentation=draw(instruments),
        sessions=sessions if len(set(sessions)) > 1 else (),
    )


@st.composite
def recordings(draw):
    plan = draw(plans())
    values = draw(st.lists(st.none() | st.floats(-200, 200), min_size=len(plan), max_size=len(plan)))
    values[0] = 0.5
    return Recording(plan, [math.nan if v is None else v for v in values])


def assert_same(one, two):
    for name in ("x_mm", "y_mm", "orientation_rad", "time_s", "scan", "pattern"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name), err_msg=name)
    assert one.scan_names == two.scan_names
    assert one.sessions == two.sessions
    assert one.pattern_names == two.pattern_names
    assert one.patterns == two.patterns
    assert one.instrumentation == two.instrumentation
    assert one.covariates.keys() == two.covariates.keys()
    for name, values in one.covariates.items():
        np.testing.assert_array_equal(values, two.covariates[name])


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(recording=recordings())
def test_a_recording_comes_back_to_the_last_bit(recording, tmp_path_factory):
    path = tmp_path_factory.mktemp("trip") / "rec.csv"
    write_recording(recording, path)
    back = read_recording(path)
    assert_same(recording.plan, back.plan)
    np.testing.assert_array_equal(recording.readings, back.readings)
    assert fingerprint(back) == fingerprint(recording)
    assert_same(recording.plan, read_plan(path))
    write_plan(recording.plan, path)
    plan, readings = read_plan_and_readings(path)
    assert_same(recording.plan, plan)
    assert readings is None
    assert sorted(p.name for p in path.parent.iterdir()) == ["rec.csv", "rec.json"]


@given(degrees=st.floats(-1e4, 1e4))
def test_an_angle_read_from_degrees_is_written_as_degrees_that_read_the_same(degrees):
    radians = math.radians(degrees)
    assert math.radians(shortest_degrees(radians)) == radians


def plan_of(n, **changes):
    base = Plan.from_arrays(x_mm=np.arange(n), y_mm=0, scan=["a"] * n, patterns={"white": Uniform(1.0)}, unit="LEGO")
    return replace(base, **changes)


@pytest.mark.parametrize("suffix", [".png", ".npy"])
def test_an_image_travels_with_its_recording(tmp_path, suffix):
    albedo = np.arange(12).reshape(3, 4) * 20 / 255
    image = Image(albedo, 2.0, (-4.0, 1.5), f"photo{suffix}")
    plan = plan_of(2, patterns={"photo": image}, pattern_names=("photo",))
    write_plan(plan, tmp_path / "plan.csv")
    back = read_plan(tmp_path / "plan.csv").patterns["photo"]
    np.testing.assert_allclose(back.albedo, albedo, rtol=1e-15)
    assert (back.pixel_mm, back.origin_mm, back.file) == (2.0, (-4.0, 1.5), f"photo{suffix}")


def test_two_images_that_differ_have_no_file_in_common(tmp_path):
    dark, light = (Image(np.full((2, 2), level), 1.0, (0.0, 0.0), "photo.npy") for level in (0.0, 1.0))
    with pytest.raises(ParameterError, match=r"file of patterns\['light'\] is 'photo.npy'; allowed: another file"):
        write_plan(plan_of(2, patterns={"white": dark, "light": light}), tmp_path / "plan.csv")
    assert not list(tmp_path.iterdir())
    write_plan(plan_of(2, patterns={"white": dark, "again": replace(dark, pixel_mm=2.0)}), tmp_path / "plan.csv")
    assert (read_plan(tmp_path / "plan.csv").patterns["again"].albedo == 0.0).all()


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (Image([[0.5]], 1.0, (0.0, 0.0), "../photo.npy"), "without a path"),
        (Image([[2.0]], 1.0, (0.0, 0.0), "photo.npy"), "0 to 1 in every pixel"),
        (Image([[np.nan]], 1.0, (0.0, 0.0), "photo.png"), "0 to 1 in every pixel"),
        (Image([[0.1234]], 1.0, (0.0, 0.0), "photo.png"), "npy"),
    ],
)
def test_an_image_that_could_not_be_read_back_is_not_written(tmp_path, image, message):
    (tmp_path / "own").mkdir()
    with pytest.raises(ParameterError, match=message):
        write_plan(plan_of(2, patterns={"white": image}), tmp_path / "own" / "plan.csv")
    assert not list(tmp_path.glob("**/*.*"))


def test_two_scans_of_one_name_that_follow_each_other_stay_two(tmp_path):
    plan = plan_of(4, scan=[0, 0, 1, 1], scan_names=("a", "a"))
    write_plan(plan, tmp_path / "plan.csv")
    back = read_plan(tmp_path / "plan.csv")
    np.testing.assert_array_equal(back.scan, plan.scan)
    assert back.scan_names == ("a", "a (again)")


def test_the_fingerprint_does_not_depend_on_layout_and_does_on_content(tmp_path):
    recording = Recording(plan_of(3), [1.0, 2.0, 3.5])
    write_recording(recording, tmp_path / "a.csv")
    text = (tmp_path / "a.csv").read_text()
    rows = [line.split(",") for line in text.split()]
    turned = "\r\n".join(",".join(reversed(row)) for row in rows)
    (tmp_path / "b.csv").write_bytes(b"\xef\xbb\xbf" + turned.encode())
    (tmp_path / "b.json").write_bytes((tmp_path / "a.json").read_bytes())
    assert fingerprint(read_recording(tmp_path / "b.csv")) == fingerprint(recording)
    assert fingerprint(Recording(plan_of(3), [1.0, 2.0, 3.6])) != fingerprint(recording)


def test_predictions_keep_every_row_and_leave_missing_densities_empty(tmp_path):
    mean, sd, log_density = np.array([1.0, 2 / 3, 3.0]), np.array([0.1, 0.2, 1 / 3]), np.array([-1.5, np.nan, 0.7])
    path = tmp_path / "p.csv"
    write_prediction(Prediction(plan_of(3), mean, sd, log_density), path)
    back = read_prediction_columns(path)
    for written, read in zip((mean, sd, log_density), back, strict=True):
        np.testing.assert_array_equal(written, read)
    lines = path.read_text().splitlines()
    assert len(lines) == 4
    assert lines[2].endswith(",")


@pytest.mark.parametrize(
    ("mean", "sd", "log_density"),
    [([np.nan, 1], [1, 1], [0, 0]), ([1, 1], [0, 1], [0, 0]), ([1, 1], [1, 1], [0, -np.inf])],
)
def test_a_prediction_without_sense_is_refused(mean, sd, log_density):
    with pytest.raises(ParameterError):
        Prediction(plan_of(2), mean, sd, log_density)


@pytest.mark.parametrize(
    "changes",
    [
        {"patterns": {}},
        {"scan_names": ("a\nb",)},
        {"scan_names": (" a",)},
        {"scan": [1, 0, 0], "scan_names": ("a", "b")},
        {"covariates": {"reading": [1, 2, 3]}},
        {"covariates": {"t_c": [1, 2, np.inf]}},
        {"x_mm": [0, 1, 1e300]},
        {"patterns": {"white": "paint"}},
    ],
)
def test_what_the_format_cannot_say_is_not_written(tmp_path, changes):
    with pytest.raises(ParameterError):
        write_plan(plan_of(3, **changes), tmp_path / "plan.csv")
    assert not list(tmp_path.iterdir())


def test_a_write_that_fails_leaves_the_old_file_whole(tmp_path, monkeypatch):
    path = tmp_path / "plan.csv"
    write_plan(plan_of(2), path)
    before = path.read_bytes()

    def no_room(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", no_room)
    with pytest.raises(FileError, match="No space left"):
        write_plan(plan_of(5), path)
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["plan.csv", "plan.json"]


FORMULAS = ("=1+1", "+a", "-a", "@b", "'=x", "''@", "=", "-", "+", "-1.2.3", "'-1", "=a,b", '="q"')
NO_FORMULAS = ("-5", "+1e3", "'a", "it's", "'", "a=b", "1")


def test_texts_that_a_spreadsheet_would_compute_are_written_so_that_it_does_not_and_read_back_as_they_were(tmp_path):
    cells = (*FORMULAS, *NO_FORMULAS)
    path = tmp_path / "table.csv"
    path.write_text(csv_text({"=column": cells, "n": ["-1.5"] * len(cells)}))
    written = list(csv.reader(path.read_text().splitlines()))
    assert written[0] == ["'=column", "n"]
    assert [row[0] for row in written[1:]] == [*(f"'{cell}" for cell in FORMULAS), *NO_FORMULAS]
    assert {row[1] for row in written[1:]} == {"-1.5"}
    table = read_table(path)
    assert list(table.columns) == ["=column", "n"]
    assert table.columns["=column"] == list(cells)


def test_the_paper_plan_is_the_papers():
    """Paper, "Data Collection for SSF Estimation": four scans of 101 places, then four quadrants."""
    plan = paper_plan()
    assert len(plan) == 408
    assert plan.scan_names == ("edge_0", "edge_90", "edge_180", "edge_270", "quadrants")
    rows = plan.rows_by_scan()
    assert [len(r) for r in rows] == [101, 101, 101, 101, 4]
    np.testing.assert_array_equal(plan.x_mm[rows[2]], np.arange(-50, 51))
    np.testing.assert_allclose(plan.orientation_rad[[r[0] for r in rows]], np.radians([0, 90, 180, 270, 0]))
    assert [plan.pattern_names[k] for k in plan.pattern[rows[4]]] == [f"quadrant_{c}" for c in "abcd"]
    quadrants = [plan.patterns[f"quadrant_{c}"] for c in "abcd"]
    assert [quadrant.corner_mm for quadrant in quadrants] == [(0, 0), (0, 0), (4, 4), (-4, 4)]
    assert [quadrant.direction for quadrant in quadrants] == [(1, 1), (-1, 1), (1, 1), (-1, 1)]
    np.testing.assert_array_equal(plan.direction_of_motion[rows[0]], np.tile([1.0, 0.0], (101, 1)))
    np.testing.assert_array_equal(plan.direction_of_motion[rows[4]], 0)
    np.testing.assert_allclose(np.diff(plan.time_s[rows[0]]), 1.2)


def test_the_two_way_plan_goes_both_ways_in_every_orientation():
    plan = two_way_plan()
    assert len(plan) == 961
    for deg in (0, 90, 180, 270):
        out, back = (plan.rows_by_scan()[plan.scan_names.index(f"edge_{deg}_{way}")] for way in ("out", "back"))
        np.testing.assert_array_equal(plan.x_mm[out], plan.x_mm[back][::-1])
        assert plan.direction_of_motion[out[0], 0] == 1
        assert plan.direction_of_motion[back[0], 0] == -1
        fast = 2 if deg >= 180 else 1
        np.testing.assert_allclose(np.diff(plan.time_s[out])[0], fast * np.diff(plan.time_s[back])[0])
    assert set(plan.pattern_names) >= {"white", "black", "disc"}
    np.testing.assert_array_equal(plan.direction_of_motion[-1], [0, -1])
    assert np.all(np.diff(plan.time_s) > 0)


def test_jitter_keeps_the_order_and_the_pace():
    plan = two_way_plan()
    taken = with_jittered_times(plan, rng=np.random.default_rng(1))
    ratio = np.diff(taken.time_s) / np.diff(plan.time_s)
    assert ratio.min() > 0.899
    assert ratio.max() < 1.101
    assert ratio.std() > 0.05
    assert taken.covariates["battery_mv"][-1] < taken.covariates["battery_mv"][0] - 100


def test_a_recording_that_does_not_ship_is_refused():
    with pytest.raises(ParameterError, match="'paper' or 'concealed'"):
        shipped("other")


HOLD = """
import sys, time
from probewise._writing import hold_lock
with hold_lock(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_refused_and_a_killed_holder_holds_it_no_more(tmp_path):
    path = tmp_path / "journal.jsonl"
    with subprocess.Popen([sys.executable, "-c", HOLD, path], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(FileError, match=r"journal.jsonl: another process is writing to it"), hold_lock(path):
            pass
        other.send_signal(signal.SIGKILL if os.name != "nt" else signal.SIGTERM)
        other.wait()
    with hold_lock(path, patience_s=10):
        pass
    assert [p.name for p in tmp_path.iterdir()] == [".journal.jsonl.lock"]


def test_a_folder_that_is_missing_is_named(tmp_path):
    with pytest.raises(FileError, match=r"nowhere.*cannot be written"), hold_lock(tmp_path / "nowhere" / "a"):
        pass


def test_what_a_killed_writer_left_is_removed_by_the_next_and_what_a_living_one_holds_is_not(tmp_path):
    (tmp_path / ".a.01234567.part").write_text("half")
    (tmp_path / ".b.other.part").write_text("of another name")
    with (tmp_path / ".a.89abcdef.part").open("w") as living:
        if os.name != "nt":
            import fcntl

            fcntl.flock(living, fcntl.LOCK_EX)
        write_bytes_atomically(tmp_path / "a", b"whole")
        assert {p.name for p in tmp_path.iterdir()} == {"a", ".a.89abcdef.part", ".b.other.part"}
    write_bytes_atomically(tmp_path / "a", b"again")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {"a": b"again", ".b.other.part": b"of another name"}


@pytest.mark.skipif(os.name == "nt", reason="Windows has links for administrators only")
def test_a_lock_file_that_is_a_symbolic_link_is_refused_and_where_it_leads_stays_as_it_is(tmp_path):
    (tmp_path / "victim").write_text("precious")
    for target in ("victim", "to be made"):
        (tmp_path / ".a.lock").unlink(missing_ok=True)
        (tmp_path / ".a.lock").symlink_to(tmp_path / target)
        with pytest.raises(FileError, match=r"\.a\.lock: cannot be locked \(is a sym"), hold_lock(tmp_path / "a"):
            pass
    assert {p.name for p in tmp_path.iterdir()} == {".a.lock", "victim"}
    assert (tmp_path / "victim").read_text() == "precious"


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
