"""Investigations: rounds until an explanation is settled, the budget, the folder that keeps the readings."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from hand_made import sensor_of

from probewise.arm import carry_out
from probewise.calibration import posterior_mean_ssf_field
from probewise.diagnosis import Hypothesis
from probewise.errors import FileError, ParameterError
from probewise.investigation import (
    Budget,
    RoundsFolder,
    SimulatedRecorder,
    investigate,
    parse_concealed,
    reason_if_settled,
)
from probewise.recordings import Instrumentation, Recording, paper_plan, write_recording
from probewise.world import World
from probewise.world.concealed import backlash, lag, saturation
from probewise.world.shipped import BLOB, true_world
from probewise.world.spots import gaussian_spot


def scans(*numbers):
    plan = paper_plan()
    return plan.take(np.isin(plan.scan, numbers))


def diagnosis(p, *, verdict="named", ask=True):
    rows = scans(1)
    asked = SimpleNamespace(plan=rows, description="take it again", minutes=1.0) if ask else None
    hypotheses = (Hypothesis(("lag",), p), Hypothesis((), 1 - p))
    return SimpleNamespace(hypotheses=hypotheses, verdict=verdict, next_measurement=asked, reason="")


@pytest.fixture
def diagnosed(monkeypatch):
    """Let `diagnose` return what is put in, one after another, and tell what it was asked."""

    def with_results(*results):
        calls, waiting = [], iter(results)

        def diagnose(recordings, **options):
            calls.append((list(recordings), options))
            return next(waiting)

        monkeypatch.setattr("probewise.investigation.diagnose", diagnose)
        return calls

    return with_results


def record(number, plan, asked):
    return Recording(plan, np.full(len(plan), float(number)))


def rounds_of(**options):
    return list(investigate(record, scans(0), rng=np.random.default_rng(0), **options))


def test_it_ends_as_soon_as_one_hypothesis_is_settled(diagnosed):
    calls = diagnosed(diagnosis(0.6), diagnosis(0.97))
    rounds = rounds_of()
    assert [each.settled for each in rounds] == [False, True]
    assert rounds[-1].stop_reason == "a sensor that follows slowly: probability 0.970"
    assert [len(recordings) for recordings, _ in calls] == [1, 2]
    assert rounds[1].reason_for_readings == "take it again"


def test_what_the_verdict_does_not_state_is_not_settled():
    assert reason_if_settled(diagnosis(0.99, verdict="cannot_tell")) is None
    assert reason_if_settled(diagnosis(0.949)) is None
    assert reason_if_settled(diagnosis(0.95)) is not None


def test_it_ends_where_nothing_would_tell_more(diagnosed):
    diagnosed(diagnosis(0.6, ask=False))
    assert rounds_of()[-1].stop_reason == "no further reading would tell more"


def test_it_ends_when_the_budget_is_spent(diagnosed):
    n = len(scans(1))
    diagnosed(*[diagnosis(0.6)] * 3)
    rounds = rounds_of(budget=Budget(readings=2 * n))
    assert len(rounds) == 3
    assert rounds[-1].stop_reason == "the budget of readings is spent"
    assert sum(len(each.recording) for each in rounds[1:]) == 2 * n


def test_it_says_when_the_minutes_are_spent_and_when_they_suffice_for_a_part(diagnosed):
    found = [diagnosis(0.6) for _ in range(2)]
    found[0].next_measurement.plan, found[1].next_measurement.plan = scans(1, 2), scans(3)
    after_s = scans(0).time_s.max()
    diagnosed(*found)
    rounds = rounds_of(budget=Budget(minutes=(scans(1).time_s.max() - after_s) / 60 + 0.01))
    n, both = len(scans(1)), len(scans(1, 2))
    assert rounds[1].reason_for_readings == f"take it again; the budget allows {n} of {both} readings"
    assert rounds[1].stop_reason == "the budget of minutes is spent"


def test_it_ends_after_the_rounds_that_were_allowed(diagnosed):
    diagnosed(*[diagnosis(0.6)] * 2)
    assert rounds_of(rounds=2)[-1].stop_reason == "the limit of 2 rounds is reached"


def test_a_round_thinks_alike_however_often_the_others_were_run(diagnosed):
    calls = diagnosed(*[diagnosis(0.6)] * 2, *[diagnosis(0.6)] * 3)
    rounds_of(rounds=2)
    rounds_of(rounds=3)
    drawn = [options["rng"].random() for _, options in calls]
    assert drawn[:2] == drawn[2:4]


def test_it_is_known_whether_hands_are_there(diagnosed):
    calls = diagnosed(diagnosis(0.97))
    rounds_of(hands=False)
    assert calls[0][1]["hands"] is False


class Fixed:
    """An instrument at one height that its arm cannot change."""

    turns = True

    def measure(self, pose):
        return 0.0


@pytest.mark.slow
def test_an_instrument_at_another_height_than_its_sensors_calibration_goes_on_to_a_second_round():
    """Calibrated at 16 mm, read at 20 mm: what is advised is read at 20 mm too, without a word about heights."""
    inverse = np.linalg.inv([[16.0, 1.5], [1.5, 6.25]]) / 2  # of the world's spot
    truth = np.array([1.0, 0.0, 1.5, inverse[0, 0], inverse[1, 1], inverse[0, 1], 10.0, 60.0])
    sd = np.array([0.0, 0.03, 0.03, 6e-4, 2e-3, 3e-4, 0.1, 0.1])
    samples = truth + sd * np.random.default_rng(1).standard_normal((500, 8))
    field = posterior_mean_ssf_field(samples, 1, pixel_mm=0.5)
    sensor = sensor_of(samples, field=field, instrumentation=Instrumentation(height_mm=16.0))
    world = World(gaussian_spot([BLOB]), height_mm=16.0, concealed=(backlash(1.0),))

    def record_at_20_mm(number, plan, asked):
        assert plan.instrumentation.height_mm == 20.0
        next(carry_out(Fixed(), plan, origin_mm=(0.0, 0.0), ask=lambda _: None))  # refuses another height
        lifted = replace(plan, covariates={**plan.covariates, "height_mm": np.full(len(plan), 20.0)})
        return Recording(plan, world.simulate(lifted, rng=np.random.default_rng(number)).readings)

    plan = scans(0, 1, 2, 3)
    plan = replace(plan, instrumentation=replace(plan.instrumentation, height_mm=20.0))
    rounds = list(investigate(record_at_20_mm, plan, sensor=sensor, rounds=2, rng=np.random.default_rng(0)))
    assert len(rounds) == 2
    found = rounds[-1].diagnosis
    assert found.combination == ("backlash",)
    assert found.recording.plan.instrumentation.height_mm == 20.0
    repaired = found.repaired.fitted_sensor(found.recording, rng=np.random.default_rng(0))
    assert repaired.instrumentation.height_mm == 16.0
    assert abs(repaired.median()["u_1"]) < 0.1


def test_scans_are_taken_whole_or_not_at_all():
    plan = scans(0, 1)
    n_first = int((plan.scan == 0).sum())
    cut = Budget(len(plan) - 1).affordable_scans(plan, 0.0)
    assert len(cut) == n_first
    assert cut.scan_names == plan.scan_names[:1]


def test_minutes_count_from_the_end_of_the_last_round():
    plan = scans(0)
    minutes = float(plan.time_s.max() + 600.0) / 60
    assert Budget(minutes=minutes + 0.01).affordable_scans(plan, -600.0) is plan
    assert Budget(minutes=minutes - 0.01).affordable_scans(plan, -600.0) is None


TAKE = SimulatedRecorder(true_world("paper"), seed=3)


class Cut(Exception):
    pass


def cut_after(n):
    def take(number, plan, asked, taken):
        for k, reading in enumerate(TAKE(number, plan, asked, taken)):
            if k == n:
                raise Cut
            yield reading

    return take


@pytest.mark.slow
def test_a_round_that_was_cut_is_the_round_that_was_not(tmp_path, monkeypatch):
    monkeypatch.setattr("probewise.investigation._KEPT_AGAIN_S", 0.0)
    whole = RoundsFolder(tmp_path / "whole", {"seed": 1}, resume=False).record_round(1, scans(0), "", take=TAKE)
    with pytest.raises(Cut):
        RoundsFolder(tmp_path / "cut", {"seed": 1}, resume=False).record_round(1, scans(0), "", take=cut_after(5))
    folder = RoundsFolder(tmp_path / "cut", {"seed": 1}, resume=True)
    assert folder.n_readings == 5
    resumed = folder.record_round(1, scans(0), "", take=TAKE)
    assert (tmp_path / "cut" / "1.csv").read_bytes() == (tmp_path / "whole" / "1.csv").read_bytes()
    np.testing.assert_array_equal(resumed.readings, whole.readings)


def test_an_instrument_that_fails_soon_loses_no_reading(tmp_path):
    folder = RoundsFolder(tmp_path / "rounds", {"seed": 1}, resume=False)
    with pytest.raises(Cut):
        folder.record_round(1, scans(0), "", take=cut_after(5))
    assert folder.n_readings == 5


def test_a_plan_that_was_written_decides(tmp_path):
    folder = RoundsFolder(tmp_path / "rounds", {"seed": 1}, resume=False)
    first = folder.record_round(1, scans(0), "", take=TAKE)
    other = scans(0).take(np.arange(3))
    np.testing.assert_array_equal(folder.record_round(1, other, "", take=TAKE).readings, first.readings)


@pytest.mark.parametrize("rows", [range(100, -1, -1), [*range(101), 5], [101, 102]], ids=["turned", "more", "scan 1"])
def test_readings_of_another_plan_than_their_round_s_are_refused(rows, tmp_path):
    folder = RoundsFolder(tmp_path / "rounds", {"seed": 1}, resume=False)
    folder.record_round(1, scans(0), "", take=TAKE)
    plan = scans(0, 1).take([*rows])
    write_recording(Recording(plan, np.full(len(plan), 20.0)), tmp_path / "rounds" / "1.csv")
    with pytest.raises(FileError, match="readings of another plan"):
        folder.record_round(1, scans(0), "", take=TAKE)


def test_two_investigations_do_not_mix(tmp_path):
    begin = partial(RoundsFolder, tmp_path / "rounds")
    with pytest.raises(FileError, match="omit --resume to begin a new one"):
        begin({"seed": 1}, resume=True)
    begin({"seed": 1}, resume=False).record_round(1, scans(0), "", take=TAKE)
    with pytest.raises(FileError, match="--resume to continue it"):
        begin({"seed": 1}, resume=False)
    with pytest.raises(FileError, match="seed 1"):
        begin({"seed": 2}, resume=True)
    with pytest.raises(FileError, match="an investigation with another plan; allowed"):
        begin({"seed": 1, "plan": "a61760525c3b"}, resume=True)
    (tmp_path / "rounds" / "settings.json").write_text("[1]")
    with pytest.raises(FileError, match="no JSON object"):
        begin({"seed": 1}, resume=True)


def test_each_round_has_noise_of_its_own():
    take = SimulatedRecorder(true_world("paper"), seed=3)
    one, other = ([r.value for r in take(number, scans(0), "", ())] for number in (1, 2))
    assert one != other


def test_what_a_world_conceals_is_read_from_its_name_and_numbers():
    assert parse_concealed("nothing") == ()
    assert parse_concealed("backlash:0.5+lag:2") == (backlash(0.5), lag(2.0))
    assert parse_concealed("saturation:55,1.5") == (saturation(55.0, 1.5),)


@pytest.mark.parametrize(
    ("text", "way_out"),
    [
        ("backlash", "backlash:width_mm"),
        ("backlash:x", "backlash:width_mm"),
        ("backlash:1,2", "backlash:width_mm"),
        ("backlash:nan", "magnitude up to 1e"),
        ("backlash:0.5+lag:1e300", "magnitude up to 1e"),
        ("bcklash:1", "did you mean backlash"),
        ("", "nothing"),
    ],
)
def test_what_is_no_effect_is_refused_with_the_way_out(text, way_out):
    with pytest.raises(ParameterError, match=way_out):
        parse_concealed(text)
