"""A person's own instrument: what it may return, what it may leave out, how its mistakes are told."""

import contextlib
import math

import numpy as np
import pytest

from probewise.arm import OwnInstrument, Pose, Reading, SimulatedArm, as_instrument, carry_out, recording_of_readings
from probewise.errors import FileError, LinkError, ParameterError, ReachError, ShapeError
from probewise.recordings import HalfPlane, Plan, Quadrant, Uniform, read_recording, write_recording

PLACES = np.array([[0.0, 0.0], [30.0, 40.0]])
HERE = Pose(1.0, 2.0)


class Own:
    """Measure what it is told to; `more` are the optional methods."""

    def __init__(self, found=41.5, **more):
        self.found, self.asked, self.closed = found, [], 0
        self.__dict__.update(more)

    def measure(self, pose):
        self.asked.append(pose)
        return self.found(pose) if callable(self.found) else self.found

    def close(self):
        self.closed += 1


class Clock:
    def __init__(self):
        self.now_s = 100.0

    def monotonic(self):
        self.now_s += 1.0
        return self.now_s

    def sleep(self, seconds):
        self.now_s += seconds


def entered(own, **options):
    return OwnInstrument(lambda: own, clock=Clock(), **options).__enter__()


def test_what_is_known_of_a_reading_takes_the_place_of_what_was_asked_for_and_the_rest_is_kept_as_covariates():
    known = {"x_mm": 1.25, "orientation_rad": 0.1, "time_s": 7, "temperature_c": np.float64(21.5), "lux": math.nan}
    reading = entered(Own({"value": 3, **known})).measure(Pose(1.0, 2.0, height_mm=9.0))
    assert reading.pose == Pose(1.25, 2.0, 0.1, 9.0)
    assert reading.time_s == 7.0
    assert reading.covariates["temperature_c"] == 21.5
    assert math.isnan(reading.covariates["lux"])


BAD = {
    "nothing": (None, "what measure returned is None; allowed: a finite number, or a dict"),
    "a text": ("41", "what measure returned is '41'; allowed: a finite number"),
    "a masked number": (np.ma.masked, "what measure returned is masked; allowed: a finite number"),
    "a truth": (True, "what measure returned is True; allowed: a finite number"),
    "no value": ({"reading": 3}, r"what measure returned is \{'reading': 3\}; allowed: a dict with \"value\""),
    "a text beside it": ({"value": 3, "note": "ok"}, "note of what measure returned is 'ok'; allowed: a finite number"),
    "a time that is none": ({"value": 3, "time_s": math.nan}, "time_s of what measure returned is nan"),
    "a column's name": (
        {"value": 3, "orientation_deg": 90},
        "a name in what measure returned is 'orientation_deg'; allowed: .*orientation_rad",
    ),
    "a Reading with a time beside it": (
        Reading(1.0, HERE, 1.0, {"time_s": 1.0}),
        "a name in what measure returned is 'time_s'; allowed: .* time_s and pose of a Reading",
    ),
    "a Reading that is infinite": (Reading(math.inf, HERE, 1.0), "value of what measure returned is inf"),
    "a time that no file takes": ({"value": 3, "time_s": 1e300}, "time_s of what measure returned is 1e"),
    "a Reading far away": (Reading(1.0, Pose(1e12, 2.0), 1.0), r"x_mm of what .* is 1000000000000.0; .* up to 1e.09"),
    "a Reading nowhere": (Reading(1.0, Pose(math.nan, 2.0), 1.0), "x_mm of what measure returned is nan"),
}


@pytest.mark.parametrize(("found", "message"), BAD.values(), ids=BAD.keys())
def test_what_is_no_reading_is_told_with_what_is_allowed(found, message):
    with pytest.raises(ParameterError, match=message):
        entered(Own(found)).measure(Pose(0.0, 0.0))
    with pytest.raises(LinkError, match=f"mine.py: {message}"):
        entered(Own(found), source="mine.py").measure(Pose(0.0, 0.0))


def test_what_an_instrument_does_not_say_is_taken_for_the_usual():
    arm = entered(Own())
    assert arm.reachable(PLACES).tolist() == [True, True]
    assert arm.orientation_rad(PLACES).tolist() == [0.0, 0.0]
    there, farther = arm.travel_s(Pose(0.0, 0.0), PLACES)
    assert farther - there == pytest.approx(50.0 / SimulatedArm(lambda *_: 0.0).speed.move_mm_s)
    assert (arm.turns, arm.lifts) == (False, False)


def test_one_value_stands_for_all_places():
    own = Own(reachable=lambda places: True, travel_s=lambda start, places: 2, orientation_rad=0.25)
    arm = entered(own)
    assert arm.reachable(PLACES).tolist() == [True, True]
    assert arm.travel_s(Pose(0.0, 0.0), PLACES).tolist() == [2.0, 2.0]
    assert arm.orientation_rad(PLACES).tolist() == [0.25, 0.25]


@pytest.mark.parametrize(
    ("more", "ask", "message"),
    [
        ({"reachable": lambda p: [True]}, "reachable", r"reachable returned shape \(1,\); allowed: \(2,\)"),
        ({"reachable": lambda p: ["yes", "no"]}, "reachable", "what reachable returned is .*; allowed: True or False"),
        ({"orientation_rad": lambda p: None}, "orientation_rad", "what orientation_rad returned is None"),
        *(
            ({"travel_s": lambda start, p, s=s: s}, "travel_s", "travel_s returned")
            for s in (None, -1.0, math.nan, "soon", [1.0, 2.0, 3.0])
        ),
    ],
)
def test_what_it_says_of_places_is_checked(more, ask, message):
    with pytest.raises((ParameterError, ShapeError), match=message):
        getattr(entered(Own(**more)), ask)(*[HERE] * (ask == "travel_s"), PLACES)


@pytest.mark.parametrize("error", [None, RuntimeError, KeyboardInterrupt])
def test_an_instrument_is_closed_once_whatever_ends_it(error):
    own = Own()
    with contextlib.suppress(RuntimeError, KeyboardInterrupt), as_instrument(own):
        if error:
            raise error
    assert own.closed == 1


def test_one_that_is_a_context_manager_is_entered_and_left_as_such():
    log = []

    class Guarded(Own):
        def __enter__(self):
            log.append("in")
            return self

        def __exit__(self, kind, error, trace):
            log.append(kind)

    own = Guarded()
    with pytest.raises(ValueError, match="x"), as_instrument(own):
        raise ValueError("x")
    assert log == ["in", ValueError]
    assert own.closed == 0


def test_what_gave_the_instrument_on_entering_is_kept_until_the_end_and_then_left():
    """A function with `yield`, once forgotten, would run to its end and switch off before the first reading."""
    log = []

    @contextlib.contextmanager
    def connect():
        try:
            yield Own(close=lambda: log.append("closed"))
        finally:
            log.append("off")

    with OwnInstrument(connect) as arm:
        assert arm.measure(HERE).value == 41.5
        assert log == []
    assert log == ["off"]
    with pytest.raises(ValueError, match="x"), OwnInstrument(connect):
        raise ValueError("x")
    assert log == ["off", "off"]


def test_an_error_in_closing_does_not_hide_what_went_wrong_before():
    def stuck():
        raise OSError("the port is gone")

    with (
        pytest.warns(RuntimeWarning, match="may not be at rest: the port is gone"),
        pytest.raises(ValueError, match="first"),
        as_instrument(Own(close=stuck)),
    ):
        raise ValueError("first")
    with pytest.raises(OSError, match="the port is gone"), as_instrument(Own(close=stuck)):
        pass


def file_of(folder, text):
    path = folder / "mine.py"
    path.write_text(text)
    return path


# What stands in the file, and what is said of it when it is loaded, or when it connects and measures.
FILES = {
    "no Python": ("def connect(:", "line 1: is no Python"),
    "stops": ("x = 1\nimport nowhere_to_be_found", "line 2: stops with ModuleNotFoundError: No module named"),
    "no connect": ("def conect(): pass", "connect is missing; allowed: def connect"),
    "a number": ("connect = 3", "connect is a int; allowed: def connect"),
    "leaves": ("raise SystemExit(3)", "line 1: stops with SystemExit: 3"),
    "ends": ("raise GeneratorExit", "line 1: stops with GeneratorExit; allowed"),
    "connect fails": ("def connect():\n    raise OSError('no port')", "line 2: connect raises OSError: no port"),
    "connect brings nothing": ("def connect():\n    pass", "what connect.* returned is None; allowed: an Instr"),
    "connect brings a class": ("class A:\n  def measure(s, p): pass\ndef connect(): return A", r"of it is A\("),
    "measure leaves": ("import sys\nclass A:\n  def measure(s, p): sys.exit('off')\ndef connect(): return A()",
                       "line 3: measure raises SystemExit: off"),
    "measure ends": ("class A:\n  def measure(s, p): raise GeneratorExit\ndef connect(): return A()",
                     "line 2: measure raises GeneratorExit$"),
    "an error that cannot be shown": ("class E(Exception):\n  def __str__(s): 1 / 0\ndef connect(): raise E",
                                      "line 3: connect raises E: its message raises ZeroDivisionError"),
    "deep down": ("import math\nclass A:\n  def measure(s, p):\n    return half(p)\ndef half(p):\n"
                  "    return math.sqrt(-1)\ndef connect(): return A()", "line 6: measure raises ValueError: "),
}  # fmt: skip


@pytest.mark.parametrize(("text", "message"), FILES.values(), ids=FILES.keys())
def test_what_goes_wrong_in_a_file_is_told_with_its_line(tmp_path, text, message):
    def measure():
        with OwnInstrument.from_file(file_of(tmp_path, text)) as arm:
            arm.measure(Pose(0.0, 0.0))

    with pytest.raises((FileError, LinkError), match=f"mine.py.*{message}") as raised:
        measure()
    assert isinstance(raised.value, LinkError) == (" raises " in message or "of it" in message or "what" in message)
    assert "\n" not in str(raised.value)


def test_a_file_may_hold_dataclasses_and_import_what_lies_beside_it(tmp_path):
    (tmp_path / "beside_it_25.py").write_text("LEVEL = 7.0")
    text = (
        "from __future__ import annotations\nfrom dataclasses import dataclass\nimport beside_it_25\n"
        "@dataclass\nclass A:\n  level: float\n  def measure(self, pose): return self.level\n"
        "def connect(): return A(beside_it_25.LEVEL)\nif __name__ == '__main__': raise ValueError"
    )
    with OwnInstrument.from_file(file_of(tmp_path, text)) as arm:
        assert arm.measure(Pose(0.0, 0.0)).value == 7.0


EDGE, CORNER = HalfPlane(0.0, 0.0), Quadrant((0.0, 0.0), (1, 1))


def plan(**changes):
    options = {
        "x_mm": [-10, 0, 10, 10],
        "y_mm": 0,
        "patterns": {"edge": EDGE, "corner": CORNER},
        "pattern": ["edge", "edge", "edge", "corner"],
        "orientation_rad": [0.0, 0.0, math.pi / 3, math.pi / 3],
        "unit": "counts",
        "max": 1023,
    }
    return Plan.from_arrays(**{**options, **changes})


def taken(own, asked, plan, **options):
    with as_instrument(own) as arm:
        return list(carry_out(arm, plan, origin_mm=(100.0, 50.0), ask=asked.append, **options))


def test_a_plan_is_carried_out_with_a_person_who_lays_patterns_and_turns_the_sensor(tmp_path):
    asked, own = [], Own(lambda pose: {"value": 2 * pose.x_mm, "lux": pose.y_mm})
    readings = taken(own, asked, plan())
    assert [str(request).split(",")[0].split(" at (")[0] for request in asked] == [
        "lay sheet 'edge'",
        "turn the sensor on its mount to 60 degrees",
        "lay sheet 'corner'",
    ]
    assert own.asked[2] == Pose(110.0, 50.0, math.pi / 3)
    write_recording(recording_of_readings(plan(), readings), tmp_path / "r.csv")
    back = read_recording(tmp_path / "r.csv")
    assert back.plan.x_mm.tolist() == [-10.0, 0.0, 10.0, 10.0]
    assert back.readings.tolist() == [180.0, 200.0, 220.0, 220.0]
    assert back.plan.covariates["lux"].tolist() == [50.0] * 4
    assert back.plan.instrumentation.unit == "counts"


def turns_asked(asked):
    return [round(math.degrees(request.turned_rad)) for request in asked if request.turned_rad is not None]


@pytest.mark.parametrize(
    ("own", "changes", "angles"),
    [
        (Own(), {}, [0, 60]),
        (Own(), {"orientation_rad": 0.0}, [0]),
        (Own(), {"patterns": {"edge": Uniform(1.0), "corner": Uniform(0.0)}}, [0, 60]),
        (Own(), {"patterns": {"edge": Uniform(1.0), "corner": Uniform(0.0)}, "orientation_rad": 0.0}, []),
        (Own(turns=True), {}, []),
    ],
    ids=["turns over an edge", "over an edge", "turns over plain sheets", "over plain sheets", "turns by itself"],
)
def test_a_sensor_that_somebody_may_have_turned_is_turned_back_where_that_matters(own, changes, angles):
    asked = []
    with as_instrument(own) as arm:
        arm.mounted_rad = math.nan
        for _ in range(2):
            read = list(carry_out(arm, plan(**changes), origin_mm=(0.0, 0.0), ask=asked.append))
    assert [reading.pose.orientation_rad for reading in read] == plan(**changes).orientation_rad.tolist()
    assert turns_asked(asked) == (angles * 2 if len(angles) == 2 else angles)


def test_where_it_knows_that_it_read_is_written_in_the_plans_frame():
    own = Own(lambda pose: {"value": 1.0, "x_mm": pose.x_mm + 0.5, "orientation_rad": 0.1})
    readings = taken(own, [], plan())
    assert [reading.pose for reading in readings][:2] == [Pose(-9.5, 0.0, 0.1), Pose(0.5, 0.0, 0.1)]
    assert taken(Own(), [], plan(x_mm=[1 / 3] * 4))[0].pose.x_mm == 1 / 3  # as planned, not to a micron


@pytest.mark.parametrize(
    ("own", "changes", "error", "message"),
    [
        (Own(reachable=lambda p: p[:, 0] < 105), {}, ReachError, r"the place of row 3 of the plan \(mm\) is \(110"),
        (Own(), {"covariates": {"led": [1, 1, 0, 0]}}, ParameterError, "the plan's led is 0.0; allowed: 1"),
        (Own(), {"height_mm": 14, "covariates": {"height_mm": [14, 10, 10, 10]}}, ParameterError, "height_mm is 10.0"),
        (
            Own(),
            {"covariates": {"height_mm": [math.nan, 10, 14, 20]}},
            ParameterError,
            "height_mm is 14.0; allowed: 10",
        ),
    ],
)
def test_a_plan_that_it_cannot_carry_out_is_refused_before_anything_moves(own, changes, error, message):
    with pytest.raises(error, match=message):
        taken(own, [], plan(**changes))
    assert own.asked == []


def test_any_object_that_measures_carries_out_a_plan():
    own = Own(3.0)
    assert [reading.value for reading in carry_out(own, plan(), origin_mm=(0.0, 0.0), ask=lambda text: None)] == [
        3.0
    ] * 4
    with pytest.raises(ParameterError, match=r"arm is 3; allowed: .*an object with measure\(pose\)"):
        next(carry_out(3, plan(), origin_mm=(0.0, 0.0), ask=lambda text: None))


def test_what_a_file_prints_does_not_mix_with_results(tmp_path, capsys):
    text = "class A:\n  def measure(s, p):\n    print('here')\n    return 1.0\ndef connect(): return A()"
    with OwnInstrument.from_file(file_of(tmp_path, text)) as arm:
        arm.measure(Pose(0.0, 0.0))
    assert capsys.readouterr() == ("", "here\n")
