"""One JSON line a measurement: what is written, what survives, what is refused."""

import json
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from exploring import run

from probewise.arm import read_geometry, shipped_geometry_path
from probewise.arm.instrument import Pose, Reading
from probewise.effects import EFFECTS, Known, Origin
from probewise.errors import FileError, LinkError, ParameterError
from probewise.experiment import HiddenShape, JournalWriter, geometry_entry, read_journal, recording_of
from probewise.experiment.journal import PosteriorSummary, require_same_settings, value_digest
from probewise.recordings.patterns import Disc
from probewise.recordings.plan import Instrumentation
from probewise.scene import Card, CardedScene, Circle, Field, HypothesisScene
from probewise.sensor import FAST_NODES, Chain, FixedLevels, FixedMixture

SETTINGS = {"shape": "Circle()", "seed": "7", "spawn_key": [0], "options": {"n_live": 60}}


def reading(k):
    return Reading(10.0 + k, Pose(1.5 * k, 2.0 * k, 0.25), 3.0 * k, {"battery_mv": 7900.0 + k})


def summary(k):
    return PosteriorSummary({"x_mm": 1.0 / 3.0 + k}, {"x_mm": 2.0 / k}, 1.25 * k, Pose(0.1 * k, 7.0))


def write(path, n, settings=SETTINGS):
    with JournalWriter.begin(path, settings) as writer:
        for k in range(1, n + 1):
            writer.write_reading(k, reading(k))
            writer.write_summary(summary(k))


def test_a_journal_reads_back_every_bit_of_what_was_written(tmp_path):
    path = tmp_path / "journal.jsonl"
    write(path, 3)
    journal = read_journal(path)
    assert journal.settings["format"] == "journal/1"
    assert journal.readings == (reading(1), reading(2), reading(3))
    assert [entry.summary for entry in journal.entries] == [summary(1), summary(2), summary(3)]
    assert journal.notes == ()


def test_a_journal_is_one_json_object_a_line(tmp_path):
    write(tmp_path / "j", 2)
    lines = [json.loads(line) for line in (tmp_path / "j").read_text().splitlines()]
    assert len(lines) == 3
    assert set(lines[1]) == {"index", "pose", "time_s", "reading", "covariates", "belief", "digest"}
    assert set(lines[1]["belief"]) == {"mean", "sd", "bits", "next"}


def test_whatever_byte_the_writer_is_killed_at_a_run_goes_on_behind_the_last_whole_reading(tmp_path):
    """Cut at every byte of the last line: a reading that is there is never taken out again, not even for a moment."""
    path = tmp_path / "journal.jsonl"
    write(path, 3)
    whole = path.read_bytes()
    last = whole.rindex(b"\n", 0, -1) + 1
    reading_done = whole.index(b', "belief": ', last)
    for n_bytes in range(last, len(whole)):
        path.write_bytes(whole[:n_bytes])
        journal = read_journal(path)
        kept = 3 if n_bytes >= reading_done else 2
        assert journal.readings == tuple(reading(k) for k in range(1, kept + 1)), n_bytes
        assert len(journal.notes) == (n_bytes > last)
        assert kept == 2 or journal.entries[2].summary is None
        with JournalWriter.resume(journal) as writer:
            assert path.read_bytes() == whole[: reading_done if kept == 3 else last]
            if kept == 2:
                writer.write_reading(3, reading(3))
            writer.write_summary(summary(3))
        assert path.read_bytes() == whole


def test_a_missing_reading_is_null_and_comes_back_as_nan(tmp_path):
    with JournalWriter.begin(tmp_path / "j", SETTINGS) as writer:
        writer.write_reading(1, Reading(math.nan, Pose(1.0, 2.0), 0.0))
        writer.write_summary(summary(1))
    assert "NaN" not in (tmp_path / "j").read_text()
    assert math.isnan(read_journal(tmp_path / "j").readings[0].value)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "no whole first line"),
        (b"x,y\n1,2\n", "line 1.*JSON"),
        (b'{"format": "journal/2"}\n', r"journal/2.*journal/1"),
        (b'{"format": "journal/1"}\n{"index": 1}\n', "line 2, column pose"),
        (b'{"format": "journal/1", "seed": NaN}\n', "line 1.*NaN is no JSON number"),
        (b'{"format": "journal/1", "seed": 1, "seed": 2}\n', "line 1.*'seed' comes twice"),
    ],
)
def test_a_damaged_journal_says_which_file_which_line_and_what(tmp_path, content, says):
    path = tmp_path / "bad.jsonl"
    path.write_bytes(content)
    with pytest.raises(FileError, match=says) as caught:
        read_journal(path)
    assert "bad.jsonl" in str(caught.value)


def test_a_line_that_is_missing_in_the_middle_is_found(tmp_path):
    write(tmp_path / "j", 3)
    lines = (tmp_path / "j").read_text().splitlines(keepends=True)
    (tmp_path / "j").write_text("".join([*lines[:2], *lines[3:]]))
    with pytest.raises(FileError, match=r"line 3: index 3; allowed: 2"):
        read_journal(tmp_path / "j")


def test_a_new_journal_never_overwrites_a_file(tmp_path):
    (tmp_path / "j").write_text("precious")
    with pytest.raises(FileError, match="exists"), JournalWriter.begin(tmp_path / "j", SETTINGS):
        pass
    assert (tmp_path / "j").read_text() == "precious"


def test_every_setting_that_differs_is_named(tmp_path):
    write(tmp_path / "j", 1)
    journal = read_journal(tmp_path / "j")
    require_same_settings(journal, SETTINGS)
    with pytest.raises(FileError, match=r"seed '7' there, '8' here; shape 'Circle\(\)' there, 'Square\(\)' here"):
        require_same_settings(journal, {**SETTINGS, "seed": "8", "shape": "Square()"})


def test_a_journal_becomes_a_recording_over_the_field(tmp_path):
    write(tmp_path / "j", 3)
    disc, lego = Disc((1.0, 2.0), 30.0), Instrumentation(min=1, max=100, step=1)
    recording = read_journal(tmp_path / "j").recording(patterns={"field": disc}, instrumentation=lego)
    np.testing.assert_array_equal(recording.readings, [11.0, 12.0, 13.0])
    np.testing.assert_array_equal(recording.plan.y_mm, [2.0, 4.0, 6.0])
    np.testing.assert_array_equal(recording.plan.orientation_rad, 0.25)
    np.testing.assert_array_equal(recording.plan.covariates["battery_mv"], [7901.0, 7902.0, 7903.0])
    assert recording.plan.rows_by_pattern()[0][0] == "field"
    assert recording.plan.patterns["field"] == disc


def test_a_covariate_that_one_reading_lacks_is_nan_there():
    recording = recording_of([reading(1), Reading(5.0, Pose(0.0, 0.0), 1.0)])
    assert np.isnan(recording.plan.covariates["battery_mv"]).tolist() == [False, True]


def test_the_height_that_was_commanded_is_a_covariate_unless_the_reading_has_its_own():
    pose = Pose(0.0, 0.0, height_mm=20.0)
    told = [Reading(5.0, pose, 1.0), Reading(5.0, pose, 2.0, {"height_mm": 20.5}), Reading(5.0, Pose(0.0, 0.0), 3.0)]
    height_mm = recording_of(told).plan.covariates["height_mm"]
    np.testing.assert_array_equal(height_mm, [20.0, 20.5, np.nan])


@pytest.mark.parametrize("key", [None, "x", [1.5], [-1]])
def test_a_journal_without_a_usable_seed_is_refused(small, tmp_path, key):
    experiment = small.experiment()

    class Own:
        def measure(self, pose):
            return 10.0

    run(Own(), experiment, rng=np.random.default_rng(5), max_readings=1, journal=tmp_path / "j")
    first = (tmp_path / "j").read_text().partition("\n")[0]
    (tmp_path / "j").write_text(json.dumps({**json.loads(first), "spawn_key": key}) + "\n")
    with pytest.raises(FileError, match="spawn_key is"):
        run(Own(), experiment, rng=np.random.default_rng(5), max_readings=2, journal=tmp_path / "j")


@dataclass(frozen=True)
class Holder:
    values: object
    name: str = "a"


def test_a_digest_tells_values_by_type_fields_and_every_bit():
    first = value_digest(Holder(np.array([1.0, 2.0])))
    assert first == value_digest(Holder(np.array([1.0, 2.0])))
    others = [np.array([1.0, np.nextafter(2.0, 3.0)]), np.array([[1.0, 2.0]]), (1.0, 2.0), [1, 2], {"a": 1.0}, None]
    digests = {value_digest(Holder(other)) for other in others} | {first, value_digest(Holder(others[0], "b"))}
    assert len(digests) == 8


def test_a_value_that_cannot_be_recognised_again_is_refused():
    with pytest.raises(ParameterError, match="frozen dataclasses"):
        value_digest(Holder(lambda: 1))


def test_a_digest_tells_effects_by_name_origin_and_values_whatever_their_classes():
    def digest(time_s=0.0, values=(0.02, 60.0), **changed):
        return value_digest(Known(replace(EFFECTS["gain_drift"](Origin(time_s)), **changed), values))

    assert digest() == digest(apply=lambda value, theta, plan: value, units=())
    others = digest(time_s=1.0), digest(values=(0.02, 61.0)), digest(name="gain_jump")
    assert len({digest(), *others}) == 4


def test_a_journal_whose_digest_is_of_the_classes_of_effects_goes_on_with_the_same_sensor(tmp_path):
    sensor, kept = value_digest(Known(EFFECTS["gain_drift"](), (0.02, 60.0))), {**SETTINGS, "sensor_sha256": "a" * 64}
    with JournalWriter.begin(tmp_path / "j", {**kept, "sensor": "b" * 64}):
        pass
    require_same_settings(read_journal(tmp_path / "j"), {**kept, "sensor": sensor})
    with pytest.raises(FileError, match="a run with other settings: another sensor;"):
        require_same_settings(read_journal(tmp_path / "j"), {**kept, "sensor": sensor, "sensor_sha256": "c" * 64})
    with pytest.raises(FileError, match="another sensor model, or other cards;"):
        require_same_settings(read_journal(tmp_path / "j"), {**kept, "sensor": "c" * 64})


def test_a_run_over_another_hidden_shape_does_not_go_on_from_a_journal(small, tmp_path):
    """The readings that it holds are of what lay there, whatever the caller believes now."""
    path = tmp_path / "new" / "folder" / "journal.jsonl"
    here, there = (HiddenShape("circle", Circle(), np.array([x_mm, 140.0, 60.0])) for x_mm in (250.0, 300.0))

    def go_on(hidden):
        rng = np.random.default_rng(5)
        return run(small.arm(), small.experiment(), rng=rng, max_readings=1, journal=path, hidden=hidden)

    assert len(go_on(here).steps) == len(go_on(here).steps) == 1
    for other, said in ((there, "hidden.x_mm 250.0 there, 300.0 here"), (None, "hidden.x_mm 250.0 there, None here")):
        with pytest.raises(FileError, match=said):
            go_on(other)


def test_what_a_journal_says_of_its_files_may_differ_when_the_run_goes_on(tmp_path):
    with JournalWriter.begin(tmp_path / "j", {**SETTINGS, "arm": "COM5", "sensor_file": "../s.json"}):
        pass
    journal = read_journal(tmp_path / "j")
    require_same_settings(journal, {**SETTINGS, "arm": "COM6", "sensor_file": "elsewhere/s.json"})
    with pytest.raises(FileError, match="another sensor"):
        require_same_settings(journal, {**SETTINGS, "sensor_sha256": "abc"})


def test_a_journal_that_names_the_geometry_is_not_resumed_with_another_and_an_older_one_is(tmp_path):
    built = read_geometry(shipped_geometry_path())
    here, there = (geometry_entry(geometry) for geometry in (built, replace(built, links_mm=(351.0, 350.0))))
    assert geometry_entry(None) == {}
    for name, settings in (("new", {**SETTINGS, **here}), ("old", SETTINGS)):
        with JournalWriter.begin(tmp_path / name, settings):
            pass
    new, old = read_journal(tmp_path / "new"), read_journal(tmp_path / "old")
    require_same_settings(new, {**SETTINGS, **here})
    require_same_settings(old, {**SETTINGS, **there})
    for other in (there, {}):
        with pytest.raises(FileError, match="a run with other settings: another geometry of the arm;"):
            require_same_settings(new, {**SETTINGS, **other})


def test_a_line_that_was_changed_or_is_of_another_run_is_refused_and_older_lines_have_no_digest(tmp_path):
    one, other = ((tmp_path / name) for name in ("j", "other"))
    for path, settings in ((one, SETTINGS), (other, {**SETTINGS, "seed": "8"})):
        write(path, 3, settings)
    lines, others = (path.read_text().splitlines() for path in (one, other))
    changed = lines[2].replace('"time_s": ', '"time_s": 1')
    moved = lines[0].replace("{", "{ ", 1)
    for row, wrong in ((3, [*lines[:2], changed, lines[3]]), (4, [*lines[:3], others[3]]), (2, [moved, *lines[1:]])):
        one.write_text("\n".join([*wrong, ""]))
        with pytest.raises(FileError, match=f"line {row}: this line or one before it was changed"):
            read_journal(one)
    one.write_text("\n".join([*(line.partition(', "digest"')[0] + "}" * (k > 0) for k, line in enumerate(lines)), ""]))
    with JournalWriter.resume(read_journal(one)) as writer:
        writer.write_reading(4, reading(4))
        writer.write_summary(summary(4))
    assert len(read_journal(one).entries) == 4


def test_a_reading_that_the_sensor_cannot_return_is_not_written(small, tmp_path):
    """Else a run could never go on: its journal would hold what it refuses, as one does that was changed."""

    class Broken:
        def measure(self, pose):
            return value

    experiment, value = small.experiment(reading_range=(0.0, 100.0)), 1023.0
    with pytest.raises(LinkError, match=r"beyond the sensor: reading is 1023\.0; allowed: 0 to 100"):
        run(Broken(), experiment, rng=np.random.default_rng(5), journal=tmp_path / "j")
    assert read_journal(tmp_path / "j").entries == ()
    value = 10.0
    run(Broken(), experiment, rng=np.random.default_rng(5), journal=tmp_path / "j", max_readings=1)
    changed = (tmp_path / "j").read_text().replace('"reading": 10.0', '"reading": 1023.0')
    (tmp_path / "j").write_text(changed.partition(', "digest"')[0] + "}\n")
    with pytest.raises(FileError, match=r"j, line 2: reading is 1023\.0; allowed: 0 to 100"):
        run(Broken(), experiment, rng=np.random.default_rng(5), journal=tmp_path / "j")


IMPOSSIBLE = {
    "a lamp of eight bits": ({"led": 128}, {}, r"led is 128\.0; allowed: 0 \(off\) to 1 \(on\)"),
    "in the table": (
        {"height_mm": 0.0},
        {"heights_mm": (14.0,), "calibrated_height_mm": 14.0},
        r"height_mm is 0\.0; allowed: greater than 0",
    ),
}


@pytest.mark.parametrize(("tells", "changes", "said"), IMPOSSIBLE.values(), ids=IMPOSSIBLE.keys())
def test_what_a_reading_cannot_have_been_taken_with_is_not_written(small, tmp_path, tells, changes, said):
    """Predictions refuse it: such a journal could not be resumed, whatever became of the instrument."""

    class Own:
        lifts = True

        def measure(self, pose):
            return {"value": 10.0, **tells}

    mixture = FixedMixture(np.ones(1), np.zeros((1, 2)), 9.0 * np.eye(2)[None])
    scene = HypothesisScene(Circle(Field(400.0, 300.0), (40.0, 80.0)))
    model = Chain(mixture, FixedLevels(10.0, 60.0), scene, n_nodes=FAST_NODES)
    experiment = small.experiment(shape=scene.shape, model=model, **changes)
    path = tmp_path / "j"
    with pytest.raises(LinkError, match=f"what the instrument returned is beyond the sensor: {said}"):
        run(Own(), experiment, rng=np.random.default_rng(5), journal=path)
    assert read_journal(path).entries == ()
    tells = {}
    assert len(run(Own(), experiment, rng=np.random.default_rng(5), journal=path, max_readings=1).readings) == 1


def test_the_clock_of_ones_own_instrument_goes_on_where_an_earlier_run_ended(small, tmp_path):
    class Own:
        def measure(self, pose):
            return {"value": 10.0, **({"time_s": 500.0} if not (tmp_path / "j").read_text().count("index") else {})}

    for n in (1, 2):
        rng = np.random.default_rng(5)
        found = run(Own(), small.experiment(), rng=rng, max_readings=n, journal=tmp_path / "j")
    first, second = found.readings
    assert first.time_s == 500.0 <= second.time_s < 600.0
    volts = Instrumentation(unit="V", max=20.0)
    assert found.recording(instrumentation=volts).plan.instrumentation == volts


@pytest.mark.parametrize(
    ("truth", "name", "theta"),
    [
        ({"radius_mm": 90, "x_mm": 600, "y_mm": 260}, "circle", [600.0, 260.0, 90.0]),
        ({"circle": {"radius_mm": 90, "x_mm": 600, "y_mm": 260}}, "circle", [600.0, 260.0, 90.0]),
        ({"ellipse": (600, 260, 90, 60, 0.5)}, "ellipse", [600.0, 260.0, 90.0, 60.0, 0.5]),
        ((600, 260, 90), "circle", [600.0, 260.0, 90.0]),
    ],
)
def test_what_lies_there_may_be_said_in_order_or_by_name(truth, name, theta):
    hidden = HiddenShape.given_or_drawn(truth, Circle(), Field(), rng=np.random.default_rng(0))
    assert (hidden.name, hidden.theta.tolist()) == (name, theta)
    assert hidden.journal_entry["shape"] == name


@pytest.mark.parametrize(
    ("cards", "begins"), [((), "d768feff3763a63d"), ((Card(120.0, 100.0, 80.0, 60.0, 1.0),), "fc65a040f38a87fb")]
)
def test_the_fingerprint_of_a_sensor_stays_that_of_the_journals_that_people_have(cards, begins):
    """A class or a field with another name would refuse to resume every journal written before."""
    circle = Circle(radius_mm=(50.0, 150.0), inside=True)
    mixture = FixedMixture([1.0], [[0.0, 1.5]], [[[16.0, 0.0], [0.0, 6.25]]])
    scene = CardedScene(circle, cards) if cards else HypothesisScene(circle)
    assert value_digest(Chain(mixture, FixedLevels(10.0, 60.0), scene)).startswith(begins)
